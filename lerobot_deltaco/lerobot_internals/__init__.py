"""Workarounds that rely on LeRobot's internals."""
