"""Identification, sweep and fit: against published responses, and JAX well against FMU."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from identify.schedule import identify_schedule
from identify.step_test import identify_step_response, settling, settling_notes
from identify.sweep import steady_sweep
from identify.well_fit import StepData, fit_well, load_step_data, main
from identify.well_fmu import WellFmuPlant
from jaxmpc.controller.schedule import ModelSchedule
from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.function_plant import FunctionPlant
from jaxmpc.process.host import HostPlant
from jaxmpc.process.model_plant import ModelPlant
from jaxmpc.process.plant import Parameter, Signals
from jaxmpc.process.well.equations import WellParameters, load_parameters, parameters_to_dict
from jaxmpc.process.well.grids import SWEEP
from jaxmpc.process.well.plant import STATE_SCALE, WellPlant, rates, steady_state

DATA = Path(__file__).parents[2].parent / "shared" / "data" / "single_well_step_response.json"


TANKS = Signals(
    ("level", "heat", "flow"),
    ("pump", "steam", "valve"),
    ("m", "C", "m3/h"),
    ("m3/h", "kg/h", "%"),
    ("mm/h",),
)
GAIN = np.array([[0.1, 0.0, -0.2], [-0.3, 0.02, 0.0], [0.5, 0.0, 0.4]])  # CV unit per MV unit
OWN = np.array([10.0, 200.0, 40.0])  # where they start


def aim(u, curved):
    """Where the CVs go: linear in the MVs, and quadratic in the valve around 40 %."""
    return jnp.asarray(GAIN) @ (u - OWN) + curved * (u[2] - 40.0) ** 2


def approach(x, u, d, p):
    """First order, 60 s."""
    return (aim(u, p["curved"]) + d - x) / 60.0


def levels(x, u, d, p):
    """All states."""
    return x


def tanks(curved=0.0):
    """Three CVs, three MVs and a disturbance that adds to all CVs."""
    parameters = [Parameter("curved", "1", curved)]
    given = dict(dt=5.0, mv=OWN, guess=[0.0] * 3, disturbance_names=["rain"], parameters=parameters)
    return FunctionPlant(approach, levels, **given)


@pytest.mark.parametrize("plant", [tanks(), HostPlant(tanks())], ids=["JAX", "stateful"])
def test_a_plant_of_any_size_and_kind_gives_its_gains_and_time_constant(plant):
    point = {"steam": 250.0, "valve": 20.0, "pump": 11.0}
    found = identify_step_response(
        plant,
        point,
        {"pump": 1.0, "steam": -5.0, "valve": 2.0},
        120,
        disturbance_steps={"rain": 4.0},
        signals=TANKS,
    )
    rise = 1.0 - np.exp(-5.0 * np.arange(1, 121) / 60.0)
    np.testing.assert_allclose(
        found.coefficients, GAIN[..., None] * rise, atol=1e-5
    )  # held 15 time constants
    np.testing.assert_allclose(found.dv_coefficients, np.tile(rise, (3, 1, 1)), atol=1e-5)
    assert (found.cv_names, found.mv_units, found.dt) == (TANKS.cv_names, TANKS.mv_units, 5.0)
    assert (found.dv_names, found.dv_units) == (("rain",), ("mm/h",))
    assert dict(found.provenance)["steps"] == (1.0, -5.0, 2.0, 4.0)
    where = dict(found.working_point)
    assert [where[name] for name in TANKS.mv_names] == [11.0, 250.0, 20.0]
    assert [where[name] for name in TANKS.cv_names] == pytest.approx(GAIN @ [1.0, 50.0, -20.0], abs=1e-3)


def test_a_model_that_is_identified_from_its_own_plant_is_that_model(model):
    both = np.split(np.asarray(model.coefficients), 2, axis=1)
    known = dataclasses.replace(model, coefficients=both[0], mv_names=("choke",), mv_units=("%",))
    known = dataclasses.replace(known, dv_coefficients=both[1], dv_names=("gas_lift",), dv_units=("m3/h",))
    found = identify_step_response(
        ModelPlant(known), steps=[2.0], samples=250, disturbance_steps={"gas_lift": 100.0}
    )
    for key in ("coefficients", "dv_coefficients"):
        np.testing.assert_allclose(getattr(found, key), getattr(known, key), rtol=1e-9, atol=1e-9)
    for key in ("cv_names", "mv_names", "dv_names", "cv_units", "mv_units", "dv_units", "dt"):
        assert getattr(found, key) == getattr(known, key)
    kept = dict(known.working_point)
    assert dict(found.working_point) == pytest.approx(
        {name: kept[name] for name in ("choke", *known.cv_names)}
    )


def test_steps_both_ways_take_the_curvature_out():
    options = dict(steps=(1.0, 5.0, 2.0), samples=100, signals=TANKS)
    one, both = (identify_step_response(tanks(0.1), both_ways=way, **options) for way in (False, True))
    assert both.coefficients[:, 2, -1] == pytest.approx(GAIN[:, 2], abs=1e-3)
    assert one.coefficients[:, 2, -1] == pytest.approx(GAIN[:, 2] + 0.1 * 2.0, abs=1e-3)
    assert dict(both.provenance)["steps"] == (1.0, 5.0, 2.0, -1.0, -5.0, -2.0)


def test_a_sweep_over_two_of_three_mvs_holds_the_third():
    sweep = steady_sweep(
        tanks(),
        {"valve": [10.0, 20.0, 50.0], "pump": [9.0, 12.0]},
        working_point=[1.0, 300.0, 2.0],
        signals=TANKS,
    )
    at = lambda valve, pump: GAIN @ (np.array([pump, 300.0, valve]) - OWN)  # noqa: E731
    expected = np.array([[at(valve, pump) for valve in (10.0, 20.0, 50.0)] for pump in (9.0, 12.0)])
    np.testing.assert_allclose(np.moveaxis(sweep.cv, 0, -1), expected, rtol=1e-12)
    np.testing.assert_allclose(
        sweep.coefficient, np.broadcast_to(GAIN[:, 2, None, None], (3, 2, 2)), atol=1e-12
    )
    with pytest.raises(InputError, match="steady states"):
        steady_sweep(HostPlant(tanks()), {"valve": [10.0, 20.0], "pump": [9.0]}, signals=TANKS)


def test_a_schedule_of_a_plant_of_three_mvs_is_over_those_that_are_named():
    schedule = identify_schedule(tanks(0.01), {"valve": (20.0, 60.0)}, (1.0, 5.0, 2.0), 100, signals=TANKS)
    for valve in (20.0, 30.0, 60.0):
        gain = schedule.model_at([0.0, 0.0, valve]).coefficients[:, 2, -1]
        assert np.asarray(gain) == pytest.approx(GAIN[:, 2] + 2 * 0.01 * (valve - 40.0), abs=1e-3)
    again = ModelSchedule.from_dict(schedule.to_dict())
    assert again.scheduled == ("valve",)
    assert np.array_equal(again.coefficients, schedule.coefficients)


@pytest.fixture(scope="module")
def model():
    return identify_step_response(WellPlant())


@pytest.fixture(scope="module")
def sweep():
    return steady_sweep(WellPlant(), SWEEP)


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
    short = identify_step_response(WellPlant(), samples=30)
    facts = dict(short.provenance)
    assert facts["settled"] is False
    assert "oil_rate after a step of gas_lift had not settled by sample 30" in " ".join(facts["notes"])
    gas = {(row.cv, row.mv): row for row in settling(model)}["gas_rate", "choke"]
    assert gas.peak > 2 * gas.gain > 0


def test_model_does_not_depend_on_the_step_size_of_a_linear_plant():
    small = identify_step_response(WellPlant(), steps=(0.01, 1.0), samples=60)
    smaller = identify_step_response(WellPlant(), steps=(0.005, 0.5), samples=60)
    scale = np.abs(small.coefficients).max(axis=-1, keepdims=True)
    assert (np.abs(small.coefficients - smaller.coefficients) / scale).max() < 1e-3


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"working_point": (99.0, 7500.0)}, "choke"),
        ({"working_point": (50.0, -1.0)}, "gas_lift"),
        ({"working_point": {"choke": 50.0}}, "working_point"),
        ({"working_point": (1.0, 7500.0), "both_ways": True}, "choke"),
        ({"samples": 0}, "samples"),
        ({"steps": (0.0, 100.0)}, "steps.choke"),
        ({"steps": (2.0, float("nan"))}, "steps.gas_lift"),
        ({"steps": 2.0}, "steps"),
        ({"plant": WellPlant(actuator="step"), "steps": (1.0, 100.0), "samples": 5}, "steps.choke"),
        ({"disturbance_steps": {"rain": 1.0}}, "disturbance_steps.rain"),
        (
            {"disturbance_steps": {"reservoir_pressure_offset": 0.0}},
            "disturbance_steps.reservoir_pressure_offset",
        ),
        ({"plant": tanks()}, "signals"),
        ({"plant": tanks(), "signals": TANKS}, "steps"),
    ],
)
def test_bad_step_tests_are_refused_by_name(arguments, field):
    with pytest.raises(InputError) as caught:
        identify_step_response(**({"plant": WellPlant()} | arguments))
    assert caught.value.field == field


def test_step_choke_gives_the_same_model_for_a_whole_step(model):
    stepped = identify_step_response(WellPlant(actuator="step"))
    np.testing.assert_allclose(stepped.coefficients, model.coefficients, rtol=1e-9, atol=1e-12)


def test_gains_fall_as_the_choke_opens_at_every_lift(sweep):
    assert sweep.converged.all()
    assert sweep.coefficient.shape == (2, 3, 49)
    assert (np.diff(sweep.coefficient, axis=-1)[..., 1:] < 0).all()
    for lift in range(3):
        oil = dict(zip(sweep.grid["choke"], sweep.coefficient[1, lift], strict=False))
        assert 4 <= oil[10.0] / oil[50.0] <= 9
        assert oil[98.0] <= 0.35 * oil[50.0]


def test_sweep_on_the_fmu_agrees(fmu):
    grid = {"choke": [4.0, 20.0, 50.0, 52.0, 98.0], "gas_lift": [5000.0, 10000.0]}
    jax_well, other = steady_sweep(WellPlant(), grid), steady_sweep(fmu, grid)
    np.testing.assert_allclose(other.cv, jax_well.cv, rtol=1e-9)
    np.testing.assert_allclose(other.coefficient, jax_well.coefficient, rtol=1e-6)
    assert other.converged.all()


def test_sweep_at_the_working_point_equals_the_identified_gain(model, sweep):
    at = list(sweep.grid["choke"]).index(50.0)
    np.testing.assert_allclose(sweep.coefficient[:, 1, at], model.coefficients[:, 0, -1], rtol=2e-3)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"choke": [10.0, 5.0]}, "grid.choke"),
        ({"choke": [50.0]}, "grid.choke"),
        ({"choke": [50.0, 110.0]}, "choke"),
        ({"gas_lift": [-1.0]}, "gas_lift"),
        ({"valve": [1.0]}, "grid"),
    ],
)
def test_bad_sweeps_are_refused_by_name(arguments, field):
    with pytest.raises(InputError) as caught:
        steady_sweep(WellPlant(), SWEEP | arguments)
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
    grid = SWEEP | {"choke": [4.0, 10.0, 30.0, 50.0, 70.0, 98.0]}
    ours, theirs = steady_sweep(WellPlant(shipped), grid), steady_sweep(WellPlant(fitted), grid)
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
