"""MPC with whole moves of the integer MVs (thesis chapter 6), for one controller or many that advance together.

Prediction, bookkeeping and the problems of a sample are compiled and mapped over the scenarios; `step_solver` decides
the whole moves of all of them side by side on the host.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxmpc import status as codes
from jaxmpc.batch import Lanes, lanes_of
from jaxmpc.condense import CondensedQp, QpInstance, make_instance
from jaxmpc.controller import ControllerState, Memory, StepInfo, first_move, outside_limits
from jaxmpc.errors import InputError
from jaxmpc.integer import FINISHES
from jaxmpc.newton import WarmStart
from jaxmpc.plan import Planner
from jaxmpc.relaxer import Relaxer
from jaxmpc.step_response import StepResponseModel, check_match
from jaxmpc.step_solver import StepSolver, fitting
from jaxmpc.structure import Structure, check_vector
from jaxmpc.tuning import Tuning


class MixedIntegerControllers:
    """Mixed-integer controllers of one structure, one per scenario, that advance together.

    Args:
        structure: static configuration with at least one integer MV.
        tunings: one per scenario, or a single one for all.
        models: one per scenario, or a single one for all.
        count: number of scenarios where it does not follow from the tunings or models.
        gap: relative gap of a solve.
        time_limit: seconds of work per scenario and sample, None for none.
        finish: path that closes the integer problems, see `jaxmpc.integer`.
    """

    def __init__(
        self,
        structure: Structure,
        tunings: Sequence[Tuning],
        models: Sequence[StepResponseModel],
        *,
        count: int | None = None,
        gap: float = 1e-6,
        time_limit: float | None = None,
        finish: str = "auto",
    ):
        if not structure.integer_mvs:
            raise InputError(
                "structure.integer_step",
                list(structure.integer_step),
                "at least one integer MV",
                "Use ContinuousController for continuous moves",
            )
        if finish not in FINISHES:
            raise InputError("finish", finish, f"one of {', '.join(FINISHES)}")
        counts = {len(tunings), len(models), count or 1} - {1}
        if len(counts) > 1 or not tunings or not models:
            raise InputError(
                "tunings", f"{len(tunings)} with {len(models)} models", "one for all or one per scenario"
            )
        for model in models:
            check_match(structure, model)
        self.structure, self.count = structure, counts.pop() if counts else 1
        self.gap, self.time_limit, self.finish = gap, time_limit, finish
        self.solver = StepSolver(structure, tunings, models)
        self.memory = lanes_of(
            [
                Memory(structure, t, m.extended(max(structure.prediction_horizon, m.samples)))
                for t, m in zip(self.solver.tunings, self.solver.models, strict=True)
            ]
        )

    def init(
        self, cv: Float[np.ndarray, "scenario cv"], mv: Float[np.ndarray, "scenario mv"]
    ) -> ControllerState:
        """State at steady states with measured CVs and present MVs (engineering units)."""
        for path, value, names in (("cv", cv, self.structure.cv_names), ("mv", mv, self.structure.mv_names)):
            if np.shape(value) != (self.count, len(names)) or not np.isfinite(value).all():
                expected = f"finite numbers of shape {[self.count, len(names)]}"
                raise InputError(path, f"shape {list(np.shape(value))}", expected)
        cold = fitting(None, self.solver.relaxer(1), self.count)
        return _init(self.memory, cv, mv, cold)

    def prepare(self, state: ControllerState, cv: Float[np.ndarray, "scenario cv"]) -> None:
        """Compile what every sample needs; arguments as in `step`."""
        self.step(state, cv, cv)

    def step(
        self,
        state: ControllerState,
        cv: Float[np.ndarray, "scenario cv"],
        setpoint: Float[np.ndarray, "scenario cv"],
    ) -> tuple[ControllerState, StepInfo]:
        """One sample of all scenarios.

        Args:
            state: from `init` or the previous step.
            cv: measurements now [CV unit].
            setpoint: held over the horizon [CV unit].
        """
        begin, compiled = time.perf_counter(), self.solver.compiling
        known = np.isfinite(np.asarray(cv)).all(axis=1)
        target = np.asarray(setpoint, dtype=np.float64)
        narrow = self.solver.relaxer(1)
        state, free_response, ready = _observe(
            self.memory, narrow.lanes, state, np.asarray(cv, dtype=np.float64), target
        )

        def instances_of(relaxer: Relaxer) -> QpInstance:
            if relaxer is narrow:
                return ready
            return _instances(self.memory, relaxer.lanes, state, free_response, target)

        relaxer, instances, results, roots = self.solver.solve(
            instances_of,
            previous_moves=np.asarray(state.plan),
            warm=state.warm,
            gap=self.gap,
            time_limit=self.time_limit,
            finish=self.finish,
        )
        good = known & np.array([result.x is not None for result in results])
        none = np.zeros(instances.lower.shape[-1])
        x = np.stack([none if r.x is None else r.x for r in results])
        fits = roots.warm.row_price.shape[-1] == state.warm.row_price.shape[-1]
        warm = roots.warm if fits else state.warm
        state, moves, recovering = _remember(self.memory, relaxer.lanes, instances, state, x, good, warm)
        moves = np.asarray(moves)
        certified = lambda values: np.where(good, values, np.nan)  # noqa: E731
        value, bound = (np.array([getattr(r, key) for r in results]) for key in ("value", "bound"))
        scale = np.array([relaxer.scenario(i).scale for i in range(self.count)])
        with np.errstate(invalid="ignore"):
            gap = np.maximum(value - bound, 0.0) / np.maximum(np.abs(value), 1e-6 * scale)
        seconds = np.array([r.seconds for r in results])
        wall = time.perf_counter() - begin - (self.solver.compiling - compiled)
        values: dict[str, Any] = dict(  # on the host: NumPy where the compiled controller has JAX arrays
            move=moves[:, 0],
            mv=np.asarray(state.mv),
            moves=moves,
            status=np.where(known, [r.status for r in results], codes.FAILED),
            fallback=~good,
            recovering=np.asarray(recovering),
            objective=certified(value),
            bound=certified(bound),
            gap=certified(gap),
            nodes=np.array([r.nodes for r in results]),
            finished_by=np.where(good, [codes.finisher_code(r.finished_by) for r in results], 0),
            # prediction and bookkeeping are shared evenly
            solve_time=seconds + max(wall - float(seconds.sum()), 0.0) / self.count,
        )
        return state, StepInfo(**values)


@jax.jit
def _init(memory: Lanes[Memory], cv, mv, cold: WarmStart) -> ControllerState:
    return jax.vmap(lambda own, *args: eqx.combine(own, memory.shared).init(*args))(memory.each, cv, mv, cold)


@jax.jit
def _observe(memory: Lanes[Memory], qps: Lanes[CondensedQp], state: ControllerState, cv, setpoint):
    """Bias and free response after a measurement, and the problems for moves of one step: ``"scenario"``."""

    def lane(own, state, cv):
        return eqx.combine(own, memory.shared).observe(state, cv)

    state, free_response = jax.vmap(lane)(memory.each, state, cv)
    return state, free_response, _instances(memory, qps, state, free_response, setpoint)


@jax.jit
def _instances(
    memory: Lanes[Memory], qps: Lanes[CondensedQp], state: ControllerState, free_response, setpoint
):
    """The problems of one sample, ``"scenario"``."""

    def lane(own, own_qp, state, free_response, setpoint):
        its = eqx.combine(own, memory.shared)
        return make_instance(
            its.structure,
            its.tuning,
            eqx.combine(own_qp, qps.shared),
            free_response=free_response,
            setpoint=jnp.broadcast_to(setpoint, free_response.shape),
            mv_now=state.mv,
            last_move=state.last_move,
            past_moves=state.past_moves,
            recover=True,
        )

    return jax.vmap(lane)(memory.each, qps.each, state, free_response, setpoint)


@jax.jit
def _remember(
    memory: Lanes[Memory], qps: Lanes[CondensedQp], instances, state: ControllerState, x, good, warm
):
    """Apply the first moves of the plans that there are: ``(state, planned moves, recovering)``."""

    def lane(own, own_qp, instance, state, x, good, warm):
        its, qp = eqx.combine(own, memory.shared), eqx.combine(own_qp, qps.shared)
        planned = (x * qp.scale).reshape(its.structure.mv_count, -1).T
        moves = jnp.where(good, planned.at[0].set(first_move(its.structure, qp, instance, planned[0])), 0.0)
        recovering = outside_limits(its.tuning, state.mv)
        warm = jax.tree.map(lambda new, old: jnp.where(good, new, old), warm, state.warm)
        return its.remember(state, moves[0], moves, warm), moves, recovering

    return jax.vmap(lane)(memory.each, qps.each, instances, state, x, good, warm)


class MixedIntegerController:
    """MPC with whole moves of the integer MVs (thesis chapter 6); runs on the host, solves exactly.

    Args:
        structure: static configuration with at least one integer MV.
        tuning: weights and limits.
        model: step-response model.
        gap: relative gap of a solve.
        time_limit: seconds per solve, None for none.
        finish: path that closes the integer problem, see `jaxmpc.integer`.
    """

    def __init__(
        self,
        structure: Structure,
        tuning: Tuning,
        model: StepResponseModel,
        *,
        gap: float = 1e-6,
        time_limit: float | None = None,
        finish: str = "auto",
    ):
        self._together = MixedIntegerControllers(
            structure, [tuning], [model], gap=gap, time_limit=time_limit, finish=finish
        )
        self.structure, self.tuning, self.model = structure, tuning, model
        self.gap, self.time_limit, self.finish = gap, time_limit, finish

    @functools.cached_property
    def planner(self) -> Planner:
        """Solves single steps of this controller, with the whole plan in engineering units."""
        return Planner(self.structure, self.tuning, self.model)

    @property
    def memory(self) -> Memory:
        """Prediction and bookkeeping of this controller."""
        return self._together.memory.lane(0)

    def init(self, cv, mv) -> ControllerState:
        """State at a steady state with measured CVs and present MVs (engineering units)."""
        check_vector("cv", cv, self.structure.cv_names, "CV unit")
        check_vector("mv", mv, self.structure.mv_names, "MV unit")
        return _first(self._together.init(np.asarray(cv)[None], np.asarray(mv)[None]))

    def prepare(self, state: ControllerState, cv) -> None:
        """Compile what every sample needs; arguments as in `step`."""
        self.step(state, cv, cv)

    def step(self, state: ControllerState, cv, setpoint) -> tuple[ControllerState, StepInfo]:
        """One sample; arguments as in `ContinuousController.step`."""
        lane = jax.tree.map(lambda leaf: np.asarray(leaf)[None], state)
        together = self._together.step(lane, np.asarray(cv)[None], np.asarray(setpoint)[None])
        return _first(together)


def _first(tree):
    return jax.tree.map(
        lambda leaf: np.asarray(leaf)[0], tree
    )  # on the host: indexing a JAX array is a dispatch
