"""What compiled programs know of a controller (thesis 5.3, 6), and the steps of a sample that they take with it.

`Core` has no structure, only its arrays: controllers of one size share programs, and may be lanes of one batch. A sample is
observed (2.31), posed as a problem (5.8), decided (`integer.search`) and carried out. A bad measurement is left out, a
solve that gives no plan holds the MVs, and the info says so.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxmpc import status as codes
from jaxmpc.controller.measurement import GOOD, IMPLAUSIBLE, Sensors
from jaxmpc.controller.sample import Sample
from jaxmpc.controller.state import ControllerState, StepInfo, filter_bias
from jaxmpc.integer.search import Decision, decide
from jaxmpc.integer.tables import Tables
from jaxmpc.model.step_response import advance_free_response, future_response, shift_free_response
from jaxmpc.problem.condense import CondensedQp, Matrices, condense, matrices_of
from jaxmpc.problem.instance import DRIFT, QpInstance, make_instance
from jaxmpc.problem.layout import Layout, Size
from jaxmpc.problem.tuning import Tuning
from jaxmpc.relaxed.gap import relative_gap
from jaxmpc.relaxed.newton import WarmStart
from jaxmpc.relaxed.solve import cold_start, shifted_start


class Moment(NamedTuple):
    """A sample that is observed and decided as far as a compiled program decides it."""

    state: ControllerState  # after the measurement
    free_response: Float[Array, "future cv"]  # Lambda (5.13) at j = 1, 2, ... [CV unit]
    instance: QpInstance  # its problem
    decision: Decision  # what the search found
    scale: Float[Array, " n"]  # MV units per unit of x
    unit: Float[Array, ""]  # of the objective, see `gap.closes`
    # whether an MV is outside its limits or between its allowed values
    recovering: Bool[Array, ""]
    # to the nearest allowed values, made together with the first move; None where no MV has a list [MV unit]
    correction: Float[Array, " mv"] | None = None

    @property
    def good(self) -> Bool[Array, ""]:
        """Whether the compiled program has closed it."""
        return self.decision.closed & (abs(self.decision.x) < np.inf).all(axis=-1)

    def said(self, whole: Bool[Array, ""]) -> dict[str, Array]:
        """What the decision says of itself, by the names of `StepInfo` and `Trajectory`; `whole`: of whole moves."""
        found, sensors, good = self.decision, self.state.sensors, self.good
        certified = lambda value: jnp.where(good, value, jnp.nan)  # noqa: E731
        return dict(
            status=jnp.where(good, codes.OPTIMAL, codes.FAILED),
            fallback=~good,
            quality=sensors.quality,
            off=sensors.off,
            objective=certified(found.value),
            bound=certified(found.bound),
            gap=certified(relative_gap(found.value, found.bound, self.unit)),
            nodes=jnp.where(whole, found.nodes, found.steps),
            finished_by=jnp.where(good, found.finished_by, 0),
        )


class Core(eqx.Module):
    """Everything of a controller that stays the same from sample to sample, as arrays of a size."""

    layout: Layout  # the structure
    tuning: Tuning  # weights and limits
    # of the model, as long as the shift register [CV unit per MV unit]
    coefficients: Float[Array, "cv mv future"]
    # of measured disturbances; None without any [CV unit per DV unit]
    dv_coefficients: Float[Array, "cv dv future"] | None
    qp: CondensedQp  # constant part of the problems
    tables: Tables  # what the search for whole moves reads
    size: Size = eqx.field(static=True)  # of the arrays
    switching: bool = eqx.field(static=True)  # whether a CV may be switched off by bad measurements

    def of(self, core: Core) -> Core:
        """Another core, with what this one has besides the fields of every core."""
        fields: dict[str, Any] = {field.name: getattr(core, field.name) for field in dataclasses.fields(Core)}
        return dataclasses.replace(self, **fields)

    def init(
        self, cv: Float[Array, " cv"], mv: Float[Array, " mv"], dv: Float[Array, " dv"] | None = None
    ) -> ControllerState:
        """State of a controller that starts in a steady state."""
        s, zeros = self.size, lambda *shape: jnp.zeros(shape)
        cv, mv = jnp.asarray(cv, dtype=jnp.float64), jnp.asarray(mv, dtype=jnp.float64)
        state = ControllerState(
            base=cv,
            future=zeros(s.cvs, s.future),
            bias=zeros(s.cvs),
            bias_raw=zeros(s.cvs),
            mv=mv,
            position=mv,
            last_move=zeros(s.mvs),
            past_moves=zeros(s.past, s.mvs),
            plan=zeros(s.blocks, s.mvs),
            warm=None,  # pyright: ignore[reportArgumentType]
            sensors=Sensors.fresh(cv),
            manual=jnp.zeros(s.mvs, dtype=bool),
            dv=None if dv is None else jnp.asarray(dv, dtype=jnp.float64),
        )
        response = jnp.broadcast_to(cv, (s.future, s.cvs))
        cold = cold_start(self.qp, self.instance(state, self.qp, self.tuning, response, response))
        return eqx.tree_at(lambda s: s.warm, state, cold, is_leaf=lambda v: v is None)

    def locate(self, state: ControllerState, mv, manual) -> ControllerState:
        """Predict from where the actuators stand, as if they had moved there in place of the last move.

        Args:
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
        self, state: ControllerState, cv, mv, manual, dv=None
    ) -> tuple[ControllerState, Float[Array, "future cv"]]:
        """Compare a measurement with its prediction, update the bias, and move on to the next sample.

        Args:
            cv: measurement now [CV unit]; a bad one leaves the bias to itself.
            dv: ``"row dv"``, measured disturbances now and in the samples to come, as far as told [DV unit].

        Returns:
            ``(state, free_response)``: the future now starts at the next sample; Lambda (5.13) at j = 1, 2, ....
        """
        tuning, dt = self.tuning, jnp.asarray(self.layout.dt)
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
        if self.dv_coefficients is None or state.dv is None or dv is None:
            return state, state.base + future.T + bias
        change, now = changes_of(state.dv, dv)
        future = advance_free_response(future, self.dv_coefficients, change[0])
        state = eqx.tree_at(lambda s: (s.future, s.dv), state, (future, now))
        if len(change) > 1:  # what is still to come stays out of the register
            future += future_response(self.dv_coefficients, change.at[0].set(0.0))
        return state, state.base + future.T + bias

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

    def instance(self, state: ControllerState, qp, tuning: Tuning, free_response, setpoint) -> QpInstance:
        """The problem after a measurement, with MVs outside their limits on their way back."""
        return make_instance(
            self.layout,
            self.size,
            tuning,
            qp,
            free_response=free_response,
            setpoint=jnp.broadcast_to(setpoint, free_response.shape),
            mv_now=state.mv,
            last_move=state.last_move,
            past_moves=state.past_moves,
            position=state.position,
            recover=True,
        )

    def condensed_now(self, off: Bool[Array, " cv"]) -> tuple[CondensedQp, Tables]:
        """The constant part of this sample's problem, another one while CVs are switched off; and its tables."""
        if not self.switching:
            return self.qp, self.tables

        def reduced() -> CondensedQp:
            given = self.qp
            matrices = matrices_of(self.layout, self.size, self.coefficients, summed=False)
            matrices = eqx.tree_at(lambda m: m.summed, matrices, given.summed, is_leaf=lambda v: v is None)
            return self.condensed(without(self.tuning, off), matrices)

        qp = jax.lax.cond(jnp.any(off), reduced, lambda: self.qp)
        known = self.tables.known & ~jnp.any(off)
        return qp, eqx.tree_at(lambda t: (t.known, t.scale), self.tables, (known, qp.unit))

    def condensed(self, tuning: Tuning, matrices: Matrices) -> CondensedQp:
        """The constant part of another tuning or model, in the form of this one's."""
        form: dict[str, Any] = dict(
            envelope=self.qp.steep.shape[0],
            has_limits=self.qp.has_limits,
            has_ideal=self.qp.ideal is not None,
        )
        return condense(self.layout, self.size, tuning, matrices, **form)

    def consider(self, state: ControllerState, sample: Sample, gap, search=True, most=np.inf) -> Moment:
        """Observe, pose and decide a sample.

        Args:
            search: whether whole moves may be searched for here; otherwise none but the relaxation is solved.
            most: Newton steps after which it gives up.
        """
        state, free_response = self.observe(state, sample.cv, sample.mv, sample.manual, sample.dv)
        tuning = without(self.limits_now(state), state.sensors.off)
        qp, tables = self.condensed_now(state.sensors.off)
        correction, standing = self.correction(state), state
        if correction is not None:
            free_response += advance_free_response(
                jnp.zeros_like(state.future), self.coefficients, correction
            ).T
            corrected = state.mv + correction, state.position + correction
            standing = eqx.tree_at(lambda s: (s.mv, s.position), state, corrected)
        instance = self.instance(standing, qp, tuning, free_response, sample.setpoint)
        tables = eqx.tree_at(lambda t: t.known, tables, tables.known & search)
        decision = decide(qp, tables, instance, state.warm, gap, most)
        recovering = outside_limits(tuning, state.mv)
        if correction is not None:
            recovering |= jnp.any(correction != 0.0)
        return Moment(
            state, free_response, instance, decision, qp.scale, tables.scale, recovering, correction
        )

    def correction(self, state: ControllerState) -> Float[Array, " mv"] | None:
        """The moves to the nearest allowed values, zero in manual and for float drift; None where no MV has a list."""
        values = self.layout.values
        if values is None:
            return None
        away = values - state.mv[:, None]
        least = jnp.take_along_axis(away, jnp.argmin(jnp.abs(away), axis=1)[:, None], axis=1)[:, 0]
        needed = jnp.isfinite(least) & (jnp.abs(least) > DRIFT * self.layout.step) & ~state.manual
        return jnp.where(needed, least, 0.0)

    def carry_out(
        self, moment: Moment, x: Float[Array, " n"], good: Bool[Array, ""]
    ) -> tuple[ControllerState, Float[Array, "block mv"]]:
        """Apply the first moves of a plan; the MVs are held where there is none.

        Returns:
            ``(state, planned moves)``: predictions, history, and plan and prices shifted by one sample.
        """
        state, warm = moment.state, moment.decision.root.warm
        planned = (x * moment.scale).reshape(self.size.mvs, -1).T
        first = self.first_move(moment.scale, moment.instance, planned[0])
        if moment.correction is not None:
            first += moment.correction
        moves = jnp.where(good, planned.at[0].set(first), 0.0)
        warm = jax.tree.map(lambda new, old: jnp.where(good, new, old), warm, state.warm)
        return self.remember(state, moves, warm), moves

    def remember(
        self, state: ControllerState, moves: Float[Array, "block mv"], warm: WarmStart
    ) -> ControllerState:
        """The state after moves of which the first was made: predictions, history, plan and prices of the next sample.

        Args:
            moves: the plan [MV unit], padded.
        """
        move = moves[0]
        return dataclasses.replace(
            state,
            future=advance_free_response(state.future, self.moving(state.mv, move), move),
            mv=state.mv + move,
            position=state.position + move,
            last_move=move,
            past_moves=jnp.concatenate([state.past_moves[1:], move[None]]),
            plan=self.layout.shifted(moves),
            warm=shifted_start(warm, self.size.cvs),
        )

    def moving(self, before: Float[Array, " mv"], move: Float[Array, " mv"]) -> Float[Array, "cv mv future"]:
        """Coefficients with which a move enters the shift register."""
        return self.coefficients

    def first_move(self, scale, instance: QpInstance, move: Float[Array, " mv"]) -> Float[Array, " mv"]:
        """The move to apply [MV unit]: solver tolerance must not leave what the limits allow the first block."""
        mv, held = np.arange(self.size.mvs), self.layout.count[..., 0]
        first, row = mv * self.size.blocks, mv * self.size.rows
        low = jnp.maximum(instance.lower[first], instance.row_low[row] / held)
        high = jnp.minimum(instance.upper[first], instance.row_high[row] / held)
        wanted = move / scale[first]
        kept = jnp.clip(wanted, low, high)
        if (
            self.tables.complete is not None
        ):  # whole moves that were decided on the host may have other limits
            kept = jnp.where(self.layout.integer, wanted, kept)
        return kept * scale[first]

    def conclude(self, moment: Moment) -> tuple[ControllerState, StepInfo]:
        """Carry out what the compiled program decided; the MVs are held where it left something open."""
        state, moves = self.carry_out(moment, moment.decision.x, moment.good)
        own: dict[str, Any] = dict(move=moves[0], mv=state.mv, moves=moves, solve_time=jnp.asarray(jnp.nan))
        return state, StepInfo(**own, recovering=moment.recovering, **moment.said(self.tables.count > 0))


def changes_of(
    before: Float[Array, " dv"], dv: Float[Array, "row dv"]
) -> tuple[Float[Array, "row dv"], Float[Array, " dv"]]:
    """Changes of the measured disturbances from sample to sample, and what they are now [DV unit].

    Args:
        before: last known ones.
        dv: now and in the samples to come; what is not a number is as in the row before.
    """
    known = jnp.abs(dv) < IMPLAUSIBLE  # false for what is not a number
    row = jax.lax.cummax(jnp.where(known, 1 + jnp.arange(dv.shape[0])[:, None], 0))
    filled = jnp.take_along_axis(jnp.concatenate([before[None], dv]), row, axis=0)
    return jnp.diff(filled, axis=0, prepend=before[None]), filled[0]


def outside_limits(tuning: Tuning, mv: Float[Array, " mv"]) -> Bool[Array, ""]:
    """Whether any MV is outside its limits by more than rounding."""
    drift = 1e-6 * jnp.maximum(1.0, jnp.abs(mv))
    return jnp.any((mv < tuning.mv_low - drift) | (mv > tuning.mv_high + drift))


def without(tuning: Tuning, off: Bool[Array, " cv"] | Bool[np.ndarray, " cv"]) -> Tuning:
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
