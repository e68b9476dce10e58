"""JAX functions as a plant: integration, start, parameters and lanes, against solutions known in closed form."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError, PlantError
from jaxmpc.loop.simulate import simulate, simulate_batch
from jaxmpc.model.step_response import make_model
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.process.actuator import Actuator
from jaxmpc.process.function_plant import FunctionPlant
from jaxmpc.process.host import HostPlant
from jaxmpc.process.plant import Parameter, lanes_of_plants
from jaxmpc.process.reference import Reference

AREA = Parameter("area", "m2", 2.0, positive=True)
VALVE = Parameter("valve", "m3/s/m^0.5", 0.1, "conductance of the valve", low=0.0)


def rates(x, u, d, p):
    """Two tanks, one above the other, that drain by gravity; u: pump [m3/s]; d: another inflow of the lower one [m3/s]."""
    upper, lower = p["valve"] * jnp.sqrt(jnp.maximum(x, 0.0))
    return [(u[0] - upper) / p["area"], (upper + d[0] - lower) / p["area"]]


def levels(x, u, d, p):
    """The level of the lower tank [m]."""
    return x[1:]


def tanks(**more):
    """Their plant, which looks for its steady state from far away."""
    given: Any = dict(
        rates=rates,
        outputs=levels,
        dt=10.0,
        mv=[0.15],
        guess=[1.0, 0.3],
        parameters=[AREA, VALVE],
        disturbance_names=["inflow"],
    )
    return FunctionPlant(**(given | more))


def test_it_starts_in_the_steady_state_of_its_working_point():
    for valve in (0.1, 0.2):
        plant = tanks().replaced({"valve": valve})
        np.testing.assert_allclose(plant.init().x, (0.15 / valve) ** 2, rtol=1e-9)
    found = plant.run(plant.init(), np.full((50, 1), 0.15))[1]
    np.testing.assert_allclose(found.cv, np.full((50, 1), 0.5625), rtol=1e-9)


def test_it_starts_at_the_state_that_it_is_given_steady_or_not():
    plant = tanks(guess=None, state=[4.0, 0.0])
    np.testing.assert_array_equal(plant.init().x, [4.0, 0.0])
    assert float(plant.run(plant.init(), np.array([[0.15]]))[1].cv[0, 0]) > 0.5


def test_a_process_without_steady_state_says_so():
    level = FunctionPlant(lambda x, u, d, p: u - 0.1, lambda x, u, d, p: x, dt=1.0, mv=[0.2], guess=[1.0])
    with pytest.raises(
        PlantError, match=r"guess \[1.0\] with MVs at \[0.2\]: after 17280 samples of 1 s .* by 1.0e-01"
    ):
        level.init()


def test_integration_is_that_of_the_exact_solution_with_held_inputs():
    """dx/dt = -a x + u + d, which a sample multiplies by exp(-a dt) and fills up to (u + d) / a."""
    a, dt = 0.3, 2.0
    plant = FunctionPlant(
        lambda x, u, d, p: -p["a"] * x + u + d,
        lambda x, u, d, p: x + 10.0 * d,
        dt=dt,
        mv=[0.0],
        state=[1.0],
        parameters=[Parameter("a", "1/s", a)],
        disturbance_names=["load"],
        actuators=[Actuator("stepped", step=0.5)],
    )
    demands, loads, x = np.array([0.3, 0.2, -1.1]), np.array([0.0, 0.4, -0.2]), 1.0
    found = plant.run(plant.init(), demands[:, None], loads)[1]
    np.testing.assert_array_equal(found.mv[:, 0], [0.5, 0.0, -1.0])
    for k in range(3):
        forced = float(found.mv[k, 0]) + loads[k]
        x = np.exp(-a * dt) * x + (1 - np.exp(-a * dt)) * forced / a
        np.testing.assert_allclose(found.cv[k, 0], x + 10.0 * loads[k], rtol=1e-6)


@pytest.fixture(scope="module")
def loop():
    """A controller of the tanks, and a reference."""
    structure = Structure(
        cv_names=("level",),
        mv_names=("pump",),
        prediction_horizon=40,
        control_horizon=20,
        blocks=(1, 2, 4, 13),
    )
    plant = tanks()
    stepped = plant.run(plant.init(), np.full((40, 1), 0.16))[1].cv
    model = make_model(
        [[(np.asarray(stepped)[:, 0] - 2.25) / 0.01]], 10.0, structure.cv_names, structure.mv_names
    )
    tuning = make_tuning(structure, cv_weight=1.0, move_weight=50.0)
    return structure, tuning, model, Reference([0.0, 20.0], [[2.25], [2.6]], 400.0)


def test_loops_on_it_settle_and_lanes_are_each_plant_alone(loop):
    structure, tuning, model, reference = loop
    area = np.array([1.8, 2.0, 2.4])
    lanes = lanes_of_plants(tanks(), {"area": area, "valve": 0.11})
    assert lanes.shared.numbers == (None, 0.11)
    together = simulate_batch(Controllers(structure, [tuning] * 3, model), lanes, reference)
    for value, run in zip(area, together, strict=True):
        plant = tanks().replaced({"area": value, "valve": 0.11})
        alone = simulate(Controller(structure, tuning, model), plant, reference)
        np.testing.assert_allclose(run.cv, alone.cv, atol=1e-6)
        assert abs(run.cv[-1, 0] - 2.6) < 0.05


def test_a_lane_without_steady_state_starts_unsteady_and_leaves_the_others_alone(loop):
    structure, tuning, model, reference = loop
    lanes = lanes_of_plants(tanks(), {"valve": np.array([0.1, 0.0])})  # the other tank only fills up
    good, bad = simulate_batch(Controllers(structure, [tuning] * 2, model), lanes, reference, samples=5)
    np.testing.assert_allclose(good.cv[0], 2.25, rtol=1e-9)
    assert (bad.cv == 0.3).all()


def test_it_steps_on_the_host_as_in_a_compiled_program():
    plant = tanks()
    host = HostPlant(plant)
    np.testing.assert_allclose(host.init().cv, [2.25])
    stepped = [host.step(np.array([u]), d).cv for u, d in ((0.2, 0.0), (0.1, 0.01))]
    np.testing.assert_allclose(
        stepped, plant.run(plant.init(), np.array([[0.2], [0.1]]), np.array([0.0, 0.01]))[1].cv, rtol=1e-12
    )


@pytest.mark.parametrize(
    ("more", "field"),
    [
        ({"state": [1.0, 1.0]}, "plant.state"),
        ({"guess": [1.0, float("nan")]}, "plant.guess"),
        ({"rates": levels}, "plant.rates"),
        ({"outputs": lambda x, u, d, p: x[0]}, "plant.outputs"),
        ({"mv": []}, "plant.mv"),
        ({"substep": 3.0}, "plant.dt"),
        ({"actuators": [Actuator()] * 2}, "actuators"),
        ({"parameters": [AREA, Parameter("valve", "1", -1.0, low=0.0)]}, "plant.valve"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(more, field):
    with pytest.raises(InputError) as caught:
        tanks(**more)
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"are": 1.0}, "plant.are: .* Did you mean area"),
        ({"area": 0.0}, r"plant.area: .* positive number \[m2\]"),
        ({"valve": [0.1, -0.1]}, r"plant.valve: .* \[m3/s/m\^0.5\], 0 or more"),
    ],
)
def test_parameters_that_cannot_be_are_refused(values, told):
    with pytest.raises(InputError, match=told):
        tanks().replaced(values)
