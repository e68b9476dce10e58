"""Exact whole moves (thesis 6.1, 6.5, 6.6): relaxation, fixing, enumeration under cuts, HiGHS, branch and bound.

The line of a solve: one tight relaxation bounds the problem and nearly always finds whole moves by itself; otherwise
the best candidates by its prices and the shifted previous plan are solved in one batch and give an incumbent and
quadratic cuts; prices fix every move that cannot improve on it; what is left is listed and pruned by cuts, or a reduced
MILP, or branch and bound over batched relaxations closes the rest. Every path ends with the same certificate:
incumbent, lower bound, gap. `plan` and the mixed-integer controllers call this for one step or many side by side.
"""

from __future__ import annotations

import time

import jax
import numpy as np

from jaxmpc.blocking import first_position_rows, moves_per_block
from jaxmpc.branch_and_bound import branch_and_bound
from jaxmpc.condense import QpInstance
from jaxmpc.cuts import Cuts
from jaxmpc.enumeration import enumerate_all
from jaxmpc.levelset import LowerModel, enumerate_below, exclude
from jaxmpc.newton import WarmStart
from jaxmpc.outer_approximation import outer_approximation
from jaxmpc.propagation import propagate, satisfied
from jaxmpc.relaxer import Constants, Relaxations, Relaxer
from jaxmpc.scheduling import run
from jaxmpc.search import GROUP, Search, SearchResult, Steps
from jaxmpc.status import INFEASIBLE
from jaxmpc.structure import Structure

BEAM = 64  # partial candidates kept while looking for good first moves
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
        starts: moves of integer MVs to try as incumbents ``"integer"`` [steps]; rounded here.
        warm: prices of a neighbouring problem's root relaxation; speeds the solve up, never changes the answer.
        gap: relative gap at which the solve stops.
        time_limit: seconds; the best plan so far is returned with its true gap.
        finish: ``auto``, or the one path that has to close the problem after fixing.

    Returns:
        `SearchResult`; ``status.INFEASIBLE`` when no whole moves satisfy the hard limits.
    """
    one = lambda tree: jax.tree.map(lambda leaf: leaf[None], tree)  # noqa: E731
    return solve_integers(
        Relaxer([constants]),
        one(instance),
        starts=[starts or []],
        warm=one(constants.cold if warm is None else warm),
        gap=gap,
        time_limit=time_limit,
        finish=finish,
    )[0]


def solve_integers(
    relaxer: Relaxer,
    instances: QpInstance,
    *,
    starts: list[list[np.ndarray]],
    warm: WarmStart,
    gap: float = 1e-6,
    time_limit: float | None = None,
    finish: str = "auto",
) -> list[SearchResult]:
    """Solve the problems of many scenarios side by side; arguments as in `solve_integer`, with a scenario axis.

    Args:
        relaxer: compiled relaxations of the scenarios.
        instances: their problems.
        starts: incumbents to try, per scenario.
        warm: where each root relaxation starts.
        gap: relative gap.
        time_limit: seconds of work per scenario.
        finish: path that has to close the problems.
    """
    on_host = jax.tree.map(np.asarray, instances)
    count = len(on_host.lower)
    begin, compiled = time.perf_counter(), relaxer.compiling
    root = relaxer.solve_roots(instances, warm)
    seconds = time.perf_counter() - begin - (relaxer.compiling - compiled)
    results: list[SearchResult | None] = [None] * count
    open_searches = []
    for i in range(count):
        own = root.part(i, i + 1)
        bound = max(float(own.bound[0]), 0.0)
        value = float(own.snapped[0])
        scale = max(abs(value), 1e-6 * relaxer.scenario(i).scale)
        if finish == "auto" and np.isfinite(value) and value - bound <= max(gap, 1e-9) * scale:
            results[i] = _closed_by_root(relaxer, own, bound, seconds / count)
            continue
        search = Search(
            relaxer.scenario(i), jax.tree.map(lambda leaf, i=i: leaf[i], on_host), own, gap, time_limit
        )
        search.spent = seconds / count
        open_searches.append((i, search, _line(search, starts[i], finish)))
    if open_searches:
        done = run(relaxer, instances, open_searches)
        for (i, search, _), result in zip(open_searches, done, strict=True):
            result.seconds = search.spent
            results[i] = result
    return [result for result in results if result is not None]


def _closed_by_root(relaxer: Relaxer, root: Relaxations, bound: float, seconds: float) -> SearchResult:
    """The root's own moves are whole: nothing to search."""
    x = root.x[0].copy()
    x[relaxer.integer] = np.round(x[relaxer.integer])
    value = float(root.snapped[0])
    return SearchResult(x, value, min(bound, value), 0, "relaxation", 1, root.start(0), seconds)


def _line(search: Search, starts: list[np.ndarray], finish: str) -> Steps:
    """The whole line of one solve, from its relaxation on; returns `SearchResult`."""
    c, root, root_bound = search.constants, search.root, search.root_bound
    integer = c.integer
    low = np.round(search.limits[0][integer]).astype(int)
    high = np.round(search.limits[1][integer]).astype(int)
    infeasible = SearchResult(None, np.inf, np.inf, INFEASIBLE, None, 0)
    lower, upper, possible = propagate(search.chains, low[None], high[None])
    if not possible[0] or not continuous_feasible(c.structure, search.instance):
        return infeasible
    lower, upper = lower[0], upper[0]
    search.offer(root, 0)
    model = search.lower_model(root, 0, low, high)
    points = _candidates(search, model, starts, lower, upper)
    if points is None:
        return infeasible
    cuts = Cuts(c)
    cuts.add(root, 0, low, high)
    first = yield from search.evaluate(points)
    for lane, point in enumerate(points):
        cuts.add(first, lane, point, point)
    if finish == "auto" and root_bound >= search.cutoff:
        return search.finish("relaxation", root_bound)
    if search.out_of_time():
        return search.finish(None, root_bound)
    if np.isfinite(search.value):
        kept_low, kept_high = exclude(model, search.cutoff)
        lower, upper = np.maximum(lower, kept_low), np.minimum(upper, kept_high)
        lower, upper, possible = propagate(search.chains, lower[None], upper[None])
        lower, upper = lower[0], upper[0]
        search.discard(max(root_bound, search.cutoff))
        if not possible[0]:
            return search.finish("fixing" if finish == "auto" else finish, np.inf)
        if (lower == upper).all() and finish == "auto":
            last = search.new([lower])
            if len(last):
                yield from search.evaluate(last)
            return search.finish("fixing", np.inf)
    if finish in ("auto", "enumeration"):
        done = yield from enumerate_all(search, model, cuts, lower, upper, limited=finish == "auto")
        if done or finish == "enumeration" or search.out_of_time():
            return search.finish("enumeration" if done else None, np.inf if done else root_bound)
    if finish in ("auto", "highs"):
        seconds = search.seconds_left()
        if finish == "auto":
            seconds = HIGHS_SECONDS if seconds is None else min(seconds, HIGHS_SECONDS)
        done, bound = yield from outer_approximation(search, cuts, lower, upper, seconds)
        root_bound = max(root_bound, min(bound, search.value))
        if done or finish == "highs" or search.out_of_time():
            return search.finish("highs" if done else None, root_bound)
    bound = yield from branch_and_bound(search, root, model, lower, upper, root_bound)
    return search.finish("branch-and-bound", bound)


def _candidates(
    search: Search, model: LowerModel, starts: list[np.ndarray], lower: np.ndarray, upper: np.ndarray
) -> np.ndarray | None:
    """First whole moves to solve, ``"point integer"``: rounded relaxation, starts, the best by the model, zero.

    None if no whole moves satisfy the hard rows at all.
    """
    fits = lambda point: bool(satisfied(search.chains, point[None], lower, upper)[0])  # noqa: E731
    zero = np.zeros(len(lower))
    center, *others, still = (
        np.clip(np.round(w), lower, upper).astype(int) for w in (model.center, *starts, zero)
    )
    points = [point for point in (center, *others) if fits(point)]
    by_model = enumerate_below(model, search.chains, lower, upper, np.inf, None, beam=BEAM)
    if by_model is not None and len(by_model[0]):
        points += list(by_model[0][satisfied(search.chains, by_model[0], lower, upper)])
    points = [*points[: GROUP - 1], *([still] if fits(still) else []), *points[GROUP - 1 :]]
    if not points:
        repaired = (search.rounded(wanted, lower, upper) for wanted in (model.center, zero))
        points = [point for point in repaired if point is not None]
    return search.new(points)[:GROUP] if points else None


def continuous_feasible(structure: Structure, instance: QpInstance) -> bool:
    """Whether the limits of the continuous MVs leave any moves at all (exact, by reachable positions)."""
    lower, upper = np.asarray(instance.lower), np.asarray(instance.upper)
    counts = moves_per_block(structure)
    blocks, firsts = structure.block_count, first_position_rows(structure)
    row_low, row_high = np.asarray(instance.row_low), np.asarray(instance.row_high)
    slack = 1e-7
    for mv in range(structure.mv_count):
        if mv in structure.integer_mvs:
            continue
        own_low, own_high = lower[mv * blocks : (mv + 1) * blocks], upper[mv * blocks : (mv + 1) * blocks]
        if (own_low > own_high + slack).any():
            return False
        first = firsts[mv]
        least = most = 0.0
        for b in range(blocks):
            least = max(least + counts[b] * own_low[b], row_low[first + b])
            most = min(most + counts[b] * own_high[b], row_high[first + b])
            if least > most + slack:
                return False
    return True
