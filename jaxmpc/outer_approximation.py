"""Closing an integer problem with HiGHS: MILPs over cuts of solved problems, the master of `highs`.

Every proposal of the master is solved together with its neighbours, each giving a cut and perhaps an incumbent, until
the master's bound reaches the incumbent.
"""

from __future__ import annotations

import itertools
import time

import numpy as np

from jaxmpc.propagation import satisfied
from jaxmpc.search import SINGLE, Relaxations, Search


def _cut_of(search: Search, result: Relaxations, lane: int, lower, upper):
    """Cut of R, the problem without the integer moves' own weight: value at `at`, and gradient."""
    c = search.constants
    at = result.x[lane, c.integer]
    gradient = result.gradient[lane, c.integer].copy()
    # undo the box of the integers that the bound minimised over, and the linearised own weight
    value = result.bound[lane] - np.minimum(gradient * (lower - at), gradient * (upper - at)).sum()
    if c.levels:
        price = result.envelope[lane].reshape(c.levels, -1)
        knot = c.knot.reshape(c.levels, -1)
        value -= (price * at - knot * np.abs(price)).sum()
        gradient -= price.sum(axis=0)
    return float(value), at, gradient


def outer_approximation(search: Search, lower, upper, seconds: float | None) -> tuple[bool, float]:
    """Close the reduced problem with MILPs over cuts; returns whether it is closed, and the bound reached."""
    from jaxmpc.highs import ReducedMilp  # HiGHS is loaded when it is first needed

    c = search.constants
    limit = None if seconds is None else time.perf_counter() + seconds
    width = int((upper - lower).max(initial=0)) + 1
    values = lower[:, None] + np.arange(width)[None, :]
    own = c.own_weight[:, None] * values.astype(float) ** 2
    master = ReducedMilp(
        search.chains, lower, upper, own, unit=search.reference if np.isfinite(search.value) else c.scale
    )
    wide = search.relax(lower[None], upper[None])
    search.nodes += 1
    master.add_cut(*_cut_of(search, wide, 0, lower, upper))
    if search.x is not None:
        here = np.round(search.x[c.integer]).astype(int)
        neighbourhood = _neighbours(search, here, lower, upper)
        result = search.evaluate(neighbourhood)
        for i, point in enumerate(neighbourhood):
            master.add_cut(*_cut_of(search, result, i, point, point))
    best_bound = max(float(wide.bound[0]), 0.0)
    while True:
        left = None if limit is None else limit - time.perf_counter()
        if left is not None and left <= 0:
            return False, best_bound
        bound, point, finished = master.solve(left)
        best_bound = max(best_bound, min(bound, search.value))
        if bound >= search.cutoff:
            return True, best_bound
        if point is None or not finished:
            return False, best_bound
        search.nodes += 1
        if point.tobytes() in search.seen:
            master.forbid(point)  # solved before: its value is known, only what is left matters
            continue
        neighbourhood = _neighbours(search, point, lower, upper)
        result = search.evaluate(neighbourhood)
        for i, other in enumerate(neighbourhood):
            master.add_cut(*_cut_of(search, result, i, other, other))
        master.forbid(point)


def _neighbours(search: Search, point: np.ndarray, lower, upper) -> np.ndarray:
    """The point and feasible points one step away, as many as one batch holds."""
    points = [point]
    for i in np.flatnonzero(upper > lower):
        for step in (-1, 1):
            other = point.copy()
            other[i] += step
            points.append(other)
    # a step moved from one block to the next keeps later positions
    free = np.flatnonzero(upper > lower)
    for i, j in itertools.pairwise(free):
        for step in (-1, 1):
            other = point.copy()
            other[i] += step
            other[j] -= step
            points.append(other)
    array = np.array(points)
    good = satisfied(search.chains, array, lower, upper)
    new = np.array([p.tobytes() not in search.seen for p in array])
    keep = good & new
    keep[0] = True
    return array[keep][: SINGLE - 1]
