"""Exact whole moves (thesis 6.1, 6.5, 6.6): relaxation, level-set fixing, enumeration, HiGHS, branch and bound.

The line of a solve: one tight relaxation bounds the problem; the shifted previous plan, the rounded relaxation and the
zero plan give incumbents; prices fix every move that cannot improve on the best of them; the few combinations left
are enumerated in batches, or a reduced MILP, or branch and bound over batched relaxations closes the rest. Every
path ends with the same certificate: incumbent, lower bound, gap. `plan` calls this for one problem.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import time

import equinox as eqx
import jax
import numpy as np

from jaxmpc.blocking import hard_rows, moves_per_block
from jaxmpc.condense import CondensedQp, QpInstance, integer_columns
from jaxmpc.levelset import LowerModel, enumerate_below, exclude, schur_complement
from jaxmpc.newton import WarmStart, warm_start_of
from jaxmpc.propagation import Chain, chains_of, nearest, propagate, satisfied
from jaxmpc.relaxation import cold_start, solve_relaxed
from jaxmpc.status import FAILED, INFEASIBLE, LIMIT, OPTIMAL
from jaxmpc.structure import Structure

BATCH = 16  # lanes of a batched relaxation call; fewer than `SINGLE` problems are solved one by one
SINGLE = 4
WIDE = 128  # variables from which problems are solved one by one
FEW = 128  # combinations that are enumerated rather than searched
HIGHS_SECONDS = 0.1  # what the reduced MILP may take before branch and bound closes the rest
FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")


@eqx.filter_jit
def _relax(qp: CondensedQp, rows, instance: QpInstance, lower, upper, starts: WarmStart):
    """Batched relaxation; returns only what the search reads."""
    predictions = instance.limit_high.shape[0]

    def lane(low, high, start):
        s = solve_relaxed(qp, rows, instance, low, high, start)
        envelope = s.row_price[predictions:]
        return s.x, s.objective, s.bound, s.status, s.lower_price - s.upper_price, envelope, warm_start_of(s)

    return jax.vmap(lane)(lower, upper, starts)


@dataclasses.dataclass
class Relaxations:
    """Results of a batch of relaxed problems, on the host; first axis is the batch."""

    x: np.ndarray
    objective: np.ndarray
    bound: np.ndarray
    status: np.ndarray
    gradient: np.ndarray
    envelope: np.ndarray
    warm: WarmStart

    def start(self, lane: int) -> WarmStart:
        """Moves and prices of one lane, to start its neighbours from."""
        return jax.tree.map(lambda leaf: leaf[lane], self.warm)


class Constants:
    """What the search needs of a `CondensedQp`, computed once per structure, model and tuning."""

    def __init__(self, structure: Structure, qp: CondensedQp):
        self.structure, self.qp = structure, qp
        # few lanes do not pay for streaming the packed products through the cache
        self.lean = eqx.tree_at(lambda q: q.packed, qp, None, is_leaf=lambda leaf: leaf is None)
        self.rows = hard_rows(structure)
        self.integer = integer_columns(structure)
        hessian = np.asarray(qp.hessian)
        self.schur, self.radius = schur_complement(hessian, self.integer)
        predictions = structure.cv_count * structure.horizon_count
        self.slope = np.asarray(qp.soft_linear)[predictions:]  # of the envelope rows
        self.knot = np.asarray(qp.deadzone)[predictions:]
        self.levels = len(self.slope) // max(len(self.integer), 1)
        self.scale = max(float(np.diag(np.asarray(qp.curvature)).max()), 1e-12)
        full = np.diag(np.asarray(qp.curvature))[self.integer]
        self.own_weight = (
            0.5 * (full - np.diag(hessian)[self.integer]) if self.levels else np.zeros(len(self.integer))
        )


@dataclasses.dataclass
class SearchResult:
    """Outcome of an integer solve: scaled moves, value, bound, status code, who finished, nodes, root prices."""

    x: np.ndarray | None
    value: float
    bound: float
    status: int
    finished_by: str | None
    nodes: int
    root: WarmStart | None = None


class Search:
    """State of one integer solve.

    Args:
        constants: of the structure, model and tuning.
        instance: the problem of this sample.
        gap: relative gap at which a solve is optimal.
        deadline: `time.perf_counter()` value after which the best plan so far is returned; None for none.
    """

    def __init__(self, constants: Constants, instance: QpInstance, gap: float, deadline: float | None):
        self.constants, self.instance, self.gap, self.deadline = constants, instance, gap, deadline
        self.limits = np.asarray(instance.lower), np.asarray(instance.upper)
        self.chains: list[Chain] = chains_of(
            constants.structure, np.asarray(instance.row_low), np.asarray(instance.row_high)
        )
        self.value, self.x = np.inf, None
        self.left_out = np.inf  # least bound of everything that was discarded
        self.root_bound = 0.0  # every term of (6.6) is non-negative
        self.nodes = 0
        self.seen: set[bytes] = set()
        self.start = jax.tree.map(np.asarray, cold_start(constants.qp, len(constants.rows)))
        self.lanes = BATCH if len(self.limits[0]) <= WIDE else 1

    # ---- bookkeeping
    @property
    def cutoff(self) -> float:
        """Bounds from here on cannot improve the incumbent by more than the gap."""
        return self.value - 0.5 * max(self.gap, 1e-9) * self.reference if np.isfinite(self.value) else np.inf

    @property
    def reference(self) -> float:
        """What gaps are relative to: the incumbent's value, or a small share of the problem's scale if that is zero."""
        return max(abs(self.value), 1e-6 * self.constants.scale)

    def out_of_time(self) -> bool:
        """Whether the deadline has passed."""
        return self.deadline is not None and time.perf_counter() > self.deadline

    def seconds_left(self) -> float | None:
        """Seconds to the deadline, None without one."""
        return None if self.deadline is None else max(self.deadline - time.perf_counter(), 0.0)

    def discard(self, bound: float) -> None:
        """Record the bound of something that is not searched further."""
        self.left_out = min(self.left_out, bound)

    # ---- batched relaxations
    def relax(
        self, lower: np.ndarray, upper: np.ndarray, starts: list[WarmStart] | None = None
    ) -> Relaxations:
        """Solve relaxed problems with integer limits ``"batch integer"``, one by one or in padded batches of one size.

        Args:
            lower: integer lower limits.
            upper: integer upper limits.
            starts: prices to start from, one per problem; the root's if not given.
        """
        count, parts = len(lower), []
        wide_low, wide_high = (np.repeat(v[None], count, axis=0) for v in self.limits)
        wide_low[:, self.constants.integer], wide_high[:, self.constants.integer] = lower, upper
        starts = [self.start] * count if starts is None else starts
        size = 1 if count < SINGLE else self.lanes
        qp = self.constants.lean if size == 1 else self.constants.qp
        for first in range(0, count, size):
            pad = np.minimum(first + np.arange(size), count - 1)
            stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(starts[i] for i in pad))
            out = _relax(qp, self.constants.rows, self.instance, wide_low[pad], wide_high[pad], stacked)
            parts.append(jax.tree.map(lambda v, n=min(size, count - first): np.asarray(v)[:n], out))
        return Relaxations(*jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts))

    def evaluate(self, points: np.ndarray, bounds: np.ndarray | None = None) -> Relaxations:
        """Solve the problems with the whole moves fixed, take the best as incumbent, discard the rest."""
        result = self.relax(points, points)
        for i in range(len(points)):
            self.seen.add(points[i].tobytes())
            if result.objective[i] < self.value and np.isfinite(result.x[i]).all():
                self.value, self.x = float(result.objective[i]), result.x[i]
        known = result.bound if bounds is None else np.maximum(result.bound, bounds)
        for i in range(len(points)):
            self.discard(float(min(known[i], result.objective[i])))
        return result

    def lower_model(self, result: Relaxations, lane: int, lower: np.ndarray, upper: np.ndarray) -> LowerModel:
        """The quadratic lower bound over the whole moves that a relaxed solve proves (see `levelset`)."""
        c = self.constants
        center = result.x[lane, c.integer]
        slope = result.gradient[lane, c.integer]
        width = int((upper - lower).max(initial=0)) + 1
        values = lower[:, None] + np.arange(width)[None, :]
        least = np.minimum(slope * (lower - center), slope * (upper - center))
        excess = slope[:, None] * (values - center[:, None]) - least[:, None]
        if c.levels:
            price = result.envelope[lane].reshape(c.levels, -1)
            knot, steep = c.knot.reshape(c.levels, -1), c.slope.reshape(c.levels, -1)
            for m in range(c.levels):
                own = steep[m][:, None] * np.maximum(np.abs(values) - knot[m][:, None], 0.0)
                excess += own - price[m][:, None] * values + (knot[m] * np.abs(price[m]))[:, None]
        excess = np.where(values <= upper[:, None], np.maximum(excess, 0.0), np.inf)
        return LowerModel(float(result.bound[lane]), center, lower, upper, excess, c.schur, c.radius)

    # ---- incumbents
    def rounded(self, moves: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """Whole moves near `moves` that satisfy the hard rows, or None where there are none."""
        point = np.clip(np.round(moves).astype(int), lower, upper)
        if satisfied(self.chains, point[None], lower, upper)[0]:
            return point
        point = nearest(self.chains, moves, lower, upper)
        return point if point is not None and satisfied(self.chains, point[None], lower, upper)[0] else None

    def try_points(self, points: list[np.ndarray | None]) -> None:
        """Evaluate the points that are new."""
        fresh = {p.tobytes(): p for p in points if p is not None and p.tobytes() not in self.seen}
        if fresh:
            self.evaluate(np.array(list(fresh.values())))

    # ---- finishing
    def finish(self, by: str | None, bound: float) -> SearchResult:
        """Assemble the result; `bound` is the least bound of what is still open."""
        bound = min(max(min(self.left_out, bound), self.root_bound), self.value)
        if self.x is None:
            status = INFEASIBLE if by is not None else FAILED
            return SearchResult(None, np.inf, np.inf if by else bound, status, by, self.nodes)
        closed = self.value - bound <= max(self.gap, 1e-9) * self.reference
        return SearchResult(
            self.x,
            self.value,
            bound,
            OPTIMAL if closed else LIMIT,
            by if closed else None,
            self.nodes,
            self.start,
        )


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
        done, bound = _outer_approximation(search, root, lower, upper, seconds)
        root_bound = max(root_bound, min(bound, search.value))
        if done or finish == "highs":
            return search.finish("highs" if done else None, root_bound)
    bound = _branch_and_bound(search, root, lower, upper, root_bound)
    return search.finish("branch-and-bound", bound)


def continuous_feasible(structure: Structure, instance: QpInstance) -> bool:
    """Whether the limits of the continuous MVs leave any moves at all (exact, by reachable positions)."""
    lower, upper = np.asarray(instance.lower), np.asarray(instance.upper)
    counts = moves_per_block(structure)
    rows, blocks = hard_rows(structure), structure.block_count
    row_low, row_high = np.asarray(instance.row_low), np.asarray(instance.row_high)
    for mv in range(structure.mv_count):
        if mv in structure.integer_mvs:
            continue
        columns = slice(mv * blocks, (mv + 1) * blocks)
        first = int(np.flatnonzero(np.abs(rows[:, columns]).sum(axis=1))[0])
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
        size = 1 if start == 0 else search.lanes
        search.evaluate(points[start : start + size], bounds[start : start + size])
        search.nodes += len(points[start : start + size])
        start += size
    return True


def _cut_of(search: Search, result: Relaxations, lane: int, lower, upper):
    """Cut of R, the problem without the integer moves' own weight: value at `at`, and gradient."""
    c = search.constants
    at = result.x[lane, c.integer]
    gradient = result.gradient[lane, c.integer].copy()
    # undo the box of the integers that the bound minimised over, and the linearised own weight
    value = result.bound[lane] - np.minimum(gradient * (lower - at), gradient * (upper - at)).sum()
    if c.levels:
        price = result.envelope[lane].reshape(c.levels, -1)
        knot = c.knot.reshape(c.levels, -1)
        value -= (price * at - knot * np.abs(price)).sum()
        gradient -= price.sum(axis=0)
    return float(value), at, gradient


def _outer_approximation(
    search: Search, root: Relaxations, lower, upper, seconds: float | None
) -> tuple[bool, float]:
    """Close the reduced problem with MILPs over cuts; returns whether it is closed, and the bound reached."""
    from jaxmpc.highs import ReducedMilp  # HiGHS is loaded when it is first needed

    c = search.constants
    limit = None if seconds is None else time.perf_counter() + seconds
    width = int((upper - lower).max(initial=0)) + 1
    values = lower[:, None] + np.arange(width)[None, :]
    own = c.own_weight[:, None] * values.astype(float) ** 2
    master = ReducedMilp(
        search.chains, lower, upper, own, unit=search.reference if np.isfinite(search.value) else c.scale
    )
    wide = search.relax(lower[None], upper[None])
    search.nodes += 1
    master.add_cut(*_cut_of(search, wide, 0, lower, upper))
    if search.x is not None:
        here = np.round(search.x[c.integer]).astype(int)
        neighbourhood = _neighbours(search, here, lower, upper)
        result = search.evaluate(neighbourhood)
        for i, point in enumerate(neighbourhood):
            master.add_cut(*_cut_of(search, result, i, point, point))
    best_bound = max(float(wide.bound[0]), 0.0)
    while True:
        left = None if limit is None else limit - time.perf_counter()
        if left is not None and left <= 0:
            return False, best_bound
        bound, point, finished = master.solve(left)
        best_bound = max(best_bound, min(bound, search.value))
        if bound >= search.cutoff:
            return True, best_bound
        if point is None or not finished:
            return False, best_bound
        search.nodes += 1
        if point.tobytes() in search.seen:
            master.forbid(point)  # solved before: its value is known, only what is left matters
            continue
        neighbourhood = _neighbours(search, point, lower, upper)
        result = search.evaluate(neighbourhood)
        for i, other in enumerate(neighbourhood):
            master.add_cut(*_cut_of(search, result, i, other, other))
        master.forbid(point)


def _neighbours(search: Search, point: np.ndarray, lower, upper) -> np.ndarray:
    """The point and feasible points one step away, as many as one batch holds."""
    points = [point]
    for i in np.flatnonzero(upper > lower):
        for step in (-1, 1):
            other = point.copy()
            other[i] += step
            points.append(other)
    # a step moved from one block to the next keeps later positions
    free = np.flatnonzero(upper > lower)
    for i, j in itertools.pairwise(free):
        for step in (-1, 1):
            other = point.copy()
            other[i] += step
            other[j] -= step
            points.append(other)
    array = np.array(points)
    good = satisfied(search.chains, array, lower, upper)
    new = np.array([p.tobytes() not in search.seen for p in array])
    keep = good & new
    keep[0] = True
    return array[keep][:BATCH]


def _branch_and_bound(search: Search, root: Relaxations, lower, upper, root_bound: float) -> float:
    """Best-first branch and bound, a batch of nodes at a time; returns the least bound still open."""
    c = search.constants
    counter = itertools.count()
    model = search.lower_model(
        root,
        0,
        np.round(search.limits[0][c.integer]).astype(int),
        np.round(search.limits[1][c.integer]).astype(int),
    )
    heap = [(root_bound, next(counter), lower, upper, model, root.x[0, c.integer], root.start(0))]
    while heap:
        if heap[0][0] >= search.cutoff:
            search.discard(heap[0][0])
            return np.inf
        if search.out_of_time():
            return heap[0][0]
        children = []
        while heap and len(children) < max(search.lanes - 1, 1):
            bound, _, low, high, model, center, start = heapq.heappop(heap)
            if bound >= search.cutoff:
                search.discard(bound)
                continue
            children += [(*child, start) for child in _split(bound, low, high, model, center)]
        if not children:
            continue
        low, high = np.array([ch[1] for ch in children]), np.array([ch[2] for ch in children])
        low, high, possible = propagate(search.chains, low, high)
        bounds = np.array([ch[0] for ch in children])
        low, high, bounds = low[possible], high[possible], bounds[possible]
        starts = [child[3] for child, keep in zip(children, possible, strict=True) if keep]
        if not len(low):
            continue
        result = search.relax(low, high, starts)
        search.nodes += len(low)
        leaf = (low == high).all(axis=1)
        candidates = []
        for i in range(len(low)):
            bounds[i] = max(bounds[i], float(result.bound[i]))
            if leaf[i]:
                if satisfied(search.chains, low[i : i + 1], low[i], high[i])[0]:
                    search.seen.add(low[i].tobytes())
                    if result.objective[i] < search.value:
                        search.value, search.x = float(result.objective[i]), result.x[i]
                    search.discard(float(min(bounds[i], result.objective[i])))
            elif bounds[i] < search.cutoff:
                candidates.append(search.rounded(result.x[i, c.integer], low[i], high[i]))
        search.try_points(candidates[:BATCH])
        for i in np.flatnonzero(~leaf):
            if bounds[i] >= search.cutoff:
                search.discard(float(bounds[i]))
                continue
            model = search.lower_model(result, i, low[i], high[i])
            tight_low, tight_high = exclude(model, search.cutoff)
            search.discard(max(float(bounds[i]), search.cutoff))
            tight_low, tight_high, good = propagate(search.chains, tight_low[None], tight_high[None])
            if good[0]:
                entry = (
                    float(bounds[i]),
                    next(counter),
                    tight_low[0],
                    tight_high[0],
                    model,
                    result.x[i, c.integer],
                    result.start(i),
                )
                heapq.heappush(heap, entry)
    return np.inf


def _split(bound: float, low, high, model: LowerModel, center) -> list[tuple]:
    """Two children of a node, on the move whose better side costs most by the node's own prices."""
    free = np.flatnonzero(high > low)
    if not len(free):
        return [(bound, low, high)]
    best, choice = -1.0, (free[0], low[free[0]])
    for i in free:
        values = np.arange(low[i], high[i] + 1)
        away = values - center[i]
        curve = 0.5 * away**2 / model.radius[i] if np.isfinite(model.radius[i]) else np.zeros(len(values))
        cost = model.excess[i, values - model.lower[i]] + curve
        cut = int(np.clip(np.floor(center[i] + 1e-9), low[i], high[i] - 1))
        if (
            abs(center[i] - np.round(center[i])) < 1e-6
        ):  # whole already: separate the cheapest value from the rest
            cut = int(np.clip(np.round(center[i]), low[i], high[i] - 1))
        down, up = cost[values <= cut].min(), cost[values > cut].min()
        score = min(down, up) * (1.0 + 1e-3) + 1e-3 * max(down, up)
        if score > best:
            best, choice = score, (i, cut)
    i, cut = choice
    left, right = high.copy(), low.copy()
    left[i], right[i] = cut, cut + 1
    values = np.arange(low[i], high[i] + 1)
    cost = model.value + model.excess[i, values - model.lower[i]]
    return [
        (max(bound, cost[values <= cut].min()), low, left),
        (max(bound, cost[values > cut].min()), right, high),
    ]
