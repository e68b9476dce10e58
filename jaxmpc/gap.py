"""What a certificate says: the gap between a plan's objective and the bound that no plan is below."""

from __future__ import annotations

from typing import Any

import numpy as np

FINEST = 1e-9  # smallest relative gap that is asked for; round-off is below it
SMALLEST = 1e-6  # of the problem's scale: objectives below are taken for zero


def closes(value: Any, bound: Any, scale: Any, gap: Any) -> Any:
    """Whether a plan is optimal to a relative gap; arrays of NumPy or JAX, or numbers.

    Args:
        value: objective of the plan, infinite without one.
        bound: no plan is below.
        scale: of the problem, its largest curvature per move; gaps of plans that cost next to nothing are relative to a
            small share of it.
        gap: relative gap; taken as `FINEST` where it is smaller.
    """
    difference, size, least = value - bound, abs(value), SMALLEST * scale
    near = (difference <= gap * size) | (difference <= gap * least)
    near |= (difference <= FINEST * size) | (difference <= FINEST * least)
    return near & (difference < np.inf)


def relative_gap(value: Any, bound: Any, scale: Any) -> Any:
    """Gap of plans relative to their objectives, see `closes`; NaN without a plan."""
    with np.errstate(invalid="ignore"):
        return np.maximum(value - bound, 0.0) / np.maximum(np.abs(value), SMALLEST * scale)
