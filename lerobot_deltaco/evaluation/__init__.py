"""Evaluation on the benchmark: episodes, checkpoints, records and videos."""
