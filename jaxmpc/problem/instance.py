"""The problem of one sample: offsets and limits of the condensed form (5.5a), (6.6), (6.16)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc.problem.condense import CondensedQp, penalised
from jaxmpc.problem.layout import Layout, Size
from jaxmpc.problem.tuning import Tuning

DRIFT = 1e-6  # share of a step that counts as float drift of a position


class QpInstance(eqx.Module):
    """What changes every sample: offsets and limits of one problem, in the units of `CondensedQp`."""

    offset: Float[Array, " prediction"]  # t0 = Lambda - r
    limit_high: Float[Array, " limit"]  # cv_high - r, infinite where absent; empty where no CV has limits
    limit_low: Float[Array, " limit"]
    lower: Float[Array, " n"]  # limits of x
    upper: Float[Array, " n"]
    row_low: Float[Array, " hard"]  # limits of the hard rows
    row_high: Float[Array, " hard"]
    # where the MVs stand above their ideal values; None where none has one [MV unit]
    distance: Float[Array, " mv"] | None = None


def make_instance(
    layout: Layout,
    size: Size,
    tuning: Tuning,
    qp: CondensedQp,
    *,
    free_response: Float[Array, "future cv"],
    setpoint: Float[Array, "future cv"],
    mv_now: Float[Array, " mv"],
    last_move: Float[Array, " mv"],
    past_moves: Float[Array, "past mv"],
    position: Float[Array, " mv"] | None = None,
    recover: bool | Bool[Array, ""] = False,
) -> QpInstance:
    """The problem of one sample.

    Args:
        free_response: Lambda at j = 1, 2, ..., bias included [CV unit].
        setpoint: r at j = 1, 2, ... [CV unit].
        mv_now: MVs before the move [MV unit].
        last_move: the previous move [MV unit]; enters the oscillation rows rounded to whole steps (thesis 6.5).
        past_moves: the last moves, oldest first, for the mean-move limit (6.6) [MV unit].
        position: where the actuators stand in the predictions, at `mv_now` if not given [MV unit].
        recover: let an MV outside its limits return as fast as its move limits allow, in place of being infeasible.
    """
    j, inside = penalised(layout, size)
    of_cvs = lambda values: values[jnp.minimum(j - 1, values.shape[0] - 1)].T  # noqa: E731
    target = of_cvs(setpoint)
    offset = jnp.where(inside, of_cvs(free_response) - target, 0.0).reshape(-1)
    none = jnp.zeros(0)
    limit = lambda given, absent: jnp.where(inside, given[:, None] - target, absent).reshape(-1)  # noqa: E731
    box, rows = _move_limits(layout, size, tuning, qp, mv_now, last_move, past_moves, recover)
    return QpInstance(
        offset=offset,
        limit_high=limit(tuning.cv_high, jnp.inf) if qp.has_limits else none,
        limit_low=limit(tuning.cv_low, -jnp.inf) if qp.has_limits else none,
        lower=box[0].reshape(-1),
        upper=box[1].reshape(-1),
        row_low=rows[0],
        row_high=rows[1],
        distance=None if qp.ideal is None else (mv_now if position is None else position) - tuning.ideal,
    )


def _move_limits(layout: Layout, size: Size, tuning: Tuning, qp, mv_now, last_move, past_moves, recover):
    """Limits of x ``"mv block"`` and of the hard rows, lower and upper."""
    unit = qp.scale.reshape(size.mvs, size.blocks)[:, 0]
    per_mv = lambda values: values[:, None]  # noqa: E731
    real, counts = layout.real, layout.count

    def whole(low, high):  # whole steps from wherever the MV is; float drift must not cost a step
        return jnp.where(layout.whole, whole_up(low), low), jnp.where(layout.whole, whole_down(high), high)

    down, up = whole(per_mv(tuning.move_low / unit), per_mv(tuning.move_high / unit))
    room_down, room_up = whole(
        per_mv((tuning.mv_low - mv_now) / unit), per_mv((tuning.mv_high - mv_now) / unit)
    )
    low, high = jnp.broadcast_to(down, (size.mvs, size.blocks)), jnp.broadcast_to(up, (size.mvs, size.blocks))
    # in `inputs` the zero moves inside a block must be allowed, too
    rising, falling = layout.longer & (down > 0), layout.longer & (up < 0)
    low = jnp.where(rising, jnp.maximum(low, 1.0), low)
    high = jnp.where(rising, -1.0, high)
    low = jnp.where(falling, 1.0, low)
    high = jnp.where(falling, jnp.minimum(high, -1.0), high)
    # (6.16) against zero moves beside a block, and against the last move
    held = per_mv(jnp.round(last_move / unit))
    watch = per_mv(tuning.oscillation_rows) & layout.whole
    begin = np.arange(size.blocks) == 0
    low = jnp.where(watch & layout.single, jnp.maximum(low, -1.0), low)
    high = jnp.where(watch & layout.single, jnp.minimum(high, 1.0), high)
    low = jnp.where(watch & begin, jnp.maximum(low, held - 1.0), low)
    high = jnp.where(watch & begin, jnp.minimum(high, held + 1.0), high)
    # (6.6), reactive: no further move in the direction of a mean that is too large
    mean = per_mv(layout.share @ past_moves)
    most = per_mv(tuning.mean_move_limit) * (1.0 + 1e-9)
    high = jnp.where(begin & (mean > most), jnp.minimum(high, jnp.maximum(low, 0.0)), high)
    low = jnp.where(begin & (mean < -most), jnp.maximum(low, jnp.minimum(high, 0.0)), low)
    # (6.6), predictive: what the windows leave
    kept = (layout.remaining @ past_moves).T
    total = layout.window_length * most
    budget_up = jnp.maximum(total - kept, 0.0) / per_mv(unit)
    budget_down = jnp.maximum(total + kept, 0.0) / per_mv(unit)
    ends_low, ends_high = (jnp.broadcast_to(v, low.shape) for v in (room_down, room_up))
    back_up = _fastest_return(layout, high, watch, held, budget_up, sign=1.0)
    back_down = _fastest_return(layout, low, watch, held, budget_down, sign=-1.0)
    ends_low = jnp.where(recover & (room_down > 0), jnp.minimum(ends_low, back_up), ends_low)
    ends_high = jnp.where(recover & (room_up < 0), jnp.maximum(ends_high, back_down), ends_high)
    # a range that follows from the MV limits keeps every box finite where the limits are
    shifted = lambda values: jnp.pad(values[:, :-1], ((0, 0), (1, 0)))  # noqa: E731
    many = jnp.maximum(counts, 1.0)
    least, largest = whole((ends_low - shifted(ends_high)) / many, (ends_high - shifted(ends_low)) / many)
    low = jnp.where(real, jnp.maximum(low, least), 0.0)
    high = jnp.where(real, jnp.minimum(high, largest), 0.0)
    width = jnp.where(watch & layout.coupled, 1.0, jnp.inf)
    used = jnp.any(layout.window != 0.0, axis=-1)
    rows_low = ends_low, -width, -budget_down
    rows_high = ends_high, width, budget_up
    there = real, real, used
    flat = lambda parts, absent: jnp.concatenate(  # noqa: E731
        [jnp.where(its, part, absent) for its, part in zip(there, parts, strict=True)], axis=1
    ).reshape(-1)
    return (low, high), (flat(rows_low, -jnp.inf), flat(rows_high, jnp.inf))


def whole_down(steps):
    """Largest whole number of steps within a limit, forgiving float drift (infinite stays infinite)."""
    return jnp.floor(steps + DRIFT)


def whole_up(steps):
    """Smallest whole number of steps within a limit, forgiving float drift (infinite stays infinite)."""
    return jnp.ceil(steps - DRIFT)


def _fastest_return(layout: Layout, limit, watch, held, budget, *, sign: float):
    """Positions at the block ends when every move is as large as its limit, oscillation and window rows allow."""
    blocks = limit.shape[1]
    # a move is at most one step more than the one before it: the least of all earlier limits and the steps since
    steps = np.subtract.outer(np.arange(blocks), np.arange(-1, blocks))
    reach = sign * jnp.concatenate([held, limit], axis=1)[:, None, :] + steps
    slowed = jnp.where(watch[:, :, None] & (steps >= 0) | (steps == 0), reach, jnp.inf).min(axis=2)
    move = jnp.where(jnp.isfinite(slowed), slowed, 1e9)
    if layout.window.shape[-2]:
        move = _within_windows(move, watch, layout, budget)
    return (layout.count * sign * move) @ np.tri(blocks).T


def _within_windows(moves, watch, layout: Layout, budget):
    """The moves, block after block as large as the mean-move windows leave room for."""
    # the next move may have to be none, which the oscillation rows allow after one step
    moves = jnp.where(watch, jnp.minimum(moves, 1.0), moves)
    windows, whole = jnp.asarray(layout.window), jnp.asarray(layout.whole)

    def one(block, moves):
        share, before = windows[..., block], jnp.where(np.arange(moves.shape[1]) < block, moves, 0.0)
        used = before @ windows.T if windows.ndim == 2 else jnp.einsum("mb,mwb->mw", before, windows)
        room = jnp.where(share > 0, (budget - used) / jnp.where(share > 0, share, 1.0), jnp.inf).min(axis=1)
        room = jnp.maximum(jnp.where(whole[:, block], whole_down(room), room), 0.0)
        return moves.at[:, block].min(room)

    return jax.lax.fori_loop(0, moves.shape[1], one, moves)
