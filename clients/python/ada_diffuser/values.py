"""What callers hand over as a number, a flag, a text or a vector: checked here, once, before either face spells it.

numpy scalars and arrays of one element count as the number they hold. What the wire cannot carry is `InvalidInput` with the
name of the field, the same on both faces; whether a number is a good one is the server's business.
"""

from __future__ import annotations

import reprlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ada_diffuser.errors import Detail, InvalidInput

Floats = NDArray[np.float32]

UINT32_MAX = 2**32 - 1
UINT64_MAX = 2**64 - 1
#: Longer than any call takes, and short enough for every clock below.
SECONDS_MAX = 1e6


def invalid(field: str, message: str) -> InvalidInput:
    """The error of a wrong value; what kind of thing is wrong is said by the beginning of its path, as on the server."""
    kinds = {"observation": "OBSERVATION_INVALID", "options": "OPTIONS_INVALID"}
    return InvalidInput(Detail(message, kinds.get(field.split(".")[0], "REQUEST_INVALID"), field))


def whole(value: Any, field: str, high: int = UINT64_MAX) -> int:
    """A whole number in 0 .. `high`."""
    plain = _scalar(value, field)
    if isinstance(plain, bool) or (isinstance(plain, float) and not plain.is_integer()):
        raise invalid(field, f"{plain!r} is not a whole number")
    if not 0 <= plain <= high:
        raise invalid(field, f"{plain!r} is not in 0 .. {high}")
    return int(plain)


def number(value: Any, field: str, *, infinity: bool = False) -> float:
    """A number that is finite as float32, rounded to one; `infinity` allows that too (not its negative)."""
    plain = _scalar(value, field)
    if infinity and plain == np.inf:
        return float(plain)
    try:
        with np.errstate(over="ignore"):
            single = float(np.float32(plain))
    except OverflowError:
        single = np.inf
    if not np.isfinite(single):
        raise invalid(field, "is not a finite number")
    return single


def seconds(value: Any, field: str) -> float:
    """A time that can be waited for."""
    plain = _scalar(value, field)
    if not 0 < plain <= SECONDS_MAX:
        raise invalid(field, f"{plain!r} s is not between 0 and {SECONDS_MAX:g} s")
    return float(plain)


def flag(value: Any, field: str) -> bool:
    """True or False, or the numbers 1 and 0."""
    plain = _scalar(value, field)
    if plain not in (0, 1):
        raise invalid(field, f"{plain!r} is neither True nor False")
    return bool(plain)


def text(value: Any, field: str) -> str:
    """A string that can be sent."""
    if not isinstance(value, str):
        raise invalid(field, f"{reprlib.repr(value)} is not a string")
    if any("\ud800" <= letter <= "\udfff" for letter in value):
        raise invalid(field, f"{value!r} holds half a character")
    return value


def vector(values: ArrayLike, field: str) -> Floats:
    """A copy as a float32 vector of finite numbers."""
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "biufO":
            raise TypeError(f"{array.dtype} is not a type of numbers")
        with np.errstate(over="ignore"):
            copy: Floats = array.astype(np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise invalid(field, f"is no vector of numbers ({error})") from None
    if copy.ndim != 1:
        raise invalid(field, f"has shape {copy.shape}, which is no vector")
    (bad,) = np.nonzero(~np.isfinite(copy) | np.ma.getmaskarray(np.ma.asanyarray(values)))
    if bad.size:
        raise invalid(f"{field}[{bad[0]}]", "is not a finite number")
    return copy


def _scalar(value: Any, field: str) -> bool | int | float:
    """The one plain value that a number or an array of one element holds."""
    if type(value) in (bool, int, float):
        plain: bool | int | float = value
        return plain
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        raise invalid(field, f"{reprlib.repr(value)} is not a number") from None
    if array.size != 1:
        raise invalid(field, f"has shape {array.shape}: one number belongs here")
    held = array.reshape(-1)[0]
    held = held.item() if isinstance(held, np.generic) else held
    if np.ma.is_masked(value) or not isinstance(held, (bool, int, float, np.floating)):
        raise invalid(field, f"{reprlib.repr(value)} is not a number")
    return float(held) if isinstance(held, np.floating) else held
