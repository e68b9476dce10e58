"""Weighted sums of products of rows, against the dense product."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.problem.gram import at_once, gram, one_by_one, running_sums

CVS, SAMPLES, MOVES = 3, 40, 7


@pytest.fixture
def response():
    return jnp.asarray(np.random.default_rng(1).normal(size=(CVS * SAMPLES, MOVES)))


def weights(kind: str):
    """Level and sharp weights per row."""
    rng = np.random.default_rng(2)
    level, sharp = np.zeros((CVS, SAMPLES)), np.zeros(CVS * SAMPLES)
    if kind in ("level", "both"):
        level[0, 5:], level[1, :12], level[2] = 3.0, 0.5, 1e-3
    if kind in ("sharp", "both"):
        sharp[[0, 17, CVS * SAMPLES - 1]] = 1e4
    if kind == "every row":
        level, sharp = rng.uniform(size=level.shape), rng.uniform(size=sharp.shape)
    return jnp.asarray(level.reshape(-1)), jnp.asarray(sharp)


@pytest.mark.parametrize("kind", ["none", "level", "sharp", "both", "every row"])
@pytest.mark.parametrize("summed", [True, False])
def test_the_sum_is_that_of_the_dense_product(kind, summed, response):
    level, sharp = weights(kind)
    sums = running_sums(response, CVS) if summed else None
    found = jax.jit(lambda *w: gram(response, sums, CVS, *w))(level, sharp)
    expected = np.asarray(response).T @ (np.asarray(level + sharp)[:, None] * np.asarray(response))
    # sums of some hundred terms of the order of the largest weight
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13 * max(np.abs(expected).max(), 1.0))


def test_both_ways_agree_for_a_batch(response):
    """What an accelerator does is what a CPU does."""
    sums = running_sums(response, CVS)
    _, sharp = weights("both")
    changes = jnp.stack([jnp.zeros(len(sharp)).at[k].set(k - 2.0) for k in range(5)])
    for way in (at_once, one_by_one):
        found = jax.vmap(lambda c, way=way: way(response, sums, c, sharp))(changes)
        for k in range(5):
            rows = np.asarray(response)[: k + 1] if k < SAMPLES else None
            expected = (k - 2.0) * rows.T @ rows + np.asarray(response).T @ (
                np.asarray(sharp)[:, None] * response
            )
            np.testing.assert_allclose(found[k], expected, rtol=1e-12, atol=1e-9)
