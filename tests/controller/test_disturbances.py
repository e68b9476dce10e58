"""Measured disturbances are fed forward: against superposition with NumPy, and against single steps with that forecast."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.checkpoint import load_controller, save_controller
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.plan import solve_plan
from jaxmpc.controller.schedule import make_schedule
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import make_model
from tests.conftest import second_order
from tests.five_controllers import START, tuned

RATE, TEMPERATURE = 0, 1  # the DVs
SETPOINT = START[0] + [400.0, -3.0]


@pytest.fixture(scope="module")
def model(well_like_model):
    responses = [
        [(5.0, 100.0, 20.0, 300.0), (-8.0, 200.0, 30.0, 0.0)],
        [(0.1, 90.0, 60.0, 0.0), (0.3, 150.0, 12.0, 350.0)],
    ]
    of_dvs = [[second_order(*entry, samples=60) for entry in row] for row in responses]
    named = dict(dv_names=["rate", "temperature"], dv_units=["m3/h", "degC"])
    m = well_like_model
    return make_model(m.coefficients, m.dt, m.cv_names, m.mv_names, dv_coefficients=of_dvs, **named)


@pytest.fixture(scope="module")
def controller(model, small_structure, thesis_fields):
    structure = small_structure.relaxed()
    return Controller(structure, tuned(structure, thesis_fields), model)


def superposed(model, moves, changes, samples):
    """CVs at samples 0, 1, ... after moves ``"sample mv"`` and changes of the DVs ``"sample dv"``."""
    cv = np.tile(START[0], (samples, 1))
    for steps, given in ((model.coefficients, moves), (model.dv_coefficients, changes)):
        steps = np.asarray(steps)
        for k, change in enumerate(given):
            for later in range(k + 1, samples):
                cv[later] += steps[..., min(later - k, steps.shape[-1]) - 1] @ change
    return cv


def driven(controller, model, dv, told):
    """A loop on the model itself: its states, infos and moves; `told(k)` is what the controller hears at sample k."""
    state, states, infos, moves = controller.init(*START), [], [], []
    changes = np.diff(dv, axis=0, prepend=np.zeros((1, 2)))
    for k in range(len(dv)):
        cv = superposed(model, np.reshape(moves, (-1, 2)), changes[:k], k + 1)[k]
        state, info = controller.step(state, cv, SETPOINT, dv=told(k))
        moves.append(np.asarray(info.move))
        states.append(state)
        infos.append(info)
    return states, infos, np.array(moves)


def stepping(samples=12):
    """Both DVs over time: one steps, the other one ramps."""
    dv = np.zeros((samples, 2))
    dv[3:, RATE], dv[6:, TEMPERATURE] = 40.0, np.arange(samples - 6)
    return dv


def test_a_known_disturbance_leaves_no_bias(controller, model):
    dv = stepping()
    states, infos, _ = driven(controller, model, dv, lambda k: dv[k])
    scale = np.array([400.0, 3.0])
    assert np.abs(np.array([s.bias_raw for s in states]) / scale).max() < 1e-9
    assert all(info.status == 0 for info in infos)
    unknown, _, _ = driven(controller, model, dv, lambda k: None)
    assert np.abs(np.array([s.bias_raw for s in unknown]) / scale).max() > 0.1


@pytest.mark.parametrize("preview", [False, True])
def test_a_step_with_a_disturbance_is_the_step_with_its_free_response(controller, model, preview):
    dv, at, horizon = stepping(60), 5, controller.structure.prediction_horizon
    rows = lambda k: dv[k : k + horizon] if preview else dv[k]  # noqa: E731
    states, infos, moves = driven(controller, model, dv[: at + 1], rows)
    known = dv if preview else np.concatenate([dv[: at + 1], np.tile(dv[at], (len(dv) - at - 1, 1))])
    changes = np.diff(known, axis=0, prepend=np.zeros((1, 2)))
    forecast = superposed(model, moves[:at], changes, at + 1 + horizon)[at + 1 :]
    plan = solve_plan(
        model,
        controller.structure,
        controller.tuning,
        mv_now=states[at - 1].mv,
        last_move=moves[at - 1],
        free_response=forecast,
        setpoint=np.tile(SETPOINT, (horizon, 1)),
    )
    np.testing.assert_allclose(infos[at].moves, plan.moves, atol=1e-4)
    np.testing.assert_allclose(infos[at].objective, plan.objective, rtol=1e-6)


def test_what_is_not_a_number_is_as_before(controller, model):
    dv, horizon = stepping(), controller.structure.prediction_horizon
    held, with_gaps = dv.copy(), dv.copy()
    held[7:9, TEMPERATURE], with_gaps[7:9, TEMPERATURE] = held[6, TEMPERATURE], [np.nan, np.inf]
    _, ours, _ = driven(controller, model, held, lambda k: held[k])
    _, theirs, _ = driven(controller, model, held, lambda k: with_gaps[k])
    np.testing.assert_array_equal([i.move for i in ours], [i.move for i in theirs])
    state = controller.init(*START, dv=[1.0, 2.0])
    rows = np.full((horizon, 2), np.nan)
    rows[3, RATE] = 7.0  # stays so from then on; the other one is never told
    filled = np.tile([1.0, 2.0], (horizon, 1))
    filled[3:, RATE] = 7.0
    for given in (rows, filled):
        _, info = controller.step(state, START[0], SETPOINT, dv=given)
        np.testing.assert_array_equal(
            info.moves, controller.step(state, START[0], SETPOINT, dv=filled)[1].moves
        )
    plain = controller.step(state, START[0], SETPOINT)
    same = controller.step(state, START[0], SETPOINT, dv=[1.0, 2.0])
    np.testing.assert_array_equal(plain[1].moves, same[1].moves)
    assert plain[0].dv.tolist() == [1.0, 2.0]
    assert not np.allclose(plain[1].moves, info.moves)


def test_lanes_and_traced_steps_feed_forward_alike(controller, model, small_structure, thesis_fields):
    structure, horizon = controller.structure, controller.structure.prediction_horizon
    state = controller.init(*START)
    rows = stepping(horizon)
    _, alone = controller.step(state, START[0], SETPOINT, dv=rows)
    _, now = controller.step(state, START[0], SETPOINT, dv=rows[8])
    both = Controllers(structure, [controller.tuning] * 2, model)
    twice = lambda v: np.stack([v, v])  # noqa: E731
    dv = np.stack([rows, np.tile(rows[8], (horizon, 1))])
    _, lanes = both.step(both.init(*map(twice, START)), twice(START[0]), twice(SETPOINT), dv=dv)
    np.testing.assert_allclose(lanes.move, [alone.move, now.move], atol=1e-4)
    traced = jax.jit(lambda *given: controller.step(*given[:3], dv=given[3])[1].move)
    np.testing.assert_allclose(traced(state, START[0], SETPOINT, rows), alone.move, atol=1e-4)


def test_a_saved_controller_knows_its_disturbances(controller, tmp_path):
    weight = np.array([1.0, 0.0])
    aimed = controller.with_tuning(
        dataclasses.replace(controller.tuning, ideal=0.0 * weight, ideal_weight=weight)
    )
    for one in (controller, aimed):
        state, _ = one.step(one.init(*START), START[0], SETPOINT, dv=[3.0, 4.0])
        path = save_controller(one, tmp_path / "controller.json", state)
        again, restored = load_controller(path)
        assert restored.dv.tolist() == [3.0, 4.0]
        steps = [
            c.step(s, START[0], SETPOINT, dv=[5.0, np.nan]) for c, s in ((one, state), (again, restored))
        ]
        np.testing.assert_array_equal(steps[0][1].move, steps[1][1].move)
        body = json.loads(path.read_text())
        del body["state"]["dv"]
        path.write_text(json.dumps(body))
        with pytest.raises(InputError, match=r"controller\.state\.dv"):
            load_controller(path)


def test_disturbances_that_do_not_fit_are_refused(
    controller, model, well_like_model, small_structure, thesis_fields
):
    state = controller.init(*START)
    for wrong in ([1.0], np.zeros((3, 2)), "high"):
        with pytest.raises(InputError, match=r"^dv: .*rate, temperature"):
            controller.step(state, START[0], SETPOINT, dv=wrong)
    with pytest.raises(InputError, match=r"^dv: .*finite"):
        controller.init(*START, dv=[np.nan, 0.0])
    plain = Controller(controller.structure, controller.tuning, well_like_model)
    with pytest.raises(InputError, match=r"^dv: .*no measured disturbances"):
        plain.step(plain.init(*START), START[0], SETPOINT, dv=[1.0])
    with pytest.raises(InputError, match=r"^model\[1\]\.dv"):
        Controllers(controller.structure, controller.tuning, [model, well_like_model])
    working = dataclasses.replace(model, working_point=(("choke", 50.0), ("lift", 7500.0)))
    with pytest.raises(InputError, match=r"^models\[0\]\.dv"):
        make_schedule([working])
