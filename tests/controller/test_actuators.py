"""Controllers of actuators with lists and a dwell: what they remember, and how they come back to their lists."""

import dataclasses

import numpy as np
import pytest

from jaxmpc.controller.checkpoint import load_controller, save_controller
from jaxmpc.controller.controller import Controller
from jaxmpc.problem.tuning import make_tuning
from tests.five_controllers import Process

LISTED = (10.0, 30.0, 40.0, 46.0, 50.0, 60.0, 100.0)
DWELL = 5
CV = np.array([11000.0, 185.0])
FAR = np.array([12500.0, 215.0])


@pytest.fixture(scope="module")
def made_of(well_like_model, small_structure, thesis_fields):
    """Controllers by list, dwell and changed tuning fields, each made once."""
    known = {}

    def get(values=LISTED, dwell=DWELL, **more):
        key = values, dwell, repr(sorted(more.items()))
        if key not in known:
            given = dict(integer_step=(), integer_values=(values, None)) if values else {}
            structure = dataclasses.replace(small_structure, blocking="inputs", dwell=(dwell, 1), **given)
            wide = {"move_low": [-25.0, -200.0], "move_high": [25.0, 200.0], "move_weight": [1.0, 0.2]}
            known[key] = Controller(
                structure, make_tuning(structure, **thesis_fields | wide | more), well_like_model
            )
        return known[key]

    return get


def run_of(controller, process, state, samples, setpoint=FAR, told=True, **given):
    """States and infos of a loop, and the demands of the choke."""
    infos = []
    for _ in range(samples):
        state, info = controller.step(state, process.cv, setpoint, process.mv if told else None, **given)
        process.step(np.asarray(info.mv))
        infos.append(info)
    return state, infos


def moves_of(infos):
    return np.array([float(info.move[0]) for info in infos])


def test_moves_are_apart_and_demands_in_the_list_while_the_setpoint_turns(made_of, well_like_model):
    controller, process = made_of(), Process(well_like_model)
    state, all_infos = controller.init(process.cv, process.mv), []
    for k in range(8):
        state, infos = run_of(controller, process, state, 3, FAR if k % 2 else CV - [1500.0, 30.0])
        all_infos += infos
    at = np.flatnonzero(moves_of(all_infos))
    assert len(at) > 2
    assert np.diff(at).min() >= DWELL
    assert {float(info.mv[0]) for info in all_infos} <= set(LISTED)
    assert all(int(info.status) == 0 for info in all_infos)
    assert not any(bool(info.recovering) or bool(info.fallback) for info in all_infos)


@pytest.mark.parametrize(
    ("values", "found", "back"),
    [(LISTED, 51.0, 50.0), (LISTED, 92.0, 100.0), ((50.0, 60.0, 70.0), 56.0, 60.0)],
)
def test_an_mv_between_its_values_goes_to_the_nearest_one_and_it_is_said(
    made_of, well_like_model, values, found, back
):
    controller, process = made_of(values, 3, mv_high=[100.0, 10000.0]), Process(well_like_model)
    process.mv[0] = found
    state = controller.init(process.cv, process.mv)
    state, (info,) = run_of(controller, process, state, 1, CV)
    assert bool(info.recovering)
    assert not bool(info.fallback)
    assert float(info.mv[0]) == back
    assert float(info.move[0]) == back - found
    state, infos = run_of(controller, process, state, 4, FAR)
    assert not any(bool(i.recovering) for i in infos)
    assert {float(i.mv[0]) for i in infos} <= set(values)
    if values == LISTED:  # half a step or more: the way back is a move
        assert (moves_of(infos)[: 3 - 1] == 0).all()
    assert np.abs(np.asarray(state.bias_raw)).max() < 1e-6  # and is predicted


def test_float_drift_is_no_recovery_and_a_sensor_that_is_a_little_off_no_move(made_of, well_like_model):
    controller, process = made_of(), Process(well_like_model)
    state = controller.init(process.cv, process.mv)
    state, info = controller.step(state, process.cv, CV, np.add(process.mv, [1e-9, 0.0]))
    assert not bool(info.recovering)
    for _ in range(3):
        state, info = controller.step(state, process.cv, CV, np.add(process.mv, [0.01, 0.0]))
    assert float(info.mv[0]) == 50.0
    state, info = controller.step(state, process.cv, FAR, np.add(process.mv, [0.01, 0.0]))
    assert float(info.mv[0]) != 50.0  # it has rested


def test_an_mv_outside_its_limits_comes_back_by_allowed_values(made_of, well_like_model):
    limits = {"mv_high": [55.0, 10000.0], "move_low": [-45.0, -200.0]}
    for dwell, expected in ((1, [60.0, 50.0]), (3, [60.0, 60.0, 60.0, 50.0])):
        controller, process = made_of(LISTED, dwell, **limits), Process(well_like_model)
        process.mv[0] = 100.0
        state = controller.init(process.cv, process.mv)
        state, infos = run_of(controller, process, state, len(expected), np.add(CV, [3000.0, 40.0]))
        assert [float(info.mv[0]) for info in infos] == expected
        assert all(bool(info.recovering) for info in infos)
        assert not any(bool(info.fallback) for info in infos)


def test_an_mv_outside_its_limits_waits_for_its_dwell_and_the_others_go_on(made_of, well_like_model):
    controller, process = made_of(LISTED, DWELL, mv_high=[55.0, 10000.0]), Process(well_like_model)
    state = controller.init(process.cv, process.mv)
    state, _ = run_of(controller, process, state, 1, CV)
    process.mv[0] = 60.0  # somebody opens it by hand, beyond its limit, and gives it back at once
    state, infos = run_of(controller, process, state, DWELL, FAR)
    assert (moves_of(infos)[: DWELL - 1] == 0).all()
    assert moves_of(infos)[-1] == -10.0
    assert not any(bool(info.fallback) for info in infos)
    assert any(abs(float(info.move[1])) > 0 for info in infos[: DWELL - 1])


def test_a_move_by_hand_counts_for_the_dwell(made_of, well_like_model):
    controller, process = made_of(), Process(well_like_model)
    state = controller.init(process.cv, process.mv)
    state, info = controller.step(state, process.cv, CV, process.mv, np.array([True, False]))
    process.mv[0] = 37.0  # and off the list, which nobody asks of it in manual
    state, info = controller.step(state, process.cv, FAR, process.mv, np.array([True, False]))
    assert not bool(info.recovering)
    assert float(info.mv[0]) == 37.0
    process.mv[0] = 40.0
    state, infos = run_of(controller, process, state, DWELL, FAR)
    assert (moves_of(infos)[: DWELL - 1] == 0).all()
    assert moves_of(infos)[-1] != 0


def test_a_controller_that_is_restarted_remembers_its_last_move(made_of, well_like_model, tmp_path):
    controller, process = made_of(), Process(well_like_model)
    state = controller.init(process.cv, process.mv)
    state, (info,) = run_of(controller, process, state, 1)
    assert float(info.move[0]) != 0
    again, restored = load_controller(save_controller(controller, tmp_path / "valve.json", state))
    assert again.structure == controller.structure
    twin = Process(well_like_model)
    twin.__dict__ |= {
        key: np.copy(v) if isinstance(v, np.ndarray) else v for key, v in process.__dict__.items()
    }
    back = CV - [3000.0, 60.0]
    _, infos = run_of(again, process, restored, DWELL, back)
    _, same = run_of(controller, twin, state, DWELL, back)
    assert (moves_of(infos)[: DWELL - 1] == 0).all()
    assert moves_of(infos)[-1] != 0
    np.testing.assert_array_equal(moves_of(infos), moves_of(same))
