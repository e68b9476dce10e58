"""Key figures of what follows a setpoint change: overshoot, settling, and the halves of setpoint windows.

Pure `jax.numpy` on fixed shapes like `studies.kpi.loop`, whose notation it shares; nothing here depends on how many
windows a run has, so runs with different references are lanes of one `jax.vmap`. A *setpoint window* is a
stretch of samples with equal labels (`jaxmpc.process.reference.Reference.window`); setpoints are constant in it.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from studies.kpi.loop import Cvs, Labels, PerCv


class Settling(NamedTuple):
    """How one run settles after its setpoint changes; times are NaN without any."""

    changes: Int[Array, " cv"]  # windows that begin with a change of this CV's setpoint
    mean: Float[Array, " cv"]  # settling time over them [s]
    longest: Float[Array, " cv"]  # of them [s]
    unsettled: Int[Array, " cv"]  # how many of them end outside the tolerance


@functools.partial(jax.jit, inline=True)
def window_bounds(window: Labels) -> tuple[Int[Array, " sample"], Int[Array, " sample"]]:
    """First and last sample of the window that each sample is in."""
    window = jnp.asarray(window)
    index = jnp.arange(window.shape[0])
    differs = window[1:] != window[:-1]
    edge = jnp.ones(1, bool)
    start = jax.lax.cummax(jnp.where(jnp.concatenate([edge, differs]), index, 0))
    last = jnp.where(jnp.concatenate([differs, edge]), index, window.shape[0])
    return start, jax.lax.cummin(last, reverse=True)


@functools.partial(jax.jit, inline=True)
def late_segment(start: Labels, end: Labels) -> Int[Array, " sample"]:
    """First sample of the window in its second half (from sample n // 2 of n), -1 elsewhere.

    The `segment` of `studies.kpi.loop.reversal_events` that leaves hunting: the samples of `studies.kpi.loop.second_halves`.
    """
    start, end = jnp.asarray(start), jnp.asarray(end)
    return jnp.where(jnp.arange(start.shape[0]) - start >= (end - start + 1) // 2, start, -1)


@functools.partial(jax.jit, inline=True)
def setpoint_change(cv: Cvs, setpoint: Cvs, tolerance: PerCv, start: Labels) -> Float[Array, "sample cv"]:
    """How much the setpoint changed when the window of each sample began [CV unit].

    That is r[k] - r[a - 1], with a the first sample of the window. The first window has no setpoint before it:
    it counts as a change r[0] - y[0] from where the CV was, if that is beyond the tolerance, else as none.
    """
    cv, setpoint, start = jnp.asarray(cv), jnp.asarray(setpoint), jnp.asarray(start)
    initial = setpoint - cv[0]
    initial = jnp.where(jnp.abs(initial) <= jnp.asarray(tolerance), 0.0, initial)  # NaN stays NaN
    later = setpoint - setpoint[jnp.maximum(start - 1, 0)]
    return jnp.where((start == 0)[:, None], initial, later)


@functools.partial(jax.jit, inline=True)
def overshoot(cv: Cvs, setpoint: Cvs, change: Cvs) -> Float[Array, " cv"]:
    """Largest excursion beyond a new setpoint, max_k max(sign(d[k]) (y[k] - r[k]), 0) [CV unit].

    Over all windows that begin with a change d of this CV, from `setpoint_change`; NaN without any, or if one of their
    samples is NaN.
    """
    change = jnp.asarray(change)
    beyond = jnp.sign(change) * (jnp.asarray(cv) - jnp.asarray(setpoint))
    largest = jnp.where(change != 0, jnp.maximum(beyond, 0.0), 0.0).max(axis=0)
    return jnp.where((change != 0).any(axis=0), largest, jnp.nan)


@functools.partial(jax.jit, inline=True)
def settling(
    cv: Cvs, setpoint: Cvs, change: Cvs, tolerance: PerCv, bounds: tuple[Labels, Labels], dt: float
) -> Settling:
    """Time from a setpoint change until |y - r| <= tolerance [CV unit] for the rest of the window.

    In a window of samples a..b (`bounds`, from `window_bounds`) this is (l - a + 1) dt with l the last sample outside, 0 if
    none is; a window that ends outside has the window's length, and is counted. NaN is outside. Only windows count that
    begin with a `setpoint_change`.
    """
    start, end = (jnp.asarray(bound)[:, None] for bound in bounds)
    index = jnp.arange(start.shape[0])[:, None]
    inside = jnp.abs(jnp.asarray(cv) - jnp.asarray(setpoint)) <= jnp.asarray(tolerance)
    last_outside = jax.lax.cummax(jnp.where(inside, -1, index).T, axis=1).T  # along contiguous memory
    counted = (index == end) & (jnp.asarray(change) != 0)
    time = jnp.where(counted & (last_outside >= start), (last_outside - start + 1) * dt, 0.0)
    changes = counted.sum(axis=0)
    missing = changes == 0
    return Settling(
        changes=changes,
        mean=jnp.where(missing, jnp.nan, time.sum(axis=0) / jnp.maximum(changes, 1)),
        longest=jnp.where(missing, jnp.nan, time.max(axis=0)),
        unsettled=(counted & ~inside).sum(axis=0),
    )
