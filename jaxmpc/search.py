"""State of one exact solve over whole moves: batched relaxations, incumbent, bound of what was discarded.

`integer` runs the line of a solve on it; `outer_approximation` and `branch_and_bound` are two ways to close it.
"""

from __future__ import annotations

import dataclasses
import time

import equinox as eqx
import jax
import numpy as np

from jaxmpc.blocking import hard_rows
from jaxmpc.condense import CondensedQp, QpInstance, integer_columns
from jaxmpc.levelset import LowerModel, schur_complement
from jaxmpc.newton import WarmStart, warm_start_of
from jaxmpc.propagation import Chain, chains_of, nearest, satisfied
from jaxmpc.relaxation import cold_start, solve_relaxed
from jaxmpc.status import FAILED, INFEASIBLE, LIMIT, OPTIMAL
from jaxmpc.structure import Structure

BATCH = 16  # lanes of a batched relaxation call; fewer than `SINGLE` problems are solved one by one
SINGLE = 9
MANY = 64  # nodes or points from which a search works in full batches
WIDE = 128  # variables from which problems are solved one by one


_COMPILED: set = set()  # forms of the relaxation that this process has called before


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
        self.cold = jax.tree.map(np.asarray, cold_start(qp, len(self.rows)))
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
    """Outcome of an integer solve: scaled moves, value, bound, status code, who finished, nodes, root prices,
    seconds spent compiling.
    """

    x: np.ndarray | None
    value: float
    bound: float
    status: int
    finished_by: str | None
    nodes: int
    root: WarmStart | None = None
    compiling: float = 0.0


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
        self.compiling = 0.0  # seconds of first calls
        self.start = constants.cold
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
            out = self._timed(qp, wide_low[pad], wide_high[pad], stacked)
            used = min(size, count - first)
            parts.append(jax.tree.map(lambda v, n=used: np.asarray(v)[:n], out))
        return Relaxations(*jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts))

    def _timed(self, qp: CondensedQp, lower, upper, starts):
        """Call the relaxation; a first call compiles, which is not held against the time limit."""
        arguments = (qp, self.constants.rows, self.instance, lower, upper, starts)
        form = (len(lower), qp.packed is None, self.constants.structure, qp.theta.shape, qp.has_limits)
        if form not in _COMPILED:
            begin = time.perf_counter()
            jax.block_until_ready(_relax(*arguments))
            _COMPILED.add(form)
            self.compiling += time.perf_counter() - begin
            if self.deadline is not None:
                self.deadline += time.perf_counter() - begin
        return _relax(*arguments)

    def offer(self, result: Relaxations, lane: int) -> None:
        """Take a solved problem with whole moves as incumbent if it is better."""
        if result.objective[lane] < self.value and np.isfinite(result.x[lane]).all():
            self.value, self.x = float(result.objective[lane]), result.x[lane]

    def evaluate(self, points: np.ndarray, bounds: np.ndarray | None = None) -> Relaxations:
        """Solve the problems with the whole moves fixed, take the best as incumbent, discard the rest."""
        result = self.relax(points, points)
        for i in range(len(points)):
            self.seen.add(points[i].tobytes())
            self.offer(result, i)
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
            self.compiling,
        )
