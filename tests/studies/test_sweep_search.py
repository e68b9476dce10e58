"""Searching studies: strict definitions, deterministic batches, fronts without failed runs, and nothing lost by a kill."""

import copy
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from jaxmpc.errors import InputError, MissingToolError
from studies.definition.models import identify_models
from studies.definition.sweep import StudyDefinition, shipped_studies
from studies.kpi.objectives import front, unbeaten
from studies.kpi.sweep import kpis_of
from studies.load import expand, load_study
from studies.run.chunk import run_scenarios, stored_variables
from studies.search import run as search
from studies.search.run import run_search
from studies.search.study import SearchStudy
from studies.store.reading import chunk_facts, kpi_frame, open_study, provenance
from studies.thesis.well import WELL

WEIGHT, LIFT = "tuning.move_weight.choke", "tuning.move_weight.gas_lift"
DEADZONE = ("tuning.deadzone.gas_rate", "tuning.deadzone.oil_rate")
CLOCK = ("solve_time_median", "solve_time_p99", "solve_time_max")  # all that may differ between runs
LENGTHS = {"cv": 2, "mv": 2}


def drawn(key, low, high, kind="uniform"):
    return {"key": key, "distribution": {"kind": kind, "from": low, "to": high}}


BODY = {
    "study": {"name": "sought", "chunk_size": 4},
    "base": {
        "controller": "continuous",
        "actuator": "continuous",
        "reference": "quick",
        "duration": 200,
        "prediction_horizon": 30,
        "blocks": [1, 2, 4],
    },
    "search": {"objectives": ["travel.choke", "deviation"], "batches": 3, "seed": 5},
    "axes": [
        drawn(WEIGHT, 10, 4000, "log-uniform"),
        {"keys": list(DEADZONE), "values": [[0, 0], [250, 1.25], [1000, 5]]},
    ],
    "store": {"trajectories": []},
}


def define(**changes) -> StudyDefinition:
    """The tiny search with other sections; a section that is a dictionary is changed, not replaced."""
    body = copy.deepcopy(BODY)
    for name, value in changes.items():
        body[name] = {**body[name], **value} if isinstance(body.get(name), dict) else value
    return StudyDefinition.from_dict(body)


def study(**changes) -> SearchStudy:
    return expand(define(**changes))


def run(made, path, **options):
    return run_search(made, path, **{"progress": False, "say": lambda _: None, **options})


def results(path) -> dict:
    """Everything stored but solve times."""
    data = open_study(path).load()
    return {name: v.values for name, v in data.variables.items() if name not in CLOCK}


def same(path, other):
    found, wanted = results(path), results(other)
    assert set(found) == set(wanted)
    for name, values in wanted.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


class Quick:
    """In place of the closed loop: two conflicting key figures from the tuning, at once; keeps a list of the batches."""

    def __init__(self, failing=(), scale=1.0):
        self.failing, self.scale, self.computed = failing, scale, 0

    def __call__(self, study, scenarios, models, *, lanes, **_):
        assert lanes == len(scenarios)
        fields = {
            v.name: np.full((lanes, *(LENGTHS[axis] for axis in v.dims)), 0, v.dtype)
            for v in stored_variables(WELL, study.definition.store.trajectories)
        }
        weight = np.array([float(s.tuning.move_weight[0]) for s in scenarios])
        lift = np.array([float(s.tuning.move_weight[1]) for s in scenarios])
        share = np.log(weight / 10) / np.log(400)  # 0 to 1
        rest = (
            1 + 9 * np.abs(np.log10(lift / 0.2)) + np.array([float(s.tuning.deadzone[0]) for s in scenarios])
        )
        fields["travel"][:, 0] = self.scale * share
        fields["mean_absolute_deviation"][:] = (rest * (1 - np.sqrt(share / rest)))[:, None]
        fields["complete"][:] = 1
        for lane in range(lanes):
            if (self.computed, lane) in self.failing:
                fields["complete"][lane] = 0
                fields["travel"][lane, 0] = -1e9  # would beat everything
        self.computed += 1
        return fields, {"wall_time": 0.0}


@pytest.fixture
def quick(monkeypatch):
    """`Quick` for the closed loop; call it with other arguments to replace it."""

    def put(**options):
        made = Quick(**options)
        monkeypatch.setattr(search, "run_scenarios", made)
        return made

    monkeypatch.setattr(search, "identify_models", lambda process, points: {})
    put()
    return put


# ----------------------------------------------------------------------------------------------------- definitions

REFUSED = {
    "an objective that does not exist": (
        {"search": {"objectives": ["travl.choke"]}},
        "search.objectives[0]",
        "travel",
    ),
    "an objective of the clock": (
        {"search": {"objectives": ["travel.choke", "solve_time_p99"]}},
        "search.objectives[1]",
        "clock",
    ),
    "a figure per CV without its CV": (
        {"search": {"objectives": ["mean_absolute_deviation"]}},
        "search.objectives[0]",
        "mean_absolute_deviation.oil_rate",
    ),
    "a CV that does not exist": (
        {"search": {"objectives": ["iae.oil"]}},
        "search.objectives[0]",
        "iae.oil_rate",
    ),
    "a channel of a figure without channels": (
        {"search": {"objectives": ["closed_loop_cost.oil_rate"]}},
        "search.objectives[0]",
        "no channels",
    ),
    "an objective twice": (
        {"search": {"objectives": ["deviation", "deviation"]}},
        "search.objectives[1]",
        "once",
    ),
    "no objective": ({"search": {"objectives": []}}, "search.objectives", "one or more"),
    "too few directions": ({"search": {"directions": ["minimize"]}}, "search.directions", "2 directions"),
    "a direction that is none": (
        {"search": {"directions": ["up", "minimize"]}},
        "search.directions[0]",
        "maximize",
    ),
    "no batches": ({"search": {"batches": 0}}, "search.batches", "1 or more"),
    "an unknown sampler": ({"search": {"sampler": "random"}}, "search.sampler", "nsga2, tpe"),
    "an unknown key": ({"search": {"trials": 5}}, "search.trials", "batches"),
    "a sampling besides": ({"sampling": {"method": "grid"}}, "sampling", "[search]"),
    "no axes": ({"axes": []}, "axes", "one axis or more"),
    "a normal distribution": (
        {"axes": [{"key": WEIGHT, "distribution": {"kind": "normal", "mean": 1, "deviation": 1}}]},
        "axes[0].distribution.kind",
        "uniform",
    ),
    "bounds the wrong way round": ({"axes": [drawn(WEIGHT, 5, 1)]}, "axes[0].distribution.to", "above from"),
    "a range": (
        {"axes": [{"key": WEIGHT, "range": {"from": 1, "to": 2, "count": 2}}]},
        "axes[0].range",
        "distribution",
    ),
    "a file": ({"axes": [{"key": WEIGHT, "csv": {"file": "a.csv"}}]}, "axes[0].csv", "distribution"),
    "an axis that changes the structure": (
        {"axes": [{"key": "prediction_horizon", "values": [30, 40]}]},
        "axes[0].key",
        "structure",
    ),
    "an axis that changes the kind": (
        {"axes": [drawn(WEIGHT, 1, 2), {"key": "controller", "values": ["continuous", "mixed-integer"]}]},
        "axes[1].key",
        "kind",
    ),
    "an axis that changes the length": ({"axes": [drawn("duration", 100, 200)]}, "axes[0].key", "length"),
    "limits that are finite only at times": (
        {
            "base": {"tuning": {"cv_low": dict.fromkeys(("gas_rate", "oil_rate"), -np.inf)}},
            "axes": [
                drawn(WEIGHT, 1, 2),
                {
                    "keys": ["tuning.cv_high.gas_rate", "tuning.cv_high.oil_rate"],
                    "values": [[1e4, 100], [np.inf, np.inf]],
                },
            ],
        },
        "axes[1]",
        "compiled program",
    ),
    "a model for every number": ({"axes": [drawn("model.choke", 20, 60)]}, "axes[0].distribution", "values"),
    "limits that cross in a corner": (
        {"axes": [drawn("tuning.mv_low.choke", 0, 60), drawn("tuning.mv_high.choke", 50, 100)]},
        "axes[0]",
        "mv_low",
    ),
    "a negative weight at an end": ({"axes": [drawn(WEIGHT, -1, 2)]}, "axes[0]", "0 or more"),
    "batches of a study that lists": ({"search": None, "quick": {"batches": 2}}, "quick.batches", "[search]"),
    "very many scenarios": (
        {"study": {"confirmation_limit": 11}},
        "study.confirmation_limit",
        "11 scenarios",
    ),
}


@pytest.mark.parametrize(("changes", "field", "words"), REFUSED.values(), ids=list(REFUSED))
def test_a_definition_with_a_mistake_is_refused_with_its_path_and_what_is_expected(changes, field, words):
    changes = copy.deepcopy(changes)
    body = copy.deepcopy(BODY)
    for name, value in changes.items():
        body[name] = {**body[name], **value} if isinstance(body.get(name), dict) and value else value
    body = {name: value for name, value in body.items() if value is not None}
    with pytest.raises(InputError) as caught:
        expand(StudyDefinition.from_dict(body))
    assert caught.value.field.startswith(field)
    assert words in str(caught.value)


def test_a_dry_run_counts_batches_of_scenarios_and_one_compilation():
    made = study()
    found = made.describe()
    assert (found.scenarios, found.chunks, found.compilations, found.models) == (12, 3, 1, 1)
    assert found.samples == 12 * 20
    assert "3 batches of 4 scenarios" in str(found)
    assert expand(define(study={"confirmation_limit": 11}), confirmed=True).count == 12


def test_the_quick_cut_replaces_batches_axes_and_batch_size():
    quick = {"batches": 2, "chunk_size": 3, "axes": {WEIGHT: {"values": [1, 2]}}}
    cut = expand(define(quick=quick), quick=True)
    assert (cut.name, cut.batches, cut.chunk_size, cut.count) == ("sought-quick", 2, 3, 6)
    assert cut.parameters[0].entries == ((1.0,), (2.0,))


def test_the_shipped_search_is_checked_in_both_sizes_and_its_space_holds_the_thesis_tuning():
    assert "tune" in shipped_studies()
    full, cut = load_study("tune"), load_study("tune", quick=True)
    thesis = WELL.tuning_fields("thesis")
    for made in (full, cut):
        assert isinstance(made, SearchStudy)
        for parameter in made.parameters:
            _, name, channel = parameter.name.split(".")
            assert parameter.low < thesis[name][channel] < parameter.high
    assert cut.count < full.count / 5
    assert full.describe().seconds < 20 * 60
    assert cut.describe().seconds < 75


# ------------------------------------------------------------------------------------------------------- searching


def test_tuned_values_are_coordinates_with_units_within_their_bounds(tmp_path, quick):
    axes = [
        *BODY["axes"],
        {"key": "soft", "values": [True, False]},
        drawn("seed", 3, 9),
        {"key": "preset", "values": ["thesis", "no-soft"]},
    ]
    path = run(study(axes=axes, search={"batches": 8}), tmp_path / "a.zarr")
    data = open_study(path)
    for key, unit in ((WEIGHT, "1/%^2"), (DEADZONE[0], "m3/h"), ("seed", "1"), ("soft", "")):
        assert data.coords[key].dims == ("scenario",)
        assert data.coords[key].attrs["units"] == unit
    weights, seeds = data[WEIGHT].values, data.seed.values
    assert ((weights >= 10) & (weights <= 4000)).all()
    assert len(set(weights[:4].tolist())) == 4
    assert set(seeds.tolist()) <= set(range(3, 10))
    assert set(data.soft.values.tolist()) == {"true", "false"}
    assert set(data.preset.values.tolist()) == {"thesis", "no-soft"}
    pairs = set(zip(*(data[key].values.tolist() for key in DEADZONE), strict=True))
    assert pairs == {(0.0, 0.0), (250.0, 1.25), (1000.0, 5.0)}
    table = kpi_frame(path)
    assert list(table.columns[:3]) == [WEIGHT, *DEADZONE]
    assert provenance(data, "objectives") == {"travel.choke": "minimize", "deviation": "minimize"}


@pytest.mark.parametrize("sampler", ["nsga2", "tpe"])
def test_a_search_that_stopped_anywhere_goes_on_as_if_it_had_not(tmp_path, quick, monkeypatch, sampler):
    made = study(search={"sampler": sampler, "batches": 5})
    whole = run(made, tmp_path / "whole.zarr")
    assert not np.array_equal(results(whole)[WEIGHT][:4], results(whole)[WEIGHT][4:8])

    counted = quick()
    for stop in (1, 3):

        def interrupted(*arguments, stop=stop, **options):
            if counted.computed == stop:
                raise KeyboardInterrupt
            return counted(*arguments, **options)

        monkeypatch.setattr(search, "run_scenarios", interrupted)
        with pytest.raises(KeyboardInterrupt, match=f"{stop} of 5 batches are stored"):
            run(made, tmp_path / "parts.zarr")
        assert sorted(chunk_facts(tmp_path / "parts.zarr")) == list(range(stop))
        part = open_study(tmp_path / "parts.zarr")
        assert np.isnan(part[WEIGHT].values[4 * stop :]).all()
        assert set(front(tmp_path / "parts.zarr")) <= set(range(4 * stop))
    monkeypatch.setattr(search, "run_scenarios", counted)
    run(made, tmp_path / "parts.zarr")
    assert counted.computed == 5
    same(tmp_path / "parts.zarr", whole)
    run(made, tmp_path / "parts.zarr")
    assert counted.computed == 5


def test_a_damaged_batch_is_computed_again_and_the_later_ones_stay(tmp_path, quick):
    made = study(search={"batches": 5})
    path = run(made, tmp_path / "a.zarr")
    whole = results(path)
    file = path / "travel" / "c.2.0"
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    counted = quick()
    run(made, path)
    assert counted.computed == 1
    for name, values in results(path).items():
        np.testing.assert_array_equal(values, whole[name])


def test_batches_that_answer_other_questions_are_computed_again(tmp_path, quick):
    made = study(search={"batches": 4})
    path = run(made, tmp_path / "a.zarr")
    (path / "commits" / "c.0").unlink()
    quick(scale=-1.0)  # another machine: the first batch now says the opposite
    lines = []
    run(made, path, say=lines.append)
    assert any("other points" in line for line in lines)
    wanted = run(made, tmp_path / "b.zarr")
    same(path, wanted)


def test_a_longer_search_goes_on_from_a_shorter_one(tmp_path, quick):
    run(study(search={"batches": 3}), tmp_path / "a.zarr")
    counted = quick()
    lines = []
    longer = run(study(search={"batches": 5}), tmp_path / "a.zarr", say=lines.append)
    assert counted.computed == 2
    assert any("taken over" in line for line in lines)
    same(longer, run(study(search={"batches": 5}), tmp_path / "b.zarr"))


@pytest.mark.parametrize(
    "changes",
    [
        {"search": {"seed": 6}},
        {"search": {"sampler": "tpe"}},
        {"search": {"directions": ["minimize", "maximize"]}},
        {"study": {"chunk_size": 5}},
        {"base": {"preset": "no-soft"}},
        {"axes": [drawn(WEIGHT, 10, 4001, "log-uniform"), BODY["axes"][1]]},
    ],
    ids=str,
)
def test_what_decides_a_batch_is_in_the_hash_of_its_scenarios(changes):
    one, other = study(), study(**changes)
    assert one.scenario_hash(0) == study().scenario_hash(0)
    assert one.scenario_hash(0) != other.scenario_hash(0)
    assert len({one.scenario_hash(k) for k in range(one.count)}) == one.count


def test_failed_scenarios_are_never_on_the_front_and_are_told_as_failed(tmp_path, quick, monkeypatch):
    told = []
    tell = search._Sampler.tell

    def spy(self, values):
        tell(self, values)
        told.extend(trial.state.name for trial in self.record.get_trials()[-4:])

    monkeypatch.setattr(search._Sampler, "tell", spy)
    failing = {(0, lane) for lane in range(4)} | {(1, 2), (3, 0)}  # all of the first batch
    quick(failing=failing)
    path = run(study(search={"batches": 5}), tmp_path / "a.zarr")
    lost = {4 * batch + lane for batch, lane in failing}
    assert {k for k, state in enumerate(told) if state == "FAIL"} == lost
    assert told.count("COMPLETE") == 20 - len(lost)
    best = front(path)
    assert len(best)
    assert not set(best.tolist()) & lost
    assert set(np.flatnonzero(open_study(path).complete.values == 0)) == lost


def test_the_front_is_what_no_scenario_beats_in_the_directions_of_the_search(tmp_path, quick):
    directions = ["maximize", "minimize"]
    axes = [BODY["axes"][0], drawn(LIFT, 0.01, 4, "log-uniform")]
    path = run(study(axes=axes, search={"directions": directions, "batches": 10}), tmp_path / "a.zarr")
    table = kpi_frame(path)
    deviation = (
        table["mean_absolute_deviation.gas_rate"] / 1000 + table["mean_absolute_deviation.oil_rate"] / 5
    )
    points = np.stack([-table["travel.choke"], deviation / 2], axis=1)
    wanted = [i for i, p in enumerate(points) if not any((q <= p).all() and (q < p).any() for q in points)]
    best = front(path)
    assert sorted(best.tolist()) == wanted
    assert (np.diff(points[best, 0]) >= 0).all()
    with pytest.raises(InputError, match="store of a study"):
        front(tmp_path / "none.zarr")


def test_equal_points_do_not_beat_each_other_and_numbers_that_are_not_finite_beat_nothing():
    points = np.array([[1, 2], [1, 2], [0, np.nan], [-np.inf, 0], [2, 1], [2, 2], [0.5, 3]])
    assert unbeaten(points).tolist() == [True, True, False, False, True, False, True]
    assert unbeaten(np.array([[3.0], [1.0], [1.0]])).tolist() == [False, True, True]
    assert unbeaten(np.full((2, 2), np.nan)).tolist() == [False, False]


def hypervolume(points, corner):
    """Area that two objectives beat up to a corner."""
    points = points[(points < corner).all(axis=1)]
    points = points[np.argsort(points[:, 0])]
    area, height = 0.0, corner[1]
    for x, y in points:
        area += (corner[0] - x) * max(height - y, 0.0)
        height = min(height, y)
    return area


@pytest.mark.parametrize("sampler", ["nsga2", "tpe"])
def test_a_sampler_beats_points_drawn_at_random(tmp_path, quick, sampler):
    axes = [BODY["axes"][0], drawn(LIFT, 0.001, 40, "log-uniform"), drawn(DEADZONE[0], 0, 10)]
    change = {"axes": axes, "study": {"chunk_size": 12}, "store": {"trajectories": []}}

    def volume(name, batches, size):
        change["study"]["chunk_size"] = size
        path = run(study(**change, search={"batches": batches, "sampler": sampler}), tmp_path / name)
        with open_study(path) as data:
            points = np.stack(
                [data.travel.sel(mv="choke"), data.mean_absolute_deviation.sel(cv="gas_rate")], axis=1
            )
        return hypervolume(points, (1.1, 11.0))

    assert volume("sought.zarr", 12, 12) > 1.03 * volume("random.zarr", 1, 144)  # a first batch is random


def test_a_search_without_optuna_says_what_to_install_and_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    made = study()
    assert made.describe().chunks == 3
    with pytest.raises(MissingToolError, match=r"pip install 'jaxmpc\[search\]'"):
        run(made, tmp_path / "a.zarr")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", [{"workers": 2}, {"dask": "tcp://host:1"}], ids=str)
def test_a_search_runs_in_one_process_and_says_why(tmp_path, option):
    with pytest.raises(InputError, match="waits for the one before"):
        run(study(), tmp_path / "a.zarr", **option)
    assert not list(tmp_path.iterdir())


def test_the_sampler_prints_nothing_and_leaves_its_library_as_it_was(tmp_path, quick, capfd):
    import optuna

    before = optuna.logging.get_verbosity()
    with warnings.catch_warnings(record=True) as caught:
        run(study(search={"sampler": "tpe"}), tmp_path / "a.zarr")
    assert capfd.readouterr() == ("", "")
    assert not caught
    assert optuna.logging.get_verbosity() == before


# ------------------------------------------------------------------------------------------------------- real runs

KILLED = """
import os, signal, sys
from studies.search import run as search
from tests.studies.test_sweep_search import run, study

compute, done = search.run_scenarios, []

def dying(*arguments, **options):
    if done:
        os.kill(os.getpid(), signal.SIGKILL)
    done.append(1)
    return compute(*arguments, **options)

search.run_scenarios = dying
run(study(), sys.argv[1])
"""


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """The tiny search, run for real."""
    return run(study(), tmp_path_factory.mktemp("real") / "real.zarr")


def test_a_search_that_was_killed_ends_as_one_that_was_not(tmp_path, real):
    path = tmp_path / "killed.zarr"
    ended = subprocess.run(
        [sys.executable, "-c", KILLED, str(path)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        timeout=300,
    )
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert sorted(chunk_facts(path)) == [0]
    run(study(), path)
    same(path, real)
    np.testing.assert_array_equal(front(path), front(real))


def test_a_stored_scenario_is_the_run_of_its_tuned_values(real):
    made = study()
    evaluated = made.evaluated(real)
    assert evaluated.count == 12
    data = open_study(real)
    for k in (0, 7, 11):
        scenario = evaluated.scenario(k)
        assert float(scenario.tuning.move_weight[0]) == data[WEIGHT].values[k]
        assert evaluated.scenario_hash(k) == data.scenario_hash.values[k]
    models = identify_models(WELL, [evaluated.scenario(7).model_point])
    # with the lanes of the search, which then has its program
    fields, _ = run_scenarios(evaluated, [evaluated.scenario(7)], models, lanes=4, shared_model=True)
    for kpi in kpis_of(WELL):
        if kpi.name not in CLOCK:
            stored = data[kpi.name].values[7]
            np.testing.assert_allclose(fields[kpi.name][0], stored, rtol=1e-6, atol=1e-9, err_msg=kpi.name)


@pytest.mark.slow
def test_what_is_found_for_the_well_beats_as_many_points_drawn_at_random(tmp_path):
    change = {
        "base": {"duration": 2000, "prediction_horizon": 100, "blocks": [1, 1, 2, 4, 8, 16, 32]},
        "axes": [
            drawn(WEIGHT, 1, 4000, "log-uniform"),
            drawn(LIFT, 0.002, 20, "log-uniform"),
            drawn(DEADZONE[0], 0, 3000),
            drawn(DEADZONE[1], 0, 15),
        ],
    }

    def points(name, batches, size):
        made = study(**change, study={"chunk_size": size}, search={"batches": batches})
        with open_study(run(made, tmp_path / name)) as data:
            scale = np.array([1000.0, 5.0])
            deviation = (data.mean_absolute_deviation.values / scale).mean(axis=1)
            return np.stack([data.travel.sel(mv="choke").values, deviation], axis=1)

    sought, random = points("sought.zarr", 8, 16), points("random.zarr", 1, 128)
    corner = random.max(axis=0)
    assert hypervolume(sought, corner) > hypervolume(random, corner)
