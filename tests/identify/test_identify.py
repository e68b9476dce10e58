"""Identification, sweep and fit: against published responses, and JAX well against FMU."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from identify.fit import StepData, fit_well, load_step_data, main
from identify.step_test import identify_step_response, settling, settling_notes
from identify.sweep import steady_sweep
from identify.well_fmu import WellFmuPlant
from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.well.equations import WellParameters, load_parameters, parameters_to_dict
from jaxmpc.process.well.plant import STATE_SCALE, WellPlant, rates, steady_state

DATA = Path(__file__).parents[2].parent / "shared" / "data" / "single_well_step_response.json"


@pytest.fixture(scope="module")
def model():
    return identify_step_response()


@pytest.fixture(scope="module")
def sweep():
    return steady_sweep()


@pytest.fixture(scope="module")
def fmu():
    try:
        plant = WellFmuPlant()
    except MissingToolError as error:
        pytest.skip(str(error))
    with plant:
        yield plant


@pytest.fixture(scope="module")
def published():
    if not DATA.exists():
        pytest.skip("the published step responses are not beside the repository")
    return load_step_data(DATA)


def r_squared(response, target):
    variance = ((target - target.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1)
    return 1 - ((response - target) ** 2).sum(axis=-1) / variance


def test_responses_match_the_published_ones(model, published):
    response = np.asarray(model.coefficients)[..., : published.coefficients.shape[-1]]
    assert r_squared(response, published.coefficients).min() >= 0.985
    error = np.abs(response - published.coefficients).max(axis=-1)
    assert (error / np.abs(published.coefficients).max(axis=-1)).max() < 0.06


def test_first_coefficient_is_the_change_one_sample_after_the_step(model):
    plant = WellPlant()
    _, outputs = plant.step(plant.init(), np.array([52.0, 7500.0]))
    change = (outputs.cv - plant.measure(plant.init()).cv) / 2.0
    np.testing.assert_allclose(model.coefficients[:, 0, 0], change, rtol=1e-6)


def test_fmu_and_jax_well_give_the_same_model(model, fmu):
    other = identify_step_response(fmu)
    peak = np.abs(model.coefficients).max(axis=-1, keepdims=True)
    assert (np.abs(other.coefficients - model.coefficients) / peak).max() < 1e-9
    assert dict(other.provenance)["plant"] == "fmu"
    assert dict(other.provenance)["plant_hash"] != dict(model.provenance)["plant_hash"]


def test_model_carries_units_working_point_plant_and_date(model, tmp_path):
    read = StepResponseModel.load(model.save(tmp_path / "model.json"))
    np.testing.assert_array_equal(read.coefficients, model.coefficients)
    assert read.provenance == model.provenance
    assert (read.cv_units, read.mv_units) == (("m3/h", "m3/h"), ("%", "m3/h"))
    point, facts = dict(read.working_point), dict(read.provenance)
    assert (point["choke"], point["gas_lift"]) == (50.0, 7500.0)
    assert point["oil_rate"] == pytest.approx(185.0, abs=0.01)
    assert {"plant", "plant_hash", "created", "steps", "settled", "notes"} <= set(facts)


def test_settled_and_unsettled_responses_are_told_apart(model):
    assert settling_notes(model) == []
    short = identify_step_response(samples=30)
    facts = dict(short.provenance)
    assert facts["settled"] is False
    assert "oil_rate after a step of gas_lift had not settled by sample 30" in " ".join(facts["notes"])
    gas = {(row.cv, row.mv): row for row in settling(model)}["gas_rate", "choke"]
    assert gas.peak > 2 * gas.gain > 0


def test_model_does_not_depend_on_the_step_size_of_a_linear_plant():
    small = identify_step_response(steps=(0.01, 1.0), samples=60)
    smaller = identify_step_response(steps=(0.005, 0.5), samples=60)
    scale = np.abs(small.coefficients).max(axis=-1, keepdims=True)
    assert (np.abs(small.coefficients - smaller.coefficients) / scale).max() < 1e-3


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"choke": 99.0}, "choke"),
        ({"lift": -1.0}, "gas_lift"),
        ({"samples": 0}, "samples"),
        ({"steps": (0.0, 100.0)}, "steps"),
        ({"steps": (2.0, float("nan"))}, "steps"),
        ({"steps": 2.0}, "steps"),
        ({"plant": WellPlant(actuator="step"), "steps": (1.0, 100.0), "samples": 5}, "steps[0]"),
    ],
)
def test_bad_step_tests_are_refused_by_name(arguments, field):
    with pytest.raises(InputError) as caught:
        identify_step_response(**arguments)
    assert caught.value.field == field


def test_step_choke_gives_the_same_model_for_a_whole_step(model):
    stepped = identify_step_response(WellPlant(actuator="step"))
    np.testing.assert_allclose(stepped.coefficients, model.coefficients, rtol=1e-9, atol=1e-12)


def test_gains_fall_as_the_choke_opens_at_every_lift(sweep):
    assert sweep.converged.all()
    assert sweep.coefficient.shape == (2, 3, 49)
    assert (np.diff(sweep.coefficient, axis=-1)[..., 1:] < 0).all()
    for lift in range(3):
        oil = dict(zip(sweep.choke, sweep.coefficient[1, lift], strict=False))
        assert 4 <= oil[10.0] / oil[50.0] <= 9
        assert oil[98.0] <= 0.35 * oil[50.0]


def test_sweep_on_the_fmu_agrees(fmu):
    chokes, lifts = [4.0, 20.0, 50.0, 52.0, 98.0], [5000.0, 10000.0]
    jax_well, other = steady_sweep(None, chokes, lifts), steady_sweep(fmu, chokes, lifts)
    np.testing.assert_allclose(other.cv, jax_well.cv, rtol=1e-9)
    np.testing.assert_allclose(other.coefficient, jax_well.coefficient, rtol=1e-6)
    assert other.converged.all()


def test_sweep_at_the_working_point_equals_the_identified_gain(model, sweep):
    at = list(sweep.choke).index(50.0)
    np.testing.assert_allclose(sweep.coefficient[:, 1, at], model.coefficients[:, 0, -1], rtol=2e-3)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"chokes": [10.0, 5.0]}, "chokes"),
        ({"chokes": [50.0]}, "chokes"),
        ({"chokes": [50.0, 110.0]}, "choke"),
        ({"lifts": [-1.0]}, "gas_lift"),
    ],
)
def test_bad_sweeps_are_refused_by_name(arguments, field):
    with pytest.raises(InputError) as caught:
        steady_sweep(**arguments)
    assert caught.value.field == field


def test_no_steady_state_of_the_shipped_well_grows_an_oscillation():
    lift, choke = np.meshgrid(
        [200, 500, 1000, 2000, 5000, 1e4], [2, 5, 10, 20, 30, 50, 70, 100.0], indexing="ij"
    )
    scale, well = jnp.asarray(STATE_SCALE), WellParameters()

    def linearised(choke, lift):
        found, u = steady_state(choke, lift, 0.0, well), jnp.stack([choke, lift, 0.0])
        return jax.jacfwd(lambda s: rates(s * scale, u, well) / scale)(found.x / scale), found.converged

    matrices, converged = jax.jit(jax.vmap(linearised))(choke.ravel(), lift.ravel())
    assert np.all(converged)
    modes = np.linalg.eigvals(np.asarray(matrices))
    assert (modes.real.max(axis=1) < -5e-4).all()  # the slowest mode
    swinging = np.abs(modes.imag) > 1e-3 * np.abs(modes)
    damping = np.where(swinging, -modes.real / np.abs(modes), 1.0).min(axis=1)
    assert damping.min() > 0.35
    assert damping[lift.ravel() >= 2000].min() > 0.5


def write(path, body):
    path.write_text(json.dumps(body))
    return path


def table(**changes):
    ramp = (1 - np.exp(-np.arange(20) / 5)).tolist()
    body = {
        "coefficients": [[ramp, ramp]] * 2,
        "sampling_seconds": 10,
        "cv": ["gas", "oil"],
        "mv": ["choke", "gas_lift"],
    }
    return {**body, **changes}


@pytest.mark.parametrize(
    ("body", "field"),
    [
        (table(sampling_seconds=0), "data.dt"),
        (table(coefficients=[[[0, 1]]]), "data.coefficients"),
        (table(coefficients=[[[0, 1], [0, float("nan")]]] * 2), "data.coefficients[0, 1, 1]"),
        (table(coefficients=[[[1, 1], [1, 1]]] * 2), "data.coefficients"),
        (table(coefficients=[[[0, 0], [0, 1]]] * 2), "data.coefficients"),
        (table(mv=["gas_lift", "choke"]), "data.mv"),
        (table(working_point={"choke": 99.5}), "choke"),
        (table(working_point={"gas_rate": -1.0, "oil_rate": 100.0}), "data.working_point"),
        ({"cv": []}, "data.coefficients"),
        ([], "step-response file"),
    ],
)
def test_bad_step_data_are_refused_by_name(tmp_path, body, field, capsys):
    path = write(tmp_path / "data.json", body)
    with pytest.raises(InputError) as caught:
        load_step_data(path)
    assert caught.value.field == field
    assert main([str(path), "--out", str(tmp_path / "well.json")]) == 2
    assert field in capsys.readouterr().err
    assert not (tmp_path / "well.json").exists()


def test_published_table_and_identified_model_are_read_alike(model, tmp_path):
    saved = model.save(tmp_path / "model.json")
    zero = np.concatenate([np.zeros((2, 2, 1)), model.coefficients], axis=-1)
    written = write(tmp_path / "table.json", table(coefficients=zero.tolist()))
    from_model, from_table = load_step_data(saved), load_step_data(written)
    np.testing.assert_array_equal(from_model.coefficients, from_table.coefficients)
    assert from_table.rates is None
    assert from_model.rates == pytest.approx([11012.7, 185.0], rel=1e-4)


@pytest.mark.slow
def test_fit_to_the_published_responses_agrees_with_the_shipped_well(published, tmp_path):
    out = tmp_path / "well.json"
    assert main([str(DATA), "--out", str(out)]) == 0
    fitted, shipped = load_parameters(out), WellParameters()
    report = json.loads(out.read_text())
    assert report["converged"]
    assert np.min(report["r_squared"]) >= 0.985
    for name, value in parameters_to_dict(shipped).items():
        assert parameters_to_dict(fitted)[name] == pytest.approx(value, rel=0.05), name
    chokes = [4.0, 10.0, 30.0, 50.0, 70.0, 98.0]
    ours, theirs = steady_sweep(WellPlant(shipped), chokes), steady_sweep(WellPlant(fitted), chokes)
    np.testing.assert_allclose(theirs.cv, ours.cv, rtol=0.01)


@pytest.mark.slow
def test_fit_recovers_the_responses_of_another_well():
    rng = np.random.default_rng(3)
    names = (
        "tubing_length",
        "productivity",
        "gas_oil_ratio",
        "annulus_volume",
        "friction_factor",
        "lift_time",
    )
    other = {name: getattr(WellParameters(), name) * rng.uniform(0.85, 1.15) for name in names}
    truth = identify_step_response(WellPlant(dataclasses.replace(WellParameters(), **other)), samples=150)
    point = dict(truth.working_point)
    rates = np.array([point["gas_rate"], point["oil_rate"]])
    fit = fit_well(StepData(np.asarray(truth.coefficients), 10.0, 50.0, 7500.0, rates))
    assert fit.converged
    assert fit.cost[-1] < 0.02 * fit.cost[0]
    assert fit.r_squared.min() > 0.99
    again = identify_step_response(WellPlant(fit.parameters), samples=150)
    np.testing.assert_allclose(again.coefficients, fit.response, rtol=1e-5, atol=1e-6)
