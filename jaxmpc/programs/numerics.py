"""Small numerical helpers that several modules share."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def largest(values: Float[Array, "..."]) -> Float[Array, ""]:
    """Largest magnitude, 0 if there is none, and not a number if any value is not.

    On CPUs XLA's own maximum leaves NaN out of large batches, so that a lane without any number looks like a perfect one.
    """
    top = jnp.max(jnp.abs(values), initial=0.0)
    return jnp.where(jnp.any(jnp.isnan(values)), jnp.nan, top)
