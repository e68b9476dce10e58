"""Batched relaxations for the integer searches of many scenarios: lanes of any scenario share one compiled call.

A scenario is one controller step. What scenarios have in common (the dynamic matrix, nearly always) stays single, so that
the Newton matrices of all lanes are one matrix product; what differs is picked per lane on the device.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.controller.batch import Lanes, lanes_of
from jaxmpc.integer.constants import Constants
from jaxmpc.integer.listing import Tables
from jaxmpc.integer.search import Decision, decide, searchable
from jaxmpc.problem.condense import QpInstance
from jaxmpc.programs.packing import Packing, flattened, rebuilt
from jaxmpc.relaxed.gap import FINEST
from jaxmpc.relaxed.newton import WarmStart
from jaxmpc.relaxed.solve import Solved, relax

SIZES = (1, 8, 64)  # lanes of a call, one compiled program each; a batch is padded to the least that holds it
SINGLY = 3  # problems up to which calls of one lane are faster than a padded batch
WIDE = 128  # variables from which problems are solved one by one

_COMPILED: set = set()  # forms of the relaxation that this process has called before


def forget_programs() -> None:
    """Drop the compiled programs of this process. Each takes memory mappings, of which Linux allows a process 65,530."""
    jax.clear_caches()
    _COMPILED.clear()


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
        steps: Newton steps and interior-point iterations.
    """

    x: np.ndarray
    objective: np.ndarray
    bound: np.ndarray
    status: np.ndarray
    snapped: np.ndarray
    gradient: np.ndarray
    envelope: np.ndarray
    warm: WarmStart
    steps: np.ndarray

    @property
    def solved(self) -> Solved:
        """What came back from the compiled call."""
        return Solved(self.warm, self.objective, self.bound, self.snapped, self.status, self.steps)

    def start(self, lane: int) -> WarmStart:
        """Moves and prices of one lane."""
        return jax.tree.map(lambda leaf: leaf[lane], self.warm)

    def part(self, begin: int, end: int) -> Relaxations:
        """Some of the lanes."""
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Relaxations(**{k: jax.tree.map(lambda leaf: leaf[begin:end], v) for k, v in own.items()})


@functools.partial(jax.jit, static_argnames=("structure", "form", "packings"))
def _decide(structure, leaves, problems, index, roots, gap, form, packings):
    """Searches of lanes that belong to the scenarios `index`; goes in and comes out packed."""
    of_instances, of_solved = packings
    lanes, tables, rows, _ = rebuilt(form, leaves)
    shared, own = (lanes.shared, tables.shared), (lanes.each, tables.each)
    pick = lambda tree: jax.tree.map(lambda leaf: leaf[index], tree)  # noqa: E731

    def lane(own, instance, root):
        qp, tables = eqx.combine(own, shared)
        return decide(structure, qp, tables, rows, instance, root, gap)

    found = jax.vmap(lane)(pick(own), of_instances.unpack(problems[index]), of_solved.unpack(roots))
    return Packing.of(found).pack(found)


@functools.partial(jax.jit, static_argnames=("form", "packings"))
def _relax(leaves, problems, index, lanes, form, packings):
    """Relaxations of lanes that belong to the scenarios `index`; goes in and comes out packed."""
    of_instances, of_lanes, of_solved = packings
    qps, _, rows, integer = rebuilt(form, leaves)
    pick = lambda tree: jax.tree.map(lambda leaf: leaf[index], tree)  # noqa: E731

    def lane(own, instance, given):
        return relax(eqx.combine(own, qps.shared), rows, integer, instance, *given)

    solved = jax.vmap(lane)(pick(qps.each), of_instances.unpack(problems[index]), of_lanes.unpack(lanes))
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
        steps=solved.steps,
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
            start, numbers(), numbers(), numbers(), *(jax.ShapeDtypeStruct((1,), jnp.int32),) * 2
        )
        self.of_solved = Packing.of(self.solved_shapes)
        shapes: Any = (jax.ShapeDtypeStruct((1,), t) for t in (bool, jnp.float64, jnp.int64))
        flag, number, code = shapes
        self.of_decision = Packing.of(Decision(flag, numbers(n), number, number, code, code, code))

    def part(self, index: np.ndarray) -> Relaxer:
        """The relaxations of some scenarios; nothing is compiled or computed again."""
        some = copy.copy(self)
        some.compiling = 0.0
        some.__dict__.pop("_flat", None)
        if not self.one:
            some.constants, some.lanes = [self.constants[i] for i in index], self.lanes.take(index)
            if self.tables is not None:
                some.tables = self.tables.take(index)
        return some

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

    @functools.cached_property
    def tables(self) -> Lanes[Tables] | None:
        """What compiled searches read; None where they do not know the structure."""
        return lanes_of([Tables.of(c) for c in self.constants]) if searchable(self.structure) else None

    @functools.cached_property
    def _flat(self) -> tuple[list[jax.Array], Any]:
        """All constants, taken apart."""
        return flattened((self.lanes, self.tables, self.hard, self.columns))

    def decide(self, instances: QpInstance, index: np.ndarray, roots: Relaxations, gap: float) -> Decision:
        """Search scenarios in compiled programs, as far as these go.

        Args:
            instances: problems of all scenarios, first axis ``"scenario"``.
            index: scenarios to search.
            roots: relaxations of all scenarios.
            gap: relative gap.
        """
        assert self.tables is not None
        of_instances, count = Packing.of(instances), len(index)
        problems = of_instances.pack(jax.tree.map(np.asarray, instances))
        solved = self.of_solved.pack(roots.solved)
        (leaves, form), packings = self._flat, (of_instances, self.of_solved)
        parts, begin = [], 0
        while begin < count:
            size = next((s for s in self.sizes if s >= count - begin), self.sizes[-1])
            pad = np.minimum(begin + np.arange(size), count - 1)
            lanes = solved[index[pad]]
            lanes[count - begin :] = np.nan  # no root: nothing is searched
            arguments = self.structure, leaves, problems, index[pad], lanes, max(gap, FINEST), form, packings
            call = lambda a=arguments: np.asarray(_decide(*a))  # noqa: E731
            what = "decide", self.structure, problems.shape, lanes.shape, packings, form
            found = self._timed(what, call)
            parts.append(found[: count - begin])
            begin += size
        found = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return self.of_decision.unpack(found)

    def compile(self, shapes: QpInstance, warm: WarmStart) -> None:
        """Compile what nearly every search calls: the compiled search, or relaxations in batches of a few sizes.

        Args:
            shapes: problems of all scenarios, or the shapes of their arrays.
            warm: where relaxations start.
        """
        instances = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), shapes)
        lower, upper = np.asarray(instances.lower), np.asarray(instances.upper)
        if self.tables is not None:
            blank = jax.tree.map(lambda v: np.zeros((len(lower), *v.shape[1:]), v.dtype), self.solved_shapes)
            roots = relaxations(blank._replace(bound=np.full(len(lower), np.nan)), self.predictions)
            for size in self.sizes:
                self.decide(instances, np.zeros(size, dtype=int), roots, 1e-6)
                if size >= len(lower):
                    return
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
        """Call the relaxation; compilation is not held against a time limit."""
        (leaves, form), packings = self._flat, (of_instances, self.of_lanes, self.of_solved)
        call = lambda: np.asarray(_relax(leaves, problems, index, lanes, form, packings))  # noqa: E731
        return self._timed((problems.shape, lanes.shape, packings, form), call)

    def _timed(self, what, call):
        """The result of a compiled call; what a first call of its kind takes is counted as compilation."""
        if what not in _COMPILED:
            begin = time.perf_counter()
            call()
            _COMPILED.add(what)
            self.compiling += time.perf_counter() - begin
        return call()
