"""What a controller remembers from sample to sample, with the output bias (2.31b), and what it says of one."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.controller.measurement import Sensors
from jaxmpc.relaxed.newton import WarmStart


class ControllerState(eqx.Module):
    """What a controller remembers from sample to sample."""

    base: Float[Array, " cv"]  # CVs the run started from; predictions are deviations from them [CV unit]
    future: Float[Array, "cv future"]  # effect of the moves made so far on the samples from now on [CV unit]
    bias: Float[Array, " cv"]  # filtered output bias v(k|k)
    bias_raw: Float[Array, " cv"]  # output bias before the filter (2.31b)
    mv: Float[Array, " mv"]  # present demand [MV unit]
    position: Float[Array, " mv"]  # where the actuators stand in the predictions [MV unit]
    last_move: Float[Array, " mv"]  # previous move, of the actuators where these are told [MV unit]
    past_moves: Float[Array, "past mv"]  # the last moves, oldest first [MV unit]
    plan: Float[Array, "block mv"]  # the previous plan shifted by one sample, block moves [MV unit]
    warm: WarmStart  # moves and prices of the previous relaxation, shifted; where the next solve starts
    sensors: Sensors  # what the measurements were worth
    manual: Bool[Array, " mv"]  # MVs that somebody else moved at the last sample
    dv: Float[Array, " dv"] | None = None  # last known measured disturbances; None without any [DV unit]


class StepInfo(eqx.Module):
    """What one controller step did.

    Attributes:
        move: applied move [MV unit].
        mv: demand after it [MV unit].
        moves: planned block moves [MV unit].
        status: code of `jaxmpc.status`.
        fallback: the MVs were held because there was no plan.
        recovering: an MV was outside its limits or between its allowed values and is being brought back.
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


def filter_bias(
    filtered: Float[Array, " cv"],
    raw_before: Float[Array, " cv"],
    raw: Float[Array, " cv"],
    cutoff: Float[Array, ""],
    dt: Float[Array, ""] | float,
) -> Float[Array, " cv"]:
    """One sample of the low-pass filter (6.4), the bilinear (Tustin) form of wc / (s + wc).

    Args:
        filtered: y(k-1) [CV unit].
        raw_before: x(k-1), the raw bias one sample ago.
        raw: x(k) = measured minus predicted CV (2.31b).
        cutoff: wc [rad/s]; infinite means no filter.
        dt: sampling interval [s].

    Returns:
        y(k). The filter passes a constant bias unchanged.
    """
    product = jnp.where(jnp.isfinite(cutoff), dt * cutoff, 1.0)
    keep, gain = (2.0 - product) / (2.0 + product), product / (2.0 + product)
    return jnp.where(jnp.isfinite(cutoff), keep * filtered + gain * (raw + raw_before), raw)
