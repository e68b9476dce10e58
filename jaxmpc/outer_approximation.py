"""Closing an integer problem with HiGHS: MILPs over cuts of solved problems, the master of `highs`.

Part of the curvature of the cuts is separable and goes into the master's binaries exactly: with 0 <= D <= S diagonal on the
moves still free, R(d) - 1/2 d'D d is convex and is what the linear cuts bound. Every proposal of the master is solved
together with the neighbours that the cuts leave cheapest, each giving a cut and perhaps an incumbent, until the master
finds nothing below the incumbent.
"""

from __future__ import annotations

import itertools

import numpy as np

from jaxmpc.cuts import Cuts
from jaxmpc.propagation import satisfied
from jaxmpc.search import GROUP, Offload, Search, Steps


def outer_approximation(search: Search, cuts: Cuts, lower, upper, seconds: float | None) -> Steps:
    """Close the reduced problem with MILPs over cuts; returns whether it is closed, and the bound reached.

    Args:
        search: state of the solve.
        cuts: known so far; more are added.
        lower: limits of the integer moves, equal where a move is fixed.
        upper: the same.
        seconds: time limit from here on, None for none.
    """
    from jaxmpc.highs import ReducedMilp  # HiGHS is loaded when it is first needed

    c = search.constants
    limit = None if seconds is None else search.spent + seconds
    free = np.flatnonzero(upper > lower)
    diagonal = np.zeros(len(lower))
    diagonal[free] = diagonal_share(c.schur[np.ix_(free, free)])
    width = int((upper - lower).max(initial=0)) + 1
    values = lower[:, None] + np.arange(width)[None, :]
    own = (c.own_weight + 0.5 * diagonal)[:, None] * values.astype(float) ** 2
    unit = search.reference if np.isfinite(search.value) else c.scale
    master = ReducedMilp(search.chains, lower, upper, own, unit=unit)
    wide = yield from search.relax(lower[None], upper[None])
    search.nodes += 1
    cuts.add(wide, 0, lower, upper)
    best_bound = max(float(wide.bound[0]), 0.0)
    if best_bound >= search.cutoff:
        return True, best_bound
    told = 0
    while True:
        for cut in cuts.list[told:]:
            master.add_cut(*_linear_cut(c.schur, cut, diagonal, free, lower))
        told = len(cuts.list)
        left = None if limit is None else limit - search.spent
        if left is not None and left <= 0:
            return False, best_bound
        master.set_cutoff(search.cutoff)
        bound, point, finished = yield Offload(lambda left=left: master.solve(left))
        best_bound = max(best_bound, min(bound, search.value))
        if bound >= search.cutoff:
            search.discard(search.cutoff)
            return True, best_bound
        if point is None or not finished:
            return False, best_bound
        search.nodes += 1
        if point.tobytes() in search.seen:
            master.forbid(point)  # solved before: its value is known, only what is left matters
            continue
        neighbourhood = _neighbours(search, cuts, point, lower, upper)
        result = yield from search.evaluate(neighbourhood)
        for lane, other in enumerate(neighbourhood):
            cuts.add(result, lane, other, other)
        master.forbid(point)


def diagonal_share(curvature: np.ndarray) -> np.ndarray:
    """Diagonal D with 0 <= D <= `curvature`: the scaled diagonal, as large as the least eigenvalue lets it be."""
    if not len(curvature):
        return np.zeros(0)
    scale = np.sqrt(np.maximum(np.diag(curvature), 0.0))
    if not (scale > 0.0).all():
        return np.zeros(len(curvature))
    least = np.linalg.eigvalsh(curvature / np.outer(scale, scale))[0]
    return max(least - 1e-9, 0.0) * scale**2


def _linear_cut(schur, cut, diagonal, free, lower) -> tuple[float, np.ndarray, np.ndarray]:
    """The cut of R - 1/2 d'D d over the free moves, the others being fixed at `lower`."""
    value, at, gradient = cut
    away = lower - at
    away[free] = 0.0
    bent = schur @ away
    value = value + gradient @ away + 0.5 * away @ bent
    slope = gradient + bent
    place = at + away
    return value - 0.5 * diagonal @ place**2, place, slope - diagonal * place


def _neighbours(search: Search, cuts: Cuts, point: np.ndarray, lower, upper) -> np.ndarray:
    """The point and feasible points one or two steps away, those with the least bound, as many as one batch holds."""
    free = np.flatnonzero(upper > lower)
    steps = []
    for i in free:
        for step in (-1, 1):
            other = np.zeros_like(point)
            other[i] = step
            steps.append(other)
    for i, j in itertools.combinations(free, 2):  # a step moved from one block to another
        for step in (-1, 1):
            other = np.zeros_like(point)
            other[i], other[j] = step, -step
            steps.append(other)
    array = point + np.array(steps).reshape(len(steps), len(point))
    keep = satisfied(search.chains, array, lower, upper)
    keep &= np.array([p.tobytes() not in search.seen for p in array], dtype=bool)
    array = array[keep]
    bounds = cuts.bounds(array)
    best = np.argsort(bounds, kind="stable")
    best = best[bounds[best] < search.cutoff][: GROUP - 1]
    return np.concatenate([point[None], array[best]])
