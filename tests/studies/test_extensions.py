"""Studies beyond the thesis: their definitions, limited steps, the mean-move limit ahead of time, stored schedules."""

import dataclasses

import equinox as eqx
import msgspec
import numpy as np
import pytest

from figures.registry import FIGURES
from identify.plants import open_plant
from identify.schedule import identify_schedule
from identify.step_test import identify_step_response
from jaxmpc import status
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.process.well.plant import WellPlant
from studies.definition.catalogue import Comparison
from studies.definition.comparison import ComparisonDefinition, ControllerDefinition, ReferenceDefinition
from studies.run import comparison
from studies.store.reading import open_results
from studies.thesis import catalogue, report, time_limits
from studies.thesis.well import WELL

AT = np.array([11000.0, 185.0]), np.array([50.0, 7500.0])  # CVs, MVs
KINDS = pytest.mark.parametrize("integer", [False, True], ids=["continuous", "mixed-integer"])


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("name", ["gain-scheduling", "mean-move", "time-limit"])
def test_every_study_has_controllers_that_can_be_built(name, quick):
    definition = catalogue.comparison_of(name, quick, "jax").definition
    definition.check(WELL)
    assert definition.name == f"{name}-{'quick-' if quick else ''}jax"
    for entry in FIGURES.values():
        if entry.study == name:
            assert set(entry.needs) <= {controller.name for controller in definition.controllers}


def test_a_schedule_changes_what_a_controller_runs_with_and_its_absence_does_not():
    plain = ControllerDefinition("a", "a", kind="continuous", actuator="step")
    assert "schedule" not in plain.resolved(WELL)
    assert msgspec.structs.replace(plain, schedule=True).resolved(WELL) == plain.resolved(WELL) | {
        "schedule": True
    }


# --------------------------------------------------------------------------------------------------- predictive


def predictive(structure, fields, model, integer, **changes):
    shape = dataclasses.replace(structure, mean_move_mode="predictive", mean_move_window=5)
    shape = shape if integer else shape.relaxed()
    fields = fields | {"mean_move_limit": [0.55, None]} | changes
    rows = {"oscillation_rows": {"choke": True}} if integer else {}
    return Controller(shape, make_tuning(shape, **fields, **rows), model)


def moves_of(controller, state, samples=20):
    """Choke moves towards a setpoint that asks for as much choke as there is; every sample has a plan."""
    moves = []
    for _ in range(samples):
        state, info = controller.step(state, AT[0], AT[0] + np.array([4000.0, 60.0]))
        assert int(info.status) == status.OPTIMAL
        moves.append(float(info.move[0]))
    return np.array(moves)


@KINDS
def test_the_predictive_limit_is_never_exceeded(small_structure, thesis_fields, well_like_model, integer):
    controller = predictive(small_structure, thesis_fields, well_like_model, integer)
    moves = moves_of(controller, controller.init(*AT))
    means = np.convolve(moves, np.ones(5) / 5)
    assert moves.sum() > 4.0
    assert means.max() <= 0.55 + 1e-6


@KINDS
def test_a_window_that_is_exceeded_already_leaves_a_plan_and_comes_back_to_its_limit(
    small_structure, thesis_fields, well_like_model, integer
):
    controller = predictive(small_structure, thesis_fields, well_like_model, integer)
    state = controller.init(*AT)
    past = np.zeros_like(state.past_moves)
    past[-5:, 0] = 2.0
    state = eqx.tree_at(lambda s: s.past_moves, state, past)
    moves = np.concatenate([np.full(5, 2.0), moves_of(controller, state)])
    means = np.convolve(moves, np.ones(5) / 5, "valid")
    assert moves[5] <= 1e-6
    assert (means[1:][moves[5:] > 1e-6] <= 0.55 + 1e-6).all()
    assert means[5:].max() <= 0.55 + 1e-6
    assert moves[9:].sum() > 1.0


@KINDS
@pytest.mark.parametrize("start", [30.0, 56.0], ids=["below", "above"])
def test_an_mv_outside_its_limits_returns_within_the_predictive_limit(
    small_structure, thesis_fields, well_like_model, integer, start
):
    limits = {"mv_low": [40.0, 0.0], "mv_high": [44.0, 10000.0]}
    controller = predictive(small_structure, thesis_fields, well_like_model, integer, **limits)
    moves = moves_of(controller, controller.init(AT[0], np.array([start, 7500.0])), 30)
    assert 40.0 - 1e-6 <= start + moves.sum() <= 44.0 + 1e-6
    assert np.abs(np.convolve(moves, np.ones(5) / 5)).max() <= 0.55 + 1e-6


# ------------------------------------------------------------------------------------------- limits and schedules


@pytest.fixture(scope="module")
def model():
    return identify_step_response(WellPlant())


@pytest.fixture(scope="module")
def results(model, tmp_path_factory):
    """A short run: exact, out of time at once, and with a schedule."""
    made = dict(kind="mixed-integer", actuator="step")
    definition = ComparisonDefinition(
        "short",
        "A short run",
        WELL.name,
        "jax",
        (
            ControllerDefinition("exact", "exact", **made),
            ControllerDefinition("hurried", "hurried", time_limit=1e-9, **made),
            ControllerDefinition("scheduled", "scheduled", schedule=True, **made),
        ),
        ReferenceDefinition((0.0, 100.0), ((11013.0, 185.0), (9640.0, 152.0)), 400.0),
    )
    folder = tmp_path_factory.mktemp("short")
    said = []
    comparison.run_comparison(
        definition,
        WELL,
        folder,
        model=model,
        make_plant=lambda actual: open_plant(WELL, "jax", actual=actual),
        plant_facts={"kind": "jax"},
        extra=dict,
        schedule=identify_schedule(WellPlant(), {"choke": (20.0, 40.0, 60.0), "gas_lift": (7500.0,)}),
        progress=False,
        say=said.append,
    )
    return definition, open_results(folder).load()


def test_a_step_that_is_out_of_time_applies_the_best_plan_it_has(results):
    _, data = results
    run = data.sel(controller="hurried")
    limited = run.status.values == status.LIMIT
    assert limited.any()
    assert set(run.status.values.tolist()) <= {status.OPTIMAL, status.LIMIT}
    assert (run.fallback.values == 0).all()
    assert np.isfinite(run.objective.values).all()
    assert (run.gap.values[limited] > 0).all()
    moves = run.move.sel(mv="choke").values
    assert moves == pytest.approx(2.0 * np.round(moves / 2.0), abs=1e-9)
    assert np.abs(moves).sum() > 0


def test_the_replayed_state_of_an_exact_run_gives_its_objectives_again(results, model):
    definition, data = results
    asked = data.assign(status=data.status * 0 + status.LIMIT)  # solve every step again
    loss = time_limits.objective_loss(asked, definition.controllers[0], WELL, model)
    assert loss == pytest.approx(np.zeros(len(loss)), abs=3e-6)


def test_a_limited_step_loses_no_less_than_nothing_and_no_more_than_its_gap(results, model):
    definition, data = results
    run = data.sel(controller="hurried")
    loss = time_limits.objective_loss(data, definition.controllers[1], WELL, model)
    limited = run.status.values == status.LIMIT
    gap = run.gap.values[limited]
    assert (loss[~limited] == 0).all()
    assert (loss[limited] >= 0).all()
    assert (loss[limited] * (1.0 - gap) <= gap + 1e-5 * (1.0 - gap)).all()  # a gap of 1 says nothing


def test_the_table_of_limits_has_one_row_per_limited_controller(results, model):
    definition, data = results
    (row,) = time_limits.limited_steps(data, Comparison("short", definition, WELL), model)
    limited = data.sel(controller="hurried").status.values == status.LIMIT
    loss = time_limits.objective_loss(data, definition.controllers[1], WELL, model)[limited]
    assert (row.label, row.share) == ("hurried", pytest.approx(limited.mean()))
    assert row.lost[0] == pytest.approx(np.median(loss))
    assert row.lost[0] <= row.lost[1] <= row.lost[2] == pytest.approx(loss.max())
    solved = data.assign(status=data.status * 0)
    (none,) = time_limits.limited_steps(solved, Comparison("short", definition, WELL), model)
    text = report.limits_table([row, none])
    assert text[2].startswith(f"| hurried | {100 * row.share:.1f} % | ")
    assert text[3] == "| hurried | 0.0 % |  |  |"


def test_a_controller_with_a_schedule_runs_differently_and_is_stored_under_another_hash(results):
    _, data = results
    exact, scheduled = (data.sel(controller=name) for name in ("exact", "scheduled"))
    assert exact.controller_hash.item() != scheduled.controller_hash.item()
    assert (scheduled.status.values == status.OPTIMAL).all()
    assert np.abs(exact.demand.values - scheduled.demand.values).max() > 1.0


def test_a_scheduled_controller_without_a_schedule_is_refused(model):
    definition = catalogue.comparison_of("gain-scheduling", True, "jax").definition
    with pytest.raises(InputError, match="gain schedule"):
        comparison.run_controller(
            definition.controllers[1],
            definition,
            WELL,
            model,
            lambda actual: open_plant(WELL, "jax", actual=actual),
            False,
        )


def test_a_schedule_has_the_mean_of_steps_up_and_down_at_each_point():
    schedule = identify_schedule(WellPlant(), {"choke": (9.0, 40.0), "gas_lift": (5000.0, 7500.0)})
    up = identify_step_response(WellPlant(), (9.0, 7500.0), (2.0, 100.0))
    down = identify_step_response(WellPlant(), (9.0, 7500.0), (-2.0, -100.0))
    mean = 0.5 * (up.coefficients + down.coefficients)
    assert np.asarray(schedule.model_at([9.0, 7500.0]).coefficients) == pytest.approx(np.asarray(mean))
    gains = np.asarray(schedule.coefficients)[:, :, 0, 0, -1]
    assert (gains[0] > 4.0 * gains[1]).all()
    assert dict(schedule.reference.provenance)["steps"] == (2.0, 100.0, -2.0, -100.0)


@pytest.mark.parametrize(
    ("field", "arguments"),
    [
        ("grid.choke", {"choke": ()}),
        ("grid.gas_lift", {"gas_lift": (5000.0, 5000.0)}),
        ("grid", {"valve": (1.0,)}),
        ("choke", {"choke": (1.0,)}),
    ],
)
def test_a_grid_that_cannot_be_identified_is_refused(field, arguments):
    with pytest.raises(InputError) as error:
        identify_schedule(WellPlant(), {"choke": (20.0,), "gas_lift": (7500.0,)} | arguments)
    assert error.value.field == field


def test_the_presets_reach_the_predictive_mode_through_a_definition():
    definition = catalogue.comparison_of("mean-move", True, "jax").definition
    modes = {c.name: c.structure(WELL).mean_move_mode for c in definition.controllers}
    assert modes["continuous-predictive"] == modes["mixed-integer-predictive"] == "predictive"
    assert modes["continuous-reactive"] == WELL.structure().mean_move_mode == "reactive"
