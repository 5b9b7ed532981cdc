"""The error of the project that is written for its users."""


class UserError(ValueError):
    """Raised for what a user can change. The message says what was wrong, what is valid and what to do.

    The command `deltaco` prints its message in one line. Any other error is a fault of the program, and keeps
    its traceback.
    """
