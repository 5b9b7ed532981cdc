"""Errors of the benchmark."""


class SimulatorMissingError(ImportError):
    """PyBullet is not installed, or does not load; the message says what to do."""
