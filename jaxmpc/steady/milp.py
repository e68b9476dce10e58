"""The mixed-integer linear programme of the real-time optimisation (6.19), for `jaxmpc.steady.optimise`.

A function that is linear over the triangles of a grid, its diagonals turning from cell to cell ("Union Jack"), in the
logarithmic form of Vielma and Nemhauser (2011): one share lambda_v per grid point, ::

    sum_v lambda_v = 1,   (u, Y) = sum_v lambda_v (u_v, Y_v),

and binaries that leave no two shares positive that have no triangle in common: a Gray code of the cell in either
direction, and one bit for the half of the cell. The relaxation without the other integers is the convex hull of the
function's graph. The forbidden band of the lift (6.19e) is one binary per allowed range, the step choke one whole number.
"""

from __future__ import annotations

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
        mv: choke [%] and lift [m3/h], exactly on a step and inside a range.
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
        choke_step: of the step choke, None for any position.
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
        lift_ranges: list[tuple[float, float]],
        choke: tuple[float, float],
        choke_step: float | None,
    ):
        points = map.points
        self.points, self.choke, self.choke_step, self.ranges = points, choke, choke_step, lift_ranges
        used = np.isin(np.arange(len(points)), map.triangles)
        values, profit = np.where(used[:, None], map.values, 0.0), np.where(used, profit, 0.0)
        count, cvs = values.shape
        codes = _exclusions(len(map.choke), len(map.lift)) + [(e[:1], e[1:]) for e in map.loose_edges]
        size = {"share": count, "code": len(codes), "range": len(lift_ranges), "steps": 1}
        size |= dict.fromkeys(("above", "below", "more", "less"), cvs)  # violations, deviations per CV [span]
        ends = np.cumsum(list(size.values()))
        at = {name: np.arange(end - n, end) for (name, n), end in zip(size.items(), ends, strict=True)}
        self.at, total = at, int(ends[-1])
        self._entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._row_low: list[float] = []
        self._row_high: list[float] = []
        self.low, self.high = np.zeros(total), np.ones(total)
        self.high[at["share"]] = used
        self.high[np.concatenate([at["above"], at["below"], at["steps"]])] = 0.0
        self.integer = np.zeros(total, dtype=bool)
        self.integer[np.concatenate([at["code"], at["range"], at["steps"]])] = True
        one = np.ones
        self._row(1.0, 1.0, at["share"], one(count))
        for bit, (ones, zeros) in zip(at["code"], codes, strict=True):
            self._row(-np.inf, 0.0, np.append(ones, bit), np.append(one(len(ones)), -1.0))
            self._row(-np.inf, 1.0, np.append(zeros, bit), one(len(zeros) + 1))
        self._row(1.0, 1.0, at["range"], one(len(lift_ranges)))
        unit = np.maximum(np.abs(points).max(axis=0), 1e-12)
        of_choke, of_lift = points[:, 0] / unit[0], points[:, 1] / unit[1]
        for k, side in ((0, (0.0, np.inf)), (1, (-np.inf, 0.0))):  # (6.19e)
            ends_of = np.array([r[k] for r in lift_ranges]) / unit[1]
            self._row(*side, np.concatenate([at["share"], at["range"]]), np.concatenate([of_lift, -ends_of]))
        self._row(choke[0] / unit[0], choke[1] / unit[0], at["share"], of_choke)
        self.empty = False
        if choke_step is not None:
            n = at["steps"]
            self.low[n] = np.ceil(choke[0] / choke_step - 1e-9)
            self.high[n] = np.floor(choke[1] / choke_step + 1e-9)
            self.empty = bool((self.low[n] > self.high[n]).any())
            index = np.append(at["share"], n)
            self._row(0.0, 0.0, index, np.append(of_choke, -choke_step / unit[0]))
        wanted = np.isfinite(demand)
        for c in range(cvs):
            rate = values[:, c] / span[c]
            self._row(
                low[c] / span[c], np.inf, np.append(at["share"], at["below"][c]), np.append(rate, 1.0)
            )  # (6.19c), (6.19d)
            self._row(
                -np.inf, high[c] / span[c], np.append(at["share"], at["above"][c]), np.append(rate, -1.0)
            )
            if wanted[c]:
                index = np.concatenate([at["share"], at["more"][[c]], at["less"][[c]]])
                goal = demand[c] / span[c]
                self._row(goal, goal, index, np.append(rate, [-1.0, 1.0]))
        outside = np.concatenate([at["more"], at["less"]])
        self.high[outside] = np.where(np.tile(wanted, 2), np.inf, 0.0)
        self.demanded = bool(wanted.any())
        paid = weight * span
        self.unit: dict[Goal, float] = dict.fromkeys(GOALS, float(paid.max()))
        self.unit["profit"] = float(np.abs(profit).max()) or 1.0
        self.cost: dict[Goal, np.ndarray] = {goal: np.zeros(total) for goal in GOALS}
        for name in ("above", "below"):
            self.cost["violation"][at[name]] = paid / self.unit["violation"]
        for name in ("more", "less"):
            self.cost["distance"][at[name]] = paid / self.unit["distance"]
        self.cost["profit"][at["share"]] = -profit / self.unit["profit"]

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
        """Choke and lift of a solution, the tolerances of the solver taken out."""
        shares = np.maximum(x[self.at["share"]], 0.0)
        choke, lift = shares @ self.points / shares.sum()
        if self.choke_step is not None:
            choke = self.choke_step * np.round(x[self.at["steps"][0]])
        least, most = self.ranges[int(np.argmax(x[self.at["range"]]))]
        return np.array([np.clip(choke, *self.choke), np.clip(lift, least, most)])

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
