"""Lanes: what is shared stays shared, and every lane is what it would be alone."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.controller.batch import (
    Lanes,
    build_lanes,
    controller_batch,
    for_all,
    map_lanes,
    per_lane,
    place,
    variant_mesh,
)
from jaxmpc.controller.continuous import ContinuousController
from jaxmpc.errors import InputError
from jaxmpc.problem.tuning import make_tuning, stack_tunings


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


def test_tunings_share_the_matrices_of_the_model(structure, tunings, well_like_model):
    lanes = controller_batch(structure, tunings, well_like_model)
    assert lanes.count == 3
    assert lanes.each.memory.coefficients is None
    assert lanes.each.qp.summed is None
    assert lanes.shared.qp.summed is not None
    theirs = {leaf.shape[0] for leaf in jax.tree.leaves(lanes.each)}
    assert theirs == {3}
    rows = structure.cv_count * structure.horizon_count
    # nothing with rows times moves numbers has a lane axis
    assert max(leaf[0].size for leaf in jax.tree.leaves(lanes.each)) < rows * 12
    for k, tuning in enumerate(tunings):
        assert_same(lanes.lane(k), ContinuousController(structure, tuning, well_like_model, summed=True))


def test_stacked_tunings_are_a_list_of_tunings(structure, tunings, well_like_model):
    lanes = controller_batch(structure, tunings, well_like_model)
    assert_same(lanes, controller_batch(structure, stack_tunings(tunings), well_like_model))


def test_models_may_have_lanes(structure, tunings, models):
    lanes = controller_batch(structure, tunings, models)
    assert lanes.shared.memory.coefficients is None
    assert lanes.value.qp.summed is None
    for k in range(3):
        assert_same(lanes.lane(k), ContinuousController(structure, tunings[k], models[k], summed=False))
    stacked = eqx.tree_at(lambda m: m.coefficients, models[0], jnp.stack([m.coefficients for m in models]))
    assert_same(lanes, controller_batch(structure, tunings, stacked))
    one_tuning = controller_batch(structure, tunings[1], models)
    assert one_tuning.each.tuning.cv_weight is None
    assert_same(one_tuning.lane(2), ContinuousController(structure, tunings[1], models[2], summed=False))


def test_value_and_axes_are_what_vmap_takes(structure, tunings, well_like_model):
    lanes = controller_batch(structure, tunings, well_like_model)
    cv, mv, setpoint = (
        jnp.asarray([11000.0, 185.0]),
        jnp.asarray([50.0, 7500.0]),
        jnp.asarray([12000.0, 180.0]),
    )
    one = lambda controller: controller.step(controller.init(cv, mv), cv, setpoint)[1].moves  # noqa: E731
    together = eqx.filter_jit(eqx.filter_vmap(one, in_axes=(lanes.axes,)))(lanes.value)
    for k in range(3):
        np.testing.assert_allclose(together[k], eqx.filter_jit(one)(lanes.lane(k)), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda t, m: ([], m[0]), "tunings"),
        (lambda t, m: (t[0], m[0]), "tunings"),
        (lambda t, m: (t[:2], m), "tunings"),
        (lambda t, m: (t, []), "model"),
        (lambda t, m: (t, [m[0], dataclasses.replace(m[1], dt=5.0), m[2]]), "model[1]"),
    ],
)
def test_lanes_that_do_not_fit_are_refused(structure, tunings, models, change, field):
    with pytest.raises(InputError) as error:
        controller_batch(structure, *change(tunings, models))
    assert error.value.field == field


def test_only_what_depends_on_the_argument_gets_lanes():
    constant = jnp.arange(3.0)

    def build(given):
        return {"own": given * constant, "common": constant**2, "name": "static", "nested": (given, 2.0)}

    lanes = build_lanes(build, jnp.asarray([1.0, 2.0]), 2)
    assert lanes.each["common"] is None
    assert lanes.shared["name"] == "static"
    np.testing.assert_array_equal(lanes.value["own"], [[0, 1, 2], [0, 2, 4]])
    np.testing.assert_array_equal(lanes.shared["common"], [0, 1, 4])
    assert lanes.lane(1)["nested"] == (2.0, 2.0)


def test_lanes_of_different_counts_are_refused():
    with pytest.raises(InputError, match="one length"):
        _ = per_lane((jnp.zeros(2), jnp.zeros(3))).count
    assert for_all((jnp.zeros(2), 1.0)).count is None


def test_a_function_over_lanes_is_the_function_of_each():
    mesh = variant_mesh()
    size = 2 * mesh.size
    x, y = per_lane(jnp.arange(1.0, size + 1)), for_all({"scale": jnp.asarray(3.0), "power": 2})
    taken = x.take(np.array([1] * size))
    function = lambda a, b: (b["scale"] * a ** b["power"], a)  # noqa: E731
    got, same = map_lanes(function, [place(x, mesh), place(y, mesh)], mesh)
    np.testing.assert_array_equal(got, 3.0 * np.arange(1.0, size + 1) ** 2)
    np.testing.assert_array_equal(same, x.value)
    assert isinstance(taken, Lanes)
    np.testing.assert_array_equal(taken.value, 2.0)
