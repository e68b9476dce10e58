"""The certificate's gap: by hand, on the host and traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.relaxed.gap import FINEST, SMALLEST, closes, relative_gap

CASES = [  # value, bound, scale, gap, closed
    (100.0, 99.99995, 1.0, 1e-6, True),
    (100.0, 99.9998, 1.0, 1e-6, False),
    (0.0, 0.0, 1.0, 1e-6, True),
    (1e-13, 0.0, 1.0, 1e-6, True),  # relative to a share of the scale
    (1e-11, 0.0, 1.0, 1e-6, False),
    (1e-11, 0.0, 1e2, 1e-6, True),
    (1.0, 1.0 - 0.5 * FINEST, 1.0, 0.0, True),  # round-off is no gap
    (1.0, 1.0 - 2.0 * FINEST, 1.0, 0.0, False),
    (np.inf, 1.0, 1.0, 1e-6, False),  # no plan
    (1.0, -np.inf, 1.0, 1e-6, False),
    (1.0, np.nan, 1.0, 1e-6, False),
]


@pytest.mark.parametrize(("value", "bound", "scale", "gap", "closed"), CASES)
def test_a_plan_is_optimal_by_its_bound(value, bound, scale, gap, closed):
    assert bool(closes(value, bound, scale, gap)) is closed


def test_many_at_once_on_the_host_and_traced():
    value, bound, scale, gap, closed = (np.array(column) for column in zip(*CASES, strict=True))
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(closes(value, bound, scale, gap), closed)
    np.testing.assert_array_equal(jax.jit(closes)(*map(jnp.asarray, (value, bound, scale, gap))), closed)


def test_the_gap_is_relative_to_the_objective_or_a_share_of_the_scale():
    assert relative_gap(100.0, 99.0, 1.0) == pytest.approx(0.01)
    assert relative_gap(0.0, -1e-7, 10.0) == pytest.approx(1e-7 / (10.0 * SMALLEST))
    assert relative_gap(1.0, 2.0, 1.0) == 0.0
    assert np.isnan(relative_gap(np.nan, np.nan, 1.0))
