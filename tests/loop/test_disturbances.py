"""Measured disturbances and known setpoints in closed loops, on a plant that is the model itself."""

import dataclasses

import numpy as np
import pytest

from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.loop.simulate import simulate, simulate_batch
from jaxmpc.model.step_response import make_model
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.process.host import HostPlant
from jaxmpc.process.model_plant import ModelPlant
from jaxmpc.process.reference import Reference

SAMPLES, DT = 70, 10.0  # more than one call of the longest length
LEVEL, VALVE = np.array([50.0]), np.array([40.0, 30.0])


def plant_of(model):
    """The model itself: its disturbances are the DV of the model, and what is added to the CV without being measured."""
    return ModelPlant(model, start={"level": 50.0, "valve": 40.0, "heater": 30.0})


@pytest.fixture(scope="module")
def models():
    """The model, without and with its DV."""
    n = DT * np.arange(1, 31)
    of_mvs = [[-0.4 * (1 - np.exp(-n / 60.0)), 0.25 * (1 - np.exp(-n / 120.0))]]
    of_dv = [[0.5 * (1 - np.exp(-n / 90.0))]]
    names = DT, ["level"], ["valve", "heater"]
    return make_model(of_mvs, *names), make_model(of_mvs, *names, dv_names=["inflow"], dv_coefficients=of_dv)


STRUCTURE = Structure(
    ("level",),
    ("valve", "heater"),
    prediction_horizon=30,
    control_horizon=30,
    blocks=(1,) * 6 + (2,) * 6 + (4,) * 3,
)


def tuning(**changes):
    moves = dict(move_low=[-5.0, -4.0], move_high=[5.0, 4.0])
    return make_tuning(STRUCTURE, **dict(cv_weight=1.0, move_weight=[0.02, 0.01], **moves) | changes)


@pytest.fixture(scope="module")
def controllers(models):
    return [Controller(STRUCTURE, tuning(), model) for model in models]


def disturbed(size=12.0, at=20):
    rows = np.zeros((SAMPLES, 2))
    rows[at:, 0] = size
    return rows


HOLD = Reference([0.0], [[50.0]], SAMPLES * DT)
UP = Reference([0.0, 300.0], [[50.0], [54.0]], SAMPLES * DT)


def cost(run):
    """What the objective charges for the run."""
    return float(((run.cv - run.setpoint) ** 2).sum() + (run.move**2 @ [0.02, 0.01]).sum())


def test_a_measured_disturbance_is_rejected_without_bias_and_better_when_it_is_known_ahead(
    models, controllers
):
    plant, rows = plant_of(models[1]), disturbed()
    blind, told = (simulate(one, plant, HOLD, disturbance=rows) for one in controllers)
    ahead = simulate(controllers[1], plant, HOLD, disturbance=rows, preview=True)
    assert np.abs(blind.bias_raw).max() > 0.5
    for run in (told, ahead):
        assert np.abs(run.bias_raw).max() < 1e-9
        assert (run.status == 0).all()
    assert np.flatnonzero(np.abs(told.move).max(axis=1) > 1e-4)[0] == 20  # at once, before the CV is off
    assert np.flatnonzero(np.abs(ahead.move).max(axis=1) > 1e-4)[0] < 20
    assert cost(ahead) < 0.9 * cost(told) < 0.9 * 0.5 * cost(blind)


def test_a_setpoint_that_is_known_ahead_is_met_halfway(controllers, models):
    plant = plant_of(models[1])
    late, early = (simulate(controllers[1], plant, UP, preview=ahead) for ahead in (False, True))
    assert np.flatnonzero(np.abs(late.move).max(axis=1) > 1e-4)[0] == 30
    assert np.flatnonzero(np.abs(early.move).max(axis=1) > 1e-4)[0] < 30
    assert cost(early) < 0.8 * cost(late)


@pytest.mark.parametrize("preview", [False, True])
def test_compiled_loops_host_loops_batches_and_single_steps_agree(models, controllers, preview):
    plant, one = plant_of(models[1]), controllers[1]
    rows = disturbed()
    rows[40:, 1] = 0.7  # this one is not measured
    how = dict(disturbance=rows, preview=preview)
    compiled, stepped = simulate(one, plant, UP, **how), simulate(one, HostPlant(plant), UP, **how)
    others = np.stack([disturbed(-6.0, 10), rows])
    lanes = Controllers(STRUCTURE, [tuning(move_weight=[0.5, 0.5]), one.tuning], models[1])
    _, lane = simulate_batch(lanes, plant, UP, disturbance=others, preview=preview)
    setpoint, horizon = UP.sample(DT), STRUCTURE.prediction_horizon
    whole = lambda v: np.concatenate([v, np.repeat(v[-1:], horizon + 1, axis=0)])  # noqa: E731
    setpoints, dvs = whole(setpoint), whole(rows[:, :1])
    state, process, demands = one.init(LEVEL, VALVE), HostPlant(plant), []
    outputs = process.init()
    for k in range(SAMPLES):
        known = setpoints[k + 1 : k + 1 + horizon] if preview else setpoint[k]
        state, info = one.step(state, outputs.cv, known, dv=dvs[k : k + horizon] if preview else dvs[k])
        outputs = process.step(info.mv, rows[k])
        demands.append(info.mv)
    for other in (stepped.mv_demand, lane.mv_demand, np.array(demands)):
        np.testing.assert_allclose(other, compiled.mv_demand, rtol=1e-6, atol=1e-5)
    assert np.abs(compiled.bias_raw[:40]).max() < 1e-9
    assert np.abs(compiled.bias_raw[41:]).max() > 0.5


def test_a_disturbance_that_the_plant_lacks_is_refused(models, controllers):
    plant = plant_of(dataclasses.replace(models[1], dv_names=("outflow",)))
    for run in (simulate, simulate_batch):
        with pytest.raises(InputError, match=r"^model\.dv: got 'inflow', expected .*outflow"):
            run(controllers[1], plant, HOLD)
        with pytest.raises(InputError, match=r"^preview"):
            run(controllers[1], plant_of(models[1]), HOLD, preview="yes")
