"""What one controller step is given, checked: vectors and matrices, MVs where a single step can start, and past moves.

`jaxmpc plan` (`case`) and `solve_plan` check with it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxmpc.check import LARGEST, is_count, sound
from jaxmpc.errors import InputError
from jaxmpc.problem.instance import DRIFT
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.problem.values import neighbours

ARRAYS = {  # unit, names of the columns, number of rows and what that is
    "mv_now": ("MV unit", "mv_names", "", ""),
    "last_move": ("MV unit", "mv_names", "", ""),
    "free_response": ("CV unit", "cv_names", "prediction_horizon", "prediction_horizon"),
    "setpoint": ("CV unit", "cv_names", "prediction_horizon", "prediction_horizon"),
    "previous_moves": ("MV unit per sample", "mv_names", "block_count", "the number of blocks"),
}


def step_array(path: str, given: Any, structure: Structure) -> Any:
    """A finite vector with one entry per name, or a matrix of such rows, as many as it must have; None as it is."""
    if given is None:
        return None
    given = np.asarray(given) if hasattr(given, "shape") else given
    unit, columns, count, why = ARRAYS[path]
    names = getattr(structure, columns)
    numbers = f"{len(names)} numbers [{unit}]"
    if count and len(given) != getattr(structure, count):
        expected = f"{why} = {getattr(structure, count)} rows of {numbers}"
        raise InputError(path, f"{len(given)} rows", expected)
    for i, row in enumerate(given if count else [given]):
        if np.size(row) != len(names):
            raise InputError(f"{path}[{i}]" if count else path, row, f"{numbers} for {', '.join(names)}")
    array = np.array(given, dtype=np.float64)
    bad = np.argwhere(~sound(array))
    if len(bad):
        index = "".join(f"[{i}]" for i in bad[0])
        expected = f"a finite number of size {LARGEST:g} at most [{unit}]"
        raise InputError(path + index, float(array[tuple(bad[0])]), expected)
    array.setflags(write=False)
    return array


def check_position(structure: Structure, tuning: Tuning, mv_now: np.ndarray) -> None:
    """Refuse MVs outside their limits or off their lists: the closed-loop controller recovers, a single step cannot."""
    low, high = np.asarray(tuning.mv_low), np.asarray(tuning.mv_high)
    for i, name in enumerate(structure.mv_names):
        now = float(mv_now[i])
        drift = DRIFT * (structure.steps[i] or max(1.0, abs(now)))  # what MIP solvers leave over
        if not low[i] - drift <= now <= high[i] + drift:
            expected = f"mv_low[{i}] = {low[i]:g} to mv_high[{i}] = {high[i]:g} [MV unit] for {name}"
            raise InputError(f"mv_now[{i}]", now, expected)
    check_listed(structure, mv_now)


def check_listed(structure: Structure, mv_now: np.ndarray) -> None:
    """Refuse MVs that are not on one of their allowed values."""
    for i, (name, values) in enumerate(zip(structure.mv_names, structure.integer_values, strict=False)):
        now, drift = float(mv_now[i]), DRIFT * (structure.steps[i] or 1.0)
        if values is not None and min(abs(now - value) for value in values) > drift:
            near = " or ".join(f"{value:g}" for value in neighbours(values, now))
            expected = f"a value of structure.integer_values.{name}, the nearest being {near} [MV unit]"
            raise InputError(f"mv_now[{i}]", now, expected)


def checked_since(structure: Structure, given: Any) -> tuple[int | None, ...] | None:
    """Samples since the last move of every MV, None for long ago; None as it is."""
    if given is None:
        return None
    names = ", ".join(structure.mv_names)
    if np.ndim(given) != 1 or len(given) != structure.mv_count:
        expected = f"{structure.mv_count} whole numbers [samples], null (None) for long ago, for {names}"
        raise InputError("samples_since_move", given, expected)
    for i, samples in enumerate(given):
        if samples is not None and not is_count(samples):
            expected = "a whole number of samples, 1 or more, or null (None) for long ago"
            raise InputError(f"samples_since_move[{i}]", samples, expected)
    return tuple(None if samples is None else int(samples) for samples in given)
