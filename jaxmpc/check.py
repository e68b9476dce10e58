"""Checks of values that come from outside."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Container, Iterable, Iterator
from typing import Any

import numpy as np

from jaxmpc.errors import InputError, near

LARGEST = 1e30  # size of a number from which on it cannot be meant, and products of squares overflow


def is_number(value: Any) -> bool:
    """Whether it is a finite number; true and false are none."""
    number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    return number and bool(-np.inf < value < np.inf)


def is_count(value: Any) -> bool:
    """Whether it is a whole number, 1 or more."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 1)


def as_floats(path: str, value: Any, expected: str) -> np.ndarray:
    """A copy as an array of floats, or an `InputError`."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(path, value, expected) from None


def check_keys(path: str, body: Container, keys: Iterable[str]) -> None:
    """Refuse a JSON object without one of the keys."""
    for key in keys:
        if key not in body:
            raise InputError(f"{path}.{key}", "nothing", "a value (the key is missing)")


def sound(values: np.ndarray) -> np.ndarray:
    """Which numbers are finite and not beyond `LARGEST`."""
    return np.abs(values) <= LARGEST


def require(met: object, path: str, value: object, expected: str, hint: str = "") -> None:
    """Go on if a condition is met, else raise an `InputError` of these fields."""
    if not met:
        raise InputError(path, value, expected, hint)


def among(path: str, name: Any, known: Iterable[str], expected: str = "one of", *given: Any) -> None:
    """Refuse a name that is not known; the known ones follow what is expected, and close ones are the hint.

    Args:
        given: the value that is shown, where that is not the name.
    """
    known = list(known)
    if name not in known:
        raise InputError(path, (*given, name)[0], f"{expected} {', '.join(known)}", near(name, known))


@contextlib.contextmanager
def located(place: Callable[[str], str]) -> Iterator[None]:
    """Give errors of the typed objects that are built here the path in the definition, made from their own."""
    try:
        yield
    except InputError as error:
        raise InputError(place(error.field), error.value, error.expected, error.hint) from None
