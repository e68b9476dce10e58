"""Closed loops whose choke has a list of positions and a minimum dwell: in compiled calls, on the host, and side by side."""

import dataclasses

import numpy as np
import pytest

from identify.step_test import identify_step_response
from jaxmpc import status
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.loop.simulate import simulate, simulate_batch
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant
from studies.thesis.well import WELL

SAMPLES, DWELL = 70, 4
LISTED = (10.0, 30.0, 40.0, 46.0, 50.0, 52.0, 60.0, 80.0)
PLANT = WellPlant()
REFERENCE = Reference([0, 100], [[11013, 185], [9640, 152]], 10.0 * SAMPLES)


@pytest.fixture(scope="module")
def model():
    return identify_step_response(PLANT)


def structure_of(values=LISTED, dwell=DWELL):
    base = WELL.structure("inputs", integer=True)
    given = dict(integer_step=(), integer_values=(values, None)) if values else {}
    return dataclasses.replace(base, **given, dwell=(dwell, 1))


def tuning_of(structure, weight=5.0):
    limits = {
        "move_low": {"choke": -20.0, "gas_lift": -200.0},
        "move_high": {"choke": 20.0, "gas_lift": 200.0},
    }
    changes = {"move_weight": {"choke": weight, "gas_lift": 0.2}, "oscillation_rows": {"choke": False}}
    return WELL.tuning(structure, changes=changes | limits)


def controller(model, structure, **options):
    return Controller(structure, tuning_of(structure), model, **options)


def assert_kept(run, values, dwell):
    """Demands are in the list, and moves are apart."""
    if values:
        assert np.abs(run.mv_demand[:, 0, None] - np.array(values)).min(axis=1).max() < 1e-9
    at = np.flatnonzero(run.move[:, 0])
    assert len(at) > 1
    assert np.diff(at).min() >= dwell


def test_a_compiled_loop_keeps_list_and_dwell_and_is_the_loop_of_single_steps(monkeypatch, model):
    made = controller(model, structure_of())
    run = simulate(made, PLANT, REFERENCE, position_feedback=True)
    with monkeypatch.context() as patch:
        patch.setattr(Controller, "compiled", False)
        steps = simulate(made, PLANT, REFERENCE, position_feedback=True)
    assert (run.status == status.OPTIMAL).all()
    assert run.gap.max() <= 1e-6
    assert_kept(run, LISTED, DWELL)
    np.testing.assert_array_equal(run.mv_demand[:, 0], steps.mv_demand[:, 0])
    np.testing.assert_array_equal(run.finished_by, steps.finished_by)
    np.testing.assert_allclose(run.cv, steps.cv, rtol=1e-8)


def test_lanes_with_and_without_lists_and_dwell_are_each_alone(model):
    structures = [structure_of(), structure_of(None, 1), structure_of(None, 6), structure_of(dwell=1)]
    tunings = [tuning_of(s) for s in structures]
    runs = simulate_batch(Controllers(structures, tunings, model), PLANT, REFERENCE, samples=40)
    for structure, tuning, run in zip(structures, tunings, runs, strict=True):
        alone = simulate(Controller(structure, tuning, model), PLANT, REFERENCE, samples=40)
        np.testing.assert_array_equal(run.mv_demand[:, 0], alone.mv_demand[:, 0])
        np.testing.assert_allclose(run.cv, alone.cv, rtol=1e-7)
        values = structure.integer_values[0] if structure.integer_values else None
        assert_kept(run, values, structure.dwell[0] if structure.dwell else 1)


def test_an_evenly_spaced_list_closes_the_loop_of_its_step_in_compiled_calls(model):
    stepped = structure_of(None, 1)
    even = structure_of(tuple(np.arange(10.0, 91.0, 2.0)), 1)
    limits = {"mv_low": {"choke": 10.0, "gas_lift": 0.0}, "mv_high": {"choke": 90.0, "gas_lift": 10000.0}}
    tuning = WELL.tuning(stepped, changes=limits)
    runs = [
        simulate(Controller(structure, own, model), PLANT, REFERENCE)
        for structure, own in ((stepped, tuning), (even, WELL.tuning(even)))
    ]
    for field in ("mv_demand", "cv", "objective", "nodes", "finished_by"):
        np.testing.assert_array_equal(getattr(runs[0], field), getattr(runs[1], field), err_msg=field)
