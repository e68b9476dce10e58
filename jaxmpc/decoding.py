"""Typed data from what a JSON or TOML file holds: strict, with the full path of whatever is wrong.

The one-step file and the study definitions are msgspec types; this is where they are filled in.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

from jaxmpc.errors import InputError, near

T = TypeVar("T")
WORDS = {"float": "a number", "int": "a whole number", "str": "text in quotes", "array": "a list"}


class _Nothing:
    def __repr__(self):
        return "nothing"


def decode(
    body: Any,
    kind: type[T],
    path: str = "",
    *,
    name: str = "",
    table: str = "a table",
    expected: Callable[[str, str], str] = lambda _, words: words,
) -> T:
    """The typed data, or an `InputError` with the path of what does not fit.

    Args:
        body: nested dictionaries and lists.
        kind: a `msgspec.Struct`.
        path: of `body` in its file, for errors.
        name: of the whole, where its path is empty.
        table: what the file calls an object with fields.
        expected: from a path without positions and what its type asks for to what an error says; adds units.
    """
    try:
        return msgspec.convert(body, kind)
    except msgspec.ValidationError as error:
        message, _, where = str(error).partition(" - at `$")
        value, struct = body, kind
        for key, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", where.rstrip("`")):
            value = value[key] if key else value[int(index)]
            path = _below(path, key) if key else f"{path}[{index}]"
            struct = _fields(struct)[key] if key else struct
        if isinstance(refused := error.__cause__, InputError):  # by the type itself
            at = _below(path, refused.field)
            raise InputError(at, refused.value, refused.expected, refused.hint) from None
        told = lambda at, words: expected(re.sub(r"\[\d+\]", "", at), words)  # noqa: E731
        if found := re.search(r"unknown field `(.*)`", message):
            names = list(_fields(struct))
            listed = f"no such field, only {', '.join(names)}"
            raise InputError(_below(path, found[1]), value[found[1]], listed, near(found[1], names)) from None
        if found := re.search(r"missing required field `(.*)`", message):
            path = _below(path, found[1])
            raise InputError(path, _Nothing(), told(path, "a value") + " (the field is missing)") from None
        words = "a finite number" if "out of range" in message else message[0].lower() + message[1:]
        if found := re.match(r"Expected `(\w+)( \| null)?", message):
            words = (WORDS | {"object": table}).get(found[1], words)
            words += " (or null for none)" if found[2] and found[1] == "float" else ""
        raise InputError(path or name, value, told(path, words)) from None


def _below(path: str, key: str) -> str:
    return ".".join(filter(None, [path, key or '""']))


def _fields(kind: Any) -> dict[str, Any]:
    """Names in the file and types of the fields of a type; of the struct within it, if it is a list or a choice."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return {field.encode_name: field.type for field in msgspec.structs.fields(kind)}
    return next(filter(None, map(_fields, typing.get_args(kind))), {})
