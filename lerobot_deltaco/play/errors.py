"""The error of the page."""


class PlayError(ValueError):
    """Something that a user asked for is not possible; the message says what is, in words for the page."""
