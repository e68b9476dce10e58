"""Controllers (thesis 5.3, 6): `init` and `step(state, measurement, setpoint) -> (state, info)`.

`ContinuousController` is pure JAX: jit it, vmap it, scan it. `MixedIntegerController` has the same interface on
the host, because the integer search may call HiGHS. Both share prediction, bias and bookkeeping. A solve that
gives no plan holds the MVs, and the info says so.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmpc import status as codes
from jaxmpc.blocking import block_members, first_position_rows, hard_rows, moves_per_block, sample_moves
from jaxmpc.condense import CondensedQp, QpInstance, condensed, make_instance
from jaxmpc.disturbance import filter_bias
from jaxmpc.errors import InputError
from jaxmpc.gap import relative_gap
from jaxmpc.newton import WarmStart, warm_start_of
from jaxmpc.relaxation import cold_start, shifted_start, solve_relaxed
from jaxmpc.step_response import StepResponseModel, advance_free_response, check_match, shift_free_response
from jaxmpc.structure import Structure
from jaxmpc.tuning import Tuning


class ControllerState(eqx.Module):
    """What a controller remembers from sample to sample.

    Attributes:
        base: CVs the run started from; predictions are deviations from them [CV unit].
        future: effect of the moves made so far on max(Hp, N) samples from now on [CV unit].
        bias: filtered output bias v(k|k).
        bias_raw: output bias before the filter (2.31b).
        mv: present demand [MV unit].
        last_move: previous move [MV unit].
        past_moves: the last `mean_move_window` moves, oldest first [MV unit].
        plan: the previous plan shifted by one sample, block moves [MV unit].
        warm: moves and prices of the previous relaxation, shifted; where the next solve starts.
    """

    base: Float[Array, " cv"]
    future: Float[Array, "cv future"]
    bias: Float[Array, " cv"]
    bias_raw: Float[Array, " cv"]
    mv: Float[Array, " mv"]
    last_move: Float[Array, " mv"]
    past_moves: Float[Array, "window mv"]
    plan: Float[Array, "block mv"]
    warm: WarmStart


class StepInfo(eqx.Module):
    """What one controller step did.

    Attributes:
        move: applied move [MV unit].
        mv: demand after it [MV unit].
        moves: planned block moves [MV unit].
        status: code of `jaxmpc.status`.
        fallback: the MVs were held because there was no plan.
        recovering: an MV was outside its limits and is being brought back.
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
        return ControllerState(
            base=jnp.asarray(cv, dtype=jnp.float64),
            future=zeros(s.cv_count, self.coefficients.shape[-1]),
            bias=zeros(s.cv_count),
            bias_raw=zeros(s.cv_count),
            mv=jnp.asarray(mv, dtype=jnp.float64),
            last_move=zeros(s.mv_count),
            past_moves=zeros(s.mean_move_window, s.mv_count),
            plan=zeros(s.block_count, s.mv_count),
            warm=warm,
        )

    def observe(self, state: ControllerState, cv) -> tuple[ControllerState, Float[Array, "horizon cv"]]:
        """Compare a measurement with its prediction, update the bias, and move on to the next sample.

        Args:
            state: from `init` or `remember`; its future starts at the present sample.
            cv: measurement now [CV unit].

        Returns:
            ``(state, free_response)``: the future now starts at the next sample; Lambda (5.13) at j = 1..Hp.
        """
        raw = cv - (state.base + state.future[:, 0])  # (2.31b)
        bias = filter_bias(state.bias, state.bias_raw, raw, self.tuning.bias_cutoff, self.structure.dt)
        future = shift_free_response(state.future)
        state = eqx.tree_at(lambda s: (s.bias, s.bias_raw, s.future), state, (bias, raw, future))
        return state, state.base + future[:, : self.structure.prediction_horizon].T + bias

    def remember(self, state: ControllerState, move, moves, warm: WarmStart) -> ControllerState:
        """Apply a move: predictions, history, and plan and prices shifted by one sample."""
        return ControllerState(
            base=state.base,
            future=advance_free_response(state.future, self.coefficients, move),
            bias=state.bias,
            bias_raw=state.bias_raw,
            mv=state.mv + move,
            last_move=move,
            past_moves=jnp.concatenate([state.past_moves[1:], move[None]]),
            plan=shift_plan(self.structure, moves),
            warm=shifted_start(warm, self.structure.cv_count, self.structure.horizon_count),
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


class ContinuousController(eqx.Module):
    """MPC with continuous moves (thesis chapter 5 with 6.2-6.4, 6.6); pure, so that it can be jitted, vmapped, scanned.

    Args:
        structure: static configuration without integer MVs.
        tuning: weights and limits; batch its fields to batch controllers.
        model: step-response model.
        summed: keep the running sums of the dynamic matrix; see `condense.condense`.
    """

    memory: Memory
    qp: CondensedQp

    def __init__(
        self, structure: Structure, tuning: Tuning, model: StepResponseModel, *, summed: bool = True
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

    @property
    def structure(self) -> Structure:
        """Static configuration."""
        return self.memory.structure

    @property
    def tuning(self) -> Tuning:
        """Weights and limits."""
        return self.memory.tuning

    def init(self, cv: Float[Array, " cv"], mv: Float[Array, " mv"]) -> ControllerState:
        """State at a steady state with measured CVs and present MVs (engineering units)."""
        s = self.structure
        cold = cold_start(self.qp, len(hard_rows(s)), s.cv_count * s.horizon_count)
        return self.memory.init(cv, mv, cold)

    def step(
        self, state: ControllerState, cv: Float[Array, " cv"], setpoint: Float[Array, " cv"]
    ) -> tuple[ControllerState, StepInfo]:
        """One sample.

        Args:
            state: from `init` or the previous step.
            cv: measurement now [CV unit].
            setpoint: held over the horizon [CV unit].
        """
        structure, tuning = self.structure, self.tuning
        state, free_response = self.memory.observe(state, cv)
        instance = make_instance(
            structure,
            tuning,
            self.qp,
            free_response=free_response,
            setpoint=jnp.broadcast_to(setpoint, free_response.shape),
            mv_now=state.mv,
            last_move=state.last_move,
            past_moves=state.past_moves,
            recover=True,
        )
        solution = solve_relaxed(
            self.qp, hard_rows(structure), instance, instance.lower, instance.upper, state.warm
        )
        moves = (solution.x * self.qp.scale).reshape(structure.mv_count, -1).T
        objective = solution.objective
        bound = jnp.minimum(jnp.maximum(solution.bound, 0.0), objective)
        gap = relative_gap(objective, bound, jnp.max(jnp.diagonal(self.qp.curvature)))
        good = (solution.status == codes.OPTIMAL) & jnp.all(jnp.isfinite(moves)) & jnp.all(jnp.isfinite(cv))
        move = first_move(structure, self.qp.scale, instance, moves[0])
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
            objective=missing(objective),
            bound=missing(bound),
            gap=missing(gap),
            nodes=solution.iterations,
            finished_by=jnp.where(good, codes.finisher_code("relaxation"), 0),
            solve_time=jnp.asarray(jnp.nan),
        )
        return state, info
