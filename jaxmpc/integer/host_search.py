"""State of one exact solve over whole moves: incumbent, bound of what was discarded, time spent.

`integer` runs the line of a solve on it; `enumeration`, `outer_approximation` and `branch_and_bound` are ways to close it. A
search is a generator: it yields what it needs solved and is sent the results, so that `scheduling` serves many side by side.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmpc.integer.actuators import Actuator
from jaxmpc.integer.chain import Chain, chains_of, rows_of, whole
from jaxmpc.integer.feasible import satisfied
from jaxmpc.integer.followed import followed
from jaxmpc.integer.lower_bound import LowerModel
from jaxmpc.integer.nearest import UndecidedError, held_within, nearest
from jaxmpc.integer.relaxer import LaneLimits, Relaxations
from jaxmpc.integer.symmetry import orders_of
from jaxmpc.integer.tables import Constants
from jaxmpc.problem.instance import QpInstance
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.progress import Seen
from jaxmpc.relaxed.gap import FINEST, closes, cutoff, reference, relative_gap
from jaxmpc.relaxed.newton import WarmStart
from jaxmpc.status import FAILED, INFEASIBLE, LIMIT, OPTIMAL, OUT_OF_TIME, UNPROVEN

NO_MOVES = "no moves satisfy the hard limits: positions, moves per sample, oscillation rows, mean-move limit"
NOT_CLOSED = "rounding leaves a gap that branching does not close"
NEARLY = 1e-12  # of a curvature, added where it may be singular
GROUP = 8  # problems a search asks for at once: as many as one small batch holds


@dataclasses.dataclass(frozen=True)
class Request:
    """Relaxed problems a search wants solved: their limits and where to start, first axis ``"lane"``.

    Each is solved in its `most` Newton steps at most: where these are none, it is only evaluated. The answer holds as many
    of them, the first ones, as the time limit leaves time for; None for none.
    """

    limits: LaneLimits
    starts: WarmStart
    most: np.ndarray


@dataclasses.dataclass(frozen=True)
class Offload:
    """Work outside the device (a MILP) that a search wants done in a thread; None comes back where its time ends before."""

    work: Callable[[], Any]


class OutOfTimeError(Exception):
    """The time limit of a search is used up, or the next piece of its work would not end in time."""


Steps = Generator[Request | Offload, Any, Any]  # a search, or a part of one


@dataclasses.dataclass
class SearchResult:
    """Outcome of an integer solve: scaled moves, value, bound, status code, who finished, nodes, root prices, seconds.

    `reason` is a sentence that says why it is not optimal, None where it is.
    """

    x: np.ndarray | None
    value: float
    bound: float
    status: int
    finished_by: str | None
    nodes: int
    root: WarmStart | None = None
    seconds: float = 0.0
    reason: str | None = None


def no_whole_moves(by: str | None = None, nodes: int = 0) -> SearchResult:
    """Of a problem whose hard limits no whole moves satisfy."""
    return SearchResult(None, np.inf, np.inf, INFEASIBLE, by, nodes, reason=NO_MOVES)


class Known(NamedTuple):
    """What is known of a problem before its search: scaled moves, their value (infinite for none), and a bound."""

    x: np.ndarray
    value: float
    bound: float


class Search:
    """State of one integer solve.

    Args:
        constants: of the structure, model and tuning.
        instance: the problem of this sample, on the host.
        root: its solved relaxation, lane 0.
        gap: relative gap at which a solve is optimal.
        time_limit: seconds of work on this problem after which the best plan so far is returned; None for none.
        actuators: what the integer MVs must keep besides limits and rows; none if that is all.
    """

    def __init__(
        self,
        constants: Constants,
        instance: QpInstance,
        root: Relaxations,
        gap: float,
        time_limit: float | None,
        actuators: Sequence[Actuator] = (),
    ):
        self.constants, self.instance, self.time_limit = constants, instance, time_limit
        self.gap = max(gap, FINEST)
        self.limits = np.asarray(instance.lower), np.asarray(instance.upper)
        self.chains: list[Chain] = chains_of(constants.structure, constants.size, instance, actuators)
        self.restricted = any(chain.restricted for chain in self.chains)
        integer = constants.integer
        self.orders = orders_of(constants, self.chains, *(limits[integer] for limits in self.limits))
        # whether it takes more than the chains to tell which whole moves can be followed
        self.followed = constants.structure.relaxed_moves and constants.size.windows > 0
        self.root, self.start = root, root.start(0)
        self.root_bound = max(float(root.bound[0]), 0.0)  # every term of (6.6) is non-negative
        self.value, self.x = np.inf, None
        self.left_out = np.inf  # least bound of everything that was discarded
        self.still_open = -np.inf  # least bound of what is open, as far as it is known
        self.stopped = False  # whether the time limit has ended it
        self.reason = NOT_CLOSED  # why it ends if that is without a proof and before its time
        self.nodes = 1
        self.seen: set[bytes] = set()
        self.spent = 0.0  # seconds of work so far, kept by the scheduler,
        self.clock: Clock | None = None  # with what has run since

    # ---- bookkeeping
    @property
    def cutoff(self) -> float:
        """Bounds from here on cannot improve the incumbent by more than the gap."""
        return cutoff(self.value, self.constants.scale, self.gap) if np.isfinite(self.value) else np.inf

    @property
    def reference(self) -> float:
        """What gaps of the incumbent are relative to."""
        return reference(self.value, self.constants.scale)

    def out_of_time(self) -> bool:
        """Whether the time limit is used up."""
        self.stopped = self.stopped or (self.time_limit is not None and self._used() >= self.time_limit)
        return self.stopped

    def check_time(self) -> None:
        """Called inside whatever may take longer than a millisecond.

        Raises:
            OutOfTimeError: where the time limit is used up.
        """
        if self.out_of_time():
            raise OutOfTimeError

    def _used(self) -> float:
        return self.spent + (self.clock.seconds if self.clock else 0.0)

    def seconds_left(self) -> float | None:
        """Seconds to the time limit, None without one."""
        return None if self.time_limit is None else max(self.time_limit - self._used(), 0.0)

    def seen_after(self, seconds: float) -> Seen:
        """What is known of it now, for whoever waits."""
        value, bound = self.value, min(max(min(self.left_out, self.still_open), self.root_bound), self.value)
        gap = float(relative_gap(value, bound, self.constants.scale)) if np.isfinite(value) else np.nan
        return Seen(seconds, value, bound, gap)

    def take(self, known: Known) -> None:
        """Start from what others have found."""
        self.root_bound = max(self.root_bound, known.bound)
        if known.value < self.value and self.allows(known.x):
            self.value, self.x = known.value, known.x.copy()

    def may_tighten(self) -> bool:
        """Whether chords tighten the relaxation, as far as there is time to find out."""
        weight = self.constants.chords_within(self.seconds_left())
        return weight is not None and bool(weight.any())

    def discard(self, bound: float) -> None:
        """Record the bound of something that is not searched further."""
        self.left_out = min(self.left_out, bound)

    # ---- relaxations
    def relax(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        starts: list[WarmStart] | None = None,
        positions: tuple[np.ndarray, np.ndarray] | None = None,
        most: float | np.ndarray = np.inf,
    ) -> Steps:
        """Solve relaxed problems with integer limits ``"batch integer"``; returns `Relaxations`.

        Args:
            lower: integer lower limits.
            upper: integer upper limits.
            starts: prices to start from, one per problem; the root's if not given.
            positions: lower and upper limits of the position after every integer move [steps]; the problem's own if not
                given.
            most: Newton steps of a problem, or of each, after which it is taken as it is; 0 evaluates the moves of the
                starts.

        Raises:
            OutOfTimeError: where there is no time for all of them; those that are solved were offered as incumbents.
        """
        count, integer = len(lower), self.constants.integer
        own = *self.limits, np.asarray(self.instance.row_low), np.asarray(self.instance.row_high)
        limits = LaneLimits(*(np.repeat(v[None], count, axis=0) for v in own))
        limits.lower[:, integer], limits.upper[:, integer] = lower, upper
        if positions is not None:
            rows = self.constants.position
            limits.row_low[:, rows], limits.row_high[:, rows] = rows_of(*positions)
        if starts is None:
            stacked = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (count, *leaf.shape)), self.start)
        else:
            stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *starts)
        result = yield Request(limits, stacked, np.broadcast_to(np.asarray(most, dtype=float), count))
        self.stopped = self.stopped or result is None or len(result.bound) < count
        if result is None:
            raise OutOfTimeError
        if len(result.bound) < count:
            for lane in range(len(result.bound)):
                self.offer(result, lane)
            raise OutOfTimeError
        return result

    def offer(self, result: Relaxations, lane: int) -> None:
        """Take a solved problem with its integer moves rounded as incumbent if that is better."""
        if result.snapped[lane] < self.value and np.isfinite(result.x[lane]).all():
            if self.restricted and not self.allows(result.x[lane]):
                return
            self.value, self.x = float(result.snapped[lane]), result.x[lane].copy()
            self.x[self.constants.integer] = np.round(self.x[self.constants.integer])

    def evaluate(self, points: np.ndarray, bounds: np.ndarray | None = None) -> Steps:
        """Solve the problems with the whole moves fixed, take the best as incumbent, discard the rest.

        Returns:
            `Relaxations`.
        """
        result = yield from self.relax(points, points)
        known = result.bound if bounds is None else np.maximum(result.bound, bounds)
        for i, point in enumerate(points):
            self.offer(result, i)
            self.settle(point, float(known[i]), float(result.snapped[i]))
        return result

    def settle(self, point: np.ndarray, bound: float, value: float) -> None:
        """Record that whole moves were solved: nothing is left of them beyond their bound and their value."""
        self.seen.add(point.tobytes())
        c = self.constants
        if (
            value == np.inf
            and self.followed
            and not followed(c.structure, c.size, c.qp.rows, self.instance, point)
        ):
            return
        self.discard(min(bound, value))

    def lower_model(self, result: Relaxations, lane: int, lower: np.ndarray, upper: np.ndarray) -> LowerModel:
        """The quadratic lower bound over the whole moves that a relaxed solve within these limits proves."""
        c = self.constants
        center = result.x[lane, c.integer]
        slope = result.gradient[lane, c.integer]
        width = int((upper - lower).max(initial=0)) + 1
        values = lower[:, None] + np.arange(width)[None, :]
        least = np.minimum(slope * (lower - center), slope * (upper - center))
        excess = slope[:, None] * (values - center[:, None]) - least[:, None]
        for steep, knot, price in zip(c.slope, c.knot, result.envelope[lane][:, c.integer], strict=True):
            own = steep[:, None] * np.maximum(np.abs(values) - knot, 0.0)
            excess += own - price[:, None] * values + (knot * np.abs(price))[:, None]
        value = float(result.bound[lane])
        if len(
            result.position[lane]
        ):  # complete the square: the same bound about another center of what is free
            more, bend = c.of_chords(result.position[lane], center)
            step, free = np.zeros(len(center)), np.flatnonzero(upper > lower)
            own = c.schur[np.ix_(free, free)]
            step[free] = np.linalg.solve(own + NEARLY * own.trace() * np.eye(len(free)), bend[free])
            bent = c.schur @ step
            rest = np.where(upper > lower, bend - bent, 0.0)  # next to nothing
            least = np.minimum(rest * (lower - center), rest * (upper - center))
            excess += rest[:, None] * (values - center[:, None]) - least[:, None]
            value += more + least.sum() - 0.5 * step @ bent
            center = center - step
        excess = np.where(values <= upper[:, None], np.maximum(excess, 0.0), np.inf)
        return LowerModel(value, center, lower, upper, excess, c.schur, c.radius, c.order, c.leading)

    # ---- incumbents
    def allows(self, x: np.ndarray) -> bool:
        """Whether moves, the integer ones rounded, keep all that whole moves must."""
        low, high = (whole(values[self.constants.integer]) for values in self.limits)
        return bool(satisfied(self.chains, whole(x[self.constants.integer])[None], low, high)[0])

    def rounded(self, moves: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """Whole moves near `moves` that satisfy the hard rows, or None where there are none; see `nearest`."""
        point = np.clip(whole(moves), lower, upper)
        if satisfied(self.chains, point[None], lower, upper)[0]:
            return point
        point = nearest(self.chains, moves, lower, upper, self.check_time)
        return point if point is not None and satisfied(self.chains, point[None], lower, upper)[0] else None

    def new(self, points: Sequence[np.ndarray | None]) -> np.ndarray:
        """The points that have not been evaluated yet, each once, ``"point integer"``."""
        fresh = {p.tobytes(): p for p in points if p is not None and p.tobytes() not in self.seen}
        return np.array(list(fresh.values())).reshape(len(fresh), len(self.constants.integer))

    def salvaged(self, starts: Sequence[np.ndarray]) -> Steps:
        """Without a plan at the end of the time: one that needs no solve, near the relaxed moves, a start, or no moves."""
        c = self.constants
        low, high = (whole(limits[c.integer]) for limits in self.limits)
        relaxed = np.nan_to_num(self.root.x[0])
        for wanted in (relaxed[c.integer], *starts, np.zeros(len(low))):
            point = np.clip(whole(wanted), low, high)
            if satisfied(self.chains, point[None], low, high)[0]:
                break
        else:
            with contextlib.suppress(UndecidedError):
                point = nearest(self.chains, relaxed[c.integer], low, high)
            if point is None or not satisfied(self.chains, point[None], low, high)[0]:
                return
        x = held_within(c.structure, c.size, self.instance, relaxed)
        x[c.integer] = point
        start = dataclasses.replace(self.start, x=x)
        with contextlib.suppress(OutOfTimeError):
            result = yield from self.relax(point[None], point[None], [start], most=0.0)
            self.offer(result, 0)

    # ---- finishing
    def finish(self, by: str | None, bound: float) -> SearchResult:
        """Assemble the result; `bound` is the least bound of what is still open."""
        bound = min(max(min(self.left_out, bound), self.root_bound), self.value)
        if self.x is None:
            if by is not None:
                return no_whole_moves(by, self.nodes)
            status, reason = (LIMIT, OUT_OF_TIME) if self.stopped else (FAILED, self.reason)
            return SearchResult(None, np.inf, bound, status, None, self.nodes, reason=reason)
        if closes(self.value, bound, self.constants.scale, self.gap):
            return SearchResult(self.x, self.value, bound, OPTIMAL, by, self.nodes, self.start)
        status, reason = (LIMIT, OUT_OF_TIME) if self.stopped else (UNPROVEN, self.reason)
        return SearchResult(self.x, self.value, bound, status, None, self.nodes, self.start, reason=reason)
