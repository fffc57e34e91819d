"""The exception that users see, and the warning."""


class DraxError(ValueError):
    """Bad input or a missing capability: the message names the cause, the value and the fix."""


class DraxWarning(UserWarning):
    """The answer will be less good than it could be: the message names the cause and the fix."""
