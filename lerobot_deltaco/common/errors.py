"""Errors that any command may end with."""


class UnsupportedSystemError(ImportError):
    """The operating system lacks something that is needed; the message says what."""
