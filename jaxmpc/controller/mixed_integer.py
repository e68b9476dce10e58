"""MPC with whole moves of the integer MVs (thesis chapter 6), for one controller or many that advance together.

Prediction, bookkeeping and the problems of a sample are compiled and mapped over the scenarios; `step_solver` decides
the whole moves of all of them side by side on the host.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from jaxmpc import status as codes
from jaxmpc.controller.batch import Lanes, lanes_of
from jaxmpc.controller.continuous import (
    ControllerState,
    Memory,
    StepInfo,
    first_move,
    may_switch,
    outside_limits,
    without,
)
from jaxmpc.controller.plan import Planner
from jaxmpc.controller.sample import Sample, checked, checked_start
from jaxmpc.errors import InputError
from jaxmpc.integer.host_search import SearchResult
from jaxmpc.integer.relaxer import Relaxer, relaxations
from jaxmpc.integer.solve import FINISHES
from jaxmpc.integer.step_solver import StepSolver
from jaxmpc.model.step_response import StepResponseModel, check_match
from jaxmpc.problem.condense import CondensedQp, QpInstance, make_instance
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.programs.packing import Packing
from jaxmpc.programs.threads import compile_together
from jaxmpc.relaxed.gap import check_gap, check_time_limit, relative_gap
from jaxmpc.relaxed.newton import WarmStart
from jaxmpc.relaxed.solve import Solved, relax

KEPT = 8  # combinations of CVs that are switched off, with what their searches need


class MixedIntegerControllers:
    """Mixed-integer controllers of one structure, one per scenario, that advance together.

    Args:
        structure: static configuration with at least one integer MV.
        tunings: one per scenario, or a single one for all.
        models: one per scenario, or a single one for all.
        count: number of scenarios where it does not follow from the tunings or models.
        gap: relative gap of a solve.
        time_limit: seconds of work per scenario and sample, None for none.
        finish: path that closes the integer problems, see `jaxmpc.integer.solve`.
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
        self.gap, self.time_limit = check_gap("gap", gap), check_time_limit("time_limit", time_limit)
        self.finish = finish
        self.solver = StepSolver(structure, tunings, models)
        self.switching = any(may_switch(tuning) for tuning in tunings)
        self._without: dict[bytes, MixedIntegerControllers] = {}
        self._decides = False  # whether a step has been decided
        self.memory = lanes_of(
            [
                Memory(structure, t, m.extended(max(structure.prediction_horizon, m.samples)))
                for t, m in zip(self.solver.tunings, self.solver.models, strict=True)
            ]
        )
        self._packings: dict[str, Packing] = {}
        self._scales: dict[Relaxer, tuple[Lanes, np.ndarray]] = {}

    def part(self, index: np.ndarray) -> MixedIntegerControllers:
        """The controllers of some scenarios, which share what is computed already."""
        if self.count == len(index) and (index == np.arange(self.count)).all():
            return self
        some = copy.copy(self)
        some.count = len(index)
        some.solver, some.memory = self.solver.part(index), self.memory.take(index)
        return some

    @functools.cached_property
    def constants(self) -> tuple[Lanes[CondensedQp], Any, Any]:
        """Of problems for moves of one step: the lanes, and hard rows and integer moves where these are all there are."""
        narrow = self.solver.relaxer(1)
        if not self.solver.narrow:
            return narrow.lanes, None, None
        return narrow.lanes, narrow.hard, narrow.columns

    def scales_of(self, relaxer: Relaxer) -> tuple[Lanes, np.ndarray]:
        """MV units per unit of x as lanes, and the scale of the objective per scenario."""
        if relaxer not in self._scales:
            lanes = Lanes(relaxer.lanes.each.scale, relaxer.lanes.shared.scale)
            self._scales[relaxer] = (
                lanes,
                np.array([relaxer.scenario(i).scale for i in range(self.count)]),
            )
        return self._scales[relaxer]

    def init(
        self, cv: Float[ArrayLike, "scenario cv"], mv: Float[ArrayLike, "scenario mv"]
    ) -> ControllerState:
        """State at steady states with measured CVs and present MVs (engineering units).

        Raises:
            InputError: for other shapes and values that are not finite.
        """
        cv, mv = checked_start(self.structure, cv, mv, lanes=self.count)
        cold = self.solver.relaxer(1).fitting(None, self.count)
        return jax.tree.map(np.asarray, _init(self.memory, cv, mv, cold))

    def prepare(self, state: ControllerState, cv: Float[np.ndarray, "scenario cv"]) -> None:
        """Compile what nearly every sample needs; arguments as in `step`."""
        step = lambda: self.step(state, cv, cv)  # noqa: E731
        if not self.solver.narrow:
            step()
            return
        qps, rows, columns = self.constants
        sample = checked(self.structure, cv, cv, lanes=self.count)
        _, _, shapes, _ = jax.eval_shape(observed, self.memory, qps, rows, columns, state, sample)
        compile_together(step, lambda: self.solver.relaxer(1).compile(shapes, state.warm))

    def step(
        self,
        state: ControllerState,
        cv: Float[ArrayLike, "scenario cv"],
        setpoint: Float[ArrayLike, "scenario cv"] | Float[ArrayLike, "scenario horizon cv"],
        mv: Float[ArrayLike, "scenario mv"] | None = None,
        manual: Bool[ArrayLike, "scenario mv"] | None = None,
    ) -> tuple[ControllerState, StepInfo]:
        """One sample of all scenarios; arguments as in `ContinuousController.step`, the scenario axis first."""
        sample = checked(self.structure, cv, setpoint, mv, manual, lanes=self.count)
        return self.decide(state, sample)

    def decide(self, state: ControllerState, sample: Sample) -> tuple[ControllerState, StepInfo]:
        """`step` of a checked sample."""
        return self._switched(state, sample)._decide(state, sample)

    def _switched(self, state: ControllerState, sample: Sample) -> MixedIntegerControllers:
        """These controllers without the CVs that this sample switches off."""
        if not self.switching:
            return self
        off = np.asarray(_off(self.memory, state, sample.cv))
        if not off.any():
            return self
        pattern = off.tobytes()
        if pattern not in self._without:
            every = self.solver.tunings * (self.count if len(self.solver.tunings) == 1 else 1)
            made = {(id(t), own.tobytes()): without(t, own) for t, own in zip(every, off, strict=True)}
            tunings = [made[id(t), own.tobytes()] for t, own in zip(every, off, strict=True)]
            same: dict[str, Any] = dict(gap=self.gap, time_limit=self.time_limit, finish=self.finish)
            reduced = MixedIntegerControllers(self.structure, tunings, self.solver.models, **same)
            reduced.solver.has_limits = self.solver.has_limits  # so that the same programs serve
            self._without[pattern] = reduced
            while len(self._without) > KEPT:
                self._without.pop(next(iter(self._without)))
        return self._without[pattern]

    def _decide(self, state: ControllerState, sample: Sample) -> tuple[ControllerState, StepInfo]:
        begin, compiled = time.perf_counter(), self.solver.compiling
        narrow = self.solver.relaxer(1)
        target = sample.setpoint
        observed, (state, free_response, ready, root) = self._observe(narrow, state, sample)

        def instances_of(relaxer: Relaxer) -> QpInstance:
            if relaxer is narrow:
                return ready
            return _instances(self.memory, relaxer.lanes, state, free_response, target)

        try:
            relaxer, instances, results, roots = self.solver.solve(
                instances_of,
                root=None if root is None else relaxations(root, narrow.predictions),
                previous_moves=np.asarray(state.plan),
                warm=state.warm,
                gap=self.gap,
                time_limit=self.time_limit,
                finish=self.finish,
            )
        except InputError:  # moves without limits have ranges that follow from the measurements
            if not self._decides:
                raise
            relaxer, instances, roots = narrow, ready, None
            results = [SearchResult(None, np.inf, -np.inf, codes.FAILED, None, 0)] * self.count
        self._decides = True
        good = np.array([result.x is not None for result in results])
        none = np.zeros(instances.lower.shape[-1])
        x = np.stack([none if r.x is None else r.x for r in results])
        if root is None:  # otherwise all that is remembered is there already
            warm = state.warm
            if roots is not None and roots.warm.row_price.shape[-1] == warm.row_price.shape[-1]:
                warm = roots.warm
            observed = state, free_response, instances, Solved(warm, *([np.zeros(self.count)] * 5))
        state, moves, recovering = self._remember(relaxer, observed, x, good)
        certified = lambda values: np.where(good, values, np.nan)  # noqa: E731
        value, bound = (np.array([getattr(r, key) for r in results]) for key in ("value", "bound"))
        scale = self.scales_of(relaxer)[1]
        gap = relative_gap(value, bound, scale)
        seconds = np.array([r.seconds for r in results])
        wall = time.perf_counter() - begin - (self.solver.compiling - compiled)
        values: dict[str, Any] = dict(  # on the host: NumPy where the compiled controller has JAX arrays
            move=moves[:, 0],
            mv=state.mv,
            moves=moves,
            status=np.array([r.status for r in results]),
            fallback=~good,
            recovering=recovering,
            quality=state.sensors.quality,
            off=state.sensors.off,
            objective=certified(value),
            bound=certified(bound),
            gap=certified(gap),
            nodes=np.array([r.nodes for r in results]),
            finished_by=np.where(good, [codes.finisher_code(r.finished_by) for r in results], 0),
            # prediction and bookkeeping are shared evenly
            solve_time=seconds + max(wall - float(seconds.sum()), 0.0) / self.count,
        )
        # the module's own constructor would take longer than all of this
        return state, _INFO.unflatten([values[name] for name in _FIELDS])

    def _observe(self, narrow: Relaxer, state: ControllerState, sample: Sample):
        """`_observe` on the host: packed, and ``(state, free response, problems, relaxations or None)``."""
        given = jax.tree.map(np.asarray, (state, sample))
        qps, rows, columns = self.constants

        def shapes():
            s = self.structure
            free_response = jax.ShapeDtypeStruct((self.count, s.prediction_horizon, s.cv_count), jnp.float64)
            instances = jax.eval_shape(_instances, self.memory, qps, given[0], free_response, sample.setpoint)
            return given[0], free_response, instances, None if rows is None else narrow.solved_shapes

        of_given = self._packing(f"given {sample.setpoint.ndim}", lambda: given)
        packings = of_given, self._packing("observed", shapes)
        observed = np.asarray(_observe(self.memory, qps, rows, columns, of_given.pack(given), packings))
        return observed, packings[1].unpack(observed)

    def _remember(self, relaxer: Relaxer, observed, x, good):
        """`_remember` on the host, for the problems of this relaxer."""
        if isinstance(observed, np.ndarray):
            of_observed = self._packings["observed"]
        else:
            observed = jax.tree.map(np.asarray, observed)
            of_observed = Packing.of(observed)
            observed = of_observed.pack(observed)

        def shapes():
            state = of_observed.unpack(observed)[0]
            return state, state.plan, jax.ShapeDtypeStruct((self.count,), jnp.bool)

        packing = self._packing("remembered", shapes)
        scales, packings = self.scales_of(relaxer)[0], (of_observed, packing)
        return packing.unpack(np.asarray(_remember(self.memory, scales, observed, x, good, packings)))

    def _packing(self, name: str, tree: Callable[[], Any]) -> Packing:
        """The packing of a tree of this name, made when first needed."""
        if name not in self._packings:
            self._packings[name] = Packing.of(tree())
        return self._packings[name]

    def __getstate__(self) -> dict[str, Any]:
        """What a copy needs; all else is made again, and forms of trees do not survive a copy."""
        derived = ("constants", "_packings", "_scales", "_without")
        return {key: value for key, value in self.__dict__.items() if key not in derived}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._packings, self._scales, self._without = {}, {}, {}


_FIELDS = [field.name for field in dataclasses.fields(StepInfo)]
_INFO = jax.tree.structure(StepInfo(*(0,) * len(_FIELDS)))  # pyright: ignore[reportArgumentType]


@jax.jit
def _init(memory: Lanes[Memory], cv, mv, cold: WarmStart) -> ControllerState:
    return jax.vmap(lambda own, *args: eqx.combine(own, memory.shared).init(*args))(memory.each, cv, mv, cold)


@functools.partial(jax.jit, static_argnames="packings")
def _observe(memory: Lanes[Memory], qps: Lanes[CondensedQp], rows, columns, given, packings):
    """`observed`, packed."""
    return packings[1].pack(observed(memory, qps, rows, columns, *packings[0].unpack(given)))


@jax.jit
def _off(memory: Lanes[Memory], state: ControllerState, cv):
    """CVs that are switched off after these measurements, ``"scenario cv"``."""

    def lane(own, sensors, cv):
        return sensors.judged(eqx.combine(own, memory.shared).tuning, cv).off

    return jax.vmap(lane)(memory.each, state.sensors, cv)


def observed(
    memory: Lanes[Memory], qps: Lanes[CondensedQp], rows, columns, state: ControllerState, sample: Sample
):
    """After a measurement, ``"scenario"``: bias and free response, the problems for moves of one step, their relaxations.

    Args:
        memory: prediction and bookkeeping.
        qps: constants of the problems.
        rows: hard rows; None if the relaxations are not wanted.
        columns: integer moves.
        state: before the sample.
        sample: what is known.
    """

    def lane(own, state, sample: Sample):
        return eqx.combine(own, memory.shared).observe(state, sample.cv, sample.mv, sample.manual)

    state, free_response = jax.vmap(lane)(memory.each, state, sample)
    instances = _instances(memory, qps, state, free_response, sample.setpoint)

    def relaxed(own_qp, instance, start):
        qp = eqx.combine(own_qp, qps.shared)
        return relax(qp, rows, columns, instance, instance.lower, instance.upper, start)

    root = None if rows is None else jax.vmap(relaxed)(qps.each, instances, state.warm)
    return state, free_response, instances, root


@jax.jit
def _instances(
    memory: Lanes[Memory], qps: Lanes[CondensedQp], state: ControllerState, free_response, setpoint
):
    """The problems of one sample, ``"scenario"``."""

    def lane(own, own_qp, state, free_response, setpoint):
        its = eqx.combine(own, memory.shared)
        return make_instance(
            its.structure,
            its.limits_now(state),
            eqx.combine(own_qp, qps.shared),
            free_response=free_response,
            setpoint=jnp.broadcast_to(setpoint, free_response.shape),
            mv_now=state.mv,
            last_move=state.last_move,
            past_moves=state.past_moves,
            recover=True,
        )

    return jax.vmap(lane)(memory.each, qps.each, state, free_response, setpoint)


@functools.partial(jax.jit, static_argnames="packings")
def _remember(memory: Lanes[Memory], scales: Lanes, observed, x, good, packings):
    """`remembered`, packed."""
    state, _, instances, root = packings[0].unpack(observed)
    return packings[1].pack(remembered(memory, scales, instances, state, x, good, root.warm))


def remembered(memory: Lanes[Memory], scales: Lanes, instances, state: ControllerState, x, good, warm):
    """Apply the first moves of the plans that there are, ``"scenario"``: ``(state, planned moves, recovering)``.

    Args:
        memory: prediction and bookkeeping.
        scales: MV units per unit of x.
        instances: the problems.
        state: after the measurement.
        x: the plans.
        good: whether there is one; the MVs are held otherwise.
        warm: where the next relaxations start.
    """

    def lane(own, own_scale, instance, state, x, good, warm):
        its, scale = eqx.combine(own, memory.shared), eqx.combine(own_scale, scales.shared)
        planned = (x * scale).reshape(its.structure.mv_count, -1).T
        first = first_move(its.structure, scale, instance, planned[0])
        moves = jnp.where(good, planned.at[0].set(first), 0.0)
        recovering = outside_limits(its.limits_now(state), state.mv)
        warm = jax.tree.map(lambda new, old: jnp.where(good, new, old), warm, state.warm)
        return its.remember(state, moves[0], moves, warm), moves, recovering

    return jax.vmap(lane)(memory.each, scales.each, instances, state, x, good, warm)


class MixedIntegerController:
    """MPC with whole moves of the integer MVs (thesis chapter 6); runs on the host, solves exactly.

    `together` is the same controller as a batch of one.

    Args:
        structure: static configuration with at least one integer MV.
        tuning: weights and limits.
        model: step-response model.
        gap: relative gap of a solve.
        time_limit: seconds per solve, None for none.
        finish: path that closes the integer problem, see `jaxmpc.integer.solve`.
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
        self.together = MixedIntegerControllers(
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
        return self.together.memory.lane(0)

    def init(self, cv: Float[ArrayLike, " cv"], mv: Float[ArrayLike, " mv"]) -> ControllerState:
        """State at a steady state; arguments and errors as in `ContinuousController.init`."""
        start = checked_start(self.structure, cv, mv)
        return _first(self.together.init(*(np.asarray(value)[None] for value in start)))

    def prepare(self, state: ControllerState, cv: Float[ArrayLike, " cv"]) -> None:
        """Compile what every sample needs; arguments as in `step`."""
        self.step(state, cv, cv)

    def step(
        self,
        state: ControllerState,
        cv: Float[ArrayLike, " cv"],
        setpoint: Float[ArrayLike, " cv"] | Float[ArrayLike, "horizon cv"],
        mv: Float[ArrayLike, " mv"] | None = None,
        manual: Bool[ArrayLike, " mv"] | None = None,
    ) -> tuple[ControllerState, StepInfo]:
        """One sample; arguments and errors as in `ContinuousController.step`."""
        sample = checked(self.structure, cv, setpoint, mv, manual)
        lane, of_lane = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (state, sample))
        return _first(self.together.decide(lane, of_lane))


def _first(tree):
    return jax.tree.map(
        lambda leaf: np.asarray(leaf)[0], tree
    )  # on the host: indexing a JAX array is a dispatch
