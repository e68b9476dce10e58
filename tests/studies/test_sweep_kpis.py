"""Key figures of sweep scenarios, against a run that was worked out by hand and against the thesis comparison."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxmpc import status as codes
from jaxmpc.errors import InputError
from jaxmpc.loop.trajectory import TrajectoryBatch
from jaxmpc.problem.tuning import make_tuning, stack_tunings
from studies.kpi import evaluate
from studies.kpi.sweep import ALWAYS, RECORD, batch_kpis, kpis_of, measures_of, run_kpis, runs_of
from studies.store.reading import open_results
from studies.thesis.well import WELL
from tests import studies_synthetic as made

STRUCTURE = WELL.structure()
KPIS = kpis_of(WELL)
MEASURES = measures_of(WELL)
SMALLEST, INTEGRALS = MEASURES
WINDOW = np.array([0] * 4 + [1] * 8)
TUNING = make_tuning(
    STRUCTURE,
    cv_weight=[0.01, 1.0],
    move_weight=[10.0, 0.001],
    soft_quadratic=[0.02, 2.0],
    soft_linear=[0.5, 3.0],
    deadzone=[100.0, 2.0],
    cv_low=[0.0, 46.0],
    cv_high=[1400.0, None],
    mv_low=[50.0, 0.0],
    mv_high=[100.0, 7150.0],
)


def batch_of(cv, setpoint, mv, mv_demand, move, **fields) -> TrajectoryBatch:
    """A batch of some lanes from arrays with the lane axis first; solves without a fault unless given."""
    cv, setpoint, mv = (
        np.asarray(cv, dtype=float),
        np.asarray(setpoint, dtype=float),
        np.asarray(mv, dtype=float),
    )
    lanes, samples = cv.shape[:2]
    solves = dict(
        status=np.zeros((lanes, samples), dtype=np.int32),
        fallback=np.zeros((lanes, samples), dtype=bool),
        objective=np.ones((lanes, samples)),
        gap=np.zeros((lanes, samples)),
        solve_time=np.full((lanes, samples), 1e-3),
        quality=np.zeros((lanes, samples, 2), dtype=np.int32),
        off=np.zeros((lanes, samples, 2), dtype=bool),
    )
    return TrajectoryBatch(
        lanes=np.arange(lanes),
        time=STRUCTURE.dt * np.arange(samples),
        setpoint=setpoint,
        fields={**solves, "cv": cv, "mv": mv, "mv_demand": mv_demand, "move": move, **fields},
        cv_names=STRUCTURE.cv_names,
        mv_names=STRUCTURE.mv_names,
        cv_units=STRUCTURE.cv_units,
        mv_units=STRUCTURE.mv_units,
        dt=STRUCTURE.dt,
    )


def by_hand() -> TrajectoryBatch:
    """One run of twelve samples. The choke starts at 50 % and moves in steps while its demand creeps."""
    gas = [1000, 1050, 1000, 980, 1000, 1200, 1450, 1350, 1420, 1310, 1290, 1300]
    oil = [45, 49, 53, 51, 50, 50, 50, 50, 50, 50, 47, 53]
    choke = [52, 52, 50, 50, 50, 52, 50, 52, 52, 50, 52, 52]
    creeping = 50 + 1.7 * np.arange(1, 13)
    lift = [7200, 7200] + [7100] * 10
    demand = np.stack([creeping, lift], axis=1)
    return batch_of(
        cv=np.stack([gas, oil], axis=1)[None],
        setpoint=np.array([[1000, 50]] * 4 + [[1300, 50]] * 8)[None],
        mv=np.stack([choke, lift], axis=1)[None],
        mv_demand=demand[None],
        move=np.diff(demand, axis=0, prepend=[[50.0, 7000.0]])[None],
        objective=np.arange(12.0)[None],
        gap=1e-7 * (np.arange(12) % 4)[None],
        solve_time=1e-3 * np.arange(1, 13)[None],
        status=np.array([[codes.LIMIT] + [codes.OPTIMAL] * 11]),
        quality=np.array([[0, 0]] * 7 + [[1, 0], [2, 0], [3, 0], [0, 1], [0, 0]])[None],
        off=np.array([[False, False]] * 9 + [[True, False]] + [[False, False]] * 2)[None],
    )


BY_HAND = {
    "iae": [8100.0, 160.0],
    "mean_absolute_deviation": [67.5, 16 / 12],
    "time_outside_deadzone": [30.0, 40.0],  # a gas rate 100 m3/h away is on the border: inside
    "setpoint_changes": [1, 1],  # oil: the start, 5 m3/h below its setpoint
    "overshoot": [150.0, 3.0],
    "settling_time_mean": [50.0, 30.0],
    "settling_time_max": [50.0, 30.0],
    "unsettled_windows": [0, 0],  # the window in which oil ends outside has no change of its setpoint
    "cv_violations": [2, 1],
    "cv_largest_excess": [50.0, 1.0],
    "mv_violations": [0, 2],
    "mv_largest_excess": [0.0, 50.0],
    "travel": [14.0, 300.0],
    "moves": [7, 2],
    "reversals": [6, 1],
    "hunting_reversals": [1, 0],
    "mean_dwell": [100 / 6, 20.0],
    "shortest_dwell": [10.0, 20.0],
    "lift_volume": 85_400 / 360,
    "oil_produced": 598 / 360,
    "gas_produced": 14_350 / 360,
    "objective": 5.5,
    # gas 1425 + 858 + 135, oil 54 + 24 + 18, choke 280, lift 50
    "closed_loop_cost": 2844 / 12,
    "solve_time_median": 6.5e-3,
    "solve_time_p99": 11.89e-3,
    "solve_time_max": 12e-3,
    "largest_gap": 3e-7,
    "not_optimal": 1,
    "fallbacks": 0,
    "bad_measurements": [3, 1],
    "switched_off": [1, 0],
    "finite": 1,
}


LANES = 5  # of all random batches, so that they share one program


def random_batch(lanes: int = LANES, samples: int = 40, seed: int = 0) -> tuple[TrajectoryBatch, np.ndarray]:
    """Random walks, and windows of another length in every lane."""
    rng = np.random.default_rng(seed)
    window = np.arange(samples) // rng.integers(3, 15, size=(lanes, 1))
    levels = rng.integers(-3, 4, size=(lanes, samples, 2)) * [500.0, 10.0] + [10_000.0, 150.0]
    setpoint = np.take_along_axis(levels, window[..., None], axis=1)
    move = np.stack(
        [2.0 * rng.integers(-1, 2, (lanes, samples)), rng.normal(0, 50, (lanes, samples))], axis=-1
    )
    mv = np.array([50.0, 7500.0]) + np.cumsum(move, axis=1)
    cv = setpoint + rng.normal(size=(lanes, samples, 2)) * [800.0, 4.0]
    solve_time = rng.exponential(size=(lanes, samples))
    return batch_of(cv, setpoint, mv, mv, move, solve_time=solve_time, objective=solve_time), window


def random_tunings(lanes: int = LANES, seed: int = 1):
    rng = np.random.default_rng(seed)
    return stack_tunings(
        [
            WELL.tuning(
                STRUCTURE,
                changes={"deadzone": rng.uniform([500, 2], [1500, 6]).tolist(), "cv_high": [1.02e4, 160.0]},
            )
            for _ in range(lanes)
        ]
    )


def take(batch: TrajectoryBatch, lanes) -> TrajectoryBatch:
    fields = {key: value[lanes] for key, value in batch.fields.items()}
    return dataclasses.replace(batch, lanes=batch.lanes[lanes], setpoint=batch.setpoint[lanes], fields=fields)


def changed(batch: TrajectoryBatch, **fields) -> TrajectoryBatch:
    return dataclasses.replace(batch, fields={**batch.fields, **fields})


def assert_equal(one: dict, other: dict):
    for item in KPIS:
        np.testing.assert_allclose(one[item.name], other[item.name], rtol=1e-9, atol=1e-9, err_msg=item.name)


# one run by hand


@pytest.fixture(scope="module")
def figures_by_hand():
    return batch_kpis(by_hand(), TUNING, WINDOW, MEASURES)


@pytest.mark.parametrize("name", BY_HAND)
def test_a_run_by_hand_has_the_figures_that_were_worked_out(figures_by_hand, name):
    np.testing.assert_allclose(figures_by_hand[name][0], BY_HAND[name], rtol=1e-12)


def test_every_figure_is_described_computed_and_a_float_of_its_dims(figures_by_hand):
    assert list(BY_HAND) == list(figures_by_hand) == [item.name for item in KPIS]
    for item in KPIS:
        assert figures_by_hand[item.name].shape == (1, *(2 for _ in item.dims)), item.name
        assert figures_by_hand[item.name].dtype == np.float64, item.name


def test_the_page_on_key_figures_lists_each_with_its_unit_and_formula():
    page = (Path(__file__).resolve().parents[2] / "docs" / "kpis.md").read_text()
    rows = [
        [cell.strip() for cell in line.strip("| \n").split(" | ")]
        for line in page.splitlines()
        if line.startswith("| `")
    ]
    listed = {row[0].strip("`"): (row[2].strip("`"), row[3]) for row in rows}
    assert listed == {item.name: (item.formula, item.unit) for item in KPIS}


def test_units_are_filled_in_per_channel():
    units = {item.name: item.unit_of("m3/h") for item in KPIS}
    assert units["iae"] == "(m3/h) s"
    assert units["overshoot"] == units["mv_largest_excess"] == "m3/h"
    assert units["travel"] == "m3/h"
    assert units["oil_produced"] == "m3"


# how the figures of many runs relate


def test_a_batch_gives_what_each_run_gives():
    (batch, window), tunings = random_batch(), random_tunings()
    together = batch_kpis(batch, tunings, window, MEASURES)
    runs = runs_of(batch, window)
    figures_of = jax.jit(run_kpis, static_argnames="integrals")
    for k in range(LANES):
        run, tuning = jax.tree.map(lambda leaf, k=k: leaf[k], (runs, tunings))
        alone = figures_of(run, tuning, tuning.deadzone, batch.dt, SMALLEST, INTEGRALS)
        assert_equal({name: values[k] for name, values in together.items()}, alone)


def test_lanes_do_not_depend_on_their_place():
    (batch, window), tunings, order = random_batch(), random_tunings(), np.array([3, 0, 4, 1, 2])
    straight = batch_kpis(batch, tunings, window, MEASURES)
    lanes = jax.tree.map(lambda leaf: leaf[order], tunings)
    moved = batch_kpis(take(batch, order), lanes, window[order], MEASURES)
    assert_equal({name: values[order] for name, values in straight.items()}, moved)


def test_one_tuning_and_one_row_of_windows_serve_all_lanes():
    batch, window = random_batch()
    tuning = WELL.tuning(STRUCTURE)
    each = batch_kpis(batch, stack_tunings([tuning] * LANES), np.stack([window[0]] * LANES), MEASURES)
    assert_equal(each, batch_kpis(batch, tuning, window[0], MEASURES))


def test_only_volumes_and_limits_depend_on_where_the_setpoint_is():
    batch, window = random_batch()
    tunings = random_tunings()
    offset = np.array([250.0, 7.0])
    there = dataclasses.replace(changed(batch, cv=batch["cv"] + offset), setpoint=batch.setpoint + offset)
    here, there = (batch_kpis(one, tunings, window, MEASURES) for one in (batch, there))
    volumes = {"oil_produced": 40 * 7.0 / 360, "gas_produced": 40 * 250.0 / 360}
    for name, more in volumes.items():
        np.testing.assert_allclose(there.pop(name), here[name] + more)
    for name in ("cv_violations", "cv_largest_excess"):
        assert (there.pop(name) > here[name]).any()
    assert_equal({**here, **there}, here)


def test_a_sweep_agrees_with_the_comparison_of_the_thesis(tmp_path):
    runs = [made.trajectory(kind) for kind in made.RUNS.values()]
    compared = evaluate.key_figures(open_results(made.stored(tmp_path)))
    fields = {key: np.stack([getattr(run, key) for run in runs]) for key in RECORD}
    batch = batch_of(**{"setpoint": np.stack([run.setpoint for run in runs]), **fields})
    tunings = stack_tunings([controller.build_tuning(WELL) for controller in made.CONTROLLERS])
    swept = batch_kpis(batch, tunings, made.REFERENCE.build(WELL).window(made.DT), MEASURES)
    for name in swept:
        np.testing.assert_allclose(swept[name], compared[name].values, rtol=1e-12, err_msg=name)
    np.testing.assert_allclose(swept["hunting_reversals"], compared.late_reversals.sum("window"))
    assert swept["hunting_reversals"].any()


# edges


def test_a_run_that_rests_at_its_setpoint_has_nothing_to_report():
    level, position = np.tile([10_000.0, 150.0], (1, 30, 1)), np.tile([50.0, 7500.0], (1, 30, 1))
    found = batch_kpis(
        batch_of(level, level, position, position, np.zeros((1, 30, 2))),
        WELL.tuning(STRUCTURE),
        np.arange(30) // 10,
        MEASURES,
    )
    undefined = {"overshoot", "settling_time_mean", "settling_time_max", "mean_dwell", "shortest_dwell"}
    known = {
        "finite": 1.0,
        "objective": 1.0,
        "solve_time_median": 1e-3,
        "solve_time_p99": 1e-3,
        "solve_time_max": 1e-3,
        "lift_volume": 625.0,
        "oil_produced": 12.5,
        "gas_produced": 10_000 / 12,
    }
    for item in KPIS:
        expected = np.nan if item.name in undefined else known.get(item.name, 0.0)
        np.testing.assert_allclose(found[item.name][0], expected, rtol=1e-12, err_msg=item.name)


def test_the_move_of_the_first_sample_starts_at_the_position_before_the_run():
    level = np.tile([10_000.0, 150.0], (1, 3, 1))
    position = np.tile([54.0, 7300.0], (1, 3, 1))
    demand = position + np.array([0.3, 0.0])  # the step choke rounds
    move = np.zeros((1, 3, 2))
    move[0, 0] = [4.3, -200.0]
    found = batch_kpis(
        batch_of(level, level, position, demand, move), WELL.tuning(STRUCTURE), np.zeros(3, int), MEASURES
    )
    assert found["travel"][0].tolist() == pytest.approx([4.0, 200.0])
    assert found["moves"].tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize("field", ["cv", "mv", "mv_demand", "move", "setpoint"])
@pytest.mark.parametrize("sample", [0, 17, 39])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_run_that_is_not_finite_throughout_never_looks_good(field, sample, value):
    batch, window = random_batch()
    spoilt = batch.setpoint.copy() if field == "setpoint" else batch[field].copy()
    spoilt[1, sample, 0] = value
    bad = (
        dataclasses.replace(batch, setpoint=spoilt)
        if field == "setpoint"
        else changed(batch, **{field: spoilt})
    )
    tuning = WELL.tuning(STRUCTURE)
    found, sound = (batch_kpis(one, tuning, window, MEASURES) for one in (bad, batch))
    assert found["finite"].tolist() == [1.0, 0.0, 1.0, 1.0, 1.0]
    for name, values in found.items():
        assert name in ALWAYS or np.isnan(values[1]).all(), name
    others = np.array([0, 2, 3, 4])
    assert_equal({k: v[others] for k, v in found.items()}, {k: v[others] for k, v in sound.items()})


def test_samples_without_a_plan_are_counted_and_leave_no_objective_and_no_gap():
    batch, window = random_batch()
    fields = {key: batch[key].copy() for key in ("status", "fallback", "objective", "gap")}
    fields["status"][0, 5:8] = codes.FAILED
    fields["status"][0, 9] = codes.LIMIT
    fields["fallback"][0, 5:8] = True
    fields["objective"][0, 5:8] = fields["gap"][0, 5:8] = np.nan
    found = batch_kpis(changed(batch, **fields), WELL.tuning(STRUCTURE), window, MEASURES)
    assert found["fallbacks"].tolist() == [3.0, 0.0, 0.0, 0.0, 0.0]
    assert found["not_optimal"].tolist() == [4.0, 0.0, 0.0, 0.0, 0.0]
    assert np.isnan(found["objective"]).tolist() == [True, False, False, False, False]
    assert np.isinf(found["largest_gap"]).tolist() == [True, False, False, False, False]
    assert found["finite"].tolist() == [1.0] * LANES
    assert np.isfinite(found["closed_loop_cost"]).all()


def test_a_tolerance_judges_lanes_with_different_deadzones_alike():
    batch = by_hand()
    twice = take(batch, np.array([0, 0]))
    wide = dataclasses.replace(TUNING, deadzone=np.array([1e4, 1e4]))
    tunings = stack_tunings([TUNING, wide])
    own = batch_kpis(twice, tunings, WINDOW, MEASURES)
    assert own["settling_time_max"][:, 0].tolist() == [50.0, 0.0]
    same = batch_kpis(twice, tunings, WINDOW, MEASURES, tolerance=[40.0, 1.0])
    assert same["settling_time_max"][:, 0].tolist() == [50.0, 50.0]
    assert same["time_outside_deadzone"].tolist() == own["time_outside_deadzone"].tolist()
    each = batch_kpis(twice, tunings, WINDOW, MEASURES, tolerance=[[40.0, 1.0], [130.0, 1.0]])
    assert each["settling_time_max"][:, 0].tolist() == [50.0, 30.0]


def test_a_value_at_its_limit_up_to_rounding_is_no_violation():
    batch = by_hand()
    mv = batch["mv"].copy()
    mv[..., 1] = 7150 + 1e-3
    found = batch_kpis(changed(batch, mv=mv), TUNING, WINDOW, MEASURES)
    assert found["mv_violations"][0].tolist() == [0.0, 0.0]
    assert found["mv_largest_excess"][0].tolist() == [0.0, 0.0]


def test_a_second_batch_of_the_same_shape_compiles_nothing():
    (first, window), (second, others) = random_batch(), random_batch(seed=5)
    second = changed(second, status=second["status"].astype(np.int64))
    batch_kpis(first, random_tunings(), window, MEASURES)
    compiled = []
    monitor = lambda event, _, **__: compiled.append(event) if "compile" in event else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(monitor)
    try:
        batch_kpis(second, random_tunings(seed=6), others, MEASURES, tolerance=[1.0, 2.0])
        batch_kpis(second, WELL.tuning(STRUCTURE), others[0], MEASURES)
        assert not [event for event in compiled if "backend_compile" in event]
        batch_kpis(*random_batch(samples=41)[:1], WELL.tuning(STRUCTURE), np.zeros(41, int), MEASURES)
        assert [event for event in compiled if "backend_compile" in event]  # the monitor does see one
    finally:
        jax.monitoring.unregister_event_duration_listener(monitor)


# bad input


def refused(batch, tuning=TUNING, window=WINDOW, **options):
    with pytest.raises(InputError) as caught:
        batch_kpis(batch, tuning, window, MEASURES, **options)
    return caught.value.field


def test_a_field_that_was_not_recorded_is_refused():
    batch = by_hand()
    fields = {key: value for key, value in batch.fields.items() if key != "gap"}
    assert refused(dataclasses.replace(batch, fields=fields)) == "record"


def test_windows_tunings_and_tolerances_of_another_shape_are_refused():
    batch = by_hand()
    assert refused(batch, window=WINDOW[:-1]) == "window"
    assert refused(batch, window=WINDOW.astype(float)) == "window"
    assert refused(batch, tuning=stack_tunings([TUNING] * 2)) == "tunings.cv_weight"
    assert refused(batch, tolerance=[1.0]) == "tolerance"
    assert refused(batch, tolerance=[1.0, np.nan]) == "tolerance"
    assert refused(batch, tolerance=[1.0, -1.0]) == "tolerance"
