"""What changes while a loop runs: the same in compiled loops, on the host, in batches and by hand; nothing is compiled."""

import jax
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.core import without
from jaxmpc.controller.measurement import SensorFault, fault_errors
from jaxmpc.errors import InputError
from jaxmpc.loop import compiled
from jaxmpc.loop.events import Event
from jaxmpc.loop.simulate import simulate, simulate_batch
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.process.host import HostPlant
from jaxmpc.process.model_plant import ModelPlant
from jaxmpc.process.reference import Reference
from tests.five_controllers import START

SAMPLES, DT = 80, 10.0
CV, MV = START
REFERENCE = Reference([0.0, 100.0], [CV, np.add(CV, [600.0, 6.0])], SAMPLES * DT)
HIGHER = np.add(CV, [400.0, 5.0])
EVENTS = (
    Event(95.0, {"deadzone": {"oil": 0.5}, "move_weight": {"choke": 20.0}, "cv_high": {"gas": None}}),
    Event(200.0, cv_off=["gas"], mv_off=["lift"]),
    Event(200.0, {"cv_weight": {"gas": 5e-4}}),  # of a CV that is off: holds when it is back
    Event(450.0, {"cv_high": {"oil": 189.0}}, cv_on=["gas"], mv_on=["lift"]),
)
EXACT = dict(rtol=1e-6, atol=1e-4)  # a continuous solve repeats to about 1e-6 of a move limit


@pytest.fixture
def plant(well_like_model):
    return ModelPlant(well_like_model, start=dict(gas=CV[0], oil=CV[1], choke=MV[0], lift=MV[1]))


@pytest.fixture
def compilations():
    """Programs that are compiled from now on."""
    found = []
    listen = lambda event, _, **__: found.append(event) if "backend_compile" in event else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)


def tunings_by_hand(structure, fields):
    """From which sample on which tuning holds, and which CVs and MVs are off."""
    rows = {"oscillation_rows": {"choke": True}} if structure.integer_mvs else {}
    tuned = lambda **changes: make_tuning(structure, **fields | changes, **rows)  # noqa: E731
    gas, lift = np.array([True, False]), np.array([False, True])
    first = dict(deadzone=[1000.0, 0.5], move_weight=[20.0, 0.2], cv_high=[None, 400.0])
    last = first | dict(cv_weight=[5e-4, 0.1], cv_high=[None, 189.0])
    none = np.zeros(2, dtype=bool)
    return {
        0: (tuned(), none, none),
        10: (tuned(**first), none, none),
        20: (tuned(**first | dict(cv_weight=[5e-4, 0.1])), gas, lift),
        45: (tuned(**last), none, none),
    }


@pytest.mark.parametrize(
    "kind",
    [
        "continuous",
        "mixed-integer",
        pytest.param("scheduled", marks=pytest.mark.slow),
        "scheduled-mixed-integer",
    ],
)
def test_a_loop_with_events_is_the_controller_stepped_by_hand(made, plant, thesis_fields, kind):
    start = made(kind)
    run = simulate(start, plant, REFERENCE, events=EVENTS, keep_plans=True)
    stages = tunings_by_hand(start.structure, thesis_fields)
    setpoints, process, state = REFERENCE.sample(DT), HostPlant(plant), start.init(CV, MV)
    outputs = process.init()
    for k in range(SAMPLES):
        if k in stages:
            tuning, off, manual = stages[k]
            controller = start.with_tuning(tuning)
        state, info = controller.step(state, outputs.cv, setpoints[k], manual=manual, cv_off=off)
        np.testing.assert_allclose(run.mv_demand[k], info.mv, **EXACT, err_msg=str(k))
        np.testing.assert_allclose(run.objective[k], info.objective, rtol=1e-4, atol=1e-6)
        outputs = process.step(info.mv)
    assert not run.fallback.any()
    assert not run.move[20:45, 1].any()
    assert np.abs(run.move[45:, 1]).max() > 1.0
    assert np.ptp(run.mv[:, 0]) >= 2.0
    assert run.cv[-1, 1] < 189.5  # the limit that came last, below the setpoint


def test_a_compiled_loop_with_events_is_the_loop_on_the_host(made, plant):
    one, two = (
        simulate(made("mixed-integer"), it, REFERENCE, events=EVENTS) for it in (plant, HostPlant(plant))
    )
    for field in ("cv", "mv", "mv_demand", "bias"):
        np.testing.assert_allclose(getattr(one, field), getattr(two, field), **EXACT, err_msg=field)
    np.testing.assert_array_equal(one.status, two.status)
    np.testing.assert_array_equal(one.finished_by, two.finished_by)


def test_lanes_with_events_of_their_own_are_each_alone(
    well_like_model, small_structure, thesis_fields, plant, monkeypatch, compilations
):
    structure, tuning = small_structure, make_tuning(small_structure, **thesis_fields)
    lists = [EVENTS, (), [Event(300.0, {"soft_linear": 0.0}, mv_off=["choke"])]]
    controller = Controller(structure, tuning, well_like_model)
    monkeypatch.setattr(compiled, "TOGETHER", 2)  # two parts, the last filled up
    lanes = simulate_batch(controller, plant, REFERENCE, events=lists)
    for lane, events in zip(lanes, lists, strict=True):
        alone = simulate(controller, plant, REFERENCE, events=events)
        np.testing.assert_allclose(lane.mv_demand, alone.mv_demand, **EXACT)
    assert np.abs(lanes[0].mv - lanes[1].mv).max() > 1.0
    both = Controllers(structure, [tuning, tuning], well_like_model)
    for lane in simulate_batch(both, plant, REFERENCE, events=EVENTS):
        np.testing.assert_allclose(lane.mv_demand, lanes[0].mv_demand, **EXACT)
    compilations.clear()
    simulate_batch(controller, plant, REFERENCE, events=[lists[2], lists[0], ()])
    simulate(controller, plant, REFERENCE, events=[*EVENTS, Event(600.0, {"cv_weight": 0.05})])
    assert not compilations


def test_another_tuning_compiles_nothing(made, thesis_fields, compilations):
    one = made("mixed-integer")
    state, _ = one.step(one.init(CV, MV), CV, CV)
    other = one.with_tuning(make_tuning(one.structure, **thesis_fields | {"move_weight": [50.0, 0.1]}))
    other.step(state, CV, HIGHER)
    gas = np.array([True, False])
    compilations.clear()
    changed = one.with_tuning(make_tuning(one.structure, **thesis_fields | {"move_weight": [60.0, 0.1]}))
    _, info = changed.step(state, CV, HIGHER, cv_off=gas)
    assert not compilations
    expected = Controller(one.structure, without(changed.tuning, gas), one.model).step(state, CV, HIGHER)
    np.testing.assert_allclose(info.move, expected[1].move, atol=1e-4)
    np.testing.assert_array_equal(one.tuning.move_weight, thesis_fields["move_weight"])


@pytest.mark.parametrize(
    ("events", "field"),
    [
        ([Event(-10.0)], "events[0].time"),
        ([Event(SAMPLES * DT)], "events[0].time"),
        ([Event(np.nan)], "events[0].time"),
        ([Event(100.0), Event(50.0)], "events[1].time"),
        ([Event(0.0, {"cv_wieght": 1.0})], "events[0].tuning.cv_wieght"),
        ([Event(0.0, {"deadzone": {"water": 1.0}})], "events[0].tuning.deadzone.water"),
        ([Event(0.0, {"deadzone": {"oil": -1.0}})], "events[0].tuning.deadzone[1]"),
        (
            [Event(0.0, {"cv_low": {"oil": 390.0}}), Event(5.0, {"cv_high": {"oil": 380.0}})],
            "events[1].tuning.cv_low[1]",
        ),
        ([Event(0.0, 3.0)], "events[0].tuning"),
        ([Event(0.0, cv_off=["water"])], "events[0].cv_off"),
        ([Event(0.0, mv_on="lift")], "events[0].mv_on"),
        ([Event(0.0, cv_off=["oil"], cv_on=["oil"])], "events[0].cv_on"),
        ([(0.0, {})], "events[0][0]"),
    ],
)
def test_an_event_that_does_not_fit_is_refused_before_the_run(made, plant, events, field):
    with pytest.raises(InputError) as error:
        simulate(made("continuous"), plant, REFERENCE, events=events)
    assert error.value.field == field


def test_events_of_another_number_of_lanes_and_open_loops_before_them_are_refused(made, plant):
    with pytest.raises(InputError, match=r"^lanes"):
        simulate_batch(made("continuous"), plant, [REFERENCE] * 3, events=[EVENTS, EVENTS])
    with pytest.raises(InputError, match=r"^open_loop_from"):
        simulate(made("continuous"), plant, REFERENCE, events=EVENTS, open_loop_from=440.0)


def test_setpoints_behind_a_lag_or_a_ramp():
    steps = Reference([0.0, 20.0], [[1.0, 10.0], [5.0, 8.0]], 65.0)
    lagged = steps.filtered([30.0, 0.0], 10.0).sample(10.0)
    np.testing.assert_allclose(lagged[2:, 0], 5 - 4 * np.exp(-np.arange(1, 5) / 3))
    np.testing.assert_array_equal(lagged[:, 1], steps.sample(10.0)[:, 1])
    ramped = steps.ramped([0.15, np.inf], 10.0)
    np.testing.assert_allclose(ramped.sample(10.0)[:, 0], [1.0, 1.0, 2.5, 4.0, 5.0, 5.0])
    np.testing.assert_array_equal(ramped.sample(10.0)[:, 1], steps.sample(10.0)[:, 1])
    assert (ramped.duration, len(ramped.times)) == (60.0, 4)
    for wrong in (-1.0, [1.0, 2.0, 3.0], np.inf, "slow"):
        with pytest.raises(InputError, match="time_constant"):
            steps.filtered(wrong, 10.0)
    with pytest.raises(InputError, match="rate"):
        steps.ramped(np.nan, 10.0)


@pytest.mark.slow
def test_lanes_that_lose_cvs_of_their_own_are_each_alone(
    well_like_model, small_structure, thesis_fields, plant
):
    changed = {"move_weight": [2.5, 0.002], "bad_limit": [3, None]}
    tuning = make_tuning(small_structure, **thesis_fields | changed)
    controller = Controller(small_structure, tuning, well_like_model, finish="branch-and-bound")
    lost = fault_errors(small_structure, 40, [SensorFault("gas", "missing", 50.0, 200.0)])
    both, left = [np.zeros_like(lost), lost], set()
    lanes = simulate_batch(controller, plant, REFERENCE, samples=40, faults=np.stack(both))
    for lane, faults in zip(lanes, both, strict=True):
        alone = simulate(controller, plant, REFERENCE, samples=40, faults=faults)
        np.testing.assert_allclose(lane.mv_demand, alone.mv_demand, **EXACT)
        left |= set(lane.finished_by[lane.off[:, 0]].tolist())
    assert status.finisher_code("branch-and-bound") in left
