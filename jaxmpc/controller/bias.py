"""Output bias (2.31b) and its low-pass filter (6.4): the feedback of a step-response controller."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


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
