"""What callers hand over, as it travels: checked once, before either face, so that both take and refuse the same.

numpy scalars and arrays of one element are numbers here. What is refused raises `InvalidInput` with the name of the field and
the reason that the server gives for such a field.
"""

from __future__ import annotations

import reprlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ada_diffuser.errors import Detail, InvalidInput

Floats = NDArray[np.float32]


def invalid(field: str, why: str) -> InvalidInput:
    """The error of a wrong `field`."""
    reasons = {"observation": "OBSERVATION_INVALID", "options": "OPTIONS_INVALID"}
    return InvalidInput(Detail(why, reasons.get(field.split(".")[0], "REQUEST_INVALID"), field))


def vector(values: ArrayLike, field: str) -> Floats:
    """A float32 vector, `(n,)`, all finite: JSON could not spell NaN."""
    numbers = _float32(_numbers(values, field), field)
    if numbers.ndim != 1:
        raise invalid(field, f"has {numbers.ndim} dimensions instead of 1")
    (bad,) = np.nonzero(~np.isfinite(numbers))
    if bad.size:
        raise invalid(f"{field}[{bad[0]}]", "is not a finite number")
    return numbers


def matrix(values: ArrayLike, field: str) -> Floats:
    """A float32 matrix, `(rows, n)`, all finite; a vector is a row."""
    numbers = _float32(_numbers(values, field), field)
    if numbers.ndim not in (1, 2):
        raise invalid(field, f"has {numbers.ndim} dimensions instead of 2")
    rows = numbers.reshape(-1, numbers.shape[-1]) if numbers.ndim == 2 else numbers[None]
    bad = np.argwhere(~np.isfinite(rows))
    if bad.size:
        raise invalid(f"{field}[{bad[0][0]}][{bad[0][1]}]", "is not a finite number")
    return rows


def column(values: ArrayLike, field: str) -> NDArray[Any]:
    """Numbers one below the other, `(n,)`: one alone, a vector, or a matrix of one column."""
    numbers = np.atleast_1d(_numbers(values, field))
    if numbers.size != len(numbers):
        raise invalid(field, f"is of shape {numbers.shape}: one number, or a vector of them, is expected")
    return numbers.reshape(-1)


def number(value: Any, field: str, *, infinity: bool = False) -> float:
    """A number that float32 can hold, rounded to it; infinite only if `infinity` allows it."""
    given = _single(_numbers(value, field), field)
    one = float(_float32(given, field))
    if not (np.isfinite(one) or (infinity and one == float(given) == np.inf)):
        raise invalid(field, "is not a finite number")
    return one


def whole(value: Any, field: str, bits: int = 64) -> int:
    """A whole number in `0 .. 2^bits - 1`. 7.0 and True are none."""
    one = _single(_array(value, field), field).item()
    if not isinstance(one, int) or isinstance(one, bool):
        raise invalid(field, f"{reprlib.repr(value)} is no whole number")
    if not 0 <= one < 1 << bits:
        raise invalid(field, f"{one} is not in 0 .. 2^{bits} - 1")
    return one


def whole_if_given(value: Any, field: str, bits: int = 64) -> int | None:
    """The same, or None."""
    return None if value is None else whole(value, field, bits)


def flag(value: Any, field: str) -> bool:
    """True or False; 0 and 1 are neither."""
    one = _single(_array(value, field), field).item()
    if not isinstance(one, bool):
        raise invalid(field, f"{reprlib.repr(value)} is neither True nor False")
    return one


def text(value: Any, field: str) -> str:
    """A text that UTF-8 can spell."""
    if not isinstance(value, str):
        raise invalid(field, f"{reprlib.repr(value)} is no text")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise invalid(field, f"{value!r} is not valid Unicode") from None
    return str(value)


def _array(values: Any, field: str) -> NDArray[Any]:
    """As numpy sees it, but for masks, which it would drop in silence."""
    if np.ma.is_masked(values):
        raise invalid(field, "has masked values: fill them first")
    try:
        return np.asarray(values)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise invalid(field, f"is no array of numbers ({error})") from None


def _numbers(values: Any, field: str) -> NDArray[Any]:
    """What may be numbers: texts, dates and imaginary parts are not made some in silence."""
    array = _array(values, field)
    if array.dtype.kind in "cUSMm":
        raise invalid(field, f"{reprlib.repr(values)} holds values of type {array.dtype.name} instead of numbers")
    return array


def _single(array: NDArray[Any], field: str) -> NDArray[Any]:
    if array.size != 1:
        raise invalid(field, f"is of shape {array.shape}: one value is expected")
    return array.reshape(())


def _float32(array: NDArray[Any], field: str) -> Floats:
    try:
        with np.errstate(over="ignore"):
            return array.astype(np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise invalid(field, f"is no array of numbers ({error})") from None
