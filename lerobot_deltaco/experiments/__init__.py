"""Experiments: recipes that collect, train, evaluate and report."""
