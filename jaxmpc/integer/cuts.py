"""Quadratic cuts: what problems solved at whole moves prove about all other whole moves.

The problem over whole moves d is V(d) = own(d) + R(d), own the integer moves' own weight and R convex. Its quadratic
part keeps the curvature S once the continuous moves are minimised out, so the prices of a solved problem at d_k give

    R(d) >= R_k + g_k'(d - d_k) + 1/2 (d - d_k)' S (d - d_k)

everywhere: the cut of outer approximation (Duran and Grossmann 1986) with the curvature kept. The few cuts at the
best candidates of a level set close nearly every step of the thesis's controller.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from jaxmpc.integer.host_search import Search, Steps
from jaxmpc.integer.relaxer import Relaxations
from jaxmpc.integer.tables import Constants

AT_ONCE = 1_000_000  # pairs of a point and a cut that are held against each other in one product


def cut_of(constants: Constants, result: Relaxations, lane: int, lower, upper):
    """Value, place and gradient of R as one solved lane proves them.

    Args:
        constants: of the scenario.
        result: solved lanes.
        lane: which of them.
        lower: integer limits the lane was solved with.
        upper: the same.
    """
    c = constants
    at = result.x[lane, c.integer]
    gradient = result.gradient[lane, c.integer]
    # undo the box of the integers that the bound minimised over, and the linearised own weight
    value = result.bound[lane] - np.minimum(gradient * (lower - at), gradient * (upper - at)).sum()
    price = result.envelope[lane][:, c.integer]
    value -= (price * at - c.knot * np.abs(price)).sum()
    more, bend = c.of_chords(result.position[lane], at)
    return float(value + more), at, gradient - price.sum(axis=0) + bend


class Cuts:
    """The cuts of one scenario.

    Args:
        constants: of the scenario.
        check_time: called between many points; may raise to end it.
    """

    def __init__(self, constants: Constants, check_time: Callable[[], None] = lambda: None):
        self.constants, self.check_time = constants, check_time
        self.list: list[tuple[float, np.ndarray, np.ndarray]] = []
        # level and slope of each, less the curvature that all share, about the place of the first
        self._levels: list[float] = []
        self._slopes: list[np.ndarray] = []

    def add(self, result: Relaxations, lane: int, lower, upper) -> None:
        """Take the cut of a solved lane."""
        cut = cut_of(self.constants, result, lane, lower, upper)
        if np.isfinite(cut[0]) and np.isfinite(cut[2]).all():
            self.list.append(cut)
            value, at, gradient = cut
            away = at - self.list[0][1]
            bent = self.constants.schur @ away
            self._levels.append(value - away @ (gradient - 0.5 * bent))
            self._slopes.append(gradient - bent)

    def solve(self, search: Search, points: np.ndarray, bounds: np.ndarray | None = None) -> Steps:
        """Solve whole moves ``"point integer"`` of known bounds, each for an incumbent and a cut."""
        result = yield from search.evaluate(points, bounds)
        for lane, point in enumerate(points):
            self.add(result, lane, point, point)

    def bounds(self, points: Int[np.ndarray, "point integer"], first: int = 0) -> Float[np.ndarray, " point"]:
        """Lower bound of V at whole moves, by all cuts from number `first` on."""
        c, count = self.constants, len(self.list) - first
        best = np.full(len(points), -np.inf)
        if not count:
            return best
        levels, slopes = np.array(self._levels[first:]), np.array(self._slopes[first:]).T
        width = max(AT_ONCE // count, 1)
        for begin in range(0, len(points), width):
            self.check_time()
            some = slice(begin, begin + width)
            away = points[some] - self.list[0][1]
            best[some] = (away @ slopes + levels).max(axis=1)
            best[some] += 0.5 * ((away @ c.root_factor) ** 2).sum(axis=1)
        return best + (c.own_weight * points**2).sum(axis=1)

    def tangent(self, point: Int[np.ndarray, " integer"]):
        """Value, place and gradient at `point` of the cut of R that is highest there."""
        c = self.constants
        best = (-np.inf, point, np.zeros(len(point)))
        for value, at, gradient in self.list:
            bent = c.schur @ (point - at)
            height = value + (point - at) @ (gradient + 0.5 * bent)
            if height > best[0]:
                best = (float(height), point, gradient + bent)
        return best
