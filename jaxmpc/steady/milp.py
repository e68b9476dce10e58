"""The mixed-integer linear programme of the real-time optimisation (6.19), for `jaxmpc.steady.optimise`.

A function that is linear over the triangles of a grid, its diagonals turning from cell to cell ("Union Jack"), in the
logarithmic form of Vielma and Nemhauser (2011): one share lambda_v per grid point, ::

    sum_v lambda_v = 1,   (u, Y) = sum_v lambda_v (u_v, Y_v),

and binaries that leave no two shares positive that have no triangle in common: a Gray code of the cell in either
direction, and one bit for the half of the cell. The relaxation without the other integers is the convex hull of the
function's graph. An MV with forbidden bands (6.19e) has one binary per allowed range, one on whole steps an integer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmpc.integer.highs import solve_milp
from jaxmpc.steady.map import SteadyMap

Goal = Literal["violation", "distance", "profit"]
GOALS: tuple[Goal, ...] = ("violation", "distance", "profit")
TIE = 1e-9  # what a later goal may cost an earlier one, in units of the problem


class Best(NamedTuple):
    """Result of `PiecewiseMilp.solve`.

    Attributes:
        mv: the MVs of the map [MV unit], exactly on a step and inside a range.
        goal: what came first: ``violation`` where the limits are out of reach, else ``distance`` where there is a
            demand, else ``profit``.
        bound: proven limit of it, in its own unit: from above for the profit, from below for the others.
    """

    mv: Float[np.ndarray, "2"]
    goal: Goal
    bound: float


class PiecewiseMilp:
    """Violation, distance or profit over the triangles of a steady map, one after the other.

    Args:
        map: of which only the corners of triangles count.
        profit: of the grid points.
        weight: of deviations and violations per CV.
        span: size of each CV, for scaling.
        low, high: limits per CV, infinite for none.
        demand: per CV, NaN for none.
        ranges: per MV, the pairs of smallest and largest value that are allowed.
        steps: per MV, on whose whole multiples it stands, None for any value.
    """

    def __init__(
        self,
        *,
        map: SteadyMap,
        profit: Float[np.ndarray, " point"],
        weight: Float[np.ndarray, " cv"],
        span: Float[np.ndarray, " cv"],
        low: Float[np.ndarray, " cv"],
        high: Float[np.ndarray, " cv"],
        demand: Float[np.ndarray, " cv"],
        ranges: Sequence[Sequence[tuple[float, float]]],
        steps: Sequence[float | None],
    ):
        points = map.points
        self.points, self.ranges, self.steps = points, ranges, steps
        used = np.isin(np.arange(len(points)), map.triangles)
        values, profit = np.where(used[:, None], map.values, 0.0), np.where(used, profit, 0.0)
        count, cvs = values.shape
        width, height = (len(values) for values in map.grid.values())
        codes = _exclusions(width, height) + [(e[:1], e[1:]) for e in map.loose_edges]
        size = {"share": count, "code": len(codes)}
        size |= {f"range {k}": len(own) for k, own in enumerate(ranges) if len(own) > 1}
        size |= {f"steps {k}": 1 for k, step in enumerate(steps) if step is not None}
        size |= dict.fromkeys(("above", "below", "more", "less"), cvs)  # violations, deviations per CV [span]
        ends = np.cumsum(list(size.values()))
        at = {name: np.arange(end - n, end) for (name, n), end in zip(size.items(), ends, strict=True)}
        self.at, total = at, int(ends[-1])
        self._entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._row_low: list[float] = []
        self._row_high: list[float] = []
        self.low, self.high = np.zeros(total), np.ones(total)
        self.high[at["share"]] = used
        self.high[np.concatenate([at["above"], at["below"]])] = 0.0
        self.integer = np.zeros(total, dtype=bool)
        self.integer[count : at["above"][0]] = True  # codes, ranges and steps
        one = np.ones
        self._row(1.0, 1.0, at["share"], one(count))
        for bit, (ones, zeros) in zip(at["code"], codes, strict=True):
            self._row(-np.inf, 0.0, np.append(ones, bit), np.append(one(len(ones)), -1.0))
            self._row(-np.inf, 1.0, np.append(zeros, bit), one(len(zeros) + 1))
        self._limit_mvs()
        self.empty = bool((self.low > self.high).any())
        self._follow(values / span, low / span, high / span, demand / span)
        self.demanded = bool(np.isfinite(demand).any())
        paid = weight * span
        self.unit: dict[Goal, float] = dict.fromkeys(GOALS, float(paid.max()))
        self.unit["profit"] = float(np.abs(profit).max()) or 1.0
        self.cost: dict[Goal, np.ndarray] = {goal: np.zeros(total) for goal in GOALS}
        for name in ("above", "below"):
            self.cost["violation"][at[name]] = paid / self.unit["violation"]
        for name in ("more", "less"):
            self.cost["distance"][at[name]] = paid / self.unit["distance"]
        self.cost["profit"][at["share"]] = -profit / self.unit["profit"]

    def _limit_mvs(self) -> None:
        """Ranges (6.19e) and steps of the MVs."""
        at, points = self.at, self.points
        unit = np.maximum(np.abs(points).max(axis=0), 1e-12)
        scaled = points / unit
        # the MVs with bands first: HiGHS may end elsewhere among equally good points if rows change places
        for k, own in sorted(enumerate(self.ranges), key=lambda row: len(row[1]) == 1):  # (6.19e)
            if len(own) == 1:
                self._row(own[0][0] / unit[k], own[0][1] / unit[k], at["share"], scaled[:, k])
                continue
            chosen = at[f"range {k}"]
            self._row(1.0, 1.0, chosen, np.ones(len(own)))
            for ends, side in zip(np.array(own).T / unit[k], ((0.0, np.inf), (-np.inf, 0.0)), strict=True):
                self._row(*side, np.append(at["share"], chosen), np.append(scaled[:, k], -ends))
        for k, step in enumerate(self.steps):
            if step is not None:
                n = at[f"steps {k}"]
                self.low[n] = np.ceil(np.min(self.ranges[k]) / step - 1e-9)
                self.high[n] = np.floor(np.max(self.ranges[k]) / step + 1e-9)
                self._row(0.0, 0.0, np.append(at["share"], n), np.append(scaled[:, k], -step / unit[k]))

    def _follow(self, rate: np.ndarray, low: np.ndarray, high: np.ndarray, demand: np.ndarray) -> None:
        """Limits (6.19c), (6.19d) and demands of the CVs, in spans, and what leaves them."""
        at, wanted = self.at, np.isfinite(demand)
        for c, own in enumerate(rate.T):
            self._row(low[c], np.inf, np.append(at["share"], at["below"][c]), np.append(own, 1.0))
            self._row(-np.inf, high[c], np.append(at["share"], at["above"][c]), np.append(own, -1.0))
            if wanted[c]:
                index = np.concatenate([at["share"], at["more"][[c]], at["less"][[c]]])
                self._row(demand[c], demand[c], index, np.append(own, [-1.0, 1.0]))
        outside = np.concatenate([at["more"], at["less"]])
        self.high[outside] = np.where(np.tile(wanted, 2), np.inf, 0.0)

    def solve(self) -> Best | None:
        """The best point, None if the MV limits leave nothing of the map.

        Raises:
            RuntimeError: if HiGHS gives up.
        """
        if self.empty:
            return None
        later: list[Goal] = [goal for goal in GOALS[1:] if self._asked(goal)]
        first = later[0]
        x, bound = self._minimise(first)
        if x is None:  # the CV limits are out of reach: first as little beyond them as possible
            self.high[np.concatenate([self.at["above"], self.at["below"]])] = np.inf
            first = "violation"
            later.insert(0, first)
            x, bound = self._minimise(first)
            if x is None:
                return None
        for goal, before in zip(later[1:], later[:-1], strict=True):
            index = np.flatnonzero(self.cost[before])
            self._row(-np.inf, float(self.cost[before] @ x) + TIE, index, self.cost[before][index])
            again, _ = self._minimise(goal, x)
            x = x if again is None else again  # lost to rounding: keep what is proven
        sign = -1.0 if first == "profit" else 1.0
        return Best(self._mv(x), first, sign * bound * self.unit[first])

    def _asked(self, goal: Goal) -> bool:
        """Whether a goal says anything; the profit always does where it is the only one."""
        if goal == "distance":
            return self.demanded
        return not self.demanded or bool(self.cost[goal].any())

    def _mv(self, x: np.ndarray) -> np.ndarray:
        """The MVs of a solution, the tolerances of the solver taken out."""
        shares = np.maximum(x[self.at["share"]], 0.0)
        mv = shares @ self.points / shares.sum()
        for k, (own, step) in enumerate(zip(self.ranges, self.steps, strict=True)):
            if step is not None:
                mv[k] = step * np.round(x[self.at[f"steps {k}"][0]])
            chosen = int(np.argmax(x[self.at[f"range {k}"]])) if len(own) > 1 else 0
            mv[k] = np.clip(mv[k], *own[chosen])
        return mv

    def _minimise(self, goal: Goal, known: np.ndarray | None = None) -> tuple[np.ndarray | None, float]:
        """Best solution of one goal and the bound, in units of the problem; None if there is none.

        `known` is feasible: what it disproves is not believed.
        """
        entries = tuple(np.concatenate(part) for part in zip(*self._entries, strict=True))
        status, x, bound = solve_milp(
            self.cost[goal],
            (entries[0], entries[1], entries[2]),
            np.array(self._row_low),
            np.array(self._row_high),
            self.low,
            self.high,
            self.integer,
            known=known,
        )
        if status not in ("optimal", "infeasible"):
            raise RuntimeError(f"HiGHS ended a problem of the real-time optimisation with {status}")
        return x, bound

    def _row(self, low: float, high: float, index: np.ndarray, value: np.ndarray) -> None:
        row = np.full(len(index), len(self._row_low))
        self._entries.append((row, index, value))
        self._row_low.append(low)
        self._row_high.append(high)


def _exclusions(width: int, height: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Grid points per binary: those whose shares are 0 unless it is 1, and those whose shares are 0 unless it is 0."""
    i, j = np.tile(np.arange(width), height), np.repeat(np.arange(height), width)
    out = []
    for place, cells in ((i, width - 1), (j, height - 1)):
        gray = np.arange(cells) ^ np.arange(cells) >> 1
        before, after = gray[np.maximum(place - 1, 0)], gray[np.minimum(place, cells - 1)]
        for bit in range((cells - 1).bit_length()):
            both = (before >> bit & 1) + (after >> bit & 1)  # of the two cells beside a grid line
            out.append((np.flatnonzero(both == 2), np.flatnonzero(both == 0)))
    odd, across = i % 2 == 1, j % 2 == 1  # a triangle has one of the two corners off the diagonal
    return [*out, (np.flatnonzero(odd & ~across), np.flatnonzero(~odd & across))]
