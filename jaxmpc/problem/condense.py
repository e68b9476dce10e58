"""Condensed form of the controller's problem (thesis 5.2, 6.4), with eta and eps folded into the objective.

With y = Lambda + Theta du (5.9) the decision variables are the blocked moves alone. The deadzone slack eta
and the limit slacks eps are functions of y at the optimum, so the objective (6.6) becomes a convex piecewise quadratic

    1/2 x'Hx + g'x + sum_k soft_k(t_k) + sum_groups rho max(0, violation),   t = Theta x + t0 = y - r.

`x` holds the moves in scaled units, MV-major: integer MVs in steps, continuous ones in units of their move limit.
An integer move pays `P |d|` rows in place of `P d^2`: equal at the integers, far tighter between them (perspective
reformulation; Frangioni and Gentile 2006, Billionnet et al. 2012). Ranges beyond one step use the piecewise-linear
envelope of d^2 through the integers, a sum of deadzone terms with half widths 0, 1, 2, ...
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmpc.problem.blocking import (
    block_starts,
    moves_per_block,
    oscillation_rows,
    single_step_blocks,
    window_rows,
)
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.relaxed.gram import SUMMED_LIMIT, running_sums

FLAT_ROW = 1e-9  # squared length below which a row has next to no effect, against the longest
COARSE = 16.0


class CondensedQp(eqx.Module):
    """What stays constant from sample to sample; `rows` are the penalised predictions (CV-major) followed by the
    envelope rows of the integer moves, `n` the scaled moves (MV-major).

    `response` and `summed` follow from the structure and the model alone: a batch of tunings shares them, and the Newton
    matrices of all its lanes are one matrix product. What the tuning scales is kept apart in `scale`.

    Attributes:
        response: rows of t per MV unit of every move.
        summed: `gram.running_sums` of the prediction rows, or None where too large or too costly.
        hessian: H of the quadratic part without the integer moves' own weight if an envelope is used.
        curvature: H with that weight included (valid at integer moves only).
        move_weight: weight of x^2 that `hessian` holds, 0 where an envelope takes its place.
        quadratic: Q on the prediction rows, 0 on the envelope rows.
        soft_quadratic, soft_linear, deadzone: S, s, c per row.
        slack_weight: rho per CV.
        scale: MV units per unit of x.
        row_size: squared length of every row of theta.
        row_unit: its inverse, for predictions in powers of `COARSE` so that it changes at few samples of the horizon.
        bend: curvature of every move outside all deadzones.
        reach: what one unit of one move can do to a CV at most.
    """

    response: Float[Array, "row n"]
    summed: Float[Array, "prediction pair"] | None
    hessian: Float[Array, "n n"]
    curvature: Float[Array, "n n"]
    move_weight: Float[Array, " n"]
    quadratic: Float[Array, " row"]
    soft_quadratic: Float[Array, " row"]
    soft_linear: Float[Array, " row"]
    deadzone: Float[Array, " row"]
    slack_weight: Float[Array, " cv"]
    scale: Float[Array, " n"]
    row_size: Float[Array, " row"]
    row_unit: Float[Array, " row"]
    bend: Float[Array, " n"]
    reach: Float[Array, " cv"]
    has_limits: bool = eqx.field(static=True)

    @property
    def theta(self) -> Float[Array, "row n"]:
        """Rows of t = theta x + t0; one copy per lane where tunings are batched, so not for the solvers."""
        return self.response * self.scale[..., None, :]


class QpInstance(eqx.Module):
    """What changes every sample: offsets and limits of one problem, in the units of `CondensedQp`.

    Attributes:
        offset: t0 = Lambda - r on the prediction rows, 0 on the envelope rows.
        limit_high, limit_low: cv_high - r and cv_low - r on the prediction rows (infinite where absent).
        lower, upper: limits of x.
        row_low, row_high: limits of `blocking.hard_rows`.
    """

    offset: Float[Array, " row"]
    limit_high: Float[Array, " prediction"]
    limit_low: Float[Array, " prediction"]
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    row_low: Float[Array, " hard"]
    row_high: Float[Array, " hard"]


def dynamic_matrix(
    structure: Structure, coefficients: Float[Array, "cv mv n"]
) -> Float[Array, "cv horizon mv block"]:
    """Theta of (5.4c) after blocking, for j = 1..Hp [CV unit per MV unit].

    Args:
        structure: horizons and blocks.
        coefficients: S(1)..S(N); S keeps its last value beyond N.
    """
    horizon = structure.prediction_horizon
    samples = coefficients.shape[-1]
    index = np.minimum(np.arange(horizon), samples - 1)
    step = jnp.concatenate(
        [jnp.zeros((*coefficients.shape[:2], 1)), coefficients[..., index]], axis=-1
    )  # S(0) = 0
    starts, j = block_starts(structure), np.arange(1, horizon + 1)
    delay = np.maximum(j[:, None] - starts[None, :], 0)
    if structure.blocking == "inputs":
        columns = step[..., delay]
    else:  # a block of equal moves responds with the sum of delayed steps
        cumulative = jnp.cumsum(step, axis=-1)
        lengths = np.asarray(structure.blocks)
        columns = cumulative[..., delay] - cumulative[..., np.maximum(delay - lengths[None, :], 0)]
    return jnp.moveaxis(columns, 1, 2)


def integer_columns(structure: Structure) -> np.ndarray:
    """Positions of the integer moves in x."""
    blocks = structure.block_count
    return np.concatenate(
        [np.arange(mv * blocks, (mv + 1) * blocks) for mv in structure.integer_mvs] or [[]]
    ).astype(int)


def condense(
    structure: Structure,
    tuning: Tuning,
    coefficients: Float[Array, "cv mv n"],
    *,
    envelope: int = 1,
    has_limits: bool = True,
    summed: bool = True,
) -> CondensedQp:
    """Build the constant part of the condensed problem (5.8)-(5.13), (6.6).

    Args:
        structure: static configuration.
        tuning: weights and limits in engineering units.
        coefficients: step-response coefficients [CV unit per MV unit].
        envelope: largest whole number of steps an integer move can make, for the envelope of its weight; 0 keeps the
            plain square.
        has_limits: whether any CV limit is finite (static; False drops their rows from the solver).
        summed: whether to keep the running sums of the responses (up to `SUMMED_LIMIT` variables), which make a Newton
            step several times as fast; they take longer to make than one step takes.
    """
    blocks, mvs, rows = (
        structure.block_count,
        structure.mv_count,
        structure.cv_count * structure.horizon_count,
    )
    full = dynamic_matrix(structure, coefficients)[:, structure.first_penalised - 1 :]
    counts = jnp.tile(jnp.asarray(moves_per_block(structure), dtype=float), mvs)
    raw = full.reshape(rows, mvs * blocks)
    per_cv = lambda values: jnp.repeat(values, structure.horizon_count)  # noqa: E731
    quadratic = per_cv(tuning.cv_weight)
    weight = counts * jnp.repeat(tuning.move_weight, blocks)  # paid at every sample of the block
    by_cv = full.reshape(structure.cv_count, -1, mvs * blocks)
    per_weight = jnp.einsum("cji,cjk->cik", by_cv, by_cv)  # shared by a batch of tunings
    tracking = 2.0 * jnp.einsum("c,cik->ik", tuning.cv_weight, per_weight)
    scale = _variable_scale(structure, tuning, jnp.diagonal(tracking) + 2.0 * weight)
    weight = weight * scale**2
    tracking = tracking * scale[:, None] * scale[None, :]
    integer = integer_columns(structure)
    own = np.ones(mvs * blocks)
    if envelope:
        own[integer] = 0.0
    else:
        integer = integer[:0]
    steps = np.arange(max(envelope, 1))
    unit = np.zeros((len(integer), mvs * blocks))  # one step
    unit[np.arange(len(integer)), integer] = [
        1.0 / (structure.integer_step[c // blocks] or 1.0) for c in integer
    ]
    extra = len(integer) * len(steps)
    response = jnp.concatenate([raw, np.tile(unit, (len(steps), 1))])
    pad = lambda values, tail: jnp.concatenate([values, tail])  # noqa: E731
    slope = jnp.concatenate([(1.0 if m == 0 else 2.0) * weight[integer] for m in steps])
    soft_quadratic = pad(per_cv(tuning.soft_quadratic), jnp.zeros(extra))
    squares = response**2
    largest = jnp.max(jnp.abs(by_cv), axis=1)
    row_size = squares @ scale**2
    pay = summed and mvs * blocks <= SUMMED_LIMIT
    return CondensedQp(
        response=response,
        summed=running_sums(raw, structure.cv_count) if pay else None,
        hessian=tracking + jnp.diag(2.0 * weight * own),
        curvature=tracking + jnp.diag(2.0 * weight),
        move_weight=weight * own,
        quadratic=pad(quadratic, jnp.zeros(extra)),
        soft_quadratic=soft_quadratic,
        soft_linear=pad(per_cv(tuning.soft_linear), slope),
        deadzone=pad(per_cv(tuning.deadzone), jnp.repeat(jnp.asarray(steps, dtype=float), len(integer))),
        slack_weight=tuning.slack_weight,
        scale=scale,
        row_size=row_size,
        row_unit=_row_unit(row_size, rows),
        bend=2.0 * (soft_quadratic @ squares) * scale**2,
        reach=jnp.max(largest * scale, axis=1),
        has_limits=has_limits,
    )


condensed = eqx.filter_jit(condense)  # one program in place of a hundred operations


def _row_unit(row_size, predictions: int):
    """See `CondensedQp`; rows that hardly any move reaches count as longer than they are."""
    longest = jnp.max(row_size)
    size = jnp.maximum(row_size, FLAT_ROW * jnp.where(longest > 0.0, longest, 1.0))
    coarse = COARSE ** jnp.ceil(jnp.log(size[:predictions]) / np.log(COARSE))
    return 1.0 / jnp.concatenate([coarse, size[predictions:]])


def _variable_scale(structure: Structure, tuning: Tuning, curvature) -> Float[Array, " n"]:
    """MV units per unit of x: the step, else the move limit, else an eighth of the range, else by curvature."""
    finite = lambda a, other: jnp.where(jnp.isfinite(a) & (a > 0), a, other)  # noqa: E731
    by_curvature = 1.0 / jnp.sqrt(jnp.where(curvature > 0, curvature, 1.0))
    by_curvature = jnp.max(by_curvature.reshape(structure.mv_count, -1), axis=1)
    by_range = finite((tuning.mv_high - tuning.mv_low) / 8.0, by_curvature)
    by_move = finite(jnp.maximum(jnp.abs(tuning.move_low), jnp.abs(tuning.move_high)), by_range)
    steps = [
        by_move[mv] if step is None else jnp.asarray(step) for mv, step in enumerate(structure.integer_step)
    ]
    return jnp.repeat(jnp.stack(steps), structure.block_count)


def make_instance(
    structure: Structure,
    tuning: Tuning,
    qp: CondensedQp,
    *,
    free_response: Float[Array, "horizon cv"],
    setpoint: Float[Array, "horizon cv"],
    mv_now: Float[Array, " mv"],
    last_move: Float[Array, " mv"],
    past_moves: Float[Array, "window mv"] | None = None,
    recover: bool = False,
) -> QpInstance:
    """The problem of one sample.

    Args:
        structure: static configuration.
        tuning: limits in engineering units.
        qp: the constant part.
        free_response: Lambda at j = 1..Hp, bias included [CV unit].
        setpoint: r at j = 1..Hp [CV unit].
        mv_now: MVs before the move [MV unit].
        last_move: the previous move [MV unit]; enters the oscillation rows rounded to whole steps (thesis 6.5).
        past_moves: the last `mean_move_window` moves, oldest first, for the mean-move limit (6.6); None for no limit.
        recover: let an MV outside its limits return as fast as its move limits allow, in place of being infeasible.
    """
    first = structure.first_penalised - 1
    blocks = structure.block_count
    spread = lambda values: jnp.asarray(values)[first:].T.reshape(-1)  # noqa: E731
    target = spread(setpoint)
    extra = qp.response.shape[0] - target.shape[0]
    per_cv = lambda values: jnp.repeat(values, structure.horizon_count)  # noqa: E731
    scale = qp.scale.reshape(structure.mv_count, blocks)[:, 0]
    counts = jnp.asarray(moves_per_block(structure), dtype=float)
    lower, upper, row_low, row_high = [], [], [], []
    for mv in range(structure.mv_count):
        unit, integer = scale[mv], mv in structure.integer_mvs
        down, up = tuning.move_low[mv] / unit, tuning.move_high[mv] / unit
        room_down = (tuning.mv_low[mv] - mv_now[mv]) / unit
        room_up = (tuning.mv_high[mv] - mv_now[mv]) / unit
        if integer:  # whole steps from wherever the MV is; float drift must not cost a step
            down, up = whole_up(down), whole_down(up)
            room_down, room_up = whole_up(room_down), whole_down(room_up)
        own_low, own_high = jnp.full(blocks, down), jnp.full(blocks, up)
        if structure.blocking == "inputs":  # the zero moves inside a block must be allowed, too
            longer = np.asarray(structure.blocks) > 1
            own_low = jnp.where(longer & (down > 0), jnp.maximum(own_low, 1.0), own_low)
            own_high = jnp.where(longer & (down > 0), -1.0, own_high)
            own_low = jnp.where(longer & (up < 0), 1.0, own_low)
            own_high = jnp.where(longer & (up < 0), jnp.minimum(own_high, -1.0), own_high)
        held = jnp.round(last_move[mv] / unit)
        watch = tuning.oscillation_rows[mv] if integer else jnp.asarray(False)
        if integer:
            single = jnp.asarray(single_step_blocks(structure))
            own_low = jnp.where(watch & single, jnp.maximum(own_low, -1.0), own_low)
            own_high = jnp.where(watch & single, jnp.minimum(own_high, 1.0), own_high)
            own_low = own_low.at[0].set(jnp.where(watch, jnp.maximum(own_low[0], held - 1.0), own_low[0]))
            own_high = own_high.at[0].set(jnp.where(watch, jnp.minimum(own_high[0], held + 1.0), own_high[0]))
        if past_moves is not None and structure.mean_move_mode == "reactive":  # (6.6)
            mean = jnp.mean(past_moves[:, mv])
            limit = tuning.mean_move_limit[mv] * (1.0 + 1e-9)
            own_high = own_high.at[0].set(
                jnp.where(mean > limit, jnp.minimum(own_high[0], jnp.maximum(own_low[0], 0.0)), own_high[0])
            )
            own_low = own_low.at[0].set(
                jnp.where(mean < -limit, jnp.maximum(own_low[0], jnp.minimum(own_high[0], 0.0)), own_low[0])
            )
        windows = window_rows(structure)
        budget_up = budget_down = jnp.zeros(0)
        if len(windows):
            budget_up, budget_down = _window_budget(structure, tuning, past_moves, mv)
        ends_low, ends_high = jnp.full(blocks, room_down), jnp.full(blocks, room_up)
        if recover:
            up = (windows, budget_up / unit, integer)
            down = (windows, budget_down / unit, integer)
            back_up = _fastest_return(own_high, watch, held, counts, up, sign=1.0)
            back_down = _fastest_return(own_low, watch, held, counts, down, sign=-1.0)
            ends_low = jnp.where(room_down > 0, jnp.minimum(ends_low, back_up), ends_low)
            ends_high = jnp.where(room_up < 0, jnp.maximum(ends_high, back_down), ends_high)
        # a range that follows from the MV limits keeps every box finite where the limits are
        implied_low, implied_high = _implied_range(ends_low, ends_high, counts, integer)
        own_low, own_high = jnp.maximum(own_low, implied_low), jnp.minimum(own_high, implied_high)
        lower.append(own_low)
        upper.append(own_high)
        row_low.append(ends_low)
        row_high.append(ends_high)
        if integer:
            width = jnp.where(watch, 1.0, jnp.inf) * jnp.ones(len(oscillation_rows(structure)))
            row_low.append(-width)
            row_high.append(width)
        if len(windows):
            row_low.append(-budget_down / unit)
            row_high.append(budget_up / unit)
    return QpInstance(
        offset=jnp.concatenate([spread(free_response) - target, jnp.zeros(extra)]),
        limit_high=per_cv(tuning.cv_high) - target,
        limit_low=per_cv(tuning.cv_low) - target,
        lower=jnp.concatenate(lower),
        upper=jnp.concatenate(upper),
        row_low=jnp.concatenate(row_low),
        row_high=jnp.concatenate(row_high),
    )


DRIFT = 1e-6  # share of a step that counts as float drift of a position


def whole_down(steps):
    """Largest whole number of steps within a limit, forgiving float drift (infinite stays infinite)."""
    return jnp.floor(steps + DRIFT)


def whole_up(steps):
    """Smallest whole number of steps within a limit, forgiving float drift (infinite stays infinite)."""
    return jnp.ceil(steps - DRIFT)


def _implied_range(low, high, counts, integer: bool):
    """Limits of the block moves that follow from the positions allowed at their two ends."""
    before_low = jnp.concatenate([jnp.zeros(1), low[:-1]])
    before_high = jnp.concatenate([jnp.zeros(1), high[:-1]])
    least, most = (low - before_high) / counts, (high - before_low) / counts
    return (whole_up(least), whole_down(most)) if integer else (least, most)


def _fastest_return(limit, watch, held, counts, budget, *, sign):
    """Position at the block ends when every move is as large as its limit, oscillation and window rows allow."""
    # a move is at most one step more than the one before it: the least of all earlier limits and the steps since
    steps = np.subtract.outer(np.arange(len(limit)), np.arange(-1, len(limit)))
    reach = sign * jnp.concatenate([held[None], limit]) + steps
    slowed = jnp.where(watch & (steps >= 0) | (steps == 0), reach, jnp.inf).min(axis=1)
    move = sign * _within_windows(jnp.where(jnp.isfinite(slowed), slowed, 1e9), watch, *budget)
    return jnp.sum(np.tri(len(limit)) * (counts * move), axis=1)


def _within_windows(moves, watch, windows: np.ndarray, budget, integer: bool):
    """The moves, block after block as large as the mean-move windows leave room for."""
    if not len(windows):
        return moves
    if integer:  # the next move may have to be none, which the oscillation rows allow after one step
        moves = jnp.where(watch, jnp.minimum(moves, 1.0), moves)
    for block in range(len(moves)):
        share = windows[:, block]
        used = windows[:, :block] @ moves[:block]
        room = jnp.where(share > 0, (budget - used) / np.where(share > 0, share, 1.0), jnp.inf).min()
        room = jnp.maximum(whole_down(room) if integer else room, 0.0)
        moves = moves.at[block].min(room)
    return moves


def _window_budget(structure: Structure, tuning: Tuning, past_moves, mv: int):
    """What the mean-move window still allows at each sample of the horizon, upwards and downwards [MV unit]."""
    window, samples = structure.mean_move_window, structure.control_horizon
    past = jnp.zeros(window) if past_moves is None else past_moves[:, mv]
    # the window that ends at horizon sample k holds the last window - 1 - k past moves
    tail = jnp.concatenate([jnp.cumsum(past[::-1])[::-1], jnp.zeros(1)])
    kept = tail[np.minimum(np.arange(samples) + 1, window)]
    total = window * tuning.mean_move_limit[mv] * (1.0 + 1e-9)
    return jnp.maximum(total - kept, 0.0), jnp.maximum(total + kept, 0.0)


def engineering_moves(
    structure: Structure, qp: CondensedQp, x: Float[Array, " n"]
) -> Float[Array, "block mv"]:
    """Moves in MV units, block by MV, from the scaled vector."""
    return (x * qp.scale).reshape(structure.mv_count, structure.block_count).T
