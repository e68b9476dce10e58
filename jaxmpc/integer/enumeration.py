"""Closing an integer problem by listing what a level set leaves and pruning the list with quadratic cuts.

The candidates below the incumbent come from the root's lower model (`levelset`). The best few are solved in one batch; each
adds a cut (`cuts`) that bounds all others at once, so that a list of thousands is done in one or two rounds.
"""

from __future__ import annotations

import numpy as np

from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import satisfied
from jaxmpc.integer.host_search import Search, Steps
from jaxmpc.integer.lower_bound import LowerModel, enumerate_below
from jaxmpc.integer.symmetry import in_order

MOST = 20_000  # partial candidates alive at once from which the list is given up
CELLS = 600_000  # the same in single moves, for long horizons
FIRST, MOST_AT_ONCE = 2, 64  # candidates solved in the first round; later ones take twice as many
PIECE = 1024  # candidates that are judged together: a millisecond
PATIENCE = 7  # rounds of a limited list, whose cuts do not prune much if more are needed


def enumerate_all(
    search: Search,
    model: LowerModel,
    cuts: Cuts,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    limited: bool = True,
) -> Steps:
    """Close the problem over these limits; returns whether that was done.

    Args:
        search: with an incumbent.
        model: root's lower model.
        cuts: known so far; more are added.
        lower: limits of the integer moves, within the model's.
        upper: the same.
        limited: give up where the list grows beyond `MOST`, or is not done after `PATIENCE` rounds.
    """
    most = max(min(MOST, CELLS // max(len(lower), 1)), 1) if limited else None
    found = enumerate_below(
        model, search.chains, lower, upper, search.cutoff, most, check_time=search.check_time
    )
    if found is None:
        return False
    search.discard(search.cutoff)
    points, bounds, _ = found
    keep = _worth(search, points, lower, upper)
    points, bounds = points[keep], bounds[keep]
    bounds = np.maximum(bounds, cuts.bounds(points))
    rounds = 0
    while True:
        alive = bounds < search.cutoff
        if not alive.all():
            search.discard(float(bounds[~alive].min()))
        if 2 * alive.sum() <= len(points):  # copies are dear
            points, bounds = points[alive], bounds[alive]
        else:
            bounds[~alive] = np.inf
        if not len(points):
            return True
        if search.out_of_time():
            search.discard(float(bounds.min()))
            return False
        if limited and rounds == PATIENCE:
            return False
        size = min(FIRST * 2**rounds, MOST_AT_ONCE)
        chosen = _best(bounds, size)
        known = len(cuts.list)
        yield from cuts.solve(search, points[chosen], bounds[chosen])
        search.nodes += len(chosen)
        bounds[chosen] = np.inf
        bounds = np.maximum(bounds, cuts.bounds(points, known))
        rounds += 1


def _worth(search: Search, points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Which of them satisfy all that whole moves must, are in order, and have not been solved yet."""
    keep = np.zeros(len(points), dtype=bool)
    for begin in range(0, len(points), PIECE):
        search.check_time()
        some = points[begin : begin + PIECE]
        good = satisfied(search.chains, some, lower, upper) & in_order(search.chains, search.orders, some)
        good[good] = [point.tobytes() not in search.seen for point in some[good]]
        keep[begin : begin + PIECE] = good
    return keep


def _best(bounds: np.ndarray, count: int) -> np.ndarray:
    """Places of the least so many that are finite, in order."""
    chosen = np.argpartition(bounds, count - 1)[:count] if len(bounds) > count else np.arange(len(bounds))
    chosen = chosen[np.isfinite(bounds[chosen])]
    return chosen[np.argsort(bounds[chosen], kind="stable")]
