"""Our relaxed problems of recorded samples as arrays on the device: instances, warm starts, solves, plans."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.controller.controller import Controller
from jaxmpc.problem.instance import make_instance
from jaxmpc.relaxed.newton import warm_start_of
from jaxmpc.relaxed.problem import QpSolution
from jaxmpc.relaxed.solve import cold_start, shifted_start, solve_relaxed
from studies.bench.instances import Instances, Problems


def _solve(qp, instance, start) -> QpSolution:
    return solve_relaxed(qp, instance, instance.lower, instance.upper, start)


_solve_one, _solve_many = jax.jit(_solve), jax.jit(jax.vmap(_solve, in_axes=(None, 0, 0)))


class Lanes:
    """The relaxed problems of a continuous controller, ready to be solved one at a time or as a batch."""

    def __init__(self, instances: Instances):
        self.structure = instances.structure
        self.controller = Controller(instances.structure, instances.tuning, instances.model)
        self.core = self.controller.core
        self.qp = self.core.qp
        self.instances = self._build(instances.now)
        self.cold: Any = jax.jit(jax.vmap(lambda instance: cold_start(self.qp, instance)))(self.instances)
        self._before = instances.before

    def _build(self, problems: Problems):
        core, given = self.core, problems._asdict()
        for name in ("free_response", "setpoint"):
            given[name] = self.controller.lanes.over_horizon(given[name])
        earlier = core.size.past - given["past_moves"].shape[1]
        given["past_moves"] = np.pad(given["past_moves"], ((0, 0), (earlier, 0), (0, 0)))
        make = functools.partial(make_instance, core.layout, core.size, core.tuning, core.qp, recover=True)
        return jax.jit(jax.vmap(lambda one: make(**one)))(given)

    @functools.cached_property
    def warm(self) -> Any:
        """Where a controller would start: the solution one sample earlier, shifted."""
        earlier = self._singles(self._build(self._before), self.cold)
        found = [_solve_one(self.qp, *single) for single in earlier]
        solutions = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
        shift = functools.partial(shifted_start, cvs=self.structure.cv_count)
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
        return jax.block_until_ready(_solve_one(self.qp, *single))

    def batch(self, start, count: int) -> tuple[Any, Any]:
        """Problems and starts of a batch of any size; lanes are repeated where there are fewer."""
        index = jnp.asarray(np.arange(count) % len(self.instances.offset))
        return jax.block_until_ready(
            jax.tree.map(lambda leaf: jnp.take(leaf, index, axis=0), (self.instances, start))
        )

    def solve_batch(self, batch: tuple[Any, Any]) -> QpSolution:
        """Solve a batch in one call; blocks until it is done."""
        return jax.block_until_ready(_solve_many(self.qp, *batch))

    def plans(self, x) -> list[np.ndarray]:
        """Plans ``"block mv"`` [MV unit] of solutions ``"lane n"``."""
        scaled = np.asarray(x) * np.asarray(self.qp.scale)
        blocks = self.structure.block_count
        return [row.reshape(self.structure.mv_count, -1).T[:blocks] for row in scaled]
