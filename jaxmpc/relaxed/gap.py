"""What a certificate says: the gap between a plan's objective and the bound that no plan is below."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.errors import InputError

FINEST = 1e-9  # smallest relative gap that is asked for; round-off is below it
SMALLEST = 1e-6  # of the problem's scale: objectives below are taken for zero


def _module(value: Any) -> Any:
    return jnp if isinstance(value, jax.Array) else np


def reference(value: Any, scale: Any) -> Any:
    """What gaps are relative to: the objective, or a small share of the problem's scale where that costs next to nothing.

    Args:
        value: objective, of NumPy or JAX, or a number.
        scale: of the problem, its largest curvature per move.
    """
    return _module(value).maximum(abs(value), SMALLEST * scale)


def closes(value: Any, bound: Any, scale: Any, gap: Any) -> Any:
    """Whether a plan is optimal to a relative gap; arrays of NumPy or JAX, or numbers.

    Args:
        value: objective of the plan, infinite without one.
        bound: no plan is below.
        scale: see `reference`.
        gap: relative gap; taken as `FINEST` where it is smaller.
    """
    difference, size = value - bound, reference(value, scale)
    return ((difference <= gap * size) | (difference <= FINEST * size)) & (difference < np.inf)


def cutoff(value: Any, scale: Any, gap: Any) -> Any:
    """Bounds from here on cannot improve on a plan by more than the gap; arguments as for `closes`."""
    return value - 0.5 * gap * reference(value, scale)


def relative_gap(value: Any, bound: Any, scale: Any) -> Any:
    """Gap of plans relative to their objectives, see `closes`; NaN without a plan."""
    with np.errstate(invalid="ignore"):
        return _module(value).maximum(value - bound, 0.0) / reference(value, scale)


def check_gap(path: str, gap: Any) -> float:
    """A relative gap at which a plan may count as optimal, or an `InputError` that names `path`."""
    if isinstance(gap, bool) or not isinstance(gap, (int, float, np.number)) or not 0 <= gap <= 1:
        raise InputError(path, gap, "a relative gap from 0 to 1")
    return float(gap)


def check_time_limit(path: str, seconds: Any) -> float | None:
    """A limit of the time of a solve [s], None for none, or an `InputError` that names `path`."""
    if seconds is None:
        return None
    number = isinstance(seconds, (int, float, np.number)) and not isinstance(seconds, bool)
    if not number or not 0 <= seconds < np.inf:
        raise InputError(path, seconds, "a finite time, 0 or more [s], or null (None) for no limit")
    return float(seconds)
