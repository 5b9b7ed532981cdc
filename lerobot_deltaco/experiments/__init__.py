"""Experiments: the rows of the paper's tables as configuration files, and running one."""
