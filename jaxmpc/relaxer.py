"""Batched relaxations for the integer searches of many scenarios: lanes of any scenario share one compiled call.

A scenario is one controller step. What scenarios have in common (the dynamic matrix, nearly always) stays single, so that
the Newton matrices of all lanes are one matrix product; what differs is picked per lane on the device.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.batch import lanes_of
from jaxmpc.blocking import hard_rows
from jaxmpc.condense import CondensedQp, QpInstance, integer_columns
from jaxmpc.levelset import assignment_order, leading_factor, root_factor, schur_complement
from jaxmpc.newton import WarmStart, warm_start_of
from jaxmpc.packing import Packing
from jaxmpc.relaxation import cold_start, solve_relaxed
from jaxmpc.relaxed_problem import evaluate
from jaxmpc.structure import Structure

SIZES = (1, 8, 64)  # lanes of a call, one compiled program each; a batch is padded to the least that holds it
SINGLY = 3  # problems up to which calls of one lane are faster than a padded batch
WIDE = 128  # variables from which problems are solved one by one
ROW_ROUNDING = 1e-6  # slack of the hard rows of rounded moves, which are whole numbers themselves

_COMPILED: set = set()  # forms of the relaxation that this process has called before


class Constants:
    """What the search needs of a `CondensedQp`, computed once per structure, model and tuning."""

    def __init__(self, structure: Structure, qp: CondensedQp):
        self.structure, self.qp = structure, qp
        self.rows = hard_rows(structure)
        predictions = structure.cv_count * structure.horizon_count
        self.cold = jax.tree.map(np.asarray, cold_start(qp, len(self.rows), predictions))
        self.integer = integer_columns(structure)
        self.scales = np.asarray(qp.scale)  # MV units per unit of x
        hessian = np.asarray(qp.hessian)
        self.schur, self.radius = schur_complement(hessian, self.integer)
        self.root_factor = root_factor(self.schur)
        self.order = assignment_order(structure.block_count, len(structure.integer_mvs))
        self.leading = leading_factor(self.schur[np.ix_(self.order, self.order)])
        self.slope = np.asarray(qp.soft_linear)[predictions:]  # of the envelope rows
        self.knot = np.asarray(qp.deadzone)[predictions:]
        self.levels = len(self.slope) // max(len(self.integer), 1)
        self.scale = max(float(np.diag(np.asarray(qp.curvature)).max()), 1e-12)
        full = np.diag(np.asarray(qp.curvature))[self.integer]
        self.own_weight = (
            0.5 * (full - np.diag(hessian)[self.integer]) if self.levels else np.zeros(len(self.integer))
        )


@dataclasses.dataclass
class Relaxations:
    """Results of a batch of relaxed problems, on the host; first axis is the batch.

    Attributes:
        x: moves.
        objective, bound, status: as in `QpSolution`.
        snapped: objective with the integer moves rounded where they are and the others kept; infinite if that breaks
            a hard row.
        gradient: price of the lower less that of the upper limit of x, the slope of the optimum in a fixed move.
        envelope: prices of the envelope rows.
        warm: moves and prices, to start neighbours from.
    """

    x: np.ndarray
    objective: np.ndarray
    bound: np.ndarray
    status: np.ndarray
    snapped: np.ndarray
    gradient: np.ndarray
    envelope: np.ndarray
    warm: WarmStart

    def start(self, lane: int) -> WarmStart:
        """Moves and prices of one lane."""
        return jax.tree.map(lambda leaf: leaf[lane], self.warm)

    def part(self, begin: int, end: int) -> Relaxations:
        """Some of the lanes."""
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Relaxations(**{k: jax.tree.map(lambda leaf: leaf[begin:end], v) for k, v in own.items()})


class Solved(NamedTuple):
    """What a search reads of one relaxed problem, or of a batch; see `Relaxations`."""

    warm: WarmStart
    objective: Any
    bound: Any
    snapped: Any
    status: Any


def relax(qp: CondensedQp, rows, integer, instance: QpInstance, lower, upper, start: WarmStart) -> Solved:
    """Relax one problem within limits of the moves, and evaluate its moves with the integer ones rounded."""
    s = solve_relaxed(qp, rows, instance, lower, upper, start)
    snapped = s.x.at[integer].set(jnp.round(s.x[integer]))
    w = rows @ snapped
    fits = jnp.all((w <= instance.row_high + ROW_ROUNDING) & (w >= instance.row_low - ROW_ROUNDING))
    fits &= jnp.all((snapped <= instance.upper + ROW_ROUNDING) & (snapped >= instance.lower - ROW_ROUNDING))
    value = jnp.where(fits, evaluate(qp, instance, snapped), jnp.inf)
    return Solved(warm_start_of(s), s.objective, s.bound, value, s.status)


@functools.partial(jax.jit, static_argnames="packings")
def _relax(shared, own, rows, integer, problems, index, lanes, packings):
    """Relaxations of lanes that belong to the scenarios `index`; goes in and comes out packed."""
    of_instances, of_lanes, of_solved = packings
    pick = lambda tree: jax.tree.map(lambda leaf: leaf[index], tree)  # noqa: E731

    def lane(own, instance, given):
        return relax(eqx.combine(own, shared), rows, integer, instance, *given)

    solved = jax.vmap(lane)(pick(own), of_instances.unpack(problems[index]), of_lanes.unpack(lanes))
    return of_solved.pack(solved)


def relaxations(solved: Solved, predictions: int) -> Relaxations:
    """What came back from a compiled call, on the host.

    Args:
        solved: of a batch.
        predictions: rows before those of the envelope.
    """
    x, row_price, box_price = (
        np.asarray(v) for v in (solved.warm.x, solved.warm.row_price, solved.warm.box_price)
    )
    return Relaxations(
        x=x,
        objective=solved.objective,
        bound=solved.bound,
        status=solved.status,
        snapped=solved.snapped,
        gradient=-box_price,
        envelope=row_price[:, predictions:],
        warm=solved.warm,
    )


class Relaxer:
    """The compiled relaxations of a group of scenarios with one structure.

    Args:
        constants: one per scenario, or a single one that all scenarios share.
    """

    def __init__(self, constants: Sequence[Constants]):
        self.constants = constants
        first = constants[0]
        self.structure, self.rows, self.integer = first.structure, first.rows, first.integer
        self.lanes = lanes_of([c.qp for c in constants])
        self.hard, self.columns = jnp.asarray(self.rows), jnp.asarray(self.integer)
        self.one = len(constants) == 1
        self.compiling = 0.0  # seconds of first calls so far
        rows, n = first.qp.response.shape
        self.sizes = SIZES if n <= WIDE else SIZES[:1]
        self.predictions = rows - len(first.knot)
        numbers: Any = lambda *shape: jax.ShapeDtypeStruct((1, *shape), jnp.float64)  # noqa: E731
        sizes = n, rows, self.predictions, n, len(self.rows)
        start = WarmStart(*(numbers(size) for size in sizes))
        self.of_lanes = Packing.of((numbers(n), numbers(n), start))
        self.solved_shapes = Solved(
            start, numbers(), numbers(), numbers(), jax.ShapeDtypeStruct((1,), jnp.int32)
        )
        self.of_solved = Packing.of(self.solved_shapes)

    def scenario(self, index: int) -> Constants:
        """Constants of a scenario."""
        return self.constants[0 if self.one else index]

    def solve(
        self,
        instances: QpInstance,
        index: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        starts: WarmStart,
    ) -> Relaxations:
        """Solve relaxed problems, in padded batches of few sizes.

        Args:
            instances: problems of all scenarios, first axis ``"scenario"``.
            index: scenario of each lane.
            lower: limits of all moves ``"lane n"``.
            upper: the same.
            starts: moves and prices to start from, ``"lane"``.
        """
        count, parts, begin = len(index), [], 0
        of_instances = Packing.of(instances)
        problems = of_instances.pack(jax.tree.map(np.asarray, instances))
        lanes = self.of_lanes.pack((lower, upper, starts))
        while begin < count:
            size = self._size(count - begin)
            pad = np.minimum(begin + np.arange(size), count - 1)
            solved = self._call(problems, index[pad], lanes[pad], of_instances)
            used = min(size, count - begin)
            parts.append(solved[:used])
            begin += used
        return relaxations(
            self.of_solved.unpack(parts[0] if len(parts) == 1 else np.concatenate(parts)), self.predictions
        )

    def compile(self, instances: QpInstance, warm: WarmStart) -> None:
        """Compile what searches call: single problems and small batches, and large ones where there are many scenarios."""
        lower, upper = np.asarray(instances.lower), np.asarray(instances.upper)
        for size in [s for s in self.sizes if s <= max(SIZES[1], len(lower))]:
            index = np.zeros(size, dtype=int)
            start = jax.tree.map(lambda leaf, i=index: np.asarray(leaf)[i], warm)
            self.solve(instances, index, lower[index], upper[index], start)

    def _size(self, count: int) -> int:
        """Lanes of the next call; a few problems are solved one by one, they would pay for the padding."""
        if count <= SINGLY:
            return 1
        return next((s for s in self.sizes if s >= count), self.sizes[-1])

    def fitting(self, warm: WarmStart | None, count: int) -> WarmStart:
        """The starts if they have as many rows as the problems (wider integer ranges have more), else cold ones."""
        cold = self.scenario(0).cold
        if warm is not None and np.shape(warm.row_price)[-1] == len(cold.row_price):
            return jax.tree.map(np.asarray, warm)
        return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (count, *leaf.shape)), cold)

    def solve_roots(self, instances: QpInstance, warm: WarmStart) -> Relaxations:
        """Relaxations of all scenarios themselves, within their own limits."""
        index = np.arange(len(instances.lower))
        lower, upper = np.asarray(instances.lower), np.asarray(instances.upper)
        return self.solve(instances, index, lower, upper, jax.tree.map(np.asarray, warm))

    def _call(self, problems, index, lanes, of_instances: Packing) -> np.ndarray:
        """Call the relaxation; a first call compiles, which is not held against a time limit."""
        packings = of_instances, self.of_lanes, self.of_solved
        arguments = (self.lanes.shared, self.lanes.each, self.hard, self.columns, problems, index, lanes)
        form = problems.shape, lanes.shape, packings, jax.tree.structure(arguments)
        if form not in _COMPILED:
            begin = time.perf_counter()
            jax.block_until_ready(_relax(*arguments, packings=packings))
            _COMPILED.add(form)
            self.compiling += time.perf_counter() - begin
        return np.asarray(_relax(*arguments, packings=packings))
