"""How a definition refuses what is wrong in it: by an `InputError` with the path of it, before anything is computed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from jaxmpc.errors import InputError


def require(met: object, path: str, value: object, expected: str, hint: str = "") -> None:
    """Go on if a condition is met, else raise an `InputError` of these fields."""
    if not met:
        raise InputError(path, value, expected, hint)


@contextlib.contextmanager
def located(place: Callable[[str], str]) -> Iterator[None]:
    """Give errors of the typed objects that are built here the path in the definition, made from their own."""
    try:
        yield
    except InputError as error:
        raise InputError(place(error.field), error.value, error.expected, error.hint) from None
