"""Lanes: what is shared stays shared, and every lane is what it would be alone."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.sample import Sample
from jaxmpc.errors import InputError
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.programs.lanes import Lanes, for_all, lanes_of, per_lane


@pytest.fixture(scope="module")
def structure(small_structure):
    return small_structure.relaxed()


@pytest.fixture(scope="module")
def tunings(structure, thesis_fields):
    weights = ([250.0, 0.2], [60.0, 0.1], [1000.0, 0.4])
    # move limits differ, too: the scale of the moves must not reach the shared matrices
    return [
        make_tuning(
            structure, **(thesis_fields | {"move_weight": w, "move_high": [k + 1.0, 100.0 * (k + 1)]})
        )
        for k, w in enumerate(weights)
    ]


@pytest.fixture(scope="module")
def models(well_like_model):
    return [
        eqx.tree_at(lambda m: m.coefficients, well_like_model, share * well_like_model.coefficients)
        for share in (1.0, 0.8, 1.3)
    ]


def assert_same(one, other):
    """Equal leaf by leaf up to the order of a sum."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def alone(structure, tuning, model, *, summed):
    """What compiled programs know of a controller by itself."""
    core = Controller(structure, tuning, model).core
    return core if summed else eqx.tree_at(lambda c: c.qp.summed, core, None)


def test_tunings_share_the_matrices_of_the_model(structure, tunings, well_like_model):
    lanes = Controllers(structure, tunings, well_like_model)
    cores = lanes.cores
    assert lanes.count == cores.count == 3
    assert cores.each.coefficients is None
    assert cores.each.qp.summed is None
    assert cores.shared.qp.summed is not None
    theirs = {leaf.shape[0] for leaf in jax.tree.leaves(cores.each)}
    assert theirs == {3}
    rows = structure.cv_count * structure.horizon_count
    # nothing with rows times moves numbers has a lane axis
    assert max(leaf[0].size for leaf in jax.tree.leaves(cores.each)) < rows * 12
    for k, tuning in enumerate(tunings):
        assert_same(cores.lane(k), alone(structure, tuning, well_like_model, summed=True))


def test_models_may_have_lanes(structure, tunings, models):
    cores = Controllers(structure, tunings, models).cores
    assert cores.shared.coefficients is None
    assert cores.value.qp.summed is None
    for k in range(3):
        assert_same(cores.lane(k), alone(structure, tunings[k], models[k], summed=False))
    one_tuning = Controllers(structure, tunings[1], models).cores
    assert one_tuning.each.tuning.cv_weight is None
    assert_same(one_tuning.lane(2), alone(structure, tunings[1], models[2], summed=False))


def test_a_function_of_lanes_is_mapped_over_what_they_do_not_share(structure, tunings, well_like_model):
    cores = Controllers(structure, tunings, well_like_model).cores
    cv, mv, setpoint = np.array([11000.0, 185.0]), np.array([50.0, 7500.0]), np.array([12000.0, 180.0])
    rows = np.tile(setpoint, (cores.shared.size.future, 1))
    sample = Sample(cv, rows, np.full(2, np.nan), np.zeros(2, dtype=bool))
    one = lambda core: core.conclude(core.consider(core.init(cv, mv), sample, 1e-6))[1].moves  # noqa: E731
    together = jax.jit(lambda cores: cores.vmap(one))(cores)
    for k, tuning in enumerate(tunings):
        controller = Controller(structure, tuning, well_like_model)
        own = controller.step(controller.init(cv, mv), cv, setpoint)[1].moves
        np.testing.assert_allclose(together[k, : len(own)], own, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(together[k, len(own) :], 0.0)  # padding


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda t, m: ([], m[0]), "tunings"),
        (lambda t, m: (t[:2], m), "tunings"),
        (lambda t, m: (t, []), "models"),
        (lambda t, m: (t, [m[0], dataclasses.replace(m[1], dt=5.0), m[2]]), "model[1].dt"),
    ],
)
def test_lanes_that_do_not_fit_are_refused(structure, tunings, models, change, field):
    with pytest.raises(InputError) as error:
        Controllers(structure, *change(tunings, models))
    assert error.value.field == field


def test_several_trees_are_lanes_and_a_single_one_is_shared():
    trees = [{"own": k * jnp.arange(3.0), "nested": (np.asarray(k), None)} for k in (1.0, 2.0)]
    lanes = lanes_of(trees)
    assert lanes.count == 2
    np.testing.assert_array_equal(lanes.value["own"], [[0, 1, 2], [0, 2, 4]])
    assert lanes.lane(1)["nested"] == (2.0, None)
    alone = lanes_of(trees[:1])
    assert alone.count is None
    assert alone.shared is trees[0]


def test_lanes_of_different_counts_are_refused():
    with pytest.raises(InputError, match="one length"):
        _ = per_lane((jnp.zeros(2), jnp.zeros(3))).count
    assert for_all((jnp.zeros(2), 1.0)).count is None


def test_lanes_may_be_taken_more_than_once():
    x = per_lane(jnp.arange(1.0, 4.0))
    taken = x.take(np.array([1] * 3))
    assert isinstance(taken, Lanes)
    np.testing.assert_array_equal(taken.value, 2.0)
