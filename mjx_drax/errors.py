"""The one exception that users see."""


class DraxError(ValueError):
    """Bad input or a missing capability: the message names the cause, the value and the fix."""
