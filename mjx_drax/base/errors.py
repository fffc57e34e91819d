"""The exception that users see, the warning, and the words that many of their messages share.

To complain is to raise a DraxError that names what it is about, its value and the fix.
"""

from __future__ import annotations

import math
import re
from numbers import Integral, Real


class DraxError(ValueError):
    """Bad input or a missing capability: the message names the cause, the value and the fix."""


class DraxWarning(UserWarning):
    """The answer will be less good than it could be: the message names the cause and the fix."""


def shown(value: object, width: int = 80) -> str:
    """A value as a message shows it: on one line, and cut where it is long."""
    try:
        text = re.sub(r" at 0x[0-9a-f]+", "", " ".join(repr(value).split()))
    except Exception:  # what cannot even be shown is named by its type
        text = f"an object of type {type(value).__name__}"
    return cut(text, width)


def cut(text: str, width: int = 160) -> str:
    """A text, its middle left out where it is long: paths end with what they are about."""
    end = width // 2 - 3
    return text if len(text) <= width else f"{text[: width - 5 - end]} ... {text[-end:]}"


def reason(error: BaseException) -> str:
    """What an exception says, in one line, with its type."""
    lines = str(error).strip().splitlines()
    text = f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__
    return cut(text)


def is_number(value: object) -> bool:
    """Whether a value is one finite number; truth values are none."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


def require_whole(name: str, value: object, least: int = 1) -> None:
    """Complain about what is not a whole number of at least so much."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise DraxError(f"{name} is {shown(value)}: give a whole number of at least {least}.")


def require_positive(name: str, value: object, what: str = "a positive number") -> None:
    """Complain about what is not a positive, finite number."""
    if not is_number(value) or value <= 0:  # type: ignore[operator]
        raise DraxError(f"{name} is {shown(value)}: give {what}.")


def require_not_negative(name: str, value: object) -> None:
    """Complain about what is not a finite number of at least 0."""
    if not is_number(value) or value < 0:  # type: ignore[operator]
        raise DraxError(f"{name} is {shown(value)}: give a number of at least 0.")


def require_part(name: str, value: object, method: str, example: str) -> None:
    """Complain about what is no object with such a method, as parts of a solver are."""
    if isinstance(value, type):
        raise DraxError(f"{name} is a class: give an object, {value.__name__}().")
    if not callable(getattr(value, method, None)):
        raise DraxError(f"{name} is {shown(value)}: give an object, such as {example}.")
