"""Lists of allowed values of an integer MV: their common step, checks, and where a value stands among them.

An uneven list is a grid of the greatest common step with positions left out: whole moves on the grid, and a set of positions
that are allowed. An evenly spaced list leaves nothing out, and is its step and two limits.
"""

from __future__ import annotations

import functools
import itertools
import math
from decimal import Decimal
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxmpc.check import LARGEST, is_number
from jaxmpc.errors import InputError

MOST = 5000  # points of the grid of a list: ranges of whole moves are listed
DIGITS = 12  # of a value that count
EVEN = 1e-9  # relative difference of distances that count as equal


def checked_values(path: str, given: Any) -> tuple[float, ...]:
    """A list of allowed values, increasing.

    Raises:
        InputError: naming the path, for what is no such list, and for lists whose grid has more than `MOST` points.
    """
    expected = "two or more numbers, increasing [MV unit]"
    if isinstance(given, str) or np.ndim(given) != 1 or len(given) < 2:
        raise InputError(path, given, expected)
    for k, value in enumerate(given):
        if not is_number(value) or abs(value) > LARGEST:
            raise InputError(f"{path}[{k}]", value, "a finite number [MV unit]")
        if k and value <= given[k - 1]:
            raise InputError(
                f"{path}[{k}]", value, f"more than {given[k - 1]:g}, the value before it [MV unit]"
            )
    values = tuple(float(value) for value in given)
    step = spacing(values)
    points = (values[-1] - values[0]) / step + 1.0 if step > 0.0 else math.inf
    if points > MOST + 0.5:
        raise InputError(
            path,
            list(given),
            f"values that are whole steps of {(values[-1] - values[0]) / (MOST - 1):.3g} or more apart [MV unit], so that "
            f"their grid has {MOST} points at most; the common step of these is {step:.3g}",
            "Round the values to what the actuator resolves",
        )
    return values


@functools.lru_cache(maxsize=256)
def spacing(values: tuple[float, ...]) -> float:
    """The greatest step of which all differences are whole numbers [MV unit]; the distance of evenly spaced values."""
    apart = np.diff(values)
    mean = (values[-1] - values[0]) / len(apart)
    if np.ptp(apart) <= EVEN * mean and len(apart) > 1:
        return float(mean)
    decimals = [Decimal(f"{value:.{DIGITS}g}") for value in values]
    digits = max(max(-int(d.as_tuple().exponent), 0) for d in decimals)
    whole = [int(d.scaleb(digits)) for d in decimals]
    return float(Decimal(math.gcd(*(b - a for a, b in itertools.pairwise(whole)))).scaleb(-digits))


@functools.lru_cache(maxsize=256)
def positions(values: tuple[float, ...]) -> Int[np.ndarray, " value"]:
    """The values in steps of their `spacing` from the first."""
    found = np.round((np.array(values) - values[0]) / spacing(values)).astype(int)
    found.setflags(write=False)
    return found


def has_gaps(values: tuple[float, ...]) -> bool:
    """Whether the grid of a list has points that the list leaves out."""
    return int(positions(values)[-1]) + 1 > len(values)


def neighbours(values: tuple[float, ...], value: float) -> tuple[float, ...]:
    """The allowed values next to a value: one below and one above, as far as there are."""
    below = [v for v in values if v <= value][-1:]
    return (*below, *[v for v in values if v > value][:1])
