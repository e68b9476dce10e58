import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.errors import InputError
from jaxmpc.model.step_response import (
    StepResponseModel,
    advance_free_response,
    future_response,
    make_model,
    shift_free_response,
)


def random_model(rng, cv=2, mv=2, samples=30):
    coefficients = np.cumsum(rng.normal(size=(cv, mv, samples)) * 0.8 ** np.arange(samples), axis=-1)
    return make_model(coefficients, 10.0, [f"y{i}" for i in range(cv)], [f"u{i}" for i in range(mv)])


@pytest.mark.parametrize("samples", [12, 30, 45])
def test_the_shift_register_gives_the_free_response_of_the_psi_and_upsilon_matrices(samples):
    """(5.4c): Psi du~ + Upsilon u~(k-N), with past moves older than N having reached S(N)."""
    rng = np.random.default_rng(0)
    model, horizon = random_model(rng, samples=samples), 30
    past = rng.normal(size=(80, 2))  # oldest first; all inputs were zero before
    length = max(horizon, samples)
    register, s = jnp.zeros((2, length)), model.extended(length)
    for move in past:
        register = shift_free_response(advance_free_response(register, s, jnp.asarray(move)))
    coefficients = np.asarray(model.coefficients)
    at = lambda i: coefficients[..., min(i, samples) - 1]  # noqa: E731
    n = samples
    expected = np.zeros((2, horizon))
    for j in range(1, horizon + 1):
        # the last past move was made one sample before "now", so its age at now + j is j + 1; the register starts at now + 1
        for age, move in enumerate(past[::-1], start=1):
            expected[:, j - 1] += at(age + j) @ move if age + j < n else at(n) @ move
    # after the shift the first column is two samples after the last move
    np.testing.assert_allclose(
        np.asarray(register)[:, : horizon - 1], expected[:, : horizon - 1], rtol=0, atol=1e-12
    )


def test_a_model_survives_its_file(tmp_path):
    model = make_model(
        [[[1.0, 2.0]]],
        5.0,
        ["y"],
        ["u"],
        cv_units=["m3/h"],
        mv_units=["%"],
        working_point={"u": 50.0},
        provenance={"who": "me"},
    )
    again = StepResponseModel.load(model.save(tmp_path / "m.json"))
    assert np.array_equal(again.coefficients, model.coefficients)
    assert (again.dt, again.cv_units, again.working_point, again.provenance) == (
        5.0,
        ("m3/h",),
        (("u", 50.0),),
        (("who", "me"),),
    )


def test_measured_disturbances_survive_the_file_and_are_shown(tmp_path):
    dvs = dict(dv_names=["rate"], dv_units=["m3/h"], dv_coefficients=[[[3.0, 4.0]]])
    model = make_model([[[1.0, 2.0]]], 5.0, ["y"], ["u"], **dvs)
    again = StepResponseModel.load(model.save(tmp_path / "m.json"))
    assert (again.dv_names, again.dv_units) == (("rate",), ("m3/h",))
    np.testing.assert_array_equal(again.dv_coefficients, [[[3.0, 4.0]]])
    np.testing.assert_array_equal(again.extended_dvs(3), [[[3.0, 4.0, 4.0]]])
    assert "rate [m3/h], measured disturbance" in again._repr_html_()
    plain = make_model([[[1.0, 2.0]]], 5.0, ["y"], ["u"])
    assert plain.dv_coefficients.shape == (1, 0, 2)
    assert not [key for key in plain.to_dict() if key.startswith("dv")]


@pytest.mark.parametrize("horizon", [1, 5])
def test_changes_to_come_act_from_the_sample_after_them(horizon):
    rng = np.random.default_rng(1)
    steps, change = rng.normal(size=(2, 3, horizon)), rng.normal(size=(horizon, 3))
    expected = np.zeros((2, horizon))
    for j in range(horizon):
        for later in range(j + 1, horizon + 1):
            expected[:, later - 1] += steps[..., later - j - 1] @ change[j]
    np.testing.assert_allclose(future_response(jnp.asarray(steps), jnp.asarray(change)), expected, atol=1e-12)


def test_coefficients_keep_their_last_value_beyond_n():
    model = make_model([[[1.0, 2.0, 4.0]]], 5.0, ["y"], ["u"])
    assert np.array_equal(model.extended(5)[0, 0], [1, 2, 4, 4, 4])
    assert np.array_equal(model.extended(2)[0, 0], [1, 2])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"dt": 0}, "model.dt"),
        ({"dt": True}, "model.dt"),
        ({"cv": ["y", "y"]}, "model.cv"),
        ({"coefficients": [[[1.0], [2.0]]]}, "model.coefficients"),
        ({"coefficients": [[[1.0, float("nan")]]]}, "model.coefficients[0, 0, 1]"),
        ({"coefficients": [[[]]]}, "model.coefficients"),
        ({"cv_units": ["a", "b"]}, "model.cv_units"),
        ({"dv": ["d", "d"]}, "model.dv"),
        ({"dv": ["u"], "dv_coefficients": [[[1.0, 2.0]]]}, "model.dv"),
        ({"dv": ["d"]}, "model.dv_coefficients"),
        ({"dv_coefficients": [[[1.0, 2.0]]]}, "model.dv_coefficients"),
        ({"dv": ["d"], "dv_coefficients": [[[1.0, 2.0, 3.0]]]}, "model.dv_coefficients"),
        ({"dv": ["d"], "dv_coefficients": [[[1.0, None]]]}, "model.dv_coefficients[0, 0, 1]"),
        ({"dv": ["d"], "dv_coefficients": [[[1.0, 2.0]]], "dv_units": ["a", "b"]}, "model.dv_units"),
    ],
)
def test_a_bad_model_file_names_the_field(tmp_path, change, field):
    body = {"dt": 10.0, "cv": ["y"], "mv": ["u"], "coefficients": [[[1.0, 2.0]]]} | change
    (tmp_path / "m.json").write_text(json.dumps(body))
    with pytest.raises(InputError) as error:
        StepResponseModel.load(tmp_path / "m.json")
    assert error.value.field == field
