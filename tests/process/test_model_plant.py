"""A step-response model as a plant: it is the controller's prediction, and differs from it as its parameters say."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.loop.simulate import simulate, simulate_batch
from jaxmpc.model.step_response import make_model
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.process.actuator import Actuator
from jaxmpc.process.host import HostPlant
from jaxmpc.process.model_plant import ModelPlant
from jaxmpc.process.plant import lanes_of_plants
from jaxmpc.process.reference import Reference
from tests.conftest import second_order

TO = Reference([0.0, 50.0], [[0.0, 0.0], [400.0, 8.0]], 400.0)


@pytest.fixture
def fields(thesis_fields):
    """A tuning whose deviations start at 0."""
    return thesis_fields | {"mv_low": -1e3, "cv_low": -1e4, "deadzone": 0.0, "move_weight": 1.0}


def with_feed(model):
    """The model with a measured disturbance that does half of what the choke does."""
    coefficients = np.asarray(model.coefficients)
    names = model.cv_names, model.mv_names
    return make_model(
        coefficients, model.dt, *names, dv_coefficients=0.5 * coefficients[:, :1], dv_names=["feed"]
    )


def outputs(plant, moves, disturbance: Any = 0.0):
    """CVs after moves ``"sample mv"`` from the start."""
    return np.asarray(plant.run(plant.init(), plant.start_mv + np.cumsum(moves, axis=0), disturbance)[1].cv)


def superposed(responses, moves):
    """The same by (2.29), response by response, of ``responses(k)`` k samples after a move, ``"cv mv"``."""
    count = len(moves)
    return np.array([sum(responses(k - i) @ moves[i] for i in range(k)) for k in range(1, count + 1)])


def test_it_is_the_superposition_of_its_responses_also_beyond_the_last(well_like_model):
    moves = np.random.default_rng(0).normal(size=(90, 2))
    table = np.asarray(well_like_model.coefficients)
    expected = superposed(lambda k: table[:, :, min(k, 60) - 1], moves)
    np.testing.assert_allclose(outputs(ModelPlant(well_like_model), moves), expected, atol=1e-10)


@pytest.mark.parametrize("step", [None, 2.0])
def test_a_controller_that_knows_it_has_no_bias(well_like_model, small_structure, fields, step):
    structure = small_structure if step else small_structure.relaxed()
    controller = Controller(structure, make_tuning(structure, **fields), well_like_model)
    run = simulate(controller, ModelPlant(well_like_model), TO)
    assert np.ptp(run.mv[:, 0]) > 1.0
    assert np.abs(run.bias_raw).max() < 1e-9
    plant = ModelPlant(well_like_model).replaced({"gain": 1.1})
    assert np.abs(simulate(controller, plant, TO).bias_raw).max() > 1.0


def test_it_steps_on_the_host_as_in_a_compiled_loop(well_like_model):
    plant = ModelPlant(well_like_model, start={"choke": 50.0, "gas": 11000.0})
    host, demands = HostPlant(plant), np.array([[52.0, 10.0], [54.0, -5.0], [54.0, 0.0]])
    loads = np.array([[0.0, 0.0], [3.0, -1.0], [0.0, 0.5]])
    np.testing.assert_array_equal(host.init().cv, [11000.0, 0.0])
    stepped = [host.step(demand, load).cv for demand, load in zip(demands, loads, strict=True)]
    compiled = plant.run(plant.init(), demands, loads)[1]
    np.testing.assert_allclose(stepped, compiled.cv, rtol=1e-12)
    np.testing.assert_array_equal(compiled.mv, demands)


def test_loads_are_added_to_their_cv_and_leave_nothing_behind(well_like_model):
    plant = ModelPlant(well_like_model)
    assert plant.disturbance_names == ("output.gas", "output.oil")
    moves, loads = np.ones((6, 2)), np.zeros((6, 2))
    loads[2] = 7.0, -2.0
    difference = outputs(plant, moves, loads) - outputs(plant, moves)
    np.testing.assert_allclose(difference, loads, atol=1e-12)


def test_disturbances_of_the_model_act_through_their_responses(well_like_model):
    table = np.asarray(well_like_model.coefficients)
    plant = ModelPlant(with_feed(well_like_model))
    assert plant.disturbance_names == ("feed", "output.gas", "output.oil")
    feed = np.random.default_rng(1).normal(size=20)
    found = outputs(plant, np.zeros((20, 2)), np.stack([feed, 0 * feed, 0 * feed], axis=1))
    moves = np.diff(feed, prepend=0.0)[:, None]
    np.testing.assert_allclose(found, superposed(lambda k: 0.5 * table[:, :1, k - 1], moves), atol=1e-10)
    none = outputs(plant.replaced({"gain.oil.feed": 0.0}), np.zeros((20, 2)), np.eye(3)[[0] * 20])
    assert none[:, 0].all()
    assert not none[:, 1].any()


def test_a_disturbance_that_the_controller_is_told_leaves_no_bias(well_like_model, small_structure, fields):
    structure, model = small_structure.relaxed(), with_feed(well_like_model)
    feed = np.zeros((40, 3))
    feed[5:, 0] = 8.0
    run = simulate(
        Controller(structure, make_tuning(structure, **fields), model),
        ModelPlant(model),
        TO,
        disturbance=feed,
    )
    assert np.abs(run.bias_raw).max() < 1e-9


def test_it_starts_at_the_working_point_or_where_it_is_told(well_like_model):
    known = dataclasses.replace(well_like_model, working_point=(("choke", 50.0), ("oil", 185.0)))
    at = ModelPlant(known, start={"oil": 190.0, "lift": 7500.0})
    measured = at.measure(at.init())
    np.testing.assert_array_equal(measured.cv, [0.0, 190.0])
    np.testing.assert_array_equal(measured.mv, [50.0, 7500.0])


def test_its_actuators_move_before_it_answers(well_like_model):
    plant = ModelPlant(well_like_model, [Actuator("stepped", step=2.0, threshold=1.6), Actuator(low=0.0)])
    found = plant.run(plant.init(), np.array([[1.5, -3.0], [1.7, 2.0]]))[1]
    np.testing.assert_array_equal(found.mv, [[0.0, 0.0], [2.0, 2.0]])
    np.testing.assert_array_equal(found.cv[0], [0.0, 0.0])
    np.testing.assert_allclose(found.cv[1], np.asarray(well_like_model.coefficients)[:, :, 0] @ [2.0, 2.0])


# ------------------------------------------------------------------------------------------------------- mismatch


def test_no_mismatch_is_the_model_to_the_last_bit(well_like_model):
    plant = ModelPlant(well_like_model)
    same = plant.replaced({p.name: p.default for p in plant.parameter_table})
    np.testing.assert_array_equal(same.coefficients, plant.nominal)


def test_gain_dead_time_and_time_scale_do_to_a_response_what_they_say():
    """Against the response of the process with these numbers, sampled a hundred times as fast as the model."""
    fine = second_order(2.0, 120.0, 30.0, 40.0, samples=6000, dt=0.1)
    model = make_model([[fine[99::100]]], 10.0, ["y"], ["u"])
    plant = ModelPlant(model).replaced({"gain": 1.5, "dead_time.y.u": 25.0, "time_scale.y.u": 1.6})
    times = 10.0 * np.arange(1, plant.coefficients.shape[-1] + 1)
    exact = 1.5 * second_order(2.0, 1.6 * 120.0, 1.6 * 30.0, 1.6 * 40.0, samples=20000, dt=0.1)
    delayed = [exact[round(10 * (t - 25.0)) - 1] if t > 25.0 else 0.0 for t in times]
    np.testing.assert_allclose(
        plant.coefficients[0, 0], delayed, atol=0.012
    )  # of 3, the model is linear in between
    np.testing.assert_allclose(plant.coefficients[0, 0, -1], 1.5 * fine[-1], rtol=1e-12)


def test_pairs_are_changed_alone_and_on_top_of_all(well_like_model):
    plant = ModelPlant(well_like_model)
    table = np.asarray(well_like_model.coefficients)
    both = plant.replaced({"gain": 2.0, "gain.oil.lift": 0.5, "dead_time.gas.choke": 20.0})
    np.testing.assert_allclose(both.coefficients[1, 1, :60], table[1, 1])
    np.testing.assert_allclose(both.coefficients[1, 0, :60], 2.0 * table[1, 0])
    np.testing.assert_array_equal(both.coefficients[0, 0, :2], 0.0)
    np.testing.assert_allclose(both.coefficients[0, 0, 2:60], 2.0 * table[0, 0, :58])
    np.testing.assert_array_equal(
        both.replaced({"gain": 1.0, "dead_time.gas.choke": 0.0, "gain.oil.lift": 1.0}).coefficients, table
    )


def test_dead_time_is_taken_away_as_far_as_there_is_some():
    late = [0.0, 0.0, 1.0, 1.5, 1.75]
    plant = ModelPlant(make_model([[late, [1.0] * 5]], 10.0, ["y"], ["u", "v"]))
    earlier = plant.replaced({"dead_time.y.u": -20.0})
    np.testing.assert_array_equal(earlier.coefficients[0, 0], [1.0, 1.5, 1.75, 1.75, 1.75])
    np.testing.assert_array_equal(
        plant.replaced({"dead_time.y.u": -15.0}).coefficients[0, 0, :2], [0.5, 1.25]
    )
    for name in ("dead_time.y.u", "dead_time.y.v", "dead_time"):
        with pytest.raises(InputError, match=r"plant.dead_time.y.[uv]: .* s or more"):
            plant.replaced({name: -21.0})
    slower = plant.replaced({"time_scale": 2.0, "dead_time.y.u": -40.0})
    np.testing.assert_array_equal(slower.coefficients[0, 0, :4], [0.5, 1.0, 1.25, 1.5])
    with pytest.raises(InputError, match=r"plant.dead_time.y.u: got -41.0, expected -40 s or more"):
        slower.replaced({"dead_time.y.u": -41.0})


def test_lanes_of_plants_are_each_plant_alone(well_like_model, small_structure, fields):
    structure = small_structure.relaxed()
    tunings = [make_tuning(structure, **(fields | {"move_weight": w})) for w in (10.0, 250.0, 500.0)]
    values = {
        "gain.gas.choke": np.array([0.8, 1.0, 1.3]),
        "time_scale": np.array([1.0, 1.5, 0.7]),
        "dead_time": 5.0,
    }
    plant = ModelPlant(well_like_model, [Actuator("stepped", step=2.0), Actuator()])
    lanes = lanes_of_plants(plant, values)
    assert lanes.count == 3
    assert lanes.shared.nominal is plant.nominal
    assert lanes.each.nominal is None
    assert lanes.each.coefficients.shape[0] == 3
    together = simulate_batch(Controllers(structure, tunings, well_like_model), lanes, TO)
    for k, run in enumerate(together):
        one = plant.replaced({name: np.broadcast_to(v, 3)[k] for name, v in values.items()})
        alone = simulate(Controller(structure, tunings[k], well_like_model), one, TO)
        np.testing.assert_allclose(run.cv, alone.cv, atol=1e-4)
    assert lanes_of_plants(plant, {"gain": 1.1}).count is None


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"gain.gas.chock": 1.0}, "Did you mean gain.gas.choke"),
        ({"gain": float("nan")}, r"plant.gain: .* finite number \[1\]"),
        ({"dead_time": [1.0, float("inf")]}, r"plant.dead_time: .* finite number \[s\]"),
        ({"time_scale.oil.lift": 0.0}, r"plant.time_scale.oil.lift: .* positive number \[1\]"),
        ({"time_scale": 1e9}, "plant.time_scale: .* 20000 samples at most"),
        ({"gain": [1.0, 2.0], "dead_time": [1.0, 2.0, 3.0]}, "one number of lanes"),
    ],
)
def test_mismatch_that_cannot_be_is_refused(well_like_model, values, told):
    with pytest.raises(InputError, match=told):
        ModelPlant(well_like_model).replaced(values)


@pytest.mark.parametrize("start", [{"chock": 1.0}, {"choke": float("nan")}])
def test_a_start_that_cannot_be_is_refused(well_like_model, start):
    with pytest.raises(InputError, match=r"plant.start.cho.k?"):
        ModelPlant(well_like_model, start=start)
