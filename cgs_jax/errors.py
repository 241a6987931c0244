"""The one exception for a user's mistake."""


class InputError(ValueError):
    """Wrong input. The message is one line: what is wrong, what was expected, what is available."""
