"""Experiments: the rows of the paper's tables and ours as configuration files, and their execution."""
