"""Batched relaxations for the searches on the host: lanes of any scenario share one compiled call.

A scenario is one controller step. What scenarios have in common (the dynamic matrix, nearly always) stays single;
what differs is picked per lane on the device.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.integer.search import Relaxed, relax
from jaxmpc.integer.tables import Constants
from jaxmpc.problem.condense import CondensedQp
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.layout import Size
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.lanes import Lanes, lanes_of
from jaxmpc.programs.pace import Pace
from jaxmpc.relaxed.newton import WarmStart
from jaxmpc.relaxed.solve import cold_start

LANES = 8  # of a call; a batch is cut into so many, the last is filled up with lanes that are not solved


@dataclasses.dataclass
class Relaxations:
    """Results of a batch of relaxed problems, on the host; first axis is the batch.

    Attributes:
        warm: moves and prices, to start neighbours from.
        objective, bound, status, snapped, steps: as in `search.Relaxed`.
    """

    warm: WarmStart
    objective: np.ndarray
    bound: np.ndarray
    snapped: np.ndarray
    status: np.ndarray
    steps: np.ndarray

    @classmethod
    def of(cls, solved: Relaxed) -> Relaxations:
        """What came back from a compiled call."""
        return cls(*jax.tree.map(np.asarray, solved))

    @property
    def x(self) -> np.ndarray:
        """Moves."""
        return self.warm.x  # pyright: ignore[reportReturnType]

    @property
    def gradient(self) -> np.ndarray:
        """Price of the lower less that of the upper limit of x, the slope of the optimum in a fixed move."""
        return -self.warm.box_price  # pyright: ignore[reportReturnType]

    @property
    def envelope(self) -> np.ndarray:
        """Prices of the envelope, ``"batch level n"``."""
        return self.warm.envelope_price  # pyright: ignore[reportReturnType]

    @property
    def hard(self) -> np.ndarray:
        """Prices of the hard rows, ``"batch hard"``, upper limits positive."""
        return self.warm.hard_price  # pyright: ignore[reportReturnType]

    @property
    def position(self) -> np.ndarray:
        """Prices of the chords of squared positions, ``"batch position"``; empty where there are none."""
        return self.warm.position_price  # pyright: ignore[reportReturnType]

    def start(self, lane: int) -> WarmStart:
        """Moves and prices of one lane."""
        return jax.tree.map(lambda leaf: leaf[lane], self.warm)

    @classmethod
    def joined(cls, parts: Sequence[Relaxations]) -> Relaxations:
        """Batches one after the other."""
        if len(parts) == 1:
            return parts[0]
        fields = (field.name for field in dataclasses.fields(cls))
        return cls(
            *(jax.tree.map(lambda *v: np.concatenate(v), *(getattr(p, f) for p in parts)) for f in fields)
        )

    def part(self, begin: int, end: int) -> Relaxations:
        """Some of the lanes."""
        fields = (getattr(self, field.name) for field in dataclasses.fields(self))
        return Relaxations(*jax.tree.map(lambda leaf: leaf[begin:end], tuple(fields)))


class LaneLimits(NamedTuple):
    """Limits of relaxed problems, in the units of `QpInstance`; first axis is the lane.

    Attributes:
        lower, upper: of all moves.
        row_low, row_high: of the hard rows.
    """

    lower: np.ndarray
    upper: np.ndarray
    row_low: np.ndarray
    row_high: np.ndarray


@jax.jit
def _relax(qps: Lanes, instances: QpInstance, index, limits: LaneLimits, starts, count, most) -> Relaxed:
    """Relaxations of lanes that belong to the scenarios `index`; those from `count` on are not solved.

    Each is solved in its `most` Newton steps at most.
    """
    pick = lambda tree: jax.tree.map(lambda leaf: leaf[index], tree)  # noqa: E731

    def lane(own, instance, limits: LaneLimits, start, there, most):
        # limits of no width leave nothing to solve
        low, high = (jnp.where(there, v, 0.0) for v in (limits.lower, limits.upper))
        rows = limits.row_low, limits.row_high
        instance = eqx.tree_at(lambda i: (i.row_low, i.row_high), instance, rows)
        return relax(eqx.combine(own, qps.shared), instance, low, high, start, most=most)

    there = jnp.arange(LANES) < count
    return jax.vmap(lane)(pick(qps.each), pick(instances), limits, starts, there, most)


def pace_of(size: Size) -> Pace:
    """Of relaxations of a size, before the first is solved."""
    return Pace(size.moves, size.cvs * size.horizon)


class Relaxer:
    """The compiled relaxations of a group of scenarios of one size.

    Args:
        qps: constant parts of their problems, shared or per scenario.
        constants: one per scenario, or a single one that all scenarios share.
        pace: of these relaxations as far as it is known.
    """

    def __init__(self, qps: Lanes, constants: Sequence[Constants], pace: Pace | None = None):
        self.qps, self.constants = jax.tree.map(jnp.asarray, qps), constants
        self.pace = pace_of(constants[0].size) if pace is None else pace

    def part(self, index: np.ndarray) -> Relaxer:
        """The relaxations of some scenarios; nothing is computed again."""
        if len(self.constants) == 1:
            return self
        return Relaxer(self.qps.take(index), [self.constants[i] for i in index], self.pace)

    def with_chords(self, index: int) -> Relaxer:
        """The relaxations of one scenario whose positions pay along chords what they can (`tighten`)."""
        constants, qp = self.scenario(index), self.problem(index)
        weight = np.zeros(constants.size.mvs * constants.size.rows)
        weight[constants.position] = constants.chord_weight
        values = qp.hessian - qp.rows.square(jnp.asarray(2.0 * weight)), jnp.asarray(weight)
        fields = lambda qp: (qp.hessian, qp.position_weight)  # noqa: E731
        tight = eqx.tree_at(fields, qp, values, is_leaf=lambda leaf: leaf is None)
        return Relaxer(lanes_of([tight]), [constants], self.pace)

    def problem(self, index: int) -> CondensedQp:
        """Constant part of a scenario's problems."""
        return self.qps.lane(index) if self.qps.count else self.qps.shared

    def scenario(self, index: int) -> Constants:
        """Constants of a scenario."""
        return self.constants[0 if len(self.constants) == 1 else index]

    def solve(
        self,
        instances: QpInstance,
        index: np.ndarray,
        limits: LaneLimits,
        starts: WarmStart,
        most: float | np.ndarray = np.inf,
    ) -> Relaxations:
        """Solve relaxed problems.

        Args:
            instances: problems of all scenarios, first axis ``"scenario"``.
            index: scenario of each lane.
            limits: of every lane, in place of those of its scenario.
            starts: moves and prices to start from, ``"lane"``.
            most: Newton steps of a lane, or of each, after which it is judged as it is; none evaluate the moves it
                starts from.
        """
        count, parts = len(index), []
        most = np.broadcast_to(np.asarray(most, dtype=float), count)
        for begin in range(0, count, LANES):
            pad = np.minimum(begin + np.arange(LANES), count - 1)
            *some, patience = jax.tree.map(lambda leaf, pad=pad: leaf[pad], (index, limits, starts, most))
            used = min(LANES, count - begin)
            clock = Clock()
            solved = _relax(self.qps, instances, *some, used, patience)
            own = jax.tree.map(lambda leaf, used=used: np.asarray(leaf)[:used], solved)
            parts.append(Relaxations.of(own))
            if patience.any():
                self.pace.took(clock.seconds, int(parts[-1].steps.sum()), used)
        return Relaxations.joined(parts)

    def cold(self, instances: QpInstance) -> WarmStart:
        """Starts that know nothing, one per scenario."""
        count = len(instances.lower)
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[0], instances)
        start = jax.tree.map(np.asarray, cold_start(self.problem(0), one))
        return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (count, *leaf.shape)), start)

    def solve_roots(self, instances: QpInstance, warm: WarmStart, most: float = np.inf) -> Relaxations:
        """Relaxations of all scenarios themselves, within their own limits; `most` as in `solve`."""
        index = np.arange(len(instances.lower))
        own = (instances.lower, instances.upper, instances.row_low, instances.row_high)
        limits = LaneLimits(*map(np.asarray, own))
        return self.solve(instances, index, limits, jax.tree.map(np.asarray, warm), most)
