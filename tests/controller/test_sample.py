"""What a step and a start accept is the same for all controllers, and what they refuse is named."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.plan import Planner
from jaxmpc.errors import InputError
from tests.five_controllers import KINDS, SETPOINT, START, stepped, tuned


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("field", "cv", "setpoint", "options"),
    [
        ("cv", [[1.0, 2.0]], SETPOINT, {}),
        ("cv", [1.0], SETPOINT, {}),
        ("cv", [1.0, 2.0, 3.0], SETPOINT, {}),
        ("cv", ["many", "few"], SETPOINT, {}),
        ("setpoint", START[0], 12500.0, {}),
        ("setpoint", START[0], [12500.0], {}),
        ("setpoint", START[0], np.ones((39, 2)), {}),
        ("setpoint", START[0], np.ones((40, 1)), {}),
        ("setpoint", START[0], [np.nan, 205.0], {}),
        ("setpoint", START[0], [np.inf, 205.0], {}),
        ("mv", START[0], SETPOINT, {"mv": [50.0]}),
        ("manual", START[0], SETPOINT, {"manual": [True]}),
        ("manual", START[0], SETPOINT, {"manual": [1.0, 0.0]}),
    ],
)
def test_a_step_names_what_has_the_wrong_shape_or_no_value(made, kind, field, cv, setpoint, options):
    state = made(kind).init(*START)
    with pytest.raises(InputError, match=f"^{field}: ") as caught:
        stepped(made(kind), state, cv, setpoint, **options)
    assert "expected" in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("field", "cv", "mv"),
    [
        ("mv", START[0], [50.0]),
        ("mv", START[0], 50.0),
        ("mv", START[0], [np.nan, 7500.0]),
        ("cv", [np.nan, 185.0], START[1]),
        ("cv", [11000.0], START[1]),
        ("cv", [np.inf, 185.0], START[1]),
    ],
)
def test_a_start_needs_every_value(made, kind, field, cv, mv):
    with pytest.raises(InputError, match=f"^{field}: "):
        made(kind).init(cv, mv)


@pytest.mark.parametrize("kind", KINDS)
def test_a_setpoint_trajectory_is_seen_ahead(made, kind):
    controller = made(kind)
    state = controller.init(*START)
    constant = np.tile(SETPOINT, (40, 1))
    later = constant.copy()
    later[:20] = START[0]
    _, held = stepped(controller, state, START[0], SETPOINT)
    _, same = stepped(controller, state, START[0], constant)
    _, ahead = stepped(controller, state, START[0], later)
    np.testing.assert_allclose(same.objective, held.objective, rtol=1e-9)
    assert float(ahead.objective) < 0.8 * float(held.objective)  # half the horizon asks for nothing


def test_a_setpoint_trajectory_of_lanes_is_each_lanes_own(
    made, well_like_model, small_structure, thesis_fields
):
    tuning = tuned(small_structure, thesis_fields)
    together = Controllers(small_structure, [tuning], [well_like_model], count=2)
    state = together.init(np.tile(START[0], (2, 1)), np.tile(START[1], (2, 1)))
    later = np.tile(SETPOINT, (2, 40, 1))
    later[1, :20] = START[0]
    _, info = together.step(state, np.tile(START[0], (2, 1)), later)
    for lane in range(2):
        single = made("mixed-integer")
        _, own = single.step(single.init(*START), START[0], later[lane])
        np.testing.assert_allclose(info.objective[lane], own.objective, rtol=1e-6)
    with pytest.raises(InputError, match="setpoint"):
        together.step(state, np.tile(START[0], (2, 1)), SETPOINT)


@pytest.mark.parametrize(
    "limits", [{"gap": 2.0}, {"gap": np.nan}, {"gap": -1e-3}, {"time_limit": -1.0}, {"time_limit": np.nan}]
)
def test_gaps_and_time_limits_that_mean_nothing_are_refused(
    well_like_model, small_structure, small_tuning, limits
):
    (field,) = limits
    with pytest.raises(InputError, match=f"^{field}: "):
        Controller(small_structure, small_tuning, well_like_model, **limits)
    rows = np.tile(START[0], (40, 1))
    with pytest.raises(InputError, match=f"^{field}: "):
        Planner(small_structure, small_tuning, well_like_model).solve(
            mv_now=START[1], last_move=[0.0, 0.0], free_response=rows, setpoint=rows, **limits
        )


def test_without_double_precision_nothing_is_decided(made, small_structure, small_tuning, well_like_model):
    states = {kind: made(kind).init(*START) for kind in ("continuous", "mixed-integer")}
    planner = Planner(small_structure, small_tuning, well_like_model)
    rows = np.tile(START[0], (40, 1))
    jax.config.update("jax_enable_x64", False)
    try:
        for kind, state in states.items():
            with pytest.raises(InputError, match="jax_enable_x64"):
                stepped(made(kind), state, START[0])
            with pytest.raises(InputError, match="jax_enable_x64"):
                made(kind).init(*START)
        with pytest.raises(InputError, match="jax_enable_x64"):
            planner.solve(mv_now=START[1], last_move=[0.0, 0.0], free_response=rows, setpoint=rows)
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="the system does not show memory maps")
def test_a_continuous_step_is_compiled_once_and_takes_no_more_memory_maps(made):
    controller = made("continuous")
    state, _ = stepped(controller, controller.init(*START), START[0])

    def maps():
        return len(Path("/proc/self/maps").read_text().splitlines())

    before = maps()
    for _ in range(50):
        state, _ = stepped(controller, state, START[0])
    assert maps() - before < 50  # fewer than one per step


def test_a_continuous_step_may_be_scanned_and_mapped(made):
    controller = made("continuous")
    state = controller.init(*START)

    def one(state, cv):
        state, info = controller.step(state, cv, SETPOINT)
        return state, info.move

    cvs = np.tile(START[0], (3, 1))
    _, scanned = jax.jit(lambda s: jax.lax.scan(one, s, jnp.asarray(cvs)))(state)
    moves = []
    for cv in cvs:
        state, info = controller.step(state, cv, SETPOINT)
        moves.append(info.move)
    np.testing.assert_allclose(scanned, moves, atol=1e-6)  # programs that differ in rounding
