"""Evaluations: how they are run, and the records that they write."""
