"""Condensed form of the controller's problem (thesis 5.2, 6.4), with eta and eps folded into the objective.

With y = Lambda + Theta du (5.9) the decision variables are the blocked moves alone. The deadzone slack eta
and the limit slacks eps are functions of y at the optimum, so the objective (6.6) becomes a convex piecewise quadratic

    1/2 x'Hx + g'x + sum_k soft_k(t_k) + sum_groups rho max(0, violation),   t = Theta x + t0 = y - r.

`x` holds the moves in scaled units, MV-major: integer MVs in steps, continuous ones in units of their move limit.
An integer move pays `P |d|` in place of `P d^2`: equal at the integers, far tighter between them (perspective
reformulation; Frangioni and Gentile 2006, Billionnet et al. 2012). Ranges beyond one step use the piecewise-linear
envelope of d^2 through the integers, a sum of deadzone terms with half widths 0, 1, 2, ...

`instance` has what changes from sample to sample.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc.problem.gram import running_sums
from jaxmpc.problem.ideal import IdealCost
from jaxmpc.problem.layout import Layout, Size
from jaxmpc.problem.tuning import Tuning

FLAT_ROW = 1e-9  # squared length below which a row has next to no effect, against the longest
COARSE = 16.0
SUMMED_BYTES = 2**27  # of running sums, up to which they are worth their memory


class Rows(eqx.Module):
    """The hard rows on the moves: positions at the block ends, oscillation (6.16), windows (6.6), MV after MV.

    The rows of different MVs do not meet. Where all have the same blocks they are the same for all, so that products are
    those of one small matrix; where not, there is one per MV.
    """

    # of one MV on its moves: positions of all blocks, differences of neighbouring blocks, windows
    own: Float[Array, "*mv row block"]
    size: Float[Array, "*mv row"]  # their squared lengths
    count: Float[Array, "*mv block"]  # samples that carry the move of a block

    @classmethod
    def of_layout(cls, layout: Layout) -> Rows:
        """Those of a structure."""
        blocks = layout.count.shape[-1]
        position = np.tri(blocks) * layout.count[..., None, :]
        pair = jnp.broadcast_to(np.eye(blocks) - np.eye(blocks, k=-1), position.shape)
        own = jnp.concatenate([position, pair, layout.window], axis=-2)
        return cls(own, jnp.sum(own**2, axis=-1), jnp.asarray(layout.count))

    def of(self, x: Float[Array, " n"]) -> Float[Array, " hard"]:
        """W x."""
        return self._of_each(x, self.own)

    def touch(self, free: Float[Array, " n"]) -> Bool[Array, " hard"]:
        """Which rows have free moves (1, the others 0)."""
        return self._of_each(free, jnp.abs(self.own)) > 0.0

    def pull(self, prices: Float[Array, " hard"]) -> Float[Array, " n"]:
        """W' prices."""
        by_mv = prices.reshape(-1, self.own.shape[-2])
        if self.own.ndim == 2:
            return (by_mv @ self.own).reshape(-1)
        return jnp.einsum("mr,mrb->mb", by_mv, self.own).reshape(-1)

    def _of_each(self, x: Float[Array, " n"], own: Float[Array, "*mv row block"]) -> Float[Array, " hard"]:
        by_mv = x.reshape(-1, own.shape[-1])
        if own.ndim == 2:
            return (by_mv @ own.T).reshape(-1)
        return jnp.einsum("mb,mrb->mr", by_mv, own).reshape(-1)

    def square(self, weights: Float[Array, " hard"]) -> Float[Array, "n n"]:
        """W' diag(weights) W, for weights of 0 or more."""
        rows, blocks = self.own.shape[-2:]
        by_mv = weights.reshape(-1, rows)
        position, pair = by_mv[:, :blocks], by_mv[:, blocks : 2 * blocks]
        # blocks i and j share the positions from the later one on, whose weights add up to the smaller of two sums
        later = position @ np.tri(blocks)
        square = self.count[..., :, None] * self.count[..., None, :]
        own = jnp.minimum(later[:, :, None], later[:, None, :]) * square
        after = jnp.pad(pair[:, 1:], ((0, 0), (0, 1)))
        own += np.eye(blocks) * (pair + after)[:, :, None]
        own -= np.eye(blocks, k=1) * pair[:, None, :] + np.eye(blocks, k=-1) * pair[:, :, None]
        if rows > 2 * blocks:
            window = self.own[..., 2 * blocks :, :]
            own += jnp.swapaxes(window, -1, -2) @ (by_mv[:, 2 * blocks :, None] * window)
        apart = np.eye(len(by_mv))[:, None, :, None]
        n = len(by_mv) * blocks
        return (own[:, :, None, :] * apart).reshape(n, n)

    def spread(self, of_one: Float[Array, "*mv row"], mvs: int) -> Float[Array, " hard"]:
        """Values of the rows of one MV or each, for all."""
        return jnp.tile(of_one, mvs) if of_one.ndim == 1 else of_one.reshape(-1)


class CondensedQp(eqx.Module):
    """What stays constant from sample to sample; predictions are CV-major, the `n` scaled moves MV-major.

    `response` and `summed` follow from the structure and the model alone: a batch of tunings shares them, and the Newton
    matrices of all its lanes are one matrix product. What the tuning scales is kept apart in `scale`.
    """

    response: Float[Array, "prediction n"]  # predictions per MV unit of every move
    # `gram.running_sums` of them, or None where too large or too costly
    summed: Float[Array, "prediction pair"] | None
    rows: Rows  # hard rows
    # H of the quadratic part without the integer moves' own weight if an envelope is used
    hessian: Float[Array, "n n"]
    curvature: Float[Array, "n n"]  # H with that weight included (valid at integer moves only)
    move_weight: Float[Array, " n"]  # weight of x^2 that `hessian` holds, 0 where an envelope takes its place
    quadratic: Float[Array, " prediction"]  # Q
    soft_quadratic: Float[Array, " prediction"]  # S
    soft_linear: Float[Array, " prediction"]  # s
    deadzone: Float[Array, " prediction"]  # c
    # slopes of the envelope at 0, 1, 2, ... steps; no levels for the plain square
    steep: Float[Array, "level n"]
    slack_weight: Float[Array, " cv"]  # rho per CV
    scale: Float[Array, " n"]  # MV units per unit of x
    row_size: Float[Array, " prediction"]  # squared length of every row of theta
    row_unit: Float[Array, " prediction"]  # its inverse in powers of `COARSE`, which changes at few samples
    bend: Float[Array, " n"]  # curvature of every move outside all deadzones
    reach: Float[Array, " cv"]  # what one unit of one move can do to a CV at most
    whole: Bool[Array, " n"]  # moves that are whole
    # curvature of the positions that is paid along the chords of their square and not in `hessian` (`integer.tighten`)
    position_weight: Float[Array, " hard"] | None
    ideal: IdealCost | None  # of the MVs' distances from their ideal values; None where no MV has one
    # whether any CV limit is finite (static; without, their rows are left out)
    has_limits: bool = eqx.field(static=True)

    @property
    def knot(self) -> np.ndarray:
        """Half widths of the levels of the envelope [steps], ``"level 1"``."""
        return np.arange(self.steep.shape[-2], dtype=float)[:, None]

    @property
    def unit(self) -> Float[Array, ""]:
        """Of the objective, see `relaxed.gap.closes`: its largest curvature, or that beyond the deadzones."""
        inside = jnp.max(jnp.diagonal(self.curvature, axis1=-2, axis2=-1), axis=-1)
        outside = jnp.max(self.bend, axis=-1)
        some = jnp.where(inside > 0.0, inside, outside)
        return jnp.where(some > 0.0, some, 1e-12)

    @property
    def theta(self) -> Float[Array, "prediction n"]:
        """Rows of t = theta x + t0; one copy per lane where tunings are batched, so not for the solvers."""
        return self.response * self.scale[..., None, :]


def penalised(layout: Layout, size: Size) -> tuple[Array, Bool[Array, " horizon"]]:
    """Samples j = Hw, Hw + 1, ... of the predictions, and which of them are not beyond Hp."""
    j = layout.first + jnp.arange(size.horizon)
    return j, j <= layout.last


def dynamic_matrix(
    layout: Layout, coefficients: Float[Array, "cv mv future"], j: Array
) -> Float[Array, "cv horizon mv block"]:
    """Theta of (5.4c) after blocking [CV unit per MV unit].

    Args:
        coefficients: S(1)..S(N); S keeps its last value beyond N.
    """
    if layout.start.ndim == 1:
        return jnp.moveaxis(_responses(layout.start, layout.count, coefficients, j), 1, 2)
    return jax.vmap(_responses, in_axes=(0, 0, 1, None), out_axes=2)(
        layout.start, layout.count, coefficients, j
    )


def _responses(
    start: Array, count: Array, coefficients: Float[Array, "*response future"], j: Array
) -> Float[Array, "*response horizon block"]:
    """To a unit move in each of some blocks; a block of equal moves responds with the sum of delayed steps, S(0) = 0."""
    longest = j.shape[0] + coefficients.shape[-1]
    step = coefficients[..., np.minimum(np.arange(longest), coefficients.shape[-1] - 1)]
    none = jnp.zeros((*step.shape[:-1], 1))
    summed = jnp.concatenate([none, jnp.cumsum(step, axis=-1)], axis=-1)
    delay = jnp.clip(j[:, None] - start, 0, longest)
    single = count == 1.0  # no difference of two sums is needed, nor its rounding
    before = jnp.where(single, delay, jnp.maximum(delay - count.astype(int), 0))
    padded = jnp.concatenate([none, step], axis=-1)
    return jnp.where(single, padded[..., delay], summed[..., delay] - summed[..., before])


class Matrices(eqx.Module):
    """What structure and model alone decide.

    Attributes:
        response, summed: as in `CondensedQp`.
        squared: response'response per CV.
        largest: largest size of a response per CV and move.
    """

    response: Float[Array, "prediction n"]
    summed: Float[Array, "prediction pair"] | None
    squared: Float[Array, "cv n n"]
    largest: Float[Array, "cv n"]


def matrices_of(
    layout: Layout, size: Size, coefficients: Float[Array, "cv mv future"], *, summed: bool = True
) -> Matrices:
    """The matrices that all tunings of a structure and model share.

    Args:
        coefficients: step-response coefficients [CV unit per MV unit].
        summed: whether to keep the running sums of the responses (up to `SUMMED_BYTES`), which make a Newton
            step several times as fast; they take longer to make than one step takes.
    """
    n, rows = size.moves, size.cvs * size.horizon
    j, inside = penalised(layout, size)
    by_cv = dynamic_matrix(layout, coefficients, j).reshape(size.cvs, size.horizon, n)
    real = jnp.broadcast_to(layout.real, (size.mvs, size.blocks)).reshape(-1)
    by_cv = jnp.where(inside[:, None] & real, by_cv, 0.0)
    response = by_cv.reshape(rows, n)
    pay = summed and rows * n * (n + 1) // 2 * 8 <= SUMMED_BYTES
    return Matrices(
        response=response,
        summed=running_sums(response, size.cvs) if pay else None,
        squared=jnp.einsum("cji,cjk->cik", by_cv, by_cv),
        largest=jnp.max(jnp.abs(by_cv), axis=1),
    )


def condense(
    layout: Layout,
    size: Size,
    tuning: Tuning,
    matrices: Matrices,
    *,
    envelope: int = 1,
    has_limits: bool = True,
    has_ideal: bool = True,
) -> CondensedQp:
    """Build the constant part of the condensed problem (5.8)-(5.13), (6.6).

    Args:
        envelope: largest whole number of steps an integer move can make, for the envelope of its weight; 0 keeps the
            plain square.
        has_limits: whether any CV limit is finite (static; False drops their rows from the solver).
        has_ideal: whether any MV has an ideal value (static).
    """
    n, raw = size.moves, matrices.response
    j, inside = penalised(layout, size)
    per_cv = lambda values: (values[:, None] * inside).reshape(-1)  # noqa: E731
    spread = lambda values: jnp.repeat(values, size.blocks)  # noqa: E731
    counts = jnp.broadcast_to(layout.count, (size.mvs, size.blocks)).reshape(-1)
    weight = counts * spread(tuning.move_weight)  # paid at every sample of the block
    tracking = 2.0 * jnp.einsum("c,cik->ik", tuning.cv_weight, matrices.squared)
    ideal = IdealCost.of(layout, size, tuning, j, inside) if has_ideal else None
    if ideal is not None:
        tracking += ideal.curvature()
    soft = tuning.soft_quadratic @ jnp.diagonal(matrices.squared, axis1=1, axis2=2)
    scale = _variable_scale(layout, size, tuning, jnp.diagonal(tracking) + 2.0 * (weight + soft))
    weight = weight * scale**2
    tracking = tracking * scale[:, None] * scale[None, :]
    whole = layout.whole.reshape(-1)
    own = jnp.where(whole, 0.0, 1.0) if envelope else jnp.ones(n)
    slopes = [(1.0 if m == 0 else 2.0) * jnp.where(whole, weight, 0.0) for m in range(envelope)]
    row_size = raw**2 @ scale**2
    return CondensedQp(
        response=raw,
        summed=matrices.summed,
        rows=Rows.of_layout(layout),
        hessian=tracking + jnp.diag(2.0 * weight * own),
        curvature=tracking + jnp.diag(2.0 * weight),
        move_weight=weight * own,
        quadratic=per_cv(tuning.cv_weight),
        soft_quadratic=per_cv(tuning.soft_quadratic),
        soft_linear=per_cv(tuning.soft_linear),
        deadzone=per_cv(tuning.deadzone),
        steep=jnp.stack(slopes) if envelope else jnp.zeros((0, n)),
        slack_weight=tuning.slack_weight,
        scale=scale,
        row_size=row_size,
        row_unit=_row_unit(row_size, size.cvs),
        bend=2.0 * soft * scale**2,
        reach=jnp.max(matrices.largest * scale, axis=1),
        whole=whole,
        position_weight=None,
        ideal=None if ideal is None else ideal.scaled(scale),
        has_limits=has_limits,
    )


def _row_unit(row_size, cvs: int):
    """See `CondensedQp`; rows that hardly any move reaches count as longer than they are.

    Every CV is measured by its own longest row, so that its unit does not matter.
    """
    by_cv = row_size.reshape(cvs, -1)
    longest = jnp.max(by_cv, axis=1, keepdims=True)
    longest = jnp.where(longest > 0.0, longest, 1.0)
    share = jnp.maximum(by_cv / longest, FLAT_ROW)
    return (1.0 / (longest * COARSE ** jnp.ceil(jnp.log(share) / np.log(COARSE)))).reshape(-1)


def _variable_scale(layout: Layout, size: Size, tuning: Tuning, curvature) -> Float[Array, " n"]:
    """MV units per unit of x: the step, else the move limit, else an eighth of the range, else by curvature.

    By curvature an MV is measured so that one unit of x costs what it costs of the dearest of the other MVs; where none has
    limits, what a deviation by a deadzone costs, or by the range of a CV's limits. No unit then matters.
    """
    finite = lambda a, other: jnp.where(jnp.isfinite(a) & (a > 0), a, other)  # noqa: E731
    by_curvature = 1.0 / jnp.sqrt(jnp.where(curvature > 0, curvature, 1.0))
    by_curvature = jnp.where(layout.real, by_curvature.reshape(size.mvs, -1), 0.0).max(axis=1)
    by_range = finite((tuning.mv_high - tuning.mv_low) / 8.0, 0.0)
    by_move = finite(jnp.maximum(jnp.abs(tuning.move_low), jnp.abs(tuning.move_high)), by_range)
    known = jnp.where(layout.integer, layout.step, by_move)
    costs = jnp.where(layout.real, curvature.reshape(size.mvs, -1), 0.0).max(axis=1) * known**2
    of_cv = finite(tuning.deadzone, finite(tuning.cv_high - tuning.cv_low, 0.0))
    deviation = finite(jnp.max((tuning.cv_weight + tuning.soft_quadratic) * of_cv**2), 1.0)
    like_others = jnp.sqrt(finite(jnp.max(costs), deviation)) * by_curvature
    return jnp.repeat(jnp.where(known > 0.0, known, like_others), size.blocks)
