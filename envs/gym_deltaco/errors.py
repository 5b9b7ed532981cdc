"""Errors of the benchmark."""


class SimulatorMissingError(ImportError):
    """PyBullet is not installed; the message says how to install it."""
