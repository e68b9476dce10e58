"""The shipped processes: published gains, time constants, steady states and zeros, by formulas of their own; and loops."""

import dataclasses
import math
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest

from identify.judge import judge
from identify.plants import load_model, model_of, open_plant
from identify.step_test import settling
from jaxmpc import Controller, InputError, Reference, simulate
from jaxmpc.cli.main import main
from jaxmpc.process.file import load_process, process_digest, process_of, shipped_processes
from jaxmpc.process.library import pump_tank, quadruple_tank
from studies.definition.catalogue import load_comparison
from studies.definition.sweep import shipped_studies
from studies.load import load_study

NAMES = [name for name in shipped_processes() if name != "gas-lifted-well"]
DOCS = Path(__file__).parents[2] / "docs"


def lag(gain, dead, constant, minutes):
    """Gain times 1 - exp(-(t - dead) / constant), all in minutes."""
    return gain * (1 - np.exp(-np.maximum(minutes - dead, 0) / constant))


# ------------------------------------------------------------------------------------------------- published numbers


def test_wood_berry_has_the_published_transfer_functions_and_mass_balance():
    process = load_process("wood-berry")
    model, t = load_model(process), np.arange(1, 101.0)
    published = {
        (0, 0): (12.8, 1, 16.7), (0, 1): (-18.9, 3, 21.0), (0, 2): (3.8, 8.1, 14.9),
        (1, 0): (6.6, 7, 10.9), (1, 1): (-19.4, 3, 14.4), (1, 2): (4.9, 3.4, 13.2),
    }  # fmt: skip
    found = np.concatenate([model.coefficients, model.dv_coefficients], axis=1)
    assert model.dv_names == ("feed",)
    for (cv, of), (gain, dead, constant) in published.items():
        np.testing.assert_allclose(found[cv, of], lag(gain, dead, constant, t), atol=1e-12)
    gains = np.array([[12.8, -18.9], [6.6, -19.4]])
    assert np.linalg.inv(gains)[0, 0] * gains[0, 0] == pytest.approx(2.01, abs=0.005)  # relative gain
    point = dict(model.working_point)  # methanol in a feed of 46.5 % leaves in 1.18 and 1.27 lb/min
    assert 1.18 * point["distillate"] + 1.27 * point["bottoms"] == pytest.approx(2.45 * 46.5, rel=1e-3)


def test_the_fractionator_has_the_published_transfer_functions_between_samples_too():
    model = load_model(load_process("shell-fractionator"))
    t = 4.0 * np.arange(1, 81)
    gain = [[4.05, 1.77, 5.88, 1.20, 1.44], [5.39, 5.72, 6.90, 1.52, 1.83], [4.38, 4.42, 7.20, 1.14, 1.26]]
    dead = [[27, 28, 27, 27, 27], [18, 14, 15, 15, 15], [20, 22, 0, 0, 0]]
    constant = [[50, 60, 50, 45, 40], [50, 60, 40, 25, 20], [33, 44, 19, 27, 32]]
    found = np.concatenate([model.coefficients, model.dv_coefficients], axis=1)
    for i in range(3):
        for j in range(5):
            expected = lag(gain[i][j], dead[i][j], constant[i][j], t)
            np.testing.assert_allclose(found[i, j], expected, atol=1e-12)
    assert model.dv_names == ("intermediate_duty", "upper_duty")
    found = np.asarray(gain)[:, :3]
    relative = np.diag(found * np.linalg.inv(found).T)  # as published: no misread gain would leave them
    np.testing.assert_allclose([np.linalg.det(found), *relative], [20.85, 2.08, 0.94, 4.71], atol=0.01)


def test_the_fractionator_study_has_the_published_gain_uncertainty():
    share = np.array([[2.11, 0.39, 0.59], [3.29, 0.57, 0.89], [3.11, 0.73, 1.33]])
    share /= [[4.05, 1.77, 5.88], [5.39, 5.72, 6.90], [4.38, 4.42, 7.20]]
    body = tomllib.loads(shipped_studies()["shell-fractionator"].read_text())
    _, gains, _ = body["axes"]
    process = load_process("shell-fractionator")
    expected = [f"plant.gain.{cv}.{mv}" for mv in process.mv_names for cv in process.cv_names]
    assert gains["keys"] == expected
    ends = np.array([[-1, -1, -1], [0, 0, 0], [1, 1, 1], [1, -1, 1]])
    np.testing.assert_allclose(gains["values"], [(1 + share * row).T.ravel() for row in ends], atol=5e-4)


def linear(plant, x, position):
    """A, B and C of a plant whose equations are its `rates` and `outputs`."""
    x, u = np.asarray(x, dtype=float), np.asarray(position, dtype=float)
    a, b = jax.jacfwd(lambda x, u: plant._of("rates", x, u), argnums=(0, 1))(x, u)
    return np.asarray(a), np.asarray(b), np.asarray(jax.jacfwd(lambda x: plant._of("outputs", x, u))(x))


def zeros(a, b, c):
    """Transmission zeros of a square system of which c b can be inverted: what the states do while y stays at 0."""
    found = np.linalg.eigvals((np.eye(len(a)) - b @ np.linalg.inv(c @ b) @ c) @ a).real
    return np.sort(
        found[np.argsort(-np.abs(found))[: len(a) - len(c)]]
    )  # the others are y itself, which stands still


P_MINUS = ({}, 3.0, (12.4, 12.7, 1.8, 1.4), (62, 90, 23, 30), (-0.060, -0.018))
P_PLUS = (
    {"pump_gain_1": 3.14, "pump_gain_2": 3.29, "share_1": 0.43, "share_2": 0.34},
    3.15, (12.6, 13.0, 4.8, 4.9), (63, 91, 39, 56), (-0.057, 0.013),
)  # fmt: skip


@pytest.mark.parametrize(("changes", "voltage", "levels", "constants", "where"), [P_MINUS, P_PLUS])
def test_the_quadruple_tank_is_that_of_the_paper_at_both_operating_points(
    changes, voltage, levels, constants, where
):
    plant = quadruple_tank.plant().replaced(changes)
    at = plant.steady([voltage, voltage])
    assert at.converged
    np.testing.assert_allclose(at.state.x, levels, atol=0.25)  # printed are measured ones
    a, b, c = linear(plant, at.state.x, [voltage, voltage])
    np.testing.assert_allclose(-1 / np.diag(a), constants, rtol=0.015)
    np.testing.assert_allclose(zeros(a, b, c), where, atol=1e-3)
    shares = changes.get("share_1", 0.7) + changes.get("share_2", 0.6)
    assert (where[1] > 0) == (shares < 1)


def test_the_model_of_the_quadruple_tank_has_the_published_gains():
    process = load_process("quadruple-tank")
    model = model_of(process)
    kc = 0.5  # V/cm, of the level measurements
    np.testing.assert_allclose(
        kc * np.asarray(model.coefficients)[:, :, -1], [[2.6, 1.5], [1.4, 2.8]], atol=0.1
    )


def test_the_pump_tank_rests_where_inflow_and_drain_balance():
    plant = pump_tank.plant()
    for pump, level in ((0.0, 0.25), (0.5, 1.0), (1.0, 2.25)):
        assert float(plant.steady([pump]).outputs.cv[0]) == pytest.approx(level, abs=1e-8)
        balance = (0.03 * pump + 0.015) / 0.03
        assert balance**2 == pytest.approx(level)
    a, _, _ = linear(plant, plant.steady([0.5]).state.x, [0.5])
    assert -1 / a[0, 0] == pytest.approx(2 * 10 * 1.0 / 0.03, rel=1e-8)  # 667 s


def test_the_heater_warms_by_10_degrees_with_a_time_constant_of_15_s():
    model = load_model(load_process("on-off-heater"))
    n = np.arange(1, 101)
    np.testing.assert_allclose(model.coefficients[0, 0], 10 * (1 - 0.9355069850316178**n), atol=1e-12)


def test_the_well_with_a_step_choke_is_the_gas_lifted_well():
    given = {"reservoir_pressure": 79.0, "gas_oil_ratio": 27.0}
    ours = open_plant(load_process("step-choke-well")).replaced(given)
    well = open_plant(load_process("gas-lifted-well")).replaced(given)
    steady = well.steady([30.0, 7600.0], 0.5)
    found = ours.steady([30.0], [100.0, 0.5])
    assert found.converged
    assert float(found.outputs.cv[0]) == pytest.approx(float(steady.outputs.cv[0]), rel=1e-8)


# ------------------------------------------------------------------------------------------------------- every one


MEANT = {  # what `jaxmpc process check` is to find
    "on-off-heater": ["heater on temperature"],  # neither on nor off holds a setpoint
    "pump-tank": ["pump on level"],
    # its courses leave end points within a few hundredths of their setpoints
    "shell-fractionator": ["limits of top_end_point", "limits of bottoms_temperature"],
    "step-choke-well": ["choke on gas_rate"],  # the gas rate follows a choke move within a sample
}


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_process_is_sound_and_its_studies_expand(name):
    process = load_process(name)
    assert process.name == name
    assert process.source
    assert process.stepped
    assert {"quick", process.default_reference} <= set(process.references)
    assert process.references["quick"].duration < process.reference().duration
    model = model_of(process)
    looked = [found.subject for found in judge(process, model) if found.level != "fine"]
    assert looked == MEANT.get(name, [])
    assert not any(not row.settled for row in settling(model))
    for quick in (False, True):
        study = load_study(name, quick=quick)
        assert study.definition.process.name == name
        assert 8 <= study.count <= 32
        compared = load_comparison("comparison", quick=quick, process=name)
        modes = {controller.blocking for controller in compared.definition.controllers}
        assert modes == {process.structure().blocking}


@pytest.mark.parametrize(
    ("name", "goal", "duration", "within"),
    [
        ("wood-berry", [96.5, 0.3], 4200, [0.26, 0.26]),  # a step of reflux and a deadzone
        ("quadruple-tank", [13.4, 13.2], 700, [0.4, 0.4]),
        ("step-choke-well", [9700.0], 2000, [80.0]),
        ("shell-fractionator", [0.2, 0.1, 0.0], 16800, [0.1, 0.1, math.inf]),
    ],
)
def test_whole_moves_bring_the_cvs_to_their_setpoints(name, goal, duration, within):
    process = load_process(name)
    structure = process.structure(integer=True)
    controller = Controller(structure, process.tuning(structure), model_of(process))
    reference = Reference([0.0], [goal], duration)
    run = simulate(controller, open_plant(process), reference)
    assert (np.abs(run.cv[-1] - goal) < within).all(), run.cv[-1]
    for k in process.stepped:
        step = process.mvs[k].actuator.step
        moves = np.diff(run.mv[:, k]) / step
        np.testing.assert_allclose(moves, np.round(moves), atol=1e-6)


@pytest.mark.parametrize(("name", "goal", "band"), [("on-off-heater", 24.3, 1.0), ("pump-tank", 1.0, 0.15)])
def test_what_is_on_or_off_keeps_its_dwell_and_its_cv_near_the_setpoint(name, goal, band):
    process = load_process(name)
    structure = process.structure(integer=True)
    controller = Controller(structure, process.tuning(structure), model_of(process))
    run = simulate(controller, open_plant(process), Reference([0.0], [[goal]], 120 * process.dt))
    assert (np.abs(run.cv[60:, 0] - goal) < band).all()
    assert set(np.unique(run.mv)) == {0.0, 1.0}
    moved = np.flatnonzero(np.diff(run.mv[:, 0]))
    assert len(moved) > 5
    assert (np.diff(moved) >= process.structure_fields["dwell"][0]).all()


# --------------------------------------------------------------------------------------------- a table of one's own


def written():
    """The process file of the documentation."""
    text = (DOCS / "processes.md").read_text()
    return tomllib.loads(text.split('```toml title="heat-exchanger.toml"\n', 1)[1].split("```", 1)[0])


def test_the_file_of_the_documentation_is_a_process():
    process = process_of(written())
    model = load_model(process)
    t = process.dt * np.arange(1, model.samples + 1)
    np.testing.assert_allclose(model.coefficients[0, 0], lag(0.8, 30, 240, t), atol=1e-12)
    assert model.dv_names == ("ambient",)
    assert dict(model.working_point) == {"temperature": 60.0, "valve": 40.0}
    assert [found for found in judge(process, model) if found.level != "fine"] == []


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"cv": "temprature"}, "cv"),
        ({"mv": "valv"}, "mv"),
        ({"mv": "valve", "dv": "ambient"}, "mv"),
        ({"mv": "", "dv": "output.temperature"}, "dv"),
        ({"gain": math.nan}, "gain"),
        ({"dead_time": -1.0}, "dead_time"),
        ({"dead_time": math.inf}, "dead_time"),
        ({"time_constants": [0.0]}, "time_constants[0]"),
        ({"time_constants": [math.nan]}, "time_constants[0]"),
        ({"time_constants": [], "lead": 3.0}, "lead"),
        ({"leads": 3.0}, "leads"),
    ],
)
def test_a_wrong_transfer_function_is_refused_with_its_path(change, field):
    body = written()
    body["model"]["transfer_functions"][0] |= change
    with pytest.raises(InputError) as error:
        process_of(body)
    assert error.value.field == f"model.transfer_functions[0].{field}"


@pytest.mark.parametrize(
    ("table", "change", "field"),
    [
        ("cv", {"settled": 0}, "settled"),
        ("cv", {"settled": math.inf}, "settled"),
        ("cv", {"span": 0}, "span"),
        ("cv", {"low": 70, "high": 50}, "low"),
        ("mv", {"high": math.nan}, "high"),
        ("mv", {"smallest_move": -1}, "smallest_move"),
        ("mv", {"move": 0}, "move"),
    ],
)
def test_a_number_that_a_variable_cannot_have_is_refused_with_its_path(table, change, field):
    body = written()
    body[table][0] |= change
    with pytest.raises(InputError) as error:
        process_of(body)
    assert error.value.field == f"{table}[0].{field}"


@pytest.mark.parametrize("samples", [0, 20_001, 1e9])
def test_a_model_of_no_or_too_many_samples_is_refused(samples):
    body = written()
    body["model"]["samples"] = samples
    with pytest.raises(InputError, match=r"model\.samples"):
        process_of(body)


def test_a_pair_twice_a_file_besides_and_a_point_of_nothing_are_refused():
    for change, field in (
        (lambda m: m["transfer_functions"].append(m["transfer_functions"][0]), "transfer_functions[2]"),
        (lambda m: m.update(file="model.json"), "file"),
        (lambda m: m["working_point"].update(pressure=1.0), "working_point.pressure"),
    ):
        body = written()
        change(body["model"])
        with pytest.raises(InputError) as error:
            process_of(body)
        assert error.value.field == f"model.{field}"


def test_the_digest_of_a_process_knows_a_plant_in_its_folder(tmp_path):
    body = written() | {"plants": {"own": {"kind": "python", "source": "own_plant:make"}}}
    process, file = process_of(body, tmp_path), tmp_path / "own_plant.py"
    digests = [process_digest(process)]
    for code in ("make = 1", "make = 2", "make = 1"):
        file.write_text(code)
        digests.append(process_digest(process))
    assert digests[1] == digests[3]
    assert len(set(digests)) == 3


@pytest.mark.parametrize("move_weight", [0.1, 1e-5, 0.0])
def test_a_relaxation_is_proven_where_next_to_nothing_is_left_to_gain(move_weight):
    process = load_process("on-off-heater")
    structure = dataclasses.replace(process.structure(), prediction_horizon=72, control_horizon=12, blocks=())
    tuning = dataclasses.replace(process.tuning(structure), move_weight=np.array([move_weight]))
    controller = Controller(structure, tuning, load_model(process))
    run = simulate(controller, open_plant(process, actual=False), process.reference("quick"), samples=120)
    assert np.min(run.objective) < 1e-3  # of a curvature of 314
    assert (run.status == 0).all()
    assert np.max(run.gap) <= 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_the_keys_of_a_shipped_process_are_listed(name, capsys):
    assert main(["process", "keys", name]) == 0
    listed = capsys.readouterr().out
    for key in (str(axis.key) for axis in load_study(name, quick=True).definition.axes if axis.key):
        assert f"\n{key} " in listed
