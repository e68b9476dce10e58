"""Weighted sums of the dynamic matrix with itself, theta' diag(w) theta, which cost more than the rest of a Newton step.

A step of `newton` weighs the predictions with few different numbers: none inside a deadzone, the curvature of its penalty
outside, and a large one for the rows at its edge. Along the horizon the first two change at a handful of samples, so that
summation by parts with the sums over the first j samples, which follow from the model alone, leaves a handful of terms:

    sum_j w_j P_j = sum_j (w_j - w_j+1) (P_1 + ... + P_j),   P_j = theta_j' theta_j,   w_N+1 = 0.

The rows at an edge are few and added on their own, so that their large weights cancel nothing. A CPU adds the terms that
there are one by one; elsewhere two dense products take less time than one decision.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def running_sums(response: Float[Array, "prediction n"], cvs: int) -> Float[Array, "prediction pair"]:
    """Sums of the products of columns i <= j over the rows of each CV, one CV after the other, up to this one."""
    first, second = np.triu_indices(response.shape[-1])
    # a compiler that knows the response would spend seconds on evaluating these sums itself
    response = jax.lax.optimization_barrier(response)
    products = response[:, first] * response[:, second]
    sums = jnp.cumsum(products.reshape(cvs, -1, len(first)), axis=1)
    return sums.reshape(-1, len(first))


def gram(
    response: Float[Array, "prediction n"],
    summed: Float[Array, "prediction pair"] | None,
    cvs: int,
    level: Float[Array, " prediction"],
    sharp: Float[Array, " prediction"],
) -> Float[Array, "n n"]:
    """The sum over all rows of their weight, level + sharp, times their products.

    Args:
        summed: their `running_sums`; None for one dense product.
        level: weights that change at few rows.
        sharp: weights that few rows have. Any number of changes and rows is summed; few are fast.
    """
    if summed is None:
        return _dense(response, level + sharp)
    by_cv = level.reshape(cvs, -1)
    after = jnp.pad(by_cv[:, 1:], ((0, 0), (0, 1)))
    # a compiler that fuses products with the difference would leave rounding where nothing changes
    changes = jnp.where(by_cv != after, by_cv - after, 0.0).reshape(-1)
    way = one_by_one if jax.default_backend() == "cpu" else at_once
    return way(response, summed, changes, sharp)


def _dense(response, weights):
    return response.T @ (weights[:, None] * response)


def at_once(response, summed, changes, sharp):
    """`gram` for accelerators, as two products; `changes` are the differences of the levels."""
    return _square(changes @ summed, response.shape[1]) + _dense(response, sharp)


def one_by_one(response, summed, changes, sharp):
    """`gram` for CPUs, term by term."""
    n = response.shape[1]

    def of_row(row, weight):
        return (weight * response[row])[:, None] * response[row][None, :]

    upper = _added(changes, lambda row, weight: weight * summed[row], jnp.zeros(summed.shape[1]))
    return _square(upper, n) + _added(sharp, of_row, jnp.zeros((n, n)))


def _added(weights, term, nothing):
    """The sum of the terms whose weight is not zero."""

    def add(carry):
        left, sum_ = carry
        row = jnp.argmax(left != 0.0)
        return left.at[row].set(0.0), sum_ + term(row, left[row])

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0] != 0.0), add, (weights, nothing))[1]


def _square(upper, n: int):
    """The symmetric matrix with these entries i <= j."""
    first, second = np.triu_indices(n)
    place = np.zeros((n, n), dtype=np.int32)
    place[first, second] = place[second, first] = np.arange(len(first))
    return jnp.take(upper, place.reshape(-1)).reshape(n, n)
