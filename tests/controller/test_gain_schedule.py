"""Gain schedules: interpolation, files, bumpless changes of model, and controllers against those with one model."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.schedule import (
    ModelSchedule,
    ScheduledController,
    make_schedule,
)
from jaxmpc.errors import InputError
from jaxmpc.problem.tuning import make_tuning, stack_tunings

CHOKES, LIFTS = (10.0, 30.0, 50.0), (5000.0, 7500.0)
AT = np.array([11000.0, 185.0]), np.array([50.0, 7500.0])  # CVs, MVs


def models_of(base, factor):
    """A model per working point, its coefficients scaled by a factor of choke and lift."""
    return [
        dataclasses.replace(
            base,
            coefficients=factor(choke, lift) * base.coefficients,
            working_point=(("choke", choke), ("lift", lift)),
        )
        for choke in CHOKES
        for lift in LIFTS
    ]


@pytest.fixture(scope="module")
def varied(well_like_model):
    """Gains that fall with the choke and rise with the lift."""
    return make_schedule(models_of(well_like_model, lambda choke, lift: 50.0 / choke * lift / 7500.0))


@pytest.fixture(scope="module")
def even(well_like_model):
    """The same model everywhere."""
    return make_schedule(models_of(well_like_model, lambda choke, lift: 1.0))


def near(expected, **tolerance):
    """The values within a tolerance, whichever array library they are from."""
    return pytest.approx(np.asarray(expected), **tolerance)


def continuous_of(structure, fields, made_with):
    fields = {key: value for key, value in fields.items() if key != "oscillation_rows"}
    kind = ScheduledController if isinstance(made_with, ModelSchedule) else Controller
    shape = structure.relaxed()
    return kind(shape, make_tuning(shape, **fields), made_with)


def integer_of(structure, fields, made_with):
    kind = ScheduledController if isinstance(made_with, ModelSchedule) else Controller
    return kind(
        structure, make_tuning(structure, **({"oscillation_rows": {"choke": True}} | fields)), made_with
    )


BOTH = pytest.mark.parametrize("make", [continuous_of, integer_of], ids=["continuous", "mixed-integer"])


def run(controller, samples=12):
    """Samples against measurements that do not depend on the moves, with a setpoint that asks for large ones."""
    state, infos = controller.init(*AT), []
    for k in range(samples):
        measured = AT[0] + np.array([150.0, -2.0]) * np.sin(0.5 * k)
        state, info = controller.step(state, measured, AT[0] + np.array([-2500.0, -40.0]))
        infos.append(info)
    return state, jax.tree.map(lambda *leaves: np.stack(leaves), *infos)


def test_coefficients_at_a_point_of_the_grid_are_those_of_its_model(varied, well_like_model):
    for model in models_of(well_like_model, lambda choke, lift: 50.0 / choke * lift / 7500.0):
        point = [value for _, value in model.working_point]
        assert varied.model_at(point).coefficients == near(model.coefficients, rel=1e-12)


def test_coefficients_between_four_points_are_bilinear(varied, well_like_model):
    weights = {(10, 5000): 0.75 * 0.4, (10, 7500): 0.75 * 0.6, (30, 5000): 0.25 * 0.4, (30, 7500): 0.25 * 0.6}
    factor = sum(weight * 50.0 / choke * lift / 7500.0 for (choke, lift), weight in weights.items())
    assert varied.coefficients_at(jnp.array([15.0, 6500.0])) == near(
        factor * well_like_model.coefficients, rel=1e-12
    )


@pytest.mark.parametrize(
    ("outside", "border"), [((2.0, 6000.0), (10.0, 6000.0)), ((90.0, 9000.0), (50.0, 7500.0))]
)
def test_coefficients_beyond_the_grid_are_those_of_its_border(varied, outside, border):
    assert np.array_equal(varied.model_at(outside).coefficients, varied.model_at(border).coefficients)


def test_many_working_points_in_one_call_give_what_each_gives_alone(varied):
    points = jnp.array([[5.0, 7000.0], [12.0, 5100.0], [30.0, 7500.0], [49.0, 2500.0]])
    together = jax.jit(jax.vmap(varied.coefficients_at))(points)
    for i, point in enumerate(points):
        assert together[i] == near(varied.coefficients_at(point), rel=1e-12)


def test_a_schedule_of_a_single_model_is_that_model_everywhere(well_like_model):
    one = make_schedule(models_of(well_like_model, lambda choke, lift: 1.0)[:1])
    assert np.array_equal(one.model_at([80.0, 0.0]).coefficients, well_like_model.coefficients)


def test_a_saved_schedule_is_read_back_unchanged(varied, tmp_path):
    again = ModelSchedule.load(varied.save(tmp_path / "schedule.json"))
    assert np.array_equal(again.coefficients, varied.coefficients)
    assert again.scheduled == varied.scheduled == ("choke", "lift")
    for one, other in zip(again.grid, varied.grid, strict=True):
        assert np.array_equal(one, other)
    assert again.reference.mv_names == varied.reference.mv_names
    assert again.reference.dt == varied.reference.dt


@pytest.mark.parametrize(
    ("spoil", "field"),
    [
        (lambda body: body.pop("grid"), "schedule.grid"),
        (lambda body: body["grid"].update(speed=[1.0]), "schedule.grid"),
        (lambda body: body["grid"].pop("lift"), "schedule.coefficients[0].coefficients"),
        (lambda body: body["coefficients"].pop(), "schedule.coefficients"),
        (
            lambda body: body["coefficients"][1][0][0].__setitem__(1, [1.0]),
            "schedule.coefficients[1][0].coefficients",
        ),
    ],
)
def test_a_schedule_file_that_is_wrong_is_refused_by_the_name_of_its_field(varied, tmp_path, spoil, field):
    path = varied.save(tmp_path / "schedule.json")
    body = json.loads(path.read_text())
    spoil(body)
    path.write_text(json.dumps(body))
    with pytest.raises(InputError) as error:
        ModelSchedule.load(path)
    assert error.value.field == field


def test_models_that_do_not_fill_a_grid_are_refused(well_like_model):
    models = models_of(well_like_model, lambda choke, lift: 1.0)
    with pytest.raises(InputError, match="every point of the grid"):
        make_schedule(models[:-1])
    with pytest.raises(InputError, match="no other model"):
        make_schedule([*models, models[0]])
    with pytest.raises(InputError, match=r"scheduled.*one or two of choke, lift"):
        make_schedule(models, ["speed"])
    with pytest.raises(InputError, match="working_point"):
        make_schedule([dataclasses.replace(models[0], working_point=(("choke", 10.0),))])


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(continuous_of, marks=pytest.mark.slow, id="continuous"),
        pytest.param(integer_of, id="mixed-integer"),
    ],
)
def test_equal_models_everywhere_decide_like_the_single_model(
    make, even, well_like_model, small_structure, thesis_fields
):
    state, infos = run(make(small_structure, thesis_fields, even))
    alone_state, alone = run(make(small_structure, thesis_fields, well_like_model))
    assert (infos.status == status.OPTIMAL).all()
    assert (np.abs(alone.move[:, 0]) > 0.5).any()
    assert infos.mv == near(alone.mv, rel=1e-9)
    assert infos.objective == near(alone.objective, rel=1e-9)
    assert state.future == near(alone_state.future, rel=1e-9, abs=1e-9)


@BOTH
def test_a_change_of_model_at_rest_gives_no_move(make, varied, small_structure, thesis_fields):
    controller = make(small_structure, thesis_fields, varied)
    state = controller.init(*AT)
    for choke in (50.0, 40.0, 22.0, 10.0):  # another model each time
        state = eqx.tree_at(lambda s: s.mv, state, np.array([choke, 6000.0]))
        state, info = controller.step(state, AT[0], AT[0])
        assert not info.fallback
        assert info.moves == near(np.zeros_like(info.moves), abs=1e-6)
        assert state.bias == near(np.zeros(2), abs=1e-9)


@BOTH
def test_what_past_moves_will_still_do_does_not_change_with_the_model(
    make, varied, small_structure, thesis_fields
):
    controller = make(small_structure, thesis_fields, varied)
    state, _ = run(controller, 3)
    other = eqx.tree_at(lambda s: s.mv, state, np.array([10.0, 5000.0]))
    after, info = controller.step(other, AT[0], AT[0] - np.array([2000.0, 60.0]))
    before = np.asarray(state.future)
    shifted = np.concatenate([before[:, 1:], before[:, -1:]], axis=1)
    used = varied.model_at(np.asarray(other.mv) + 0.5 * np.asarray(info.move))
    effect = np.einsum("cmn,m->cn", used.extended(before.shape[1]), info.move)
    assert info.move[0] != 0.0
    assert after.future == near(shifted + effect, rel=1e-7, abs=1e-7)


@BOTH
def test_a_prediction_error_goes_into_the_bias_after_a_change_of_model(
    make, varied, small_structure, thesis_fields
):
    controller = make(small_structure, thesis_fields, varied)
    state, _ = run(controller, 3)
    moved = eqx.tree_at(lambda s: s.mv, state, np.array([12.0, 5500.0]))
    expected = np.asarray(state.base) + np.asarray(state.future)[:, 0]
    after, _ = controller.step(moved, expected + np.array([70.0, -3.0]), AT[0])
    assert after.bias_raw == near([70.0, -3.0], abs=1e-6)


@BOTH
def test_a_step_and_the_step_back_leave_nothing_behind(make, varied, small_structure, thesis_fields):
    free = {"oscillation_rows": {"choke": False}}
    one_way = lambda by: thesis_fields | free | {"move_low": [by, 0.0], "move_high": [by, 0.0]}  # noqa: E731
    up, down = (make(small_structure, one_way(by), varied) for by in (2.0, -2.0))
    state, first = up.step(up.init(AT[0], np.array([44.0, 7500.0])), AT[0], AT[0])
    assert np.abs(np.asarray(state.future)[:, -1]).min() > 0.5
    state, back = down.step(state, AT[0], AT[0])
    assert (float(first.move[0]), float(back.move[0])) == near((2.0, -2.0))
    assert np.asarray(state.future)[:, -1] == near(np.zeros(2), abs=1e-9)


def test_a_higher_gain_near_closed_makes_the_choke_move_less(even, varied, small_structure, thesis_fields):
    target = AT[0] + np.array([600.0, 10.0])
    moves = []
    for schedule in (even, varied):
        controller = continuous_of(small_structure, thesis_fields, schedule)
        state = controller.init(AT[0], np.array([10.0, 7500.0]))
        moves.append(float(controller.step(state, AT[0], target)[1].moves[:, 0].sum()))
    assert 0.0 < moves[1] < moves[0]


@pytest.mark.slow
def test_tunings_side_by_side_do_what_each_does_alone(varied, small_structure, thesis_fields):
    shape = small_structure.relaxed()
    tunings = [
        make_tuning(shape, **(thesis_fields | {"move_weight": [weight, 0.2]})) for weight in (25.0, 250.0)
    ]
    starts = jnp.array([[50.0, 7500.0], [14.0, 6000.0]])
    target = AT[0] + np.array([600.0, 10.0])

    def two(tuning, mv):
        controller = ScheduledController(shape, tuning, varied)
        state, first = controller.step(controller.init(AT[0], mv), AT[0], target)
        return first.move, controller.step(state, AT[0], target)[1].move

    together = jax.jit(jax.vmap(two))(stack_tunings(tunings), starts)
    for i, tuning in enumerate(tunings):
        for one, both in zip(two(tuning, starts[i]), together, strict=True):
            assert both[i] == near(one, rel=1e-5, abs=1e-5)


def test_the_table_makes_a_controller_once_per_position_and_keeps_the_latest(
    varied, small_structure, small_tuning
):
    controller = ScheduledController(small_structure, small_tuning, varied, spacing=500.0, kept=2)
    table = controller.lanes
    first = table.at([30.0, 7400.0])
    assert table.at([30.0, 7700.0]) is first
    assert table.at([32.0, 7400.0]) is not first
    assert table.built == 2
    table.at([34.0, 7400.0])
    assert table.at([30.0, 7400.0]) is not first
    assert table.built == 4
    assert ScheduledController(small_structure, small_tuning, varied).lanes.grid.tolist() == [2.0, 250.0]
    model = first.scenarios.models[0]
    assert model.coefficients == near(varied.model_at([30.0, 7500.0]).coefficients, rel=1e-12)


@pytest.mark.parametrize(("name", "value"), [("spacing", 0.0), ("spacing", np.nan), ("kept", 0)])
def test_a_table_that_cannot_be_is_refused(varied, small_structure, small_tuning, name, value):
    with pytest.raises(InputError) as error:
        ScheduledController(small_structure, small_tuning, varied, **{name: value})
    assert error.value.field == name
