"""The error of a user's mistake."""


class UserError(ValueError):
    """A mistake in what was asked for, which the message explains: what was wrong, what was given, what to do.

    The command line prints it as one line. Any other exception is a fault of this library, or of a user's own code, and
    is shown with its traceback.
    """
