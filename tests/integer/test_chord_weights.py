"""Curvature that chords may pay: it leaves the objective convex, and there is no more of it."""

import numpy as np
import pytest

from jaxmpc.integer.tighten import LEAST, chord_weights


def curvatures(rng):
    """Random curvatures of full rank, with one flat direction of all positions, and with flat ones of the last four."""
    factor = rng.normal(size=(8, 8)) * 10 ** rng.uniform(-1, 1, size=(8, 1))
    apart = np.zeros((8, 8))
    apart[:4, :4] = factor[:4, :4] @ factor[:4, :4].T + np.diag(rng.uniform(1.0, 5.0, size=4))
    apart[4:, 4:] = factor[4:, :2] @ factor[4:, :2].T
    full = factor @ factor.T + np.diag(rng.uniform(0.0, 5.0, size=8))
    return {"full": full, "flat": factor[:, :7] @ factor[:, :7].T, "apart": apart}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["full", "flat", "apart"])
def test_chords_pay_all_curvature_that_leaves_the_objective_convex_but_a_tenth(kind, seed):
    curvature = curvatures(np.random.default_rng(seed))[kind]
    weight, top = chord_weights(curvature), np.diag(curvature).max()
    least = lambda weight: np.linalg.eigvalsh(curvature - 2.0 * np.diag(weight))[0]  # noqa: E731
    rounding = 1e-13 * np.trace(curvature)  # of eigenvalues
    assert (weight >= 0.0).all()
    assert least(weight) >= -rounding
    assert weight.any() == (kind != "flat")
    if kind == "apart":  # flat directions of other positions take nothing away
        alone = chord_weights(curvature[:4, :4])
        np.testing.assert_allclose(
            weight[:4], alone, rtol=0.0, atol=1e-4 * top
        )  # as below, of another programme
    if (weight > 0.0).all():
        assert least(1.12 * weight) < -rounding  # nine tenths are taken: 1 / 0.9 = 1.111 times as much is all
    # shares below LEAST are left out, whose sum is what another may be raised by; the rest is what the solver leaves
    noticeable = ((weight == 0.0).sum() * LEAST + 1e-3) * top
    for raised in np.eye(len(weight)) * noticeable:
        assert least(weight / 0.9 + raised) < -rounding
    # the interior-point solver stops at 1e-8 of the sum, which is flat: single weights are less exact
    scaled = chord_weights(1e3 * curvature)
    np.testing.assert_allclose(scaled, 1e3 * weight, rtol=0.0, atol=1e3 * 1e-5 * weight.max())


def test_no_curvature_leaves_nothing_for_chords():
    assert not chord_weights(np.zeros((3, 3))).any()
