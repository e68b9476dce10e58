"""Controllers as FMUs: they make the moves of our own loop to the last bit, whoever steps them, and say what they refuse.

The heater is on or off, has one CV and no search that lasts; `JaxmpcController` is what runs inside the FMU.
"""

import math
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from identify.controller_fmu import build_controller_fmu
from identify.controller_slave import NOT_STARTED, JaxmpcController, samples_in
from identify.fmu import validate_fmu
from identify.fmu_process import FmuProcess
from identify.plants import model_of, open_plant
from jaxmpc import (
    Controller,
    InputError,
    SensorFault,
    WellPlant,
    fault_errors,
    load_process,
    make_model,
    simulate,
)
from jaxmpc.cli.main import main
from jaxmpc.errors import MissingToolError
from jaxmpc.process.file import shipped_processes
from jaxmpc.process.host import HostPlant

HEATER = load_process("on-off-heater")
OUTPUTS = ["heater", "status", "status_text", "fallback", "objective", "gap"]


def heater():
    structure = HEATER.structure(integer=True)
    return Controller(structure, HEATER.tuning(structure), model_of(HEATER))


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The FMU of the mixed-integer controller of the heater, as the command writes it."""
    path = tmp_path_factory.mktemp("built") / "heater.fmu"
    assert main(["fmu", "controller", "on-off-heater", "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def fmu(built):
    with FmuProcess(built) as process:
        process.start()
        yield process


@pytest.fixture
def slave(built, tmp_path):
    """What runs inside the FMU, without FMI around it."""
    with zipfile.ZipFile(built) as archive:
        archive.extractall(tmp_path)
    return started(tmp_path / "resources")


def started(resources):
    slave = JaxmpcController(instance_name="controller", resources=str(resources))
    slave.setup_experiment(0.0)
    slave.exit_initialization_mode()
    return slave


def stepped(slave, time, step, **inputs):
    """Values after one communication step; dots in names are written as double underscores."""
    slave._values.update({name.replace("__", "."): value for name, value in inputs.items()})
    assert slave.do_step(time, step)
    return slave._values


def closed_loop(fmu, plant, run, dt, disturbance, errors, positions=False):
    """Demands and the outputs of the last step, with the FMU in place of the controller that made a run."""
    fmu.start()
    outputs, demands = plant.init(), []
    for k, setpoint in enumerate(run.setpoint):
        received = np.asarray(outputs.cv) + errors[k]
        inputs = dict(zip(run.cv_names, received.tolist(), strict=True))
        inputs |= {f"{name}.setpoint": float(v) for name, v in zip(run.cv_names, setpoint, strict=True)}
        if positions:
            inputs |= {f"{name}.position": float(v) for name, v in zip(run.mv_names, outputs.mv, strict=True)}
        *mv, status, objective = fmu.step(dt, inputs, [*run.mv_names, "status", "objective"])
        demands.append([*mv, status, objective])
        outputs = plant.step(np.array(mv), disturbance[k])
    return np.array(demands)


def recorded(run):
    return np.column_stack([run.mv_demand, run.status, run.objective])


# ------------------------------------------------------------------------------------------------------ the same moves


def test_fmpys_validator_finds_no_problem(built):
    assert validate_fmu(built) == []


def test_it_makes_the_moves_of_our_own_loop_bit_for_bit_and_again_after_a_reset(fmu):
    plant, samples = HostPlant(open_plant(HEATER)), 120
    disturbance = np.where(np.arange(samples) < 60, 0.0, -1.5)[:, None]
    faults = [SensorFault("temperature", "missing", time=40.0, duration=3.0)]
    errors = fault_errors(HEATER.structure(), samples, faults)
    run = simulate(
        heater(),
        plant,
        HEATER.reference("quick"),
        samples=samples,
        disturbance=disturbance,
        faults=errors,
    )
    assert len(set(run.mv_demand[:, 0])) == 2  # it switches
    for _ in range(2):
        made = closed_loop(fmu, plant, run, HEATER.dt, disturbance, errors)
        np.testing.assert_array_equal(made, recorded(run))


@pytest.mark.slow
@pytest.mark.parametrize("integer", [True, False], ids=["mixed-integer", "continuous"])
def test_it_makes_the_moves_of_our_own_loop_at_the_well(integer, tmp_path):
    well, plant = load_process("gas-lifted-well"), HostPlant(WellPlant(actuator="step"))
    structure = well.structure(integer=integer)
    controller = Controller(structure, well.tuning(structure), model_of(well, plant.plant))
    run = simulate(controller, plant, well.reference("quick"), samples=400, position_feedback=True)
    none = np.zeros((400, 2))
    path = build_controller_fmu(controller, tmp_path / "well.fmu", well.model.working_point)
    with FmuProcess(path) as fmu:
        made = closed_loop(fmu, plant, run, well.dt, np.zeros((400, 1)), none, positions=True)
    np.testing.assert_array_equal(made, recorded(run))
    assert validate_fmu(path) == []


def test_fmpy_steps_it_in_its_own_process_which_ends_soundly_after_several_instances(built):
    code = f"""
import fmpy
for interval in (1.0, 0.25, 3.0):
    found = fmpy.simulate_fmu({str(built)!r}, stop_time=6, output_interval=interval, output=["heater", "status"],
                              start_values={{"temperature": 20, "temperature.setpoint": 25}})
    print(found["heater"].tolist()[:2], found["status"].tolist()[-1])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines() == ["[0.0, 1.0] 0"] * 3
    assert done.returncode == 0, done.stderr


# --------------------------------------------------------------------------------------------------------- variables


def test_its_variables_have_the_names_and_units_of_the_process_and_start_at_the_working_point(fmu):
    found = {v.name: (v.causality, v.unit, v.start) for v in fmu.description.variables.values()}
    assert found["temperature"] == ("input", "degC", "NaN")
    assert found["temperature.setpoint"] == ("input", "degC", "20.0")
    assert found["heater"][:2] == ("output", "1")
    assert found["heater.start"] == ("parameter", "1", "0.0")
    assert found["heater.position"] == ("input", "1", "NaN")
    assert fmu.description.variables["heater.manual"].type == "Boolean"
    assert {name for name, v in found.items() if v[0] == "output"} == set(OUTPUTS)


def test_before_the_first_sample_the_mvs_stand_at_their_parameters(fmu):
    fmu.start({"heater.start": 1.0})
    heater, status, text, fallback, objective, gap = fmu.get(OUTPUTS)
    assert (heater, status, text, fallback) == (1.0, NOT_STARTED, "", False)
    assert math.isnan(objective)
    assert math.isnan(gap)


def test_the_status_is_told_as_a_number_and_as_a_word(fmu):
    fmu.start()
    assert fmu.step(1.0, {"temperature": 20.0}, ["status", "status_text"]) == [0, "optimal"]


def test_an_mv_that_somebody_else_moves_stays_where_it_is(slave):
    cold = dict(temperature=20.0, temperature__setpoint=25.0)
    assert stepped(slave, 0.0, 1.0, heater__manual=True, heater__position=0.0, **cold)["heater"] == 0.0
    assert stepped(slave, 1.0, 1.0, heater__manual=False, **cold)["heater"] == 1.0


def test_a_measurement_that_is_not_received_stops_nothing_even_at_the_start(slave):
    values = stepped(slave, 0.0, 1.0, temperature=math.nan, temperature__setpoint=math.nan)
    # no setpoint either, but the start value of the setpoint was there before
    assert values["status"] == NOT_STARTED
    assert values["heater"] == 0.0
    assert stepped(slave, 1.0, 1.0, temperature__setpoint=25.0)["status_text"] == "optimal"
    values = stepped(slave, 2.0, 1.0, temperature=20.0, temperature__setpoint=math.nan)
    assert values["heater"] == 1.0  # the setpoint is as before


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_a_cv_without_a_sound_measurement_at_the_start_counts_as_at_its_setpoint(slave, bad):
    assert stepped(slave, 0.0, 1.0, temperature=bad, temperature__setpoint=22.0)["heater"] == 0.0
    assert slave._state.base[0] == 22.0
    assert stepped(slave, 1.0, 1.0, temperature=15.0)["heater"] == 1.0


def test_measured_disturbances_count_from_the_first_sample_on(tmp_path):
    structure = HEATER.structure()
    model = model_of(HEATER)
    load = make_model(
        model.coefficients,
        model.dt,
        model.cv_names,
        model.mv_names,
        dv_coefficients=-np.asarray(model.coefficients),
        dv_names=("load",),
        dv_units=("kW",),
    )
    controller = Controller(structure, HEATER.tuning(structure), load)
    state = controller.init([20.0], [0.0], [3.0])
    expected = []
    for dv in ([3.0], [5.0], [np.nan]):
        state, info = controller.step(state, [20.0], [20.0], dv=dv)
        expected.append(float(info.mv[0]))
    path = build_controller_fmu(controller, tmp_path / "load.fmu", {"heater": 0.0})
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
    slave = started(tmp_path / "resources")
    cold = dict(temperature=20.0, temperature__setpoint=20.0)
    made = [stepped(slave, k, 1.0, load=dv, **cold)["heater"] for k, dv in enumerate((3.0, 5.0, math.nan))]
    assert made == expected
    assert made[0] == 0.0 < made[1]
    with FmuProcess(path) as fmu:
        assert fmu.description.variables["load"].unit == "kW"
    assert validate_fmu(path) == []


# ------------------------------------------------------------------------------------------------- communication steps


@pytest.mark.parametrize(
    ("since", "step", "count"),
    [
        (0.0, 10.0, 1),
        (10.0, 30.0, 3),
        (0.0, 2.5, 1),
        (2.5, 2.5, 0),
        (7.5, 2.5, 0),
        (10.0 - 1e-9, 2.5, 1),  # rounding of the master
        (10.0 / 3, 10.0 / 3, 0),
        (86400.0, 0.1, 1),
    ],
)
def test_a_sample_happens_at_each_instant_that_a_step_covers(since, step, count):
    assert samples_in(since, step, 10.0) == count


@pytest.mark.parametrize(
    ("since", "step"),
    [(0.0, 7.0), (0.0, 15.0), (0.0, 0.0), (0.0, -10.0), (0.0, math.nan), (0.0, math.inf), (5.0, 10.0)],
)
def test_other_communication_steps_are_refused_in_words(since, step):
    with pytest.raises(InputError, match=r"sampling in(terval|stant)"):
        samples_in(since, step, 10.0)


def test_the_reason_for_a_refused_step_is_said_aloud(slave, capsys):
    with pytest.raises(InputError):
        slave.do_step(0.0, 0.7)
    assert "got 0.7, expected a whole number of sampling intervals of 1 s" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(
    ("path", "start", "field"),
    [
        ("controller.zip", {}, "path"),
        ("missing/\0.fmu", {}, "path"),
        ("controller.fmu", {"heather": 1.0}, "start"),
        ("controller.fmu", {"heater": math.nan}, "start.heater"),
    ],
)
def test_bad_input_is_refused_by_name_and_writes_nothing(path, start, field, tmp_path):
    with pytest.raises(InputError) as caught:
        build_controller_fmu(heater(), tmp_path / path, start)
    assert caught.value.field == field
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_controller_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected a Controller"):
        build_controller_fmu("heater", tmp_path / "controller.fmu")  # pyright: ignore


def test_without_pythonfmu_the_message_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pythonfmu", None)
    with pytest.raises(MissingToolError, match=r"pip install 'jaxmpc\[fmu\]'"):
        build_controller_fmu(heater(), tmp_path / "controller.fmu")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["smooth.toml"], "--controller"),
        (["on-off-heater", "--preset", "other"], "--preset"),
        (["on-off-heater", "--out", "controller.zip"], "--out"),
    ],
)
def test_the_command_names_the_option_that_does_not_fit(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = shipped_processes()["on-off-heater"].read_text().replace("dwell = [3]", "")
    Path("smooth.toml").write_text(text.replace('actuator = { kind = "on-off" }', ""))
    assert main(["fmu", "controller", *words]) == 2
    assert said in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["smooth.toml"]
