"""Batched relaxations for the integer searches of many scenarios: lanes of any scenario share one compiled call.

A scenario is one controller step. What scenarios have in common (the dynamic matrix, nearly always) stays single, so that
the Newton matrices of all lanes are one matrix product; what differs is picked per lane on the device.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.batch import lanes_of
from jaxmpc.blocking import hard_rows
from jaxmpc.condense import CondensedQp, QpInstance, integer_columns
from jaxmpc.levelset import assignment_order, leading_factor, root_factor, schur_complement
from jaxmpc.newton import WarmStart, warm_start_of
from jaxmpc.relaxation import cold_start, solve_relaxed
from jaxmpc.relaxed_problem import evaluate
from jaxmpc.structure import Structure

SIZES = (1, 8, 64)  # lanes of a call, one compiled program each; a batch is padded to the least that holds it
LEAN = 8  # lanes up to which the packed products are not worth streaming through the cache
WIDE = 128  # variables from which problems are solved one by one
ROW_ROUNDING = 1e-6  # slack of the hard rows of rounded moves, which are whole numbers themselves

_COMPILED: set = set()  # forms of the relaxation that this process has called before


class Constants:
    """What the search needs of a `CondensedQp`, computed once per structure, model and tuning."""

    def __init__(self, structure: Structure, qp: CondensedQp):
        self.structure, self.qp = structure, qp
        self.rows = hard_rows(structure)
        self.cold = jax.tree.map(np.asarray, cold_start(qp, len(self.rows)))
        self.integer = integer_columns(structure)
        hessian = np.asarray(qp.hessian)
        self.schur, self.radius = schur_complement(hessian, self.integer)
        self.root_factor = root_factor(self.schur)
        self.order = assignment_order(structure.block_count, len(structure.integer_mvs))
        self.leading = leading_factor(self.schur[np.ix_(self.order, self.order)])
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


@jax.jit
def _relax(shared, own, rows, integer, instances, index, lower, upper, starts):
    """Relaxations of lanes that belong to the scenarios `index`; returns only what a search reads."""
    pick = lambda tree: jax.tree.map(lambda leaf: leaf[index], tree)  # noqa: E731

    def lane(own, instance, low, high, start):
        qp = eqx.combine(own, shared)
        predictions = instance.limit_high.shape[0]
        s = solve_relaxed(qp, rows, instance, low, high, start)
        snapped = s.x.at[integer].set(jnp.round(s.x[integer]))
        w = rows @ snapped
        fits = jnp.all((w <= instance.row_high + ROW_ROUNDING) & (w >= instance.row_low - ROW_ROUNDING))
        fits &= jnp.all(
            (snapped <= instance.upper + ROW_ROUNDING) & (snapped >= instance.lower - ROW_ROUNDING)
        )
        value = jnp.where(fits, evaluate(qp, instance, snapped), jnp.inf)
        envelope = s.row_price[predictions:]
        slope = s.lower_price - s.upper_price
        return s.x, s.objective, s.bound, s.status, value, slope, envelope, warm_start_of(s)

    return jax.vmap(lane)(pick(own), pick(instances), lower, upper, starts)


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
        self.lean = eqx.tree_at(
            lambda q: q.packed, self.lanes.shared, None, is_leaf=lambda leaf: leaf is None
        )
        self.hard, self.columns = jnp.asarray(self.rows), jnp.asarray(self.integer)
        self.one = len(constants) == 1
        self.compiling = 0.0  # seconds of first calls so far
        n = first.qp.theta.shape[1]
        self.sizes = SIZES if n <= WIDE else SIZES[:1]

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
        while begin < count:
            size = next((s for s in self.sizes if s >= count - begin), self.sizes[-1])
            pad = np.minimum(begin + np.arange(size), count - 1)
            lanes = (index[pad], lower[pad], upper[pad], jax.tree.map(lambda leaf: leaf[pad], starts))  # noqa: B023
            out = self._call(instances, *lanes)
            used = min(size, count - begin)
            parts.append(jax.tree.map(lambda v, n=used: np.asarray(v)[:n], out))
            begin += used
        if len(parts) == 1:
            return Relaxations(*parts[0])
        return Relaxations(*jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts))

    def solve_roots(self, instances: QpInstance, warm: WarmStart) -> Relaxations:
        """Relaxations of all scenarios themselves, within their own limits."""
        index = np.arange(len(instances.lower))
        lower, upper = np.asarray(instances.lower), np.asarray(instances.upper)
        return self.solve(instances, index, lower, upper, jax.tree.map(np.asarray, warm))

    def _call(self, instances, index, lower, upper, starts):
        """Call the relaxation; a first call compiles, which is not held against a time limit."""
        shared = self.lean if len(index) <= LEAN else self.lanes.shared
        arguments = (shared, self.lanes.each, self.hard, self.columns, instances, index, lower, upper, starts)
        form = jax.tree.structure(arguments), tuple(np.shape(leaf) for leaf in jax.tree.leaves(arguments))
        if form not in _COMPILED:
            begin = time.perf_counter()
            jax.block_until_ready(_relax(*arguments))
            _COMPILED.add(form)
            self.compiling += time.perf_counter() - begin
        return _relax(*arguments)
