"""Tables of a TOML file, read key by key: what is wrong, missing or left over is named."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, TypeVar, get_args, get_origin

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

T = TypeVar("T")

_KINDS = {int: "a whole number", float: "a number", str: "text", bool: "true or false", list: "a list", dict: "a table", object: "a value"}
_NEEDED: Any = object()


def loads(text: str) -> dict[str, Any]:
    """A TOML document. ValueError says where it is wrong."""
    return tomllib.loads(text)


class Table:
    """What is left of a table, and where it stands in the file."""

    def __init__(self, values: Mapping[str, Any], path: str = "") -> None:
        self._left, self.path, self._known = dict(values), path, list[str]()

    def take(self, key: str, kind: Any, default: T = _NEEDED) -> T:
        """The value of a key, `list[int]` and the like too; ValueError where it is another kind, or needed and not there."""
        self._known.append(key)
        if key not in self._left:
            if default is _NEEDED:
                raise self.wrong(key, f"is missing: {_told(kind)} is needed")
            return default
        value: Any = self._left.pop(key)
        if not _fits(value, kind):
            raise self.wrong(key, f"must be {_told(kind)}, not {value!r}")
        return value

    def tables(self, key: str, *, needed: bool = True) -> dict[str, Table]:
        """The tables of a table, by name, in the order of the file."""
        values: dict[str, Any] = self.take(key, dict, _NEEDED if needed else {})
        for name, value in values.items():
            if not isinstance(value, dict):
                raise self.wrong(f"{key}.{name}", f"must be a table, not {value!r}")
        return {name: Table(value, f"{self._at(key)}.{name}") for name, value in values.items()}

    def rest(self) -> dict[str, Any]:
        """All that is left, and nothing more is."""
        values, self._left = self._left, {}
        return values

    def end(self) -> None:
        """ValueError naming the keys that nobody took."""
        for key in self._left:
            raise self.wrong(key, f"is no key here; there are {', '.join(self._known)}")

    def wrong(self, key: str, what: str) -> ValueError:
        return ValueError(f"{self._at(key)} {what}")

    def _at(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key


def _fits(value: Any, kind: Any) -> bool:
    if get_origin(kind) is list:
        return isinstance(value, list) and all(_fits(one, get_args(kind)[0]) for one in value)
    if kind in (int, float) and isinstance(value, bool):
        return False
    return isinstance(value, (int, float) if kind is float else kind)


def _told(kind: Any) -> str:
    if get_origin(kind) is list:
        return f"a list, each {_KINDS[get_args(kind)[0]]}"
    return _KINDS[kind]
