"""Evaluations: how they are run, what is recorded of them, and what is reported."""
