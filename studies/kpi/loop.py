"""Key figures of a closed loop, as pure functions of arrays (time axis first).

Everything here is `jax.numpy` on fixed shapes, so `jax.vmap` turns it into the key figures of thousands
of scenarios; plain numpy arrays go in just as well, and each figure is then one small program. Notation: y measured CV,
r setpoint, u actuator position, k the sample, dt the sampling interval, m[k] = u[k] - u[k-1] the move at sample k.

A *move* is an |m[k]| above a threshold, the smallest move of its MV: it keeps the creeping of a continuous actuator out and
every step of a stepped one in. A *reversal* is a move whose direction is opposite to the move before it.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

import jaxmpc  # noqa: F401  (switches JAX to float64)

Samples = Float[ArrayLike, " sample"]  # moves or positions of one MV, or a number per sample
Labels = Int[ArrayLike, " sample"]
Cvs = Float[ArrayLike, "sample cv"]
PerCv = Float[ArrayLike, " cv"]
Values = Float[ArrayLike, "sample channel"]
Limits = Float[ArrayLike, " channel"]
Number = Float[Array, ""]
Count = Int[Array, ""]
Statistic = Float[Array, " cv"]


@functools.partial(jax.jit, inline=True)
def moves_of(position: Samples, start) -> Float[Array, " sample"]:
    """m[0] = u[0] - start, m[k] = u[k] - u[k-1]; `start` is the position before the run, same unit."""
    return jnp.diff(jnp.asarray(position), prepend=jnp.asarray(start)[None])


@functools.partial(jax.jit, inline=True)
def travel(move: Samples) -> Number:
    """Travel sum_k |m[k]|, in the unit of the move: the wear of an actuator."""
    return jnp.abs(jnp.asarray(move)).sum()


@functools.partial(jax.jit, inline=True)
def move_count(move: Samples, threshold: float = 0.0) -> Count:
    """Number of samples with |m[k]| > threshold."""
    return (jnp.abs(jnp.asarray(move)) > threshold).sum()


@functools.partial(jax.jit, inline=True)
def reversal_events(
    move: Samples, threshold: float = 0.0, segment: Labels | None = None
) -> Bool[Array, " sample"]:
    """Samples at which the MV turns round.

    |m[k]| > threshold and sign m[k] = -sign m[j], where j < k is the move before it; given labels `segment`, only moves
    with the same label, 0 or more, are compared.
    """
    move = jnp.asarray(move)
    moved = jnp.abs(move) > threshold
    before = _before(moved)
    turned = moved & (before >= 0) & (jnp.sign(move) * jnp.sign(move[before]) < 0)
    if segment is None:
        return turned
    segment = jnp.asarray(segment)
    return turned & (segment >= 0) & (segment[before] == segment)


def _before(event: Bool[Array, " sample"]) -> Int[Array, " sample"]:
    """The sample of the latest event before each sample, -1 without one."""
    latest = jax.lax.cummax(jnp.where(event, jnp.arange(event.shape[0]), -1))
    return jnp.concatenate([jnp.full((1,), -1, latest.dtype), latest[:-1]])


@functools.partial(jax.jit, static_argnames="segments", inline=True)
def count_by_segment(
    event: Bool[ArrayLike, " sample"], segment: Labels, segments: int
) -> Int[Array, " segment"]:
    """Number of events with each label 0..segments-1; labels below 0 are left out."""
    label = jnp.arange(segments)[:, None]
    return ((jnp.asarray(segment)[None, :] == label) & jnp.asarray(event)[None, :]).sum(axis=1)


def second_halves(window: Int[np.ndarray, " sample"]) -> Int[np.ndarray, " sample"]:
    """The window index in the second half of every window (from sample n // 2 of n), -1 elsewhere.

    What happens right after a setpoint change is a transient; what is left in the second half is hunting.
    """
    window = np.asarray(window)
    out = np.full(window.shape, -1)
    for w in np.unique(window):
        samples = np.flatnonzero(window == w)
        out[samples[len(samples) // 2 :]] = w
    return out


@functools.partial(jax.jit, inline=True)
def dwell(move: Samples, dt: float, threshold: float = 0.0) -> tuple[Number, Number]:
    """Mean and shortest time between successive moves [s].

    With moves at k1 < ... < kn: mean (kn - k1) dt / (n - 1), shortest min_i (k(i+1) - k(i)) dt; NaN if n < 2.
    """
    moved = jnp.abs(jnp.asarray(move)) > threshold
    before = _before(moved)
    follows = moved & (before >= 0)
    distance = jnp.where(follows, (jnp.arange(moved.shape[0]) - before) * dt, 0.0)
    count = follows.sum()
    mean = jnp.where(count > 0, distance.sum() / jnp.maximum(count, 1), jnp.nan)
    shortest = jnp.where(follows, distance, jnp.inf).min()
    return mean, jnp.where(count > 0, shortest, jnp.nan)


@functools.partial(jax.jit, inline=True)
def mean_absolute_deviation(cv: Cvs, setpoint: Cvs) -> Statistic:
    """mean_k |y[k] - r[k]| [CV unit]."""
    return jnp.abs(jnp.asarray(cv) - jnp.asarray(setpoint)).mean(axis=0)


@functools.partial(jax.jit, inline=True)
def integral_absolute_error(cv: Cvs, setpoint: Cvs, dt: float) -> Statistic:
    """IAE = dt sum_k |y[k] - r[k]| [CV unit s]."""
    return dt * jnp.abs(jnp.asarray(cv) - jnp.asarray(setpoint)).sum(axis=0)


@functools.partial(jax.jit, inline=True)
def time_outside_deadzone(cv: Cvs, setpoint: Cvs, deadzone: PerCv, dt: float) -> Statistic:
    """Time with |y[k] - r[k]| > c [s], c the half width of the deadzone: dt times the number of samples."""
    outside = jnp.abs(jnp.asarray(cv) - jnp.asarray(setpoint)) > jnp.asarray(deadzone)
    return dt * outside.sum(axis=0)


@functools.partial(jax.jit, inline=True)
def limit_excess(
    value: Values, low: Limits, high: Limits, tolerance: Limits | float = 0.0
) -> Float[Array, "sample channel"]:
    """How far a value is outside its limits, max(low - v, v - high, 0), same unit; 0 up to `tolerance` (rounding)."""
    value = jnp.asarray(value)
    excess = jnp.maximum(jnp.maximum(jnp.asarray(low) - value, value - jnp.asarray(high)), 0.0)
    return jnp.where(excess <= jnp.asarray(tolerance), 0.0, excess)


@functools.partial(jax.jit, inline=True)
def limit_violations(
    value: Values, low: Limits, high: Limits, tolerance: Limits | float = 0.0
) -> Int[Array, " channel"]:
    """Number of samples with a `limit_excess`."""
    return (limit_excess(value, low, high, tolerance) > 0).sum(axis=0)


@functools.partial(jax.jit, inline=True)
def largest_excess(
    value: Values, low: Limits, high: Limits, tolerance: Limits | float = 0.0
) -> Float[Array, " channel"]:
    """Largest `limit_excess` over the run."""
    return limit_excess(value, low, high, tolerance).max(axis=0)


@functools.partial(jax.jit, inline=True)
def integral(rate: Samples, dt: float, per: float = 1.0) -> Number:
    """Integral of a rate that is held from sample to sample, dt / per sum_k q[k]: with per = 3600 s, m3/h gives m3."""
    return dt / per * jnp.asarray(rate).sum()


@functools.partial(jax.jit, inline=True)
def closed_loop_cost(
    cv: Cvs,
    setpoint: Cvs,
    move: Float[ArrayLike, "sample mv"],
    *,
    cv_weight: PerCv,
    soft_quadratic: PerCv,
    soft_linear: PerCv,
    deadzone: PerCv,
    move_weight: Float[ArrayLike, " mv"],
) -> Number:
    """Tracking and move cost of (6.6) on what happened instead of a prediction, per sample.

    mean_k [sum_i (Q e^2 + S h^2 + s h) + sum_j P m^2] with e = |y[k] - r[k]| and h = max(e - c, 0); weights as in
    `jaxmpc.problem.tuning.Tuning`. The price of CV limits is left out: it is one per horizon, not per sample.
    """
    deviation = jnp.abs(jnp.asarray(cv) - jnp.asarray(setpoint))
    beyond = jnp.maximum(deviation - jnp.asarray(deadzone), 0.0)
    tracking = jnp.asarray(cv_weight) * deviation**2
    soft = (jnp.asarray(soft_quadratic) * beyond + jnp.asarray(soft_linear)) * beyond
    moves = jnp.asarray(move_weight) * jnp.asarray(move) ** 2
    return ((tracking + soft).sum(axis=1) + moves.sum(axis=1)).mean()


@functools.partial(jax.jit, static_argnames="samples", inline=True)
def windowed_mean(move: Samples, samples: int) -> Float[Array, " sample"]:
    """Mean of the last n = `samples` moves up to and including k (6.6); moves before the run are zero."""
    total = jnp.cumsum(jnp.asarray(move))
    earlier = jnp.concatenate([jnp.zeros(samples, total.dtype), total])[: total.shape[0]]
    return (total - earlier) / samples


@functools.partial(jax.jit, static_argnames="samples", inline=True)
def mean_move_stops(move: Samples, samples: int, limit: float, threshold: float = 0.0) -> Count:
    """Steps of the staircase: how often a rise pauses because the windowed mean is above its limit.

    Counts moves up m[k] > threshold whose move up before it, at j < k - 1, brought the windowed mean above `limit`, with no
    move down in between: the rise went on after a pause.
    """
    move = jnp.asarray(move)
    rising = move > threshold
    before, fallen = _before(rising), _before(move < -threshold)
    paused = rising & (before >= 0) & (jnp.arange(move.shape[0]) - before > 1) & (fallen < before)
    return (paused & (windowed_mean(move, samples)[before] > limit)).sum()


@functools.partial(jax.jit, static_argnames="samples", inline=True)
def rises_above_limit(move: Samples, samples: int, limit: float) -> Count:
    """Moves up made although the mean of the `samples` moves before them was above `limit` (6.6).

    Both comparisons allow 1e-6 for rounding, in the unit of the move.
    """
    move = jnp.asarray(move)
    before = jnp.concatenate([jnp.zeros(1, move.dtype), windowed_mean(move, samples)[:-1]])
    return ((before > limit + 1e-6) & (move > 1e-6)).sum()


@functools.partial(jax.jit, inline=True)
def solve_time_statistics(solve_time: Samples) -> Float[Array, " statistic"]:
    """Median, 99th percentile (linear interpolation) and largest solve time [s]; NaN if one is NaN."""
    value = jnp.asarray(solve_time, dtype=jnp.float64)
    # The bits of floats that are not negative are ordered like the floats, and on a CPU they sort four times as
    # fast; sorting is what most of the time of all key figures went to.
    bits = jax.lax.bitcast_convert_type(jnp.maximum(value, 0.0), jnp.int64)
    rising = jax.lax.bitcast_convert_type(jax.lax.sort(bits, is_stable=False), jnp.float64)
    place = jnp.array([0.5, 0.99, 1.0]) * (value.shape[0] - 1)
    below = jnp.floor(place).astype(int)
    above = jnp.minimum(below + 1, value.shape[0] - 1)
    share = place - below
    found = rising[below] * (1 - share) + rising[above] * share
    return jnp.where(jnp.isnan(value).any(), jnp.nan, found)


@functools.partial(jax.jit, inline=True)
def largest_gap(gap: Samples) -> Number:
    """Largest relative gap between objective and bound; infinite if a sample has none (NaN)."""
    gap = jnp.asarray(gap)
    return jnp.where(jnp.isnan(gap), jnp.inf, gap).max()
