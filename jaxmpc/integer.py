"""Exact whole moves (thesis 6.1, 6.5, 6.6): relaxation, level-set fixing, enumeration, HiGHS, branch and bound.

The line of a solve: one tight relaxation bounds the problem; the shifted previous plan, the rounded relaxation and the
zero plan give incumbents; prices fix every move that cannot improve on the best of them; the few combinations left
are enumerated in batches, or a reduced MILP, or branch and bound over batched relaxations closes the rest. Every
path ends with the same certificate: incumbent, lower bound, gap. `plan` calls this for one problem.
"""

from __future__ import annotations

import time

import numpy as np

from jaxmpc.blocking import first_position_rows, moves_per_block
from jaxmpc.branch_and_bound import branch_and_bound
from jaxmpc.condense import QpInstance
from jaxmpc.levelset import LowerModel, enumerate_below, exclude
from jaxmpc.newton import WarmStart
from jaxmpc.outer_approximation import outer_approximation
from jaxmpc.propagation import nearest, propagate, satisfied
from jaxmpc.search import MANY, SINGLE, Constants, Search, SearchResult
from jaxmpc.status import INFEASIBLE
from jaxmpc.structure import Structure

FEW = 128  # combinations that are enumerated rather than searched
HIGHS_SECONDS = 0.1  # what the reduced MILP may take before branch and bound closes the rest
FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")


def solve_integer(
    constants: Constants,
    instance: QpInstance,
    *,
    starts: list[np.ndarray] | None = None,
    warm: WarmStart | None = None,
    gap: float = 1e-6,
    time_limit: float | None = None,
    finish: str = "auto",
) -> SearchResult:
    """Solve one problem with whole moves exactly.

    Args:
        constants: of the structure, model and tuning.
        instance: the problem of this sample.
        starts: moves of integer MVs to try as incumbents ``"integer"`` [steps]; rounded and repaired here.
        warm: prices of a neighbouring problem's root relaxation; speeds the solve up, never changes the answer.
        gap: relative gap at which the solve stops.
        time_limit: seconds; the best plan so far is returned with its true gap.
        finish: ``auto``, or the one path that has to close the problem after fixing.

    Returns:
        `SearchResult`; ``status.INFEASIBLE`` when no whole moves satisfy the hard limits.
    """
    deadline = None if time_limit is None else time.perf_counter() + time_limit
    search = Search(constants, instance, gap, deadline)
    integer = constants.integer
    low, high = (
        np.round(search.limits[0][integer]).astype(int),
        np.round(search.limits[1][integer]).astype(int),
    )
    lower, upper, possible = propagate(search.chains, low[None], high[None])
    if not possible[0] or not continuous_feasible(constants.structure, instance):
        return SearchResult(None, np.inf, np.inf, INFEASIBLE, None, 0)
    lower, upper = lower[0], upper[0]
    zero = np.zeros(len(integer))
    if search.rounded(zero, lower, upper) is None and nearest(search.chains, zero, lower, upper) is None:
        return SearchResult(None, np.inf, np.inf, INFEASIBLE, None, 0)
    root = search.relax(lower[None], upper[None], None if warm is None else [warm])
    search.start = root.start(0)
    search.nodes = 1
    root_bound = search.root_bound = max(float(root.bound[0]), 0.0)
    # the rounded relaxation is optimal nearly always; the others are tried only if it does not close the problem
    for wanted in (root.x[0, integer], *(starts or []), zero):
        search.try_points([search.rounded(wanted, lower, upper)])
        if root_bound >= search.cutoff:
            break
    if finish == "auto" and root_bound >= search.cutoff:
        return search.finish("relaxation", root_bound)
    if search.out_of_time():
        return search.finish(None, root_bound)
    model = search.lower_model(root, 0, lower, upper)
    if np.isfinite(search.value):
        lower, upper = exclude(model, search.cutoff)
        lower, upper, possible = propagate(search.chains, lower[None], upper[None])
        lower, upper = lower[0], upper[0]
        search.discard(max(root_bound, search.cutoff))
        if not possible[0]:
            return search.finish("fixing" if finish == "auto" else finish, np.inf)
        if (lower == upper).all() and finish == "auto":
            search.try_points([lower])
            return search.finish("fixing", np.inf)
    if finish in ("auto", "enumeration"):
        done = _enumerate(search, model, lower, upper, FEW if finish == "auto" else None)
        if done or finish == "enumeration":
            return search.finish("enumeration" if done else None, np.inf if done else root_bound)
    if finish in ("auto", "highs"):
        seconds = search.seconds_left()
        if finish == "auto":
            seconds = HIGHS_SECONDS if seconds is None else min(seconds, HIGHS_SECONDS)
        done, bound = outer_approximation(search, lower, upper, seconds)
        root_bound = max(root_bound, min(bound, search.value))
        if done or finish == "highs":
            return search.finish("highs" if done else None, root_bound)
    bound = branch_and_bound(search, root, model, lower, upper, root_bound)
    return search.finish("branch-and-bound", bound)


def continuous_feasible(structure: Structure, instance: QpInstance) -> bool:
    """Whether the limits of the continuous MVs leave any moves at all (exact, by reachable positions)."""
    lower, upper = np.asarray(instance.lower), np.asarray(instance.upper)
    counts = moves_per_block(structure)
    blocks, firsts = structure.block_count, first_position_rows(structure)
    row_low, row_high = np.asarray(instance.row_low), np.asarray(instance.row_high)
    for mv in range(structure.mv_count):
        if mv in structure.integer_mvs:
            continue
        columns = slice(mv * blocks, (mv + 1) * blocks)
        first = firsts[mv]
        least = most = 0.0
        slack = 1e-7
        for b in range(blocks):
            if lower[columns][b] > upper[columns][b] + slack:
                return False
            least = max(least + counts[b] * lower[columns][b], row_low[first + b])
            most = min(most + counts[b] * upper[columns][b], row_high[first + b])
            if least > most + slack:
                return False
    return True


def _enumerate(search: Search, model: LowerModel, lower, upper, most: int | None) -> bool:
    """Evaluate every combination the bound leaves, best first; False if there are too many or time is up."""
    found = enumerate_below(model, search.chains, lower, upper, search.cutoff, most)
    if found is None:
        return False
    search.discard(search.cutoff)
    points, bounds, _ = found
    keep = satisfied(search.chains, points, lower, upper) if len(points) else np.zeros(0, dtype=bool)
    points, bounds = points[keep], bounds[keep]
    fresh = np.array([p.tobytes() not in search.seen for p in points], dtype=bool)
    points, bounds = points[fresh], bounds[fresh]
    start = 0
    while start < len(points):
        if bounds[start] >= search.cutoff:
            search.discard(float(bounds[start]))
            break
        if search.out_of_time():
            search.discard(float(bounds[start]))
            return False
        size = 1 if start == 0 else SINGLE - 1 if len(points) < MANY else search.lanes
        search.evaluate(points[start : start + size], bounds[start : start + size])
        search.nodes += len(points[start : start + size])
        start += size
    return True
