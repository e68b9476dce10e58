"""Controllers (thesis 5.3, 6): `init` and `step(state, measurement, setpoint) -> (state, info)`.

`ContinuousController` is pure JAX, compiled at its first step, and may be vmapped and scanned. `MixedIntegerController` has
the same interface on the host, because the integer search may call HiGHS. Both share prediction, bias and bookkeeping.
A bad measurement is left out, a solve that gives no plan holds the MVs, and the info says so.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxmpc import status as codes
from jaxmpc.controller.bias import filter_bias
from jaxmpc.controller.measurement import GOOD, Sensors
from jaxmpc.controller.sample import Sample, checked, checked_start
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import (
    StepResponseModel,
    advance_free_response,
    check_match,
    shift_free_response,
)
from jaxmpc.problem.blocking import (
    block_members,
    first_position_rows,
    hard_rows,
    moves_per_block,
    sample_moves,
)
from jaxmpc.problem.condense import CondensedQp, QpInstance, condense, condensed, make_instance
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.relaxed.gap import relative_gap
from jaxmpc.relaxed.newton import WarmStart, warm_start_of
from jaxmpc.relaxed.solve import cold_start, shifted_start, solve_relaxed


class ControllerState(eqx.Module):
    """What a controller remembers from sample to sample.

    Attributes:
        base: CVs the run started from; predictions are deviations from them [CV unit].
        future: effect of the moves made so far on max(Hp, N) samples from now on [CV unit].
        bias: filtered output bias v(k|k).
        bias_raw: output bias before the filter (2.31b).
        mv: present demand [MV unit].
        position: where the actuators stand in the predictions [MV unit].
        last_move: previous move, of the actuators where these are told [MV unit].
        past_moves: the last `mean_move_window` moves, oldest first [MV unit].
        plan: the previous plan shifted by one sample, block moves [MV unit].
        warm: moves and prices of the previous relaxation, shifted; where the next solve starts.
        sensors: what the measurements were worth.
        manual: MVs that somebody else moved at the last sample.
    """

    base: Float[Array, " cv"]
    future: Float[Array, "cv future"]
    bias: Float[Array, " cv"]
    bias_raw: Float[Array, " cv"]
    mv: Float[Array, " mv"]
    position: Float[Array, " mv"]
    last_move: Float[Array, " mv"]
    past_moves: Float[Array, "window mv"]
    plan: Float[Array, "block mv"]
    warm: WarmStart
    sensors: Sensors
    manual: Bool[Array, " mv"]


class StepInfo(eqx.Module):
    """What one controller step did.

    Attributes:
        move: applied move [MV unit].
        mv: demand after it [MV unit].
        moves: planned block moves [MV unit].
        status: code of `jaxmpc.status`.
        fallback: the MVs were held because there was no plan.
        recovering: an MV was outside its limits and is being brought back.
        quality: of the measurements, codes of `jaxmpc.controller.measurement.QUALITY`: 0 good, all others were left out.
        off: CVs that are switched off, because too many measurements in a row were left out.
        objective, bound, gap: value of the plan (6.6), proven bound, relative gap; not a number without a plan.
        nodes: relaxations solved (iterations of the one relaxation for continuous moves).
        finished_by: code of `jaxmpc.status.FINISHERS`.
        solve_time: wall time of the solve [s]; not a number inside a compiled loop, which has no clock.
    """

    move: Float[Array, " mv"]
    mv: Float[Array, " mv"]
    moves: Float[Array, "block mv"]
    status: Int[Array, ""]
    fallback: Bool[Array, ""]
    recovering: Bool[Array, ""]
    quality: Int[Array, " cv"]
    off: Bool[Array, " cv"]
    objective: Float[Array, ""]
    bound: Float[Array, ""]
    gap: Float[Array, ""]
    nodes: Int[Array, ""]
    finished_by: Int[Array, ""]
    solve_time: Float[Array, ""]


class Memory(eqx.Module):
    """Prediction and bookkeeping shared by the controllers."""

    structure: Structure = eqx.field(static=True)
    tuning: Tuning
    coefficients: Float[Array, "cv mv future"]

    def init(self, cv: Float[Array, " cv"], mv: Float[Array, " mv"], warm: WarmStart) -> ControllerState:
        """State of a controller that starts in a steady state.

        Args:
            cv: measured CVs [CV unit].
            mv: present MVs [MV unit].
            warm: where the first solve starts.
        """
        s = self.structure
        zeros = lambda *shape: jnp.zeros(shape)  # noqa: E731
        cv, mv = jnp.asarray(cv, dtype=jnp.float64), jnp.asarray(mv, dtype=jnp.float64)
        return ControllerState(
            base=cv,
            future=zeros(s.cv_count, self.coefficients.shape[-1]),
            bias=zeros(s.cv_count),
            bias_raw=zeros(s.cv_count),
            mv=mv,
            position=mv,
            last_move=zeros(s.mv_count),
            past_moves=zeros(s.mean_move_window, s.mv_count),
            plan=zeros(s.block_count, s.mv_count),
            warm=warm,
            sensors=Sensors.fresh(cv),
            manual=jnp.zeros(s.mv_count, dtype=bool),
        )

    def locate(self, state: ControllerState, mv, manual) -> ControllerState:
        """Predict from where the actuators stand, as if they had moved there in place of the last move.

        Args:
            state: from `init` or `remember`.
            mv: ``"mv"``, positions now [MV unit]; not a number where the demand counts as followed.
            manual: ``"mv"``, MVs that somebody else moves.

        Returns:
            The state with a demand within `demand_lead` of the positions, and at them in manual.
        """
        tuning, known = self.tuning, jnp.isfinite(mv)
        manual = jnp.broadcast_to(manual, state.mv.shape)
        position = jnp.where(known, mv, state.position)
        missed = position - state.position
        lead = jnp.where(manual, 0.0, tuning.demand_lead)
        demand = jnp.clip(state.mv, position - lead, position + lead)
        # what somebody else moved must not make the oscillation rows (6.16) impossible to satisfy
        last = jnp.clip(state.last_move + missed, tuning.move_low, tuning.move_high)
        return eqx.tree_at(
            lambda s: (s.future, s.mv, s.position, s.last_move, s.past_moves, s.manual),
            state,
            (
                advance_free_response(state.future, self.coefficients, missed),
                jnp.where(known, demand, state.mv),
                position,
                jnp.where(missed != 0.0, last, state.last_move),
                jnp.asarray(state.past_moves).at[-1].add(missed),
                manual,
            ),
        )

    def observe(
        self, state: ControllerState, cv, mv=jnp.nan, manual=False
    ) -> tuple[ControllerState, Float[Array, "horizon cv"]]:
        """Compare a measurement with its prediction, update the bias, and move on to the next sample.

        Args:
            state: from `init` or `remember`; its future starts at the present sample.
            cv: measurement now [CV unit]; a bad one leaves the bias to itself.
            mv, manual: as in `locate`; demands count as followed if they are not given.

        Returns:
            ``(state, free_response)``: the future now starts at the next sample; Lambda (5.13) at j = 1..Hp.
        """
        tuning, dt = self.tuning, self.structure.dt
        state = self.locate(state, mv, manual)
        sensors = state.sensors.judged(tuning, cv)
        good = sensors.quality == GOOD
        kept = jnp.exp(-dt / tuning.bias_decay)
        raw = jnp.where(good, cv - (state.base + state.future[:, 0]), kept * state.bias_raw)  # (2.31b)
        bias = filter_bias(state.bias, state.bias_raw, raw, tuning.bias_cutoff, dt)
        bias = jnp.where(good, bias, kept * state.bias)
        future = shift_free_response(state.future)
        state = eqx.tree_at(
            lambda s: (s.bias, s.bias_raw, s.future, s.sensors), state, (bias, raw, future, sensors)
        )
        return state, state.base + future[:, : self.structure.prediction_horizon].T + bias

    def limits_now(self, state: ControllerState) -> Tuning:
        """The tuning of this sample: MVs in manual stay where they are, whatever their limits."""
        held = lambda fixed, given: jnp.where(state.manual, fixed, given)  # noqa: E731
        tuning = self.tuning
        return eqx.tree_at(
            lambda t: (t.move_low, t.move_high, t.mv_low, t.mv_high, t.oscillation_rows),
            tuning,
            (
                held(0.0, tuning.move_low),
                held(0.0, tuning.move_high),
                held(-jnp.inf, tuning.mv_low),
                held(jnp.inf, tuning.mv_high),
                ~state.manual & tuning.oscillation_rows,
            ),
        )

    def remember(self, state: ControllerState, move, moves, warm: WarmStart) -> ControllerState:
        """Apply a move: predictions, history, and plan and prices shifted by one sample."""
        return ControllerState(
            base=state.base,
            future=advance_free_response(state.future, self.coefficients, move),
            bias=state.bias,
            bias_raw=state.bias_raw,
            mv=state.mv + move,
            position=state.position + move,
            last_move=move,
            past_moves=jnp.concatenate([state.past_moves[1:], move[None]]),
            plan=shift_plan(self.structure, moves),
            warm=shifted_start(warm, self.structure.cv_count, self.structure.horizon_count),
            sensors=state.sensors,
            manual=state.manual,
        )


def shift_plan(structure: Structure, moves: Float[Array, "block mv"]) -> Float[Array, "block mv"]:
    """The plan one sample later, in blocks again: the rest of the moves, and none at the end."""
    samples = jnp.asarray(sample_moves(structure)) @ moves
    later = jnp.concatenate([samples[1:], jnp.zeros((1, structure.mv_count))])
    sums = jnp.asarray(block_members(structure)).T @ later
    return sums / jnp.asarray(moves_per_block(structure))[:, None]


def outside_limits(tuning: Tuning, mv: Float[Array, " mv"]) -> Bool[Array, ""]:
    """Whether any MV is outside its limits by more than rounding."""
    drift = 1e-6 * jnp.maximum(1.0, jnp.abs(mv))
    return jnp.any((mv < tuning.mv_low - drift) | (mv > tuning.mv_high + drift))


def first_move(
    structure: Structure, scale: Float[Array, " n"], instance: QpInstance, move: Float[Array, " mv"]
):
    """The move to apply [MV unit]: solver tolerance must not leave what the limits allow the first block."""
    blocks = structure.block_count
    unit = scale[::blocks]
    low, high = instance.lower[::blocks], instance.upper[::blocks]
    first = first_position_rows(structure)
    held = moves_per_block(structure)[0]
    low = jnp.maximum(low, instance.row_low[first] / held)
    high = jnp.minimum(high, instance.row_high[first] / held)
    return jnp.clip(move / unit, low, high) * unit


def without(tuning: Tuning, off: Bool[Array, " cv"]) -> Tuning:
    """The tuning without weights and limits of the CVs that are switched off; on the host if these are."""
    xp: Any = np if isinstance(off, np.ndarray) else jnp
    none = lambda values: xp.where(off, 0.0, values)  # noqa: E731
    return eqx.tree_at(
        lambda t: (t.cv_weight, t.soft_quadratic, t.soft_linear, t.slack_weight, t.cv_low, t.cv_high),
        tuning,
        (
            none(tuning.cv_weight),
            none(tuning.soft_quadratic),
            none(tuning.soft_linear),
            none(tuning.slack_weight),
            xp.where(off, -np.inf, tuning.cv_low),
            xp.where(off, np.inf, tuning.cv_high),
        ),
    )


def may_switch(tuning: Tuning) -> bool:
    """Whether a CV can be switched off; true where that is not known yet."""
    return isinstance(tuning.bad_limit, Tracer) or bool(np.isfinite(tuning.bad_limit).any())


class ContinuousController(eqx.Module):
    """MPC with continuous moves (thesis chapter 5 with 6.2-6.4, 6.6).

    `step` is compiled when it is first called, once per structure: call it as it is. Inside functions that are given to
    `jax.jit`, `jax.vmap` or `jax.lax.scan` it is a pure function of its arguments.

    Args:
        structure: static configuration without integer MVs.
        tuning: weights and limits; batch its fields to batch controllers.
        model: step-response model.
        summed: keep the running sums of the dynamic matrix; see `condense.condense`.
        switching: whether a CV may be switched off by bad measurements; follows from the tuning if not given.
    """

    memory: Memory
    qp: CondensedQp
    switching: bool = eqx.field(static=True)

    def __init__(
        self,
        structure: Structure,
        tuning: Tuning,
        model: StepResponseModel,
        *,
        summed: bool = True,
        switching: bool | None = None,
    ):
        if structure.integer_mvs:
            raise InputError(
                "structure.integer_step",
                list(structure.integer_step),
                "no integer MVs for a continuous controller",
                "Use MixedIntegerController, or structure.relaxed()",
            )
        check_match(structure, model)
        self.memory = Memory(
            structure, tuning, model.extended(max(structure.prediction_horizon, model.samples))
        )
        self.qp = condensed(structure, tuning, model.coefficients, envelope=0, summed=summed)
        self.switching = may_switch(tuning) if switching is None else switching

    @property
    def structure(self) -> Structure:
        """Static configuration."""
        return self.memory.structure

    @property
    def tuning(self) -> Tuning:
        """Weights and limits."""
        return self.memory.tuning

    def init(self, cv: Float[ArrayLike, " cv"], mv: Float[ArrayLike, " mv"]) -> ControllerState:
        """State at a steady state with measured CVs and present MVs (engineering units).

        Raises:
            InputError: for other shapes and values that are not finite.
        """
        return _init(self, *checked_start(self.structure, cv, mv))

    def step(
        self,
        state: ControllerState,
        cv: Float[ArrayLike, " cv"],
        setpoint: Float[ArrayLike, " cv"] | Float[ArrayLike, "horizon cv"],
        mv: Float[ArrayLike, " mv"] | None = None,
        manual: Bool[ArrayLike, " mv"] | None = None,
    ) -> tuple[ControllerState, StepInfo]:
        """One sample.

        Args:
            state: from `init` or the previous step.
            cv: measurement now [CV unit]; NaN where there is none.
            setpoint: at j = 1..Hp, or held over the horizon [CV unit].
            mv: where the actuators stand before the move [MV unit], NaN where that is not known; without it, demands
                count as followed.
            manual: MVs that somebody else moves; they are predicted from `mv` and not moved.

        Raises:
            InputError: for other shapes, setpoints that are not finite, and where double precision is off.
        """
        return _step(self, state, checked(self.structure, cv, setpoint, mv, manual))

    def condensed_now(self, off: Bool[Array, " cv"]) -> CondensedQp:
        """The constant part of this sample's problem: another one while CVs are switched off."""
        if not self.switching:
            return self.qp

        def reduced() -> CondensedQp:
            tuning = without(self.tuning, off)
            own = condense(self.structure, tuning, self.memory.coefficients, envelope=0, summed=False)
            return eqx.tree_at(lambda q: q.summed, own, self.qp.summed, is_leaf=lambda v: v is None)

        return jax.lax.cond(jnp.any(off), reduced, lambda: self.qp)

    def decide(self, state: ControllerState, sample: Sample) -> tuple[ControllerState, StepInfo]:
        """`step` of a checked sample, to be traced."""
        structure = self.structure
        state, free_response = self.memory.observe(state, sample.cv, sample.mv, sample.manual)
        tuning = without(self.memory.limits_now(state), state.sensors.off)
        qp = self.condensed_now(state.sensors.off)
        instance = make_instance(
            structure,
            tuning,
            qp,
            free_response=free_response,
            setpoint=jnp.broadcast_to(sample.setpoint, free_response.shape),
            mv_now=state.mv,
            last_move=state.last_move,
            past_moves=state.past_moves,
            recover=True,
        )
        solution = solve_relaxed(
            qp, hard_rows(structure), instance, instance.lower, instance.upper, state.warm
        )
        moves = (solution.x * qp.scale).reshape(structure.mv_count, -1).T
        objective = solution.objective
        bound = jnp.minimum(jnp.maximum(solution.bound, 0.0), objective)
        gap = relative_gap(objective, bound, jnp.max(jnp.diagonal(qp.curvature)))
        good = (solution.status == codes.OPTIMAL) & jnp.all(jnp.isfinite(moves))
        move = first_move(structure, qp.scale, instance, moves[0])
        move = jnp.where(good, move, 0.0)
        moves = jnp.where(good, moves, 0.0)
        recovering = outside_limits(tuning, state.mv)
        warm = jax.tree.map(lambda new, old: jnp.where(good, new, old), warm_start_of(solution), state.warm)
        state = self.memory.remember(state, move, moves, warm)
        missing = lambda value: jnp.where(good, value, jnp.nan)  # noqa: E731
        info = StepInfo(
            move=move,
            mv=state.mv,
            moves=moves,
            status=jnp.where(good, codes.OPTIMAL, codes.FAILED),
            fallback=~good,
            recovering=recovering,
            quality=state.sensors.quality,
            off=state.sensors.off,
            objective=missing(objective),
            bound=missing(bound),
            gap=missing(gap),
            nodes=solution.iterations,
            finished_by=jnp.where(good, codes.finisher_code("relaxation"), 0),
            solve_time=jnp.asarray(jnp.nan),
        )
        return state, info


@eqx.filter_jit
def _init(controller: ContinuousController, cv, mv) -> ControllerState:
    s = controller.structure
    cold = cold_start(controller.qp, len(hard_rows(s)), s.cv_count * s.horizon_count)
    return controller.memory.init(cv, mv, cold)


@eqx.filter_jit
def _step(controller: ContinuousController, state: ControllerState, sample: Sample):
    return controller.decide(state, sample)
