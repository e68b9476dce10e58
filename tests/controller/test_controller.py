import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.state import filter_bias
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import make_model
from jaxmpc.problem.layout import Size, layout_of
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning

START = np.array([11000.0, 185.0]), np.array([50.0, 7500.0])


class LinearPlant:
    """The model itself as plant, by superposition of all moves, plus a constant output disturbance from sample 5 on."""

    def __init__(self, model, disturbance=(0.0, 0.0)):
        self.s, self.moves, self.offset = np.asarray(model.coefficients), [], np.asarray(disturbance)

    def step(self, move):
        self.moves.append(np.asarray(move))
        y, n, k = START[0].copy(), self.s.shape[-1], len(self.moves)
        for i, du in enumerate(self.moves):
            y = y + self.s[..., min(k - i, n) - 1] @ du
        return y + (self.offset if k >= 5 else 0.0)


def run(controller, plant, setpoint, samples):
    state = controller.init(*START)
    cv, infos, cvs, states = START[0], [], [], []
    for _ in range(samples):
        state, info = controller.step(state, cv, np.asarray(setpoint))
        cv = plant.step(info.move)
        infos.append(info)
        cvs.append(cv)
        states.append(state)
    return infos, np.array(cvs), states


def test_without_model_error_the_bias_stays_zero(well_like_model, small_structure, small_tuning):
    controller = Controller(small_structure, small_tuning, well_like_model)
    infos, _, states = run(
        controller, LinearPlant(well_like_model), [13500.0, 215.0], 70
    )  # longer than N = 60
    assert max(np.abs(np.asarray(s.bias_raw)).max() for s in states) < 1e-8  # rounding of 1e4 over 70 samples
    assert any(info.move[0] != 0 for info in infos)


def test_a_constant_disturbance_becomes_the_bias(well_like_model, small_structure, small_tuning):
    controller = Controller(small_structure, small_tuning, well_like_model)
    _, _, states = run(controller, LinearPlant(well_like_model, (200.0, -3.0)), START[0], 60)
    np.testing.assert_allclose(np.asarray(states[-1].bias), [200.0, -3.0], rtol=1e-6)


def test_the_bias_filter_is_the_tustin_low_pass():
    """(6.4) with wc = 1/20 and dt = 10: y = 0.6 y + 0.2 (x + x_before)."""
    got = filter_bias(jnp.asarray([1.0]), jnp.asarray([2.0]), jnp.asarray([4.0]), jnp.asarray(1 / 20), 10.0)
    np.testing.assert_allclose(got, [0.6 * 1 + 0.2 * 6])
    off = filter_bias(jnp.asarray([1.0]), jnp.asarray([2.0]), jnp.asarray([4.0]), jnp.asarray(np.inf), 10.0)
    np.testing.assert_allclose(off, [4.0])


def test_whole_moves_never_reverse_at_once_and_stay_on_the_step(
    well_like_model, small_structure, thesis_fields
):
    light = make_tuning(
        small_structure, **(thesis_fields | {"move_weight": [1.0, 0.2]}), oscillation_rows={"choke": True}
    )
    controller = Controller(small_structure, light, well_like_model)
    wrong_gain = dataclasses.replace(well_like_model, coefficients=well_like_model.coefficients * 3.0)
    infos, _, _ = run(controller, LinearPlant(wrong_gain), [11700.0, 197.0], 80)
    steps = np.array([info.move[0] for info in infos]) / 2.0
    assert np.array_equal(steps, np.round(steps))
    assert np.abs(np.diff(steps)).max() <= 1
    assert (steps > 0).any()
    assert (steps < 0).any()


def test_the_reactive_limit_stops_the_choke_once_its_mean_move_exceeds_it(
    well_like_model, small_structure, thesis_fields
):
    fields = thesis_fields | {"mean_move_limit": [0.55, np.inf], "move_weight": [1.0, 0.2]}
    controller = Controller(small_structure, make_tuning(small_structure, **fields), well_like_model)
    infos, _, _ = run(controller, LinearPlant(well_like_model), [14000.0, 230.0], 60)
    moves = np.array([info.move[0] for info in infos])
    windows = np.array([moves[max(0, k - 25) : k].sum() / 25 for k in range(60)])  # before each decision
    assert windows.max() > 0.55  # the limit was reached
    assert windows.max() <= (0.55 * 25 + 2.0) / 25 + 1e-12  # and exceeded by one step at most
    assert (moves[windows > 0.55] <= 0).all()


def test_the_predictive_limit_never_lets_the_mean_move_exceed_it(
    well_like_model, small_structure, thesis_fields
):
    structure = dataclasses.replace(small_structure, mean_move_mode="predictive")
    fields = thesis_fields | {"mean_move_limit": [0.55, 50.0], "move_weight": [1.0, 0.2]}
    controller = Controller(structure, make_tuning(structure, **fields), well_like_model)
    infos, _, _ = run(controller, LinearPlant(well_like_model), [14000.0, 230.0], 40)
    assert all(info.status == status.OPTIMAL for info in infos)
    moves = np.array([info.move for info in infos])
    for k in range(40):
        window = moves[max(0, k - 24) : k + 1].sum(axis=0) / 25
        assert window[0] <= 0.55 + 1e-9
        assert window[1] <= 50.0 + 1e-6
    assert moves[:, 0].sum() > 6 * 2.0


def test_an_infeasible_problem_holds_the_mvs(well_like_model, small_structure, thesis_fields):
    fields = thesis_fields | {"move_low": [2.0, -200.0], "mv_high": [51.0, 10000.0]}  # must open, may not
    controller = Controller(small_structure, make_tuning(small_structure, **fields), well_like_model)
    _, info = controller.step(controller.init(*START), START[0], START[0])
    assert bool(info.fallback)
    assert int(info.status) == status.INFEASIBLE
    assert np.array_equal(info.move, [0.0, 0.0])


@pytest.mark.parametrize("kind", ["continuous", "mixed-integer"])
def test_an_mv_outside_its_limits_is_brought_back(
    well_like_model, small_structure, small_tuning, thesis_fields, kind
):
    structure, tuning = small_structure, small_tuning
    if kind == "continuous":
        structure = small_structure.relaxed()
        tuning = make_tuning(structure, **thesis_fields)
    controller = Controller(structure, tuning, well_like_model)
    state = controller.init(START[0], np.array([105.0, 10500.0]))
    for k in range(4):
        state, info = controller.step(state, START[0], np.array([15000.0, 230.0]))
        assert not bool(info.fallback)
        assert bool(info.recovering) == (
            k < 3
        )  # 105 -> 103 -> 101 -> 99 or 100; 10500 -> 10300 -> 10100 -> 10000
    assert float(state.mv[0]) <= 100.0
    assert float(state.mv[1]) <= 10000.0


@pytest.mark.slow
def test_a_batch_of_controllers_does_what_each_does_alone(well_like_model, small_structure, thesis_fields):
    relaxed = small_structure.relaxed()
    weights = jnp.asarray([[250.0, 0.2], [1.0, 0.02], [0.0, 0.0]])

    def first_move(weight):
        tuning = eqx.tree_at(lambda t: t.move_weight, make_tuning(relaxed, **thesis_fields), weight)
        controller = Controller(relaxed, tuning, well_like_model)
        _, info = controller.step(controller.init(*START), START[0], jnp.asarray([11800.0, 199.0]))
        return info.move, info.objective

    together = jax.vmap(first_move)(weights)
    for lane, weight in enumerate(weights):
        alone = first_move(weight)
        # the two programs differ in rounding; both end within 1e-9 of the optimum
        np.testing.assert_allclose(together[1][lane], alone[1], rtol=1e-8)
        np.testing.assert_allclose(together[0][lane], alone[0], atol=1e-3)


def test_a_shifted_plan_keeps_the_remaining_moves():
    s = Structure(("y",), ("u",), prediction_horizon=9, control_horizon=7, blocks=(1, 1, 2, 3))
    moves = np.array([5.0, 3.0, 2.0, 1.0])  # samples 5 3 2 2 1 1 1
    shifted = lambda s: layout_of(s, Size.of(s, 9)).shift @ moves  # noqa: E731
    np.testing.assert_allclose(shifted(s), [3.0, 2.0, 1.5, 2 / 3])  # 3 2 2 1 1 1 0 averaged in blocks
    s = dataclasses.replace(s, blocking="inputs")  # samples 5 3 2 0 1 0 0
    np.testing.assert_allclose(shifted(s), [3.0, 2.0, 1.0, 0.0])


def test_wrong_models_are_refused(well_like_model, small_structure, small_tuning):
    with pytest.raises(InputError, match=r"model\.dt"):
        Controller(small_structure, small_tuning, dataclasses.replace(well_like_model, dt=5.0))
    other = make_model(np.ones((1, 2, 3)), 10.0, ["gas"], ["choke", "lift"])
    with pytest.raises(InputError, match=r"model\.cv"):
        Controller(small_structure, small_tuning, other)
