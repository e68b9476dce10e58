"""Mixed-integer controllers that advance together, against the same controllers alone."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.loop.simulate import simulate, simulate_batch
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant

START = np.array([11000.0, 185.0]), np.array([50.0, 7500.0])


def tunings_of(structure, fields):
    """Three tunings: the given one, one with a light and one with a free choke."""
    weights = (fields["move_weight"], [1.0, fields["move_weight"][1]], [0.0, fields["move_weight"][1]])
    return [make_tuning(structure, **(fields | {"move_weight": weight})) for weight in weights]


def loop(controller, setpoints, *, together):
    """Ten samples against measurements that do not depend on the moves: the same input for every controller."""
    count = len(setpoints)
    cv, mv = (np.repeat(v[None], count, axis=0) for v in START)
    state = controller.init(cv if together else cv[0], mv if together else mv[0])
    infos = []
    for k in range(10):
        measured = cv + np.array([150.0, -2.0]) * np.sin(0.5 * k)
        if together:
            state, info = controller.step(state, measured, setpoints)
        else:
            state, info = controller.step(state, measured[0], setpoints[0])
        infos.append(info)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *infos)


@pytest.mark.slow
def test_each_of_several_tunings_does_what_it_does_alone(well_like_model, small_structure, thesis_fields):
    tunings = tunings_of(small_structure, thesis_fields)
    setpoints = START[0] + np.array([[900.0, 6.0], [-700.0, -4.0], [300.0, 3.0]])
    together = loop(Controllers(small_structure, tunings, [well_like_model]), setpoints, together=True)
    for i, tuning in enumerate(tunings):
        controller = Controller(small_structure, tuning, well_like_model)
        alone = loop(controller, setpoints[i : i + 1], together=False)
        assert (together.status[:, i] == status.OPTIMAL).all()
        assert (alone.status == status.OPTIMAL).all()
        # each is solved to a relative gap of 1e-6, and ties may fall either way
        assert together.objective[:, i] == pytest.approx(alone.objective, rel=3e-6)
        assert together.mv[:, i, 0] == pytest.approx(alone.mv[:, 0], abs=1e-9)
    assert len({tuple(together.mv[:, i, 0]) for i in range(3)}) > 1


@pytest.mark.slow
def test_each_of_several_models_does_what_it_does_alone(well_like_model, small_structure, small_tuning):
    models = [
        dataclasses.replace(well_like_model, coefficients=factor * well_like_model.coefficients)
        for factor in (0.8, 1.0, 1.3)
    ]
    setpoints = np.repeat(START[0][None] + np.array([900.0, 6.0]), 3, axis=0)
    together = loop(Controllers(small_structure, [small_tuning], models), setpoints, together=True)
    for i, model in enumerate(models):
        alone = loop(Controller(small_structure, small_tuning, model), setpoints[i : i + 1], together=False)
        assert together.objective[:, i] == pytest.approx(alone.objective, rel=3e-6)
        assert together.mv[:, i, 0] == pytest.approx(alone.mv[:, 0], abs=1e-9)


@pytest.mark.slow
def test_time_is_charged_to_the_scenario_that_needs_it(well_like_model, small_structure, small_tuning):
    controllers = Controllers(
        small_structure, [small_tuning], [well_like_model], count=3, time_limit=0.0, finish="branch-and-bound"
    )
    cv, mv = (np.repeat(v[None], 3, axis=0) for v in START)
    _, info = controllers.step(controllers.init(cv, mv), cv, cv + np.array([900.0, 6.0]))
    assert (info.solve_time > 0).all()
    assert not info.fallback.any()
    assert set(info.status.tolist()) <= {status.OPTIMAL, status.LIMIT}


def test_counts_that_do_not_fit_are_refused(well_like_model, small_structure, small_tuning):
    with pytest.raises(InputError, match="tunings"):
        Controllers(small_structure, [small_tuning] * 2, [well_like_model] * 3)
    with pytest.raises(InputError, match="tunings"):
        Controllers(small_structure, [], [well_like_model])
    controllers = Controllers(small_structure, [small_tuning] * 2, [well_like_model])
    with pytest.raises(InputError, match="cv"):
        controllers.init(START[0], START[1])


def test_loops_that_advance_together_are_those_of_each_controller(
    well_like_model, small_structure, small_tuning
):
    reference = Reference([0.0, 100.0], START[0] + np.array([[0.0, 0.0], [900.0, 6.0]]), 400.0)
    controllers = Controllers(small_structure, [small_tuning], [well_like_model], count=2)
    plant = WellPlant(actuator="step")
    noise = np.array([20.0, 0.2])
    runs = simulate_batch(controllers, plant, reference, noise=noise, seed=np.array([3, 5]))
    for seed, run in zip((3, 5), runs, strict=True):
        controller = Controller(small_structure, small_tuning, well_like_model)
        alone = simulate(controller, plant, reference, noise=noise, seed=seed)
        assert run.cv == pytest.approx(alone.cv, rel=1e-7)
        assert run.mv[:, 0] == pytest.approx(alone.mv[:, 0], abs=1e-9)
        assert run.finished_by.min() > 0
        assert (run.solve_time > 0).all()
    assert np.abs(runs[0].cv - runs[1].cv).max() > 1.0
