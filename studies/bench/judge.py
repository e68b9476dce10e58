"""Times and errors: one clock for everything that is measured, one independent judge for every solution."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import numpy as np

from studies.bench.problem import objective, violation
from studies.bench.rows import RIGHT

S = TypeVar("S")
T = TypeVar("T")
FEASIBLE = 1e-8  # of `problem.violation`: a plan beyond it may be cheaper than the optimum
LEAST_COST = 1e-3  # costs below it are compared absolutely
REPEATS = 3
LONG = 0.1  # s; what takes longer is timed once


def taken(call: Callable[[], T]) -> tuple[float, T]:
    """Seconds of a call by the clock on the wall, and its result."""
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


def repeated(measure: Callable[[], tuple[float, T]]) -> tuple[float, T]:
    """The median of three measured times where one is short, and the last result; `measure` blocks until it is there."""
    times: list[float] = []
    while True:
        seconds, result = measure()
        times.append(seconds)
        if len(times) == REPEATS or times[0] >= LONG:
            return float(np.median(times)), result


def time_each(solve: Callable[[S], T], problems: Iterable[S]) -> tuple[np.ndarray, list[T]]:
    """Time and result of every problem, ``"problem"`` [s]; `repeated` says how."""
    found = [repeated(lambda one=one: taken(lambda: solve(one))) for one in problems]
    return np.array([seconds for seconds, _ in found]), [result for _, result in found]


def tolerated(value: float) -> float:
    """How far a cost may be from this one and still be the same."""
    return RIGHT * max(abs(value), LEAST_COST)


def performance_profile(seconds: dict[str, Any]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Performance profiles (Dolan and More, Mathematical Programming 91, 2002) of times ``"instance"`` by solver [s].

    Args:
        seconds: not a finite number (or None) where a solver did not solve an instance.

    Returns:
        By solver, the factors to the fastest solver of an instance at which its profile steps up, and the share of all
        instances that it solves within each.
    """
    times = np.array(list(seconds.values()), dtype=float)
    times[~np.isfinite(times)] = math.inf
    fastest = times.min(axis=0)
    factors = np.sort(times / np.where(np.isfinite(fastest), fastest, 1.0), axis=1)
    finite = [row[np.isfinite(row)] for row in factors]
    return {
        name: (row, np.arange(1, len(row) + 1) / times.shape[1])
        for name, row in zip(seconds, finite, strict=True)
    }


class Judge:
    """Judges plans of a list of problems: (6.6) straight from the equations, against the best plan anyone found."""

    def __init__(
        self,
        cases: Sequence[dict],  # as `instances.Instances.cases` makes them
        optima: Sequence[float | None] = (),  # of the problems where they are certified; none if not given
    ):
        self.cases = list(cases)
        known = [math.nan if optimum is None else optimum for optimum in optima] or [math.nan] * len(
            self.cases
        )
        self.certified = np.isfinite(known)
        self.best = np.where(self.certified, known, math.inf)
        self._seen: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def hear(self, who: str, plans: Sequence[np.ndarray | None], at: Any = None) -> None:
        """Take plans ``"block mv"`` [MV unit] in, of the problems at some positions or of the first ones.

        The cheapest feasible one of each problem is the reference of all.
        """
        where = np.arange(len(plans)) if at is None else np.asarray(at, dtype=int)
        costs, wrongs = np.full(len(plans), math.nan), np.full(len(plans), math.nan)
        for place, (i, plan) in enumerate(zip(where, plans, strict=True)):
            if plan is not None and np.isfinite(plan).all():
                costs[place], wrongs[place] = objective(self.cases[i], plan), violation(self.cases[i], plan)
                if wrongs[place] <= FEASIBLE and not self.certified[i]:
                    self.best[i] = min(self.best[i], costs[place])
        self._seen[who] = where, costs, wrongs

    def errors(self, who: str) -> np.ndarray:
        """Error of every plan: relative cost above the best, or violation of a hard constraint; NaN for no plan."""
        where, costs, wrongs = self._seen[who]
        best = self.best[where]
        with np.errstate(invalid="ignore"):
            excess = np.abs(costs - best) / np.maximum(np.abs(best), LEAST_COST)
        return np.where(np.isnan(costs), math.nan, np.maximum(excess, wrongs))
