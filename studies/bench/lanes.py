"""Our relaxed problems of recorded samples as arrays on the device: instances, warm starts, solves, plans."""

from __future__ import annotations

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.problem.blocking import hard_rows
from jaxmpc.problem.condense import condense, make_instance
from jaxmpc.relaxed.newton import warm_start_of
from jaxmpc.relaxed.problem import QpSolution
from jaxmpc.relaxed.solve import cold_start, shifted_start, solve_relaxed
from studies.bench.instances import Instances, Problems


@eqx.filter_jit
def _solve_one(rows, qp, instance, start) -> QpSolution:
    return solve_relaxed(qp, rows, instance, instance.lower, instance.upper, start)


@eqx.filter_jit
def _solve_many(rows, qp, instances, starts) -> QpSolution:
    def lane(instance, start):
        return solve_relaxed(qp, rows, instance, instance.lower, instance.upper, start)

    return jax.vmap(lane)(instances, starts)


class Lanes:
    """The relaxed problems of recorded samples, ready to be solved one at a time or as a batch.

    Args:
        instances: of a continuous controller.
    """

    def __init__(self, instances: Instances):
        self.structure, self.tuning = instances.structure, instances.tuning
        make = functools.partial(
            condense, self.structure, self.tuning, instances.model.coefficients, envelope=0
        )
        self.qp = make()
        self.rows = hard_rows(self.structure)
        self.instances = self._build(instances.now)
        predictions = self.structure.cv_count * self.structure.horizon_count
        self.cold: Any = self._repeat(cold_start(self.qp, len(self.rows), predictions), len(instances))
        self._before = instances.before

    def _build(self, problems: Problems):
        def one(free, setpoint, now, last, past):
            return make_instance(
                self.structure,
                self.tuning,
                self.qp,
                free_response=free,
                setpoint=setpoint,
                mv_now=now,
                last_move=last,
                past_moves=past,
                recover=True,
            )

        return jax.jit(jax.vmap(one))(*(jnp.asarray(values) for values in problems))

    def _repeat(self, tree, count: int):
        return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], count, axis=0), tree)

    @functools.cached_property
    def warm(self) -> Any:
        """Where a controller would start: the solution one sample earlier, shifted."""
        earlier = self._singles(self._build(self._before), self.cold)
        found = [_solve_one(self.rows, self.qp, *single) for single in earlier]
        solutions = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
        shift = functools.partial(
            shifted_start, cvs=self.structure.cv_count, horizon=self.structure.horizon_count
        )
        return jax.jit(jax.vmap(lambda solution: shift(warm_start_of(solution))))(solutions)

    def singles(self, start) -> list[tuple[Any, Any]]:
        """Problem and start of every lane by itself, so that taking them apart is not timed."""
        return self._singles(self.instances, start)

    def _singles(self, instances, start) -> list[tuple[Any, Any]]:
        parts = jax.tree.map(np.asarray, (instances, start))  # taken apart on the host
        return jax.device_put(
            [jax.tree.map(lambda leaf, i=i: leaf[i], parts) for i in range(len(parts[0].offset))]
        )

    def solve_single(self, single: tuple[Any, Any]) -> QpSolution:
        """Solve one of `singles`; blocks until it is done."""
        return jax.block_until_ready(_solve_one(self.rows, self.qp, *single))

    def batch(self, start, count: int) -> tuple[Any, Any]:
        """Problems and starts of a batch of any size; lanes are repeated where there are fewer."""
        index = jnp.asarray(np.arange(count) % len(self.instances.offset))
        return jax.block_until_ready(
            jax.tree.map(lambda leaf: jnp.take(leaf, index, axis=0), (self.instances, start))
        )

    def solve_batch(self, batch: tuple[Any, Any]) -> QpSolution:
        """Solve a batch in one call; blocks until it is done."""
        return jax.block_until_ready(_solve_many(self.rows, self.qp, *batch))

    def plans(self, x) -> list[np.ndarray]:
        """Plans ``"block mv"`` [MV unit] of solutions ``"lane n"``."""
        scaled = np.asarray(x) * np.asarray(self.qp.scale)
        return [row.reshape(self.structure.mv_count, -1).T for row in scaled]
