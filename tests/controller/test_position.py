"""Controllers that are told where the actuators stand: no wind-up, manual operation, and a return without a bump."""

import numpy as np
import pytest

from jaxmpc.controller.controller import Controller
from tests.five_controllers import KINDS, SETPOINT, START, Process, closed, stepped, tuned

FAR = np.array([14000.0, 230.0])


@pytest.mark.parametrize("kind", KINDS)
def test_actuators_that_follow_need_not_be_told_of(made, well_like_model, kind):
    told, silent = Process(well_like_model), Process(well_like_model)
    closed(made(kind), told, 12, told=True)
    closed(made(kind), silent, 12)
    np.testing.assert_allclose(told.mv, silent.mv, rtol=1e-9)  # positions are sums in another order


@pytest.mark.parametrize("kind", KINDS)
def test_the_demand_stays_with_a_stuck_actuator_and_goes_on_at_once_when_it_is_free(
    made, well_like_model, kind
):
    free = {"mv_low": [-np.inf, -np.inf], "mv_high": [np.inf, np.inf]}
    controller, process = made(kind, **free), Process(well_like_model)
    process.stuck = 0
    states, infos = closed(controller, process, 100, told=True)
    assert process.mv[0] == 50.0
    ahead = np.array([abs(float(state.mv[0]) - 50.0) for state in states])
    assert ahead.max() <= 2.0 + 1e-9  # one move
    assert not any(bool(info.fallback) for info in infos)
    assert np.abs(np.asarray(states[-1].bias)).max() < 1e-6  # the prediction knows where the choke is
    process.stuck = None
    _, info = stepped(controller, states[-1], process.cv, FAR, mv=process.mv)
    assert float(info.mv[0]) <= 52.0 + 1e-9
    assert float(info.mv[0]) > 50.0


def test_a_demand_that_may_lead_adds_up_small_moves_until_a_step_choke_follows(
    well_like_model, small_structure, thesis_fields
):
    relaxed = small_structure.relaxed()
    moved = {}
    for lead in (0.0, 2.0):
        slow = thesis_fields | {"move_high": [0.5, 200.0], "move_low": [-0.5, -200.0]}
        tuning = tuned(relaxed, slow, demand_lead=[lead, 0.0])
        controller, process = Controller(relaxed, tuning, well_like_model), Process(well_like_model)
        state = controller.init(*START)
        for _ in range(40):
            state, _ = controller.step(state, process.cv, FAR, process.mv)
            choke = (
                process.mv[0]
                if abs(state.mv[0] - process.mv[0]) < 1.6
                else 2.0 * round(float(state.mv[0]) / 2)
            )
            process.step([choke, state.mv[1]])
            assert abs(float(state.mv[0]) - process.mv[0]) <= max(lead, 0.5) + 0.5 + 1e-9
        moved[lead] = process.mv[0] - 50.0
    assert moved[0.0] == 0.0
    assert moved[2.0] >= 2.0


@pytest.mark.parametrize("kind", KINDS)
def test_an_mv_in_manual_is_predicted_and_not_moved_and_comes_back_without_a_bump(
    made, well_like_model, kind
):
    controller, process = made(kind), Process(well_like_model)
    state = controller.init(*START)
    for k in range(20):  # an operator closes the choke to 40 %, faster than the controller may, and holds it
        state, info = stepped(controller, state, process.cv, mv=process.mv, manual=np.array([True, False]))
        assert float(info.move[0]) == 0.0
        assert float(state.mv[0]) == process.mv[0]
        assert not bool(info.fallback)
        process.step([40.0 if k >= 3 else 50.0, state.mv[1]])
    state, info = stepped(controller, state, process.cv, mv=process.mv)
    assert np.abs(np.asarray(state.bias)).max() < 1e-6
    assert not bool(info.fallback)
    assert abs(float(info.mv[0]) - 40.0) <= 2.0 + 1e-9  # from where it is
    assert float(info.mv[0]) > 40.0  # towards the setpoint


def test_an_mv_in_manual_may_stand_outside_its_limits(made, well_like_model):
    for kind in ("continuous", "mixed-integer"):
        controller, process = made(kind), Process(well_like_model)
        process.mv[0] = 120.0
        state = controller.init(*START)
        state, info = stepped(controller, state, START[0], mv=process.mv, manual=np.array([True, False]))
        assert not bool(info.fallback)
        assert not bool(info.recovering)
        assert float(info.mv[0]) == 120.0
        state, info = stepped(controller, state, START[0], mv=process.mv)
        assert bool(info.recovering)
        assert float(info.move[0]) < 0.0


def test_a_position_that_is_not_known_counts_as_the_demand(made):
    controller = made("mixed-integer")
    states = []
    for mv in (None, np.array([np.nan, np.nan])):
        state = controller.init(*START)
        for _ in range(3):
            state, _ = controller.step(state, START[0], SETPOINT, mv)
        states.append(state)
    np.testing.assert_array_equal(states[0].mv, states[1].mv)
    np.testing.assert_array_equal(states[0].future, states[1].future)


def test_predictions_from_the_position_are_those_of_the_moves_that_were_made(well_like_model, made):
    """The shift register equals the superposition of the actual moves, whatever was asked for."""
    controller, process = made("continuous"), Process(well_like_model)
    rng = np.random.default_rng(5)
    state = controller.init(*START)
    for _ in range(15):
        state, _ = controller.step(state, process.cv, FAR, process.mv)
        process.step(np.asarray(state.mv) + rng.normal(size=2) * [1.0, 50.0])
    state, _ = controller.step(state, process.cv, FAR, process.mv)
    # rounding of CVs of 1e4 over 16 moves
    np.testing.assert_allclose(state.bias_raw, 0.0, atol=1e-8)
