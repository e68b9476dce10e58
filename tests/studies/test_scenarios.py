"""Scenarios: events, plans carried out blindly, stored plans, and the catalogue of named studies."""

import dataclasses

import jax
import msgspec
import numpy as np
import pytest
import xarray as xr

from identify.plants import open_plant
from identify.step_test import identify_step_response
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.plan import Planner
from jaxmpc.errors import InputError
from jaxmpc.loop.events import Event
from jaxmpc.loop.simulate import simulate
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant
from studies import plans
from studies.definition import comparison as definition
from studies.run import comparison
from studies.store.reading import open_results, provenance
from studies.thesis import catalogue
from studies.thesis.well import WELL
from tests import studies_synthetic as made

STEP = Reference([0.0, 50.0], [[11013.0, 185.0], [12600.0, 175.0]], 400.0)
GAS_OFF = {
    "cv_weight": {"gas_rate": 0.0, "oil_rate": 0.1},
    "soft_quadratic": {"gas_rate": 0.0, "oil_rate": 0.1},
    "soft_linear": {"gas_rate": 0.0, "oil_rate": 0.1},
}
KINDS = {"continuous": "continuous", "mixed-integer": "step"}  # of the controller and of the choke


@pytest.fixture(scope="module")
def model():
    return identify_step_response(WellPlant())


def controller_of(kind, model, changes=None):
    structure = WELL.structure(integer=kind == "mixed-integer")
    return Controller(structure, WELL.tuning(structure, changes=changes), model)


def run(kind, model, **how):
    return simulate(controller_of(kind, model), WellPlant(actuator=KINDS[kind]), STEP, keep_plans=True, **how)


# changes of the controller


@pytest.mark.parametrize("kind", KINDS)
def test_an_event_that_changes_nothing_changes_nothing(model, kind):
    alone = run(kind, model)
    same = {"cv_weight": controller_of(kind, model).tuning.cv_weight}
    early, late = (run(kind, model, events=[Event(t, same)]) for t in (150.0, 200.0))
    for field in ("cv", "mv", "move", "plan", "bias", "objective", "status"):
        np.testing.assert_array_equal(getattr(early, field), getattr(late, field), err_msg=field)
    np.testing.assert_array_equal(early.mv, alone.mv)
    assert np.ptp(early.mv[:, 1]) > 10.0


def test_a_changed_controller_goes_on_from_its_state(model):
    kind = "mixed-integer"
    # the first sample after 195 s starts at 200 s; the other change comes later
    changed, alone = (run(kind, model, events=[Event(time, GAS_OFF)]) for time in (195.0, 385.0))
    for field in ("cv", "mv", "bias"):
        np.testing.assert_array_equal(getattr(changed, field)[:20], getattr(alone, field)[:20])
    np.testing.assert_array_equal(changed.cv[20], alone.cv[20])
    np.testing.assert_array_equal(changed.bias[20], alone.bias[20])
    assert np.abs(alone.bias[20]).max() > 0.01
    np.testing.assert_allclose(changed.mv_demand[20], alone.mv_demand[19] + changed.move[20], atol=1e-9)
    assert not np.allclose(changed.move[20], alone.move[20], atol=1.0)
    assert not changed.fallback.any()


@pytest.mark.parametrize("kind", KINDS)
def test_an_open_loop_carries_out_its_plan_and_then_holds(model, kind):
    structure = WELL.structure(integer=kind == "mixed-integer")
    short = Reference([0.0, 50.0], [[11013.0, 185.0], [12600.0, 175.0]], 2300.0)
    how = dict(open_loop_from=50.0, keep_plans=True)
    drop = np.where(np.arange(230) > 20, -3.0, 0.0)
    plant = WellPlant(actuator=KINDS[kind])
    blind = simulate(controller_of(kind, model), plant, short, disturbance=drop, **how)
    closed = run(kind, model)
    np.testing.assert_allclose(blind.plan[5], closed.plan[5], atol=1e-3)
    planned = plans._sample_moves(
        xr.Dataset({"block_length": ("block", np.array(structure.blocks)), "blocking": structure.blocking}),
        blind.plan[5],
    )
    np.testing.assert_allclose(blind.move[5:205], planned, atol=1e-3)
    np.testing.assert_array_equal(blind.move[205:], 0.0)
    np.testing.assert_allclose(
        blind.mv_demand[6:], blind.mv_demand[5] + np.cumsum(blind.move[6:], axis=0), atol=1e-9
    )
    assert np.abs(blind.move[5:205]).sum() > 100.0
    assert np.isnan(blind.plan[6:]).all()
    assert (blind.status == 0).all()
    assert (blind.nodes[6:] == 0).all()
    np.testing.assert_array_equal(blind.bias[6:], np.broadcast_to(blind.bias[5], (224, 2)))
    assert np.ptp(blind.cv[210:, 1]) > 0  # the well goes on by itself


def test_plans_are_kept_only_where_they_are_asked_for(model):
    kept = run("mixed-integer", model)
    assert kept.plan.shape == (40, 16, 2)
    np.testing.assert_allclose(kept.plan[:, 0], kept.move, atol=1e-9)
    plain = simulate(controller_of("mixed-integer", model), WellPlant(actuator="step"), STEP, samples=8)
    assert plain.plan is None
    compiled = run("continuous", model)
    np.testing.assert_allclose(compiled.plan[:, 0], compiled.move, atol=1e-3)


@pytest.mark.parametrize(
    ("how", "field"),
    [
        ({"open_loop_from": -10.0}, "open_loop_from"),
        ({"open_loop_from": 400.0}, "open_loop_from"),
        ({"open_loop_from": 50.0, "events": [Event(100.0)]}, "open_loop_from"),
    ],
)
def test_open_loops_that_do_not_fit_are_refused_before_the_run(model, how, field):
    with pytest.raises(InputError) as error:
        simulate(controller_of("continuous", model), WellPlant(), STEP, **how)
    assert error.value.field == field


# definitions


def scenario(name="mixed-integer", kind="mixed-integer", actuator="step", **fields):
    return definition.ControllerDefinition(name, name, kind=kind, actuator=actuator, **fields)


def change(at, **changes):
    return definition.TuningChange(at, changes)


@pytest.mark.parametrize(
    ("controller", "field"),
    [
        ({"then": (change(0.0),)}, "then[0].at"),
        ({"then": (change(4000.0),)}, "then[0].at"),
        ({"then": (change(np.nan),)}, "then[0].at"),
        ({"then": (change(100.0), change(90.0))}, "then[1].at"),
        ({"then": (change(100.0, cv_wieght=1),)}, "then[0].changes.cv_wieght"),
        ({"then": (change(100.0), change(200.0, deadzone=[1.0]))}, "then[1].changes.deadzone"),
        ({"open_loop_from": -1.0}, "open_loop_from"),
        ({"open_loop_from": 4000.0}, "open_loop_from"),
        ({"open_loop_from": 50.0, "then": (change(100.0),)}, "open_loop_from"),
        ({"time_limit": 0.0}, "time_limit"),
        ({"time_limit": 0.1, "kind": "continuous"}, "time_limit"),
    ],
)
def test_a_scenario_that_cannot_be_run_is_refused_by_its_path(controller, field):
    with pytest.raises(InputError) as error:
        made.definition(controllers=(scenario(**controller),)).check(WELL)
    assert error.value.field == f"controllers.mixed-integer.{field}"


@pytest.mark.parametrize(
    ("rows", "field"),
    [
        (((-1.0, 1.0),), "disturbance[0][0]"),
        (((4000.0, 1.0),), "disturbance[0][0]"),
        (((10.0, 1.0), (10.0, 2.0)), "disturbance[1][0]"),
        (((10.0, np.inf),), "disturbance[0]"),
    ],
)
def test_a_disturbance_that_does_not_fit_is_refused_by_its_path(rows, field):
    with pytest.raises(InputError) as error:
        made.definition(disturbance=rows).check(WELL)
    assert error.value.field == field


def test_a_disturbance_holds_until_the_next():
    offsets = made.definition(disturbance=((15.0, -3.0), (40.0, 1.0))).offsets(WELL)
    assert offsets[:6, 0].tolist() == [0, 0, -3, -3, 1, 1]
    assert not made.definition().offsets(WELL).any()


def test_later_tunings_build_on_the_earlier_ones():
    controller = scenario(
        changes={"bias_cutoff": 0.1}, then=(change(10.0, **GAS_OFF), change(20.0, deadzone=[1.0, 2.0]))
    )
    (first, one), (second, two) = controller.later_tunings(WELL)
    assert (first, second) == (10.0, 20.0)
    np.testing.assert_array_equal(one.cv_weight, [0.0, 0.1])
    np.testing.assert_array_equal(two.cv_weight, [0.0, 0.1])
    np.testing.assert_array_equal(two.deadzone, [1.0, 2.0])
    assert float(two.bias_cutoff) == 0.1


def test_what_a_scenario_adds_is_part_of_what_identifies_a_run():
    plain = scenario().resolved(WELL)
    added = [
        scenario(then=(change(10.0, **GAS_OFF),)),
        scenario(open_loop_from=10.0),
        scenario(time_limit=0.1),
        scenario(mean_move_mode="predictive"),
    ]
    assert all(other.resolved(WELL) != plain for other in added)
    assert scenario(name="another").resolved(WELL) == plain


@pytest.mark.parametrize("plant", ["fmu", "jax"])
@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("name", catalogue.STUDIES)
def test_every_study_of_the_catalogue_can_be_run_and_written_down(name, quick, plant):
    study = catalogue.comparison_of(name, quick, plant).definition
    study.check(WELL)
    assert study.name == f"{name}-{'quick-' if quick else ''}{plant}"
    assert msgspec.json.decode(msgspec.json.encode(study), type=type(study)) == study
    if quick:
        assert (
            study.reference.duration
            < catalogue.comparison_of(name, False, plant).definition.reference.duration
        )


def test_names_that_are_not_in_the_catalogue_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(InputError, match="one of disturbance, fine-regulation"):
        catalogue.run_thesis("softly", tmp_path / "out")
    with pytest.raises(InputError, match="plant"):
        catalogue.run_thesis("soft", tmp_path / "out", plant="fmy")
    assert not (tmp_path / "out").exists()


# stored plans


@pytest.fixture(scope="module")
def planned(model, tmp_path_factory):
    """A short study of both kinds and both meanings of a block, with a disturbance."""
    study = made.definition(
        controllers=tuple(
            scenario(f"{kind}-{blocking}", kind, "step", blocking=blocking)
            for kind in ("continuous", "mixed-integer")
            for blocking in ("moves", "inputs")
        ),
        reference=definition.ReferenceDefinition.of(STEP),
        disturbance=((100.0, -2.0),),
    )
    folder = comparison.run_comparison(
        study,
        WELL,
        tmp_path_factory.mktemp("planned"),
        model=model,
        make_plant=lambda actual: open_plant(WELL, "jax", actual=actual),
        plant_facts={"kind": "jax"},
        extra=dict,
        progress=False,
        say=lambda line: None,
    )
    return study, open_results(folder).load()


@pytest.mark.parametrize("i", range(4))
def test_a_stored_plan_predicts_what_its_controller_predicted(model, planned, i):
    study, data = planned
    one = study.controllers[i]
    controller = Controller(one.structure(WELL), one.build_tuning(WELL), model)
    theta = Planner(one.structure(WELL), one.build_tuning(WELL), model).matrix
    blocks, horizon = one.structure(WELL).block_count, one.structure(WELL).prediction_horizon
    core, unknown, nobody = controller.core, np.full(2, np.nan), np.zeros(2, dtype=bool)
    observe = jax.jit(lambda *given: core.observe(*given))
    remember = jax.jit(lambda *given: core.remember(*given))
    run = data.sel(controller=one.name)
    mv = run.demand.values[0] - run.move.values[0]
    state = controller.init(run.measurement.values[0], mv)
    for k in range(data.sizes["time"]):
        state, free_response = observe(state, run.measurement.values[k], unknown, nobody)
        moves = run.plan.values[k]
        state = remember(state, np.pad(moves, [(0, core.size.blocks - blocks), (0, 0)]), state.warm)
        if k % 6:
            continue
        predicted = np.asarray(free_response)[:horizon] + np.einsum("chmb,bm->hc", theta, moves)
        plan = plans.plan_at(data, one.name, data.time.values[k])
        np.testing.assert_allclose(plan.cv, predicted, atol=1e-8)
        assert plan.move.shape == plan.mv.shape == (200, 2)
        np.testing.assert_allclose(plan.mv[0], run.demand.values[k], atol=1e-3)
        assert plan.time == plan.move_time[0] == plan.cv_time[0] - 10.0
    assert np.ptp(plan.cv[:, 0]) > 10.0
    np.testing.assert_allclose(np.asarray(state.bias), run.bias.values[-1], atol=1e-8)


def test_what_a_plan_is_read_with_is_stored(planned):
    study, data = planned
    assert data.block_length.values[0].sum() == 200
    assert data.blocking.values.tolist() == ["moves", "inputs"] * 2
    assert data.disturbance.values[[9, 10], 0].tolist() == [0.0, -2.0]
    assert data.disturbance_name.values.tolist() == ["reservoir_pressure_offset"]
    assert data.plan.dims == ("controller", "time", "block", "mv")
    blocks = [len(structure["blocks"]) for structure in provenance(data, "structures")]
    assert blocks == [16] * len(study.controllers)


def test_plans_that_are_not_there_are_refused(planned):
    _, data = planned
    for time in (-10.0, 400.0, np.nan):
        with pytest.raises(InputError, match="a time of the run"):
            plans.plan_at(data, "continuous-moves", time)
    with pytest.raises(InputError, match="a finished run: continuous-moves, "):
        plans.plan_at(data, "continuous", 0.0)
    blind = data.assign(plan=data.plan.where(data.time < 100))
    plans.plan_at(blind, "continuous-moves", 90.0)
    with pytest.raises(InputError, match="at which a plan was made"):
        plans.plan_at(blind, "continuous-moves", 100.0)


def test_plans_of_fewer_blocks_are_filled_up_and_read_as_they_were(tmp_path):
    unblocked = msgspec.structs.replace(made.CONTROLLERS[1], blocking="none")
    study = made.definition(controllers=(made.CONTROLLERS[0], unblocked))
    store = made.begin(tmp_path, made.layout(hashes="ab", of=study))
    names = store.layout.names
    planned = {16: 0.5, 200: 0.25}
    for name, (blocks, move) in zip(names, planned.items(), strict=True):
        plan = np.full((400, blocks, 2), move)
        made.write(store, name, dataclasses.replace(made.trajectory("smooth"), plan=plan))
    data = open_results(tmp_path).load()
    assert data.sizes["block"] == 200
    for name, move in zip(names, planned.values(), strict=True):
        np.testing.assert_array_equal(plans.plan_at(data, name, 50.0).move, np.full((200, 2), move))


# whole studies


def test_a_study_takes_finished_runs_over_from_another(tmp_path, monkeypatch):
    ran, lines = [], []

    def stub(one, study, *_):
        ran.append(f"{study.name}/{one.name}")
        return dataclasses.replace(made.trajectory("smooth"), plan=np.ones((400, 16, 2)))

    monkeypatch.setattr(comparison, "run_controller", stub)

    def study(name, controllers):
        return comparison.run_comparison(
            made.definition(name=name, controllers=controllers),
            WELL,
            tmp_path / name,
            model=made.model(),
            make_plant=lambda actuator: None,
            plant_facts={"kind": "one"},
            extra=dict,
            others=sorted(tmp_path.glob("*/results.zarr")),
            progress=False,
            say=lines.append,
        )

    first, second = made.CONTROLLERS[0], msgspec.structs.replace(made.CONTROLLERS[1], blocking="none")
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    study("one", (first,))
    renamed = msgspec.structs.replace(first, name="renamed", label="another label")
    data = open_results(study("two", (renamed, second))).load()
    assert ran == ["one/continuous-choke", "two/step-choke"]
    assert "renamed: taken over from one/results.zarr." in lines
    np.testing.assert_array_equal(plans.plan_at(data, "renamed", 0.0).move, 1.0)


def test_a_named_study_runs_from_nothing_and_a_second_call_computes_nothing(tmp_path):
    lines = []
    go = lambda: catalogue.run_thesis(  # noqa: E731
        "predictions", tmp_path, quick=True, plant="jax", progress=False, say=lines.append
    )
    data = open_results(go()).load()
    assert data.complete.values.tolist() == [1, 1]
    closed, blind = (data.sel(controller=name) for name in ("closed-loop", "open-loop"))
    step = catalogue.comparison_of("predictions", True, "jax").definition.reference.times[1]
    at = int(step / 10)
    # one loop runs in strides and the other sample by sample: two programs, whose sums differ in the last bits
    np.testing.assert_allclose(closed.demand[: at + 1], blind.demand[: at + 1], rtol=1e-12)
    plan = plans.plan_at(data, "closed-loop", step)
    np.testing.assert_allclose(blind.demand.values[at : at + 200], plan.mv, atol=1e-6)
    away = [float(abs(one.measurement - data.setpoint).sel(cv="gas_rate")[-1]) for one in (closed, blind)]
    assert away[0] < 0.2 * away[1]
    lines.clear()
    go()
    assert sum("stored already" in line for line in lines) == 2
