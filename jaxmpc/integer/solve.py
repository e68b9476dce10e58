"""Exact whole moves (thesis 6.1, 6.5, 6.6): relaxation, fixing, enumeration under cuts, branch and bound.

The line of a solve: one tight relaxation bounds the problem and nearly always finds whole moves by itself; otherwise its
moves are rounded and solved, for an incumbent and a quadratic cut; prices fix every move that cannot improve on it;
what is left is listed and pruned by cuts of the best candidates; where the list is too long, the shifted previous
plan and the best moves by the prices are tried, and branch and bound over batched relaxations closes the rest, HiGHS over
cuts where it is asked to. Every path ends with the same certificate:
incumbent, lower bound, gap. `plan` and the mixed-integer controllers call this for one step or many side by side.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import jax
import numpy as np

from jaxmpc.integer.actuators import Actuator
from jaxmpc.integer.branch_and_bound import branch_and_bound
from jaxmpc.integer.chain import SLACK, whole
from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.enumeration import enumerate_all
from jaxmpc.integer.feasible import MoveLimits, position_limits, propagate, satisfied
from jaxmpc.integer.host_search import (
    GROUP,
    NOT_CLOSED,
    Known,
    OutOfTimeError,
    Search,
    SearchResult,
    Steps,
    no_whole_moves,
)
from jaxmpc.integer.lower_bound import LowerModel, enumerate_below, exclude
from jaxmpc.integer.nearest import UndecidedError
from jaxmpc.integer.outer_approximation import ContradictionError, outer_approximation
from jaxmpc.integer.relaxer import Relaxations, Relaxer
from jaxmpc.integer.scheduling import run
from jaxmpc.problem.blocking import moves_per_block
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure
from jaxmpc.relaxed.gap import closes
from jaxmpc.status import OPTIMAL

BEAM = 64  # partial candidates kept while looking for good first moves
FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")


def solve_integers(
    relaxer: Relaxer,
    instances: QpInstance,
    root: Relaxations,
    *,
    starts: Sequence[Sequence[np.ndarray]],
    actuators: Sequence[Sequence[Actuator]] = (),
    gap: float = 1e-6,
    time_limit: float | None = None,
    finish: str = "auto",
    last: bool = True,
    spent: Sequence[float] | np.ndarray | None = None,
    known: Sequence[Known] | None = None,
) -> list[SearchResult]:
    """Search the problems of many scenarios side by side on the host.

    Args:
        relaxer: compiled relaxations of the scenarios.
        instances: their problems, first axis ``"scenario"``, with NumPy's arrays.
        root: their relaxations.
        starts: integer moves to try as incumbents, per scenario ``"integer"`` [steps]; they never change the answer.
        actuators: what the integer MVs must keep besides limits and rows, per scenario; none if that is all.
        gap: relative gap at which a solve stops.
        time_limit: seconds of work per scenario; the best plan so far is returned with its true gap.
        finish: ``auto``, or the one path that has to close the problems after fixing.
        last: whether to go on where lists are too long and chords would tighten the relaxation.
        spent: seconds that the scenarios have taken already, none if not given.
        known: plans and bounds of the scenarios that others have found.

    Returns:
        One result per scenario; ``status.INFEASIBLE`` when no whole moves satisfy the hard limits.
    """
    results: list[SearchResult | None] = [None] * len(instances.lower)
    searches, spent = [], np.zeros(len(results)) if spent is None else spent
    for i in range(len(results)):
        bound, value = max(float(root.bound[i]), 0.0), float(root.snapped[i])
        closed = finish == "auto" and closes(value, bound, relaxer.scenario(i).scale, gap)
        if closed and not actuators:
            results[i] = _closed_by_root(relaxer, root, i, bound, float(spent[i]))
            continue
        own = jax.tree.map(lambda leaf, i=i: leaf[i], instances)
        rest = actuators[i] if actuators else ()
        search = Search(relaxer.scenario(i), own, root.part(i, i + 1), gap, time_limit, rest)
        if closed and search.allows(root.x[i]):
            results[i] = _closed_by_root(relaxer, root, i, bound, float(spent[i]))
            continue
        search.spent = float(spent[i])
        if known is not None:
            search.take(known[i])
        searches.append((i, search, _line(search, starts[i], finish, last)))
    done = run(relaxer, instances, searches)
    for (i, search, _), result in zip(searches, done, strict=True):
        result.seconds = search.spent
        results[i] = result
    return [result for result in results if result is not None]


def _closed_by_root(
    relaxer: Relaxer, root: Relaxations, lane: int, bound: float, seconds: float
) -> SearchResult:
    """The root's own moves are whole: nothing to search."""
    x = root.x[lane].copy()
    integer = relaxer.scenario(lane).integer
    x[integer] = np.round(x[integer])
    value = float(root.snapped[lane])
    return SearchResult(x, value, min(bound, value), OPTIMAL, "relaxation", 1, root.start(lane), seconds)


def _line(search: Search, starts: Sequence[np.ndarray], finish: str, last: bool) -> Steps:
    """One solve, from its relaxation on, up to its end or that of its time; returns `SearchResult`."""
    result = None
    if not search.out_of_time():
        with contextlib.suppress(OutOfTimeError):
            result = yield from _stages(search, starts, finish, last)
    if result is not None and (result.x is not None or not search.out_of_time()):
        return result
    if search.x is None:
        yield from search.salvaged(starts)
    return search.finish(None, search.still_open)


def _stages(search: Search, starts: Sequence[np.ndarray], finish: str, last: bool) -> Steps:
    """The whole line of one solve; returns `SearchResult`.

    Raises:
        OutOfTimeError: where its time is used up inside a stage.
    """
    c, root, root_bound = search.constants, search.root, search.root_bound
    integer = c.integer
    low, high = whole(search.limits[0][integer]), whole(search.limits[1][integer])
    infeasible = no_whole_moves()
    if not (np.isfinite(root.x).all() and np.isfinite(root.bound).all()):
        search.reason = "the relaxation was not solved: its numbers are not finite"
        return search.finish(None, root_bound)
    model, lower, upper = search.lower_model(root, 0, low, high), low, high
    own = MoveLimits(low, high, *position_limits(search.chains))
    model = model.priced(root.hard[0][c.position], own)
    point = np.clip(whole(model.center), low, high)
    if not satisfied(search.chains, point[None], low, high)[0]:
        lower, upper, possible = (part[0] for part in propagate(search.chains, low[None], high[None]))
        try:
            point = _repaired(search, model, lower, upper) if possible else None
        except UndecidedError:
            search.reason = "whether any whole moves satisfy the hard limits would take too long to find out"
            return search.finish(None, root_bound)
        if point is None:
            return infeasible
    cuts = Cuts(c, search.check_time)
    cuts.add(root, 0, low, high)
    search.offer(root, 0)
    yield from _solve_all(search, cuts, [point])
    if not np.isfinite(search.value) and not continuous_feasible(c.structure, c.size, search.instance):
        return infeasible
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
            only = search.new([lower])
            if len(only) and satisfied(search.chains, only, lower, upper)[0]:
                yield from search.evaluate(only)
            return search.finish("fixing", np.inf)
    if finish in ("auto", "enumeration"):
        limited = finish == "auto"
        done = yield from enumerate_all(search, model, cuts, lower, upper, limited=limited)
        if not done and not search.out_of_time():  # better incumbents make the list shorter
            yield from _solve_all(search, cuts, _candidates(search, model, starts, lower, upper))
            done = yield from enumerate_all(search, model, cuts, lower, upper, limited=limited)
        search.reason = "the list of whole moves that may be better is longer than what is kept in memory"
        if done or finish == "enumeration" or search.out_of_time():
            return search.finish("enumeration" if done else None, np.inf if done else root_bound)
    search.reason = NOT_CLOSED
    if not last and search.may_tighten():
        return search.finish(None, root_bound)
    if finish == "highs":
        seconds = search.seconds_left()
        with contextlib.suppress(ContradictionError):
            done, bound = yield from outer_approximation(search, model, cuts, lower, upper, seconds)
            search.reason = "HiGHS has ended without a proof"
            return search.finish("highs" if done else None, max(root_bound, min(bound, search.value)))
        search.still_open = -np.inf  # nothing that HiGHS has said is believed any more
    bound = yield from branch_and_bound(search, root, model, cuts, lower, upper, root_bound)
    return search.finish("branch-and-bound", bound)


def _solve_all(search: Search, cuts: Cuts, points: Sequence[np.ndarray]) -> Steps:
    """Solve whole moves that are new, each for an incumbent and a cut."""
    fresh = search.new(points)
    if len(fresh):
        yield from cuts.solve(search, fresh)


def _repaired(search: Search, model: LowerModel, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
    """Where the rounded relaxation breaks a hard row: the best moves by the model, None if there are none at all."""
    by_model = _best_by_model(search, model, lower, upper)
    if len(by_model):
        return by_model[0]
    for wanted in (model.center, np.zeros(len(lower))):
        repaired = search.rounded(wanted, lower, upper)
        if repaired is not None:
            return repaired
    return None


def _best_by_model(search: Search, model: LowerModel, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Whole moves that satisfy the hard rows, the cheapest by the model first, ``"point integer"``."""
    found = enumerate_below(
        model, search.chains, lower, upper, np.inf, None, beam=BEAM, check_time=search.check_time
    )
    points = np.zeros((0, len(lower)), dtype=int) if found is None else found[0]
    return points[satisfied(search.chains, points, lower, upper)]


def _candidates(
    search: Search, model: LowerModel, starts: Sequence[np.ndarray], lower: np.ndarray, upper: np.ndarray
) -> list[np.ndarray]:
    """Whole moves that may be good: starts, no moves, and the best by the model."""
    simple = [np.clip(whole(w), lower, upper) for w in (*starts, np.zeros(len(lower)))]
    fit = [point for point in simple if satisfied(search.chains, point[None], lower, upper)[0]]
    return (fit + list(_best_by_model(search, model, lower, upper)))[:GROUP]


def continuous_feasible(structure: Structure, size: Size, instance: QpInstance) -> bool:
    """Whether the limits of the continuous MVs leave any moves at all (exact, by reachable positions)."""
    by_mv = lambda values: np.reshape(values, (size.mvs, -1))  # noqa: E731
    lower, upper = by_mv(instance.lower), by_mv(instance.upper)
    row_low, row_high = by_mv(instance.row_low), by_mv(instance.row_high)
    for mv in sorted(set(range(size.mvs)) - set(structure.integer_mvs)):
        if (lower[mv] > upper[mv] + SLACK).any():
            return False
        least = most = 0.0
        for b, count in enumerate(moves_per_block(structure, mv)):
            least = max(least + count * lower[mv, b], row_low[mv, b])
            most = min(most + count * upper[mv, b], row_high[mv, b])
            if least > most + SLACK:
                return False
    return True
