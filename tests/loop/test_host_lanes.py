"""Many loops on plants that keep their state: each is the loop of its own, and one that fails ends alone."""

import dataclasses

import numpy as np
import pytest

from identify.fmu import FmuPlant
from jaxmpc import status
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.measurement import MISSING
from jaxmpc.errors import PlantError
from jaxmpc.loop import host_lanes
from jaxmpc.loop.events import Event
from jaxmpc.loop.host_lanes import simulate_host_lanes
from jaxmpc.loop.inputs import Sweep
from jaxmpc.loop.simulate import simulate
from jaxmpc.model.step_response import make_model
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.process.actuator import Actuator
from jaxmpc.process.reference import Reference
from tests import fmus

SAMPLES, LANES, TOLD = 30, 5, [True, False, True, False, True]
REFERENCE = Reference([0.0, 50.0], [[0.0], [3.0]], SAMPLES * 10.0)
NOISE = [0.02]
EVENTS = [  # one list per lane
    [Event(10.0 * (3 + k), {"move_weight": 0.05}, mv_off=["u"]), Event(150.0, {"deadzone": 0.1}, mv_on=["u"])]
    for k in range(LANES)
]


@pytest.fixture(scope="module")
def structure():
    names = {"cv_names": ("level",), "mv_names": ("u",), "dt": 10.0, "integer_step": (1.0,)}
    return Structure(**names, prediction_horizon=20, control_horizon=6, blocks=(1, 1, 2, 2))


@pytest.fixture(scope="module")
def model(structure):
    """Of the FMU of the tests with steps of 10 s; the disturbance is measured."""
    response = [[1 - (5 / 6) ** np.arange(1, 31)]]
    return make_model(response, structure.dt, ["level"], ["u"], dv_coefficients=response, dv_names=["n"])


@pytest.fixture(scope="module")
def tunings(structure):
    limits = {"mv_low": -10.0, "mv_high": 10.0, "move_low": -2.0, "move_high": 2.0}
    return [make_tuning(structure, cv_weight=1.0, move_weight=0.1 * (k + 1), **limits) for k in range(LANES)]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Where the FMU stands at 160 s with a bias of -1 it crashes, with one of -2 it hangs."""
    code = "if (t == 160 && r[4] == -1) { abort(); } while (t == 160 && r[4] == -2) { sleep(1); }"
    varies = fmus.describe(attributes='canHandleVariableCommunicationStepSize="true"')
    return fmus.make_fmu(tmp_path_factory.mktemp("lanes"), varies, do_step=code)


def run(monkeypatch, structure, model, tunings, path, biases, preview=False):
    """Lanes on FMUs with these biases."""
    monkeypatch.setattr(host_lanes, "TOGETHER", 2)  # three parts, the last one filled up
    monkeypatch.setenv("JAXMPC_THREADS", "2")
    controllers = Controllers(structure, tunings, model)
    with FmuPlant(path, ["u"], ["level"], ["n"], dt=10.0, time_limit=2.0) as first:
        plants = [first.replaced({"bias": bias}) for bias in biases]
    loads = np.arange(LANES)[:, None, None] * (np.arange(SAMPLES) > 20)[None, :, None]
    loads = np.asarray(loads, dtype=float)
    sweep = Sweep.checked(
        controllers,
        first,
        [REFERENCE] * LANES,
        disturbance=loads,
        noise=NOISE,
        seed=range(LANES),
        position_feedback=TOLD,
        preview=preview,
        events=EVENTS,
    )
    done = []
    fields, failures = simulate_host_lanes(
        sweep.controllers, plants, sweep.inputs_of(np.arange(LANES)), done.append, sweep.stages
    )
    assert all(plant._process is None for plant in plants)
    assert sum(done) == LANES * SAMPLES
    return fields, failures, plants, loads


@pytest.mark.parametrize("preview", [False, True])
def test_every_lane_is_the_loop_of_its_controller_and_plant(
    monkeypatch, structure, model, tunings, path, preview
):
    fields, failures, plants, loads = run(
        monkeypatch, structure, model, tunings, path, [0, 1, 2, 3, 4], preview
    )
    assert failures == {}
    for k, plant in enumerate(plants):
        with plant:
            own = {"disturbance": loads[k, :, 0], "noise": NOISE, "seed": k, "position_feedback": TOLD[k]}
            own |= {"preview": preview, "events": EVENTS[k]}
            alone = simulate(Controller(structure, tunings[k], model), plant, REFERENCE, **own)
        for name in ("cv", "mv", "mv_demand", "bias", "status"):
            np.testing.assert_allclose(fields[name][k], getattr(alone, name), atol=1e-9, err_msg=name)
        assert not fields["move"][k, 3 + k : 15].any()
    assert np.ptp(fields["mv"][:, -1]) > 1  # the lanes are not alike


def test_a_plant_that_crashes_or_hangs_ends_its_own_lane_alone(monkeypatch, structure, model, tunings, path):
    fields, failures, *_ = run(monkeypatch, structure, model, tunings, path, [0, -1, 0, 0, -2])
    sound, *_ = run(monkeypatch, structure, model, tunings, path, [0, 0, 0, 0, 0])
    assert list(failures) == [1, 4]
    assert all(isinstance(error, PlantError) for error in failures.values())
    assert "SIGABRT during doStep at t = 160 s" in str(failures[1])
    assert "did not come back from doStep at t = 160 s" in str(failures[4])
    for k in (0, 2, 3):
        for name, values in sound.items():
            if name != "solve_time":
                np.testing.assert_array_equal(fields[name][k], values[k], err_msg=name)
    for k in failures:
        last = 16  # the sample in which it failed: measured and decided, but not carried out
        assert np.isfinite(fields["cv"][k, : last + 1]).all()
        assert np.isfinite(fields["mv"][k, :last]).all()
        for name in ("cv", "mv", "mv_demand", "move", "bias", "objective"):
            assert np.isnan(fields[name][k, last + 1 :]).all(), name
        assert np.isnan(fields["mv"][k, last])
        assert (fields["status"][k, last + 1 :] == status.FAILED).all()
        assert (fields["quality"][k, last + 1 :] == MISSING).all()
        assert fields["fallback"][k, last + 1 :].all()


def test_a_plant_that_does_not_start_is_a_lane_without_numbers(monkeypatch, structure, model, tunings, path):
    class Broken(FmuPlant):
        def init(self):
            raise PlantError("no valve")

    broken = Broken(path, ["u"], ["level"], ["n"], dt=10.0)
    monkeypatch.setattr(
        FmuPlant,
        "replaced",
        lambda self, values, own=FmuPlant.replaced: broken if values["bias"] == 1 else own(self, values),
    )
    fields, failures, *_ = run(monkeypatch, structure, model, tunings, path, [0, 0, 1, 0, 0])
    assert list(failures) == [2]
    assert np.isnan(fields["cv"][2]).all()
    assert np.isfinite(fields["cv"][[0, 1, 3, 4]]).all()


def test_an_on_off_valve_of_an_fmu_is_an_mv_with_two_values(structure, model, path):
    valve = dataclasses.replace(structure, mv_names=("b",), prediction_horizon=6, blocks=(1,) * 6)
    response = make_model(100 * np.asarray(model.coefficients), structure.dt, ["level"], ["b"])
    limits = {"mv_low": 0.0, "mv_high": 1.0, "move_low": -1.0, "move_high": 1.0}
    tuning = make_tuning(valve, cv_weight=1.0, move_weight=0.1, **limits)
    reference = Reference([0.0], [[50.0]], 600.0)
    on_off = Actuator("on-off", low=0.0, high=1.0)
    with FmuPlant(path, {"b": on_off}, ["level"], dt=10.0) as plant:
        run = simulate(Controller(valve, tuning, response), plant, reference)
    assert set(run.mv[:, 0]) == {0.0, 1.0}
    np.testing.assert_allclose(run.mv, run.mv_demand, atol=1e-9)
    assert abs(run.cv[20:].mean() - 50.0) < 3.0
