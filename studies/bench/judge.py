"""Times and errors: one clock for everything that is measured, one independent judge for every solution."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from studies.bench.problem import objective, violation

FEASIBLE = 1e-8  # of `problem.violation`: a plan beyond it may be cheaper than the optimum
LEAST_COST = 1e-3  # costs below it are compared absolutely
REPEATS = 3
LONG = 0.1  # s; what takes longer is timed once


def time_each(solve: Callable[[int], Any], count: int) -> tuple[np.ndarray, list[Any]]:
    """Wall time of every call: the median of three where one is short.

    Args:
        solve: of a position; blocks until its result is there.
        count: positions.

    Returns:
        Seconds ``"position"``, and the last result of each.
    """
    seconds, results = np.zeros(count), []
    for i in range(count):
        taken = []
        while not taken or (len(taken) < REPEATS and taken[0] < LONG):
            begin = time.perf_counter()
            result = solve(i)
            taken.append(time.perf_counter() - begin)
        seconds[i] = np.median(taken)
        results.append(result)
    return seconds, results


class Judge:
    """Judges plans of a list of problems: (6.6) straight from the equations, against the best plan anyone found.

    Args:
        cases: contents of case files, see `instances.Instances.case`.
    """

    def __init__(self, cases: Sequence[dict]):
        self.cases = list(cases)
        self.best = np.full(len(self.cases), math.inf)
        self._seen: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def hear(
        self, who: str, plans: Sequence[np.ndarray | None], at: Sequence[int] | np.ndarray | None = None
    ) -> None:
        """Take plans in; the cheapest feasible one of each problem is the reference of all.

        Args:
            who: found them.
            plans: ``"block mv"`` [MV unit] each, None for none.
            at: positions of the problems; the first ones if not given.
        """
        where = np.arange(len(plans)) if at is None else np.asarray(at, dtype=int)
        costs, wrongs = np.full(len(plans), math.nan), np.full(len(plans), math.nan)
        for place, (i, plan) in enumerate(zip(where, plans, strict=True)):
            if plan is None or not np.isfinite(plan).all():
                continue
            costs[place], wrongs[place] = objective(self.cases[i], plan), violation(self.cases[i], plan)
            if wrongs[place] <= FEASIBLE:
                self.best[i] = min(self.best[i], costs[place])
        self._seen[who] = where, costs, wrongs

    def errors(self, who: str) -> np.ndarray:
        """Error of every plan: relative cost above the best, or violation of a hard constraint; NaN for no plan."""
        where, costs, wrongs = self._seen[who]
        best = self.best[where]
        with np.errstate(invalid="ignore"):
            excess = np.abs(costs - best) / np.maximum(np.abs(best), LEAST_COST)
        return np.where(np.isnan(costs), math.nan, np.maximum(excess, wrongs))


def ratio(ours: np.ndarray, theirs: np.ndarray, common: np.ndarray) -> float | None:
    """How many times as fast we are by the medians of the problems that both were given.

    Args:
        ours: seconds of all problems.
        theirs: seconds of the problems in `common`.
        common: their positions.
    """
    if not len(common):
        return None
    return float(np.median(theirs) / np.median(ours[common]))
