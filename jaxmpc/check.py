"""Checks of values that come from outside."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jaxmpc.errors import InputError

LARGEST = 1e30  # size of a number from which on it cannot be meant, and products of squares overflow


def check_vector(path: str, value: ArrayLike, names: tuple[str, ...], unit: str) -> np.ndarray:
    """A finite vector with one entry per name, or an `InputError`."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (len(names),) or not sound(array).all():
        raise InputError(
            path,
            np.asarray(value).tolist(),
            f"{len(names)} finite numbers of size {LARGEST:g} at most [{unit}] for {', '.join(names)}",
        )
    return array


def sound(values: np.ndarray) -> np.ndarray:
    """Which numbers are finite and not beyond `LARGEST`."""
    return np.abs(values) <= LARGEST
