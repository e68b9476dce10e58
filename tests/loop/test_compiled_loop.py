"""Closed loops in compiled calls of many samples: the same run as the loop that asks the host at every sample."""

import numpy as np
import pytest

from identify.step_test import identify_step_response
from jaxmpc import status
from jaxmpc.controller import measurement
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.loop import compiled
from jaxmpc.loop.simulate import simulate, simulate_batch
from jaxmpc.loop.trajectory import RECORDABLE
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant
from studies.thesis.well import WELL

SAMPLES = 90  # more than one call of the longest length
PLANT = WellPlant(actuator="step")
REFERENCE = Reference([0, 200], [[11013, 185], [9640, 152]], 10.0 * SAMPLES)


@pytest.fixture(scope="module")
def model():
    return identify_step_response(PLANT.with_actuator("continuous"))


def controller(model, blocking="moves", preset="thesis", **options):
    structure = WELL.structure(blocking, integer=True)
    tuning = WELL.tuning(structure, preset, {"measurement_low": {"gas_rate": None, "oil_rate": 20.0}})
    return Controller(structure, tuning, model, **options)


def both(monkeypatch, made, **options):
    """The run in compiled calls, and sample by sample."""
    together = simulate(made, PLANT, REFERENCE, keep_plans=True, **options)
    with monkeypatch.context() as patch:
        patch.setattr(Controller, "compiled", False)
        return together, simulate(made, PLANT, REFERENCE, keep_plans=True, **options)


FAULTS = (
    measurement.SensorFault("gas_rate", "missing", 250.0, 100.0),
    measurement.SensorFault("oil_rate", "frozen", 300.0, 150.0),
    measurement.SensorFault("oil_rate", "spike", 600.0, size=-200.0),
)


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_a_compiled_loop_gives_the_run_of_single_steps(monkeypatch, model, blocking):
    disturbance = np.where(np.arange(SAMPLES) > 40, -3.0, 0.0)
    made = controller(model, blocking)
    run, steps = both(
        monkeypatch,
        made,
        disturbance=disturbance,
        noise=[20.0, 0.3],
        seed=3,
        faults=measurement.fault_errors(made.structure, SAMPLES, FAULTS),
        position_feedback=True,
    )
    assert (run.quality[25:35, 0] == measurement.MISSING).all()
    assert (run.quality[:, 1] == measurement.OUTSIDE).tolist() == (np.arange(SAMPLES) == 60).tolist()
    assert np.isfinite(run.cv).all()  # what sensors without fault measure
    assert set(np.unique(steps.finished_by)) >= {status.finisher_code("relaxation")}
    assert (steps.finished_by != status.finisher_code("relaxation")).any(), "no sample was searched"
    for field in (*RECORDABLE, "plan"):
        one, other = getattr(run, field), getattr(steps, field)
        if field in ("status", "fallback", "nodes", "finished_by", "quality", "off"):
            np.testing.assert_array_equal(one, other, err_msg=field)
        elif field == "gap":
            assert (one <= 1e-6).all()
        elif field != "solve_time":
            # sums of some hundred terms are rounded in another order, and the loop feeds that back
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8, err_msg=field)
    np.testing.assert_array_equal(run.mv_demand[:, 0], steps.mv_demand[:, 0])
    assert (run.solve_time > 0).all()


def test_progress_counts_every_sample_once(model):
    seen = []
    simulate(controller(model), PLANT, REFERENCE, samples=70, progress=lambda *given: seen.append(given))
    done = [entry[0] for entry in seen]
    assert done == sorted(done)
    assert seen[-1] == (70, 70)


def test_a_run_shorter_than_one_call_has_its_own_length(model):
    run = simulate(controller(model), PLANT, REFERENCE, samples=3)
    whole = simulate(controller(model), PLANT, REFERENCE, samples=40)
    assert run.samples == 3
    np.testing.assert_array_equal(run.cv, whole.cv[:3])


def test_a_controller_whose_finish_is_prescribed_searches_by_it_alone(monkeypatch, model):
    run, steps = both(monkeypatch, controller(model, finish="branch-and-bound"), samples=25)
    assert (run.status == status.OPTIMAL).all()
    ways = {status.finisher_code(name) for name in ("relaxation", "branch-and-bound")}
    assert set(run.finished_by.tolist()) == ways
    np.testing.assert_array_equal(run.finished_by, steps.finished_by)
    np.testing.assert_array_equal(run.mv_demand[:, 0], steps.mv_demand[:, 0])


@pytest.mark.slow
def test_many_loops_do_not_depend_on_how_many_threads_and_parts_there_are(monkeypatch, model):
    """Three parts of two, the last filled up, by one thread and by three; and each loop alone."""
    structure = WELL.structure("moves", integer=True)
    weights = [150.0, 600.0, 300.0, 2000.0, 80.0]
    tunings = [
        WELL.tuning(structure, changes={"move_weight": {"choke": w, "gas_lift": 0.2}}) for w in weights
    ]
    monkeypatch.setattr(compiled, "TOGETHER", 2)
    runs, seen = {}, []
    for threads in ("1", "3"):
        monkeypatch.setenv("JAXMPC_THREADS", threads)
        controllers = Controllers(structure, tunings, [model])
        progress = lambda done, total: seen.append((done, total))  # noqa: E731
        runs[threads] = simulate_batch(controllers, PLANT, REFERENCE, samples=60, progress=progress)
        assert seen[-1] == (5 * 60, 5 * 60)
        assert [done for done, _ in seen] == sorted(done for done, _ in seen)
        seen.clear()
    for tuning, one, three in zip(tunings, runs["1"], runs["3"], strict=True):
        for field in RECORDABLE:
            if field != "solve_time":
                np.testing.assert_array_equal(getattr(one, field), getattr(three, field), err_msg=field)
        alone = simulate(Controller(structure, tuning, model), PLANT, REFERENCE, samples=60)
        np.testing.assert_array_equal(alone.mv_demand[:, 0], one.mv_demand[:, 0])
        # sums are rounded in another order, and the loop feeds that back
        np.testing.assert_allclose(alone.cv, one.cv, rtol=1e-8)
        assert (one.solve_time > 0).all()


def test_what_one_thread_raises_ends_all(monkeypatch, model):
    monkeypatch.setattr(compiled, "TOGETHER", 1)
    monkeypatch.setenv("JAXMPC_THREADS", "2")
    structure = WELL.structure("moves", integer=True)
    controllers = Controllers(structure, [WELL.tuning(structure)], [model], count=2)

    def interrupt(done, total):
        if done > 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_batch(controllers, PLANT, REFERENCE, progress=interrupt)
