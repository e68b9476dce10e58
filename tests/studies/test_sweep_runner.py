"""Running sweep studies: stored numbers are those of single runs, and nothing that dies on the way changes them."""

import copy
import errno
import json
import math
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from jaxmpc import simulate, stack_tunings
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.loop.trajectory import TrajectoryBatch
from jaxmpc.process.well.plant import WellPlant
from studies import load
from studies.definition import scenarios
from studies.definition.sweep import StudyDefinition
from studies.kpi.sweep import RECORD, batch_kpis, measures_of
from studies.rerun import rerun, study_of
from studies.run import runner
from studies.run.chunk import prepare_study, run_chunk, run_scenarios, study_layout
from studies.run.executors import LostError
from studies.run.runner import RunError, run_study
from studies.store.reading import chunk_facts, open_study, provenance
from studies.store.writing import Store
from studies.thesis.well import WELL
from tests.sweep_hazards import BODY, computed, preparation, processes

CLOCK = ("solve_time_median", "solve_time_p99", "solve_time_max")  # all that may differ between runs
MIXED = copy.deepcopy(BODY)
MIXED["base"] |= {"controller": "mixed-integer", "duration": 200}
MIXED["axes"][1]["values"] = MIXED["axes"][1]["values"][:2]


def expand(**changes):
    """The tiny study with other sections."""
    return load.expand(StudyDefinition.from_dict({**BODY, **changes}))


def run(study, path, **options):
    """Run without a word."""
    options = {"say": lambda _: None, "progress": False, **options}
    return run_study(study, path, **options)


def same(store, other):
    """Every stored number but the solve times."""
    with open_study(store) as data, open_study(other) as wanted:
        assert set(data.variables) == set(wanted.variables)
        for name in set(wanted.variables) - set(CLOCK):
            np.testing.assert_array_equal(data[name].values, wanted[name].values, err_msg=str(name))
        assert data.complete.values.all()


@pytest.fixture(scope="module")
def study():
    """Eight scenarios in chunks of 3, 3 and 2; everything that can differ within a group does."""
    return expand()


@pytest.fixture(scope="module")
def prepared(study):
    """With the models."""
    return prepare_study(study)


@pytest.fixture(scope="module")
def serial(study, tmp_path_factory):
    """The store of an uninterrupted run in this process."""
    return run(study, tmp_path_factory.mktemp("serial") / "tiny.zarr")


@pytest.fixture
def hazard(monkeypatch, tmp_path):
    """Make a chunk of the next run go wrong."""

    def make(kind, index=1):
        monkeypatch.setattr(runner, "prepare_study", preparation(kind, index, tmp_path))

    return make


# -------------------------------------------------------------------------------------------------------- numbers


def alone(scenario, models):
    """The scenario run by itself: trajectory and key figures."""
    found = simulate(
        Controller(scenario.structure, scenario.tuning, models[scenario.model_point]),
        WellPlant(actuator=scenario.actuator).replaced(scenario.plant),
        scenario.reference,
        samples=scenario.samples,
        disturbance=scenario.disturbance,
        noise=scenario.noise,
        faults=scenario.faults,
        position_feedback=scenario.position_feedback,
        seed=scenario.seed,
    )
    batch = TrajectoryBatch(
        lanes=np.arange(1),
        time=found.time,
        setpoint=found.setpoint[None],
        fields={name: np.asarray(getattr(found, name))[None] for name in RECORD},
        **{key: getattr(found, key) for key in ("cv_names", "mv_names", "cv_units", "mv_units", "dt")},
    )
    window = scenario.reference.window(scenario.structure.dt, scenario.samples)
    figures = batch_kpis(
        batch, stack_tunings([scenario.tuning]), window, measures_of(WELL), tolerance=WELL.settled
    )
    return found, {name: values[0] for name, values in figures.items()}


def compare_with_single_runs(study, models, store, numbers):
    every = study.definition.store.every
    with open_study(store) as data:
        for k in numbers:
            found, figures = alone(study.scenario(k), models)
            row = data.sel(scenario=k)
            for field, name in (("cv", "measurement"), ("mv", "position"), ("setpoint", "setpoint")):
                # lanes and single runs are other programs: only rounding may differ
                wanted = getattr(found, field)[::every]
                np.testing.assert_allclose(row[name].values, wanted, rtol=1e-9, atol=1e-9, err_msg=name)
            for name in set(figures) - set(CLOCK):
                np.testing.assert_allclose(
                    row[name].values, figures[name], rtol=1e-7, atol=1e-7, err_msg=f"{name} of {k}"
                )


def test_stored_numbers_are_those_of_scenarios_run_alone_also_in_a_chunk_that_is_not_full(
    study, prepared, serial
):
    assert [len(chunk.scenarios) for chunk in study.chunks] == [3, 3, 2]
    compare_with_single_runs(study, prepared.models, serial, [0, 1, 2, 7])


def test_scenarios_of_a_study_differ_in_everything_that_may_differ_per_lane(study, serial):
    with open_study(serial) as data:
        assert len({tuple(row) for row in data.measurement.values[:, -1]}) == study.count
        assert len({tuple(row) for row in data.setpoint.values[:, 0]}) == 2
        assert data.sizes["time"] == math.ceil(30 / 4)
        np.testing.assert_array_equal(data.time.values, 40.0 * np.arange(8))


def test_numbers_do_not_depend_on_the_scenarios_that_share_a_chunk(study, prepared):
    options = dict(lanes=3, varying=study.varying_plant(0))
    one, _ = run_scenarios(study, [study.scenario(7)], prepared.models, **options)
    several = [study.scenario(k) for k in (7, 1, 2)]
    with_others, facts = run_scenarios(study, several, prepared.models, **options)
    assert (facts["lanes"], facts["scenarios"]) == (3, 3)
    for name in set(one) - set(CLOCK):
        assert one[name].shape[0] == 1
        np.testing.assert_array_equal(one[name][0], with_others[name][0], err_msg=name)


def test_a_chunk_computed_twice_differs_in_solve_times_only(prepared):
    first, second = run_chunk(prepared, 2), run_chunk(prepared, 2)
    assert first.index == second.index == 2
    assert set(first.fields) == set(second.fields)
    for name in set(first.fields) - set(CLOCK):
        np.testing.assert_array_equal(first.fields[name], second.fields[name], err_msg=name)


@pytest.mark.slow
def test_integer_moves_are_stored_as_scenarios_run_alone_have_them(tmp_path):
    study = load.expand(StudyDefinition.from_dict(MIXED))
    assert {group.kind for group in study.groups} == {"mixed-integer"}
    store = run(study, tmp_path / "mixed.zarr")
    compare_with_single_runs(study, prepare_study(study).models, store, [0, 3])


@pytest.mark.slow
def test_runs_of_different_length_share_a_store_and_shorter_ones_end_empty(tmp_path):
    body = copy.deepcopy(BODY)
    body["axes"] = [{"key": "duration", "values": [300, 200]}]
    body["store"] = {"every": 4, "trajectories": ["cv", "status", "objective"]}
    study = load.expand(StudyDefinition.from_dict(body))
    assert len(study.groups) == 2
    with open_study(run(study, tmp_path / "x.zarr")) as data:
        assert np.isfinite(data.measurement.values[0]).all()
        assert np.isfinite(data.measurement.values[1, :5]).all()
        assert np.isnan(data.measurement.values[1, 5:]).all()
        assert data.status.values[1].tolist() == [0] * 5 + [-1] * 3
        assert np.isfinite(data.plan_objective.values[0]).all()
        assert data.complete.values.all()


# --------------------------------------------------------------------------------------------------- what goes wrong


def test_a_worker_that_is_killed_changes_nothing(study, serial, hazard, tmp_path):
    hazard("die-once")
    said = []
    path = run(study, tmp_path / "x.zarr", workers=2, say=said.append)
    same(path, serial)
    assert any("worker died" in line for line in said)
    assert computed(tmp_path).count(1) > 1
    assert {fact["process"] for fact in chunk_facts(path).values()} <= processes(tmp_path)
    assert not any(_alive(pid) for pid in processes(tmp_path))


def _alive(pid):
    return Path(f"/proc/{pid}").exists() and ") Z" not in Path(f"/proc/{pid}/stat").read_text()


@pytest.mark.slow
def test_several_processes_store_what_one_does(study, serial, hazard, tmp_path):
    hazard("none")
    same(run(study, tmp_path / "x.zarr", workers=2), serial)
    assert sorted(computed(tmp_path)) == [0, 1, 2]
    assert not any(_alive(pid) for pid in processes(tmp_path))


@pytest.mark.slow
def test_a_chunk_that_always_kills_its_worker_fails_by_name_after_three_tries(
    study, serial, hazard, tmp_path
):
    hazard("die")
    with pytest.raises(RunError, match=r"1 of 3 chunks failed.*chunk 1 \(scenarios 3 to 5\).*same command"):
        run(study, tmp_path / "x.zarr", workers=2)
    assert 3 <= computed(tmp_path).count(1) <= 4  # once in company, then alone
    assert sorted(chunk_facts(tmp_path / "x.zarr")) == [0, 2]
    (tmp_path / "computed").unlink()
    hazard("none")
    same(run(study, tmp_path / "x.zarr"), serial)
    assert computed(tmp_path) == [1]


def test_chunks_are_given_up_when_no_worker_lives():
    class Dying:
        width = 2
        count = 0

        def submit(self, index):
            self.count += 1
            future = runner.concurrent.futures.Future()
            future.set_exception(runner.concurrent.futures.BrokenExecutor("gone"))
            return future

        def check(self):
            pass

    dying, failed = Dying(), {}
    with pytest.raises(LostError, match="no worker has lived"):
        list(runner._results(dying, list(range(1000)), failed, lambda _: None))
    assert dying.count < 10


def test_a_chunk_that_raises_is_named_and_only_it_is_tried_again(study, serial, hazard, tmp_path):
    hazard("fail")
    with pytest.raises(RunError, match=r"chunk 1 \(scenarios 3 to 5\): RuntimeError: made to fail"):
        run(study, tmp_path / "x.zarr")
    assert sorted(chunk_facts(tmp_path / "x.zarr")) == [0, 2]
    (tmp_path / "computed").unlink()
    hazard("none")
    said = []
    same(run(study, tmp_path / "x.zarr", say=said.append), serial)
    assert computed(tmp_path) == [1]
    assert "2 of 3 chunks are stored." in said


def test_a_finished_study_is_not_computed_again(study, serial, monkeypatch):
    monkeypatch.setattr(runner, "prepare_study", lambda _: pytest.fail("something was prepared"))
    before = chunk_facts(serial)
    assert run(study, serial) == serial
    assert chunk_facts(serial) == before


def test_a_full_disk_ends_the_run_with_what_to_do_and_keeps_what_is_stored(
    study, serial, monkeypatch, tmp_path
):
    whole = Store.commit

    def commit(self, index, fields, facts):
        if index == 1:
            monkeypatch.setattr("studies.store.writing.write_atomically", refuse)
        whole(self, index, fields, facts)

    def refuse(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Store, "commit", commit)
        with pytest.raises(InputError, match=r"No space left.*Free space.*same command again"):
            run(study, tmp_path / "x.zarr")
    monkeypatch.undo()
    assert sorted(chunk_facts(tmp_path / "x.zarr")) == [0]
    same(run(study, tmp_path / "x.zarr"), serial)


def test_how_a_study_is_cut_changes_its_results_by_rounding_only(study, serial, tmp_path):
    alone = expand(study={"name": "tiny"})
    assert (alone.chunk_size, study.chunk_size) == (1, 3)
    run_chunk(prepare_study(alone), 0)  # its programs are kept: the workers would both compile them at once
    with open_study(run(alone, tmp_path / "x.zarr", workers=2)) as data, open_study(serial) as wanted:
        for name in set(wanted.data_vars) - set(CLOCK):
            np.testing.assert_allclose(data[name], wanted[name], rtol=1e-9, atol=1e-9, err_msg=str(name))
    assert len(chunk_facts(tmp_path / "x.zarr")) == 8


def test_one_more_value_on_an_axis_computes_new_chunks_only(study, serial, hazard, tmp_path):
    path = tmp_path / "x.zarr"
    sections = dict(BODY, study={"name": "tiny", "chunk_size": 3})
    axis, *others = BODY["axes"]
    run(load.expand(StudyDefinition.from_dict(sections)), path)
    sections["axes"] = [{**axis, "values": [100, 200, 300]}, *others]
    more = load.expand(StudyDefinition.from_dict(sections))
    hazard("none")
    said = []
    run(more, path, say=said.append)
    assert computed(tmp_path) == [2, 3]
    assert any("6 scenarios (2 chunks) are taken over" in line for line in said)
    with open_study(path) as data, open_study(serial) as wanted:
        assert data.sizes["scenario"] == 12
        np.testing.assert_array_equal(data.position.values[:8], wanted.position.values)


@pytest.mark.parametrize("workers", [0, -1, 1.5, True, "2"])
def test_a_number_of_workers_that_is_none_is_refused(workers, study, tmp_path):
    with pytest.raises(InputError, match="workers"):
        run(study, tmp_path / "x.zarr", workers=workers)
    assert not list(tmp_path.iterdir())


# ----------------------------------------------------------------------------------------------------- provenance


def strict(text):
    """JSON without the words NaN and Infinity, which JSON does not have."""
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))


def test_a_store_says_where_its_numbers_come_from(study, serial):
    with open_study(serial) as data:
        assert load.expand(StudyDefinition.from_dict(provenance(data, "definition"))).hash == study.hash
        assert data.attrs["study_hash"] == study.hash
        assert provenance(data, "versions")["jax"]
        assert provenance(data, "seeds") == {"sampling": 0, "noise": "the column seed"}
        assert provenance(data, "quick") is False
    for facts in chunk_facts(serial).values():
        assert facts["device"]
        assert facts["wall_time"] > facts["simulation_time"] > 0


def test_infinite_limits_stay_valid_json_and_come_back(tmp_path):
    body = copy.deepcopy(BODY)
    body["base"]["tuning"] = {"cv_low": {"gas_rate": -math.inf}, "cv_high": {"oil_rate": math.inf}}
    body["axes"] = [{"key": "tuning.cv_high.gas_rate", "values": [math.inf, 20000]}]
    study = load.expand(StudyDefinition.from_dict(body))
    path = tmp_path / "x.zarr"
    Store.begin(path, study_layout(study)).close()
    attributes = strict((path / "zarr.json").read_text())["attributes"]
    strict(attributes["definition"])
    for file in (path / "commits").glob("*.json"):
        strict(file.read_text())
    assert study_of(path).hash == study.hash


# ---------------------------------------------------------------------------------------------------------- again


@pytest.mark.parametrize("number", [1, 6])
def test_a_scenario_run_again_has_the_stored_numbers_and_its_title_its_values(number, serial):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = rerun(serial, number)
    with open_study(serial) as data:
        row = data.sel(scenario=number)
        # a lane of a chunk and a single run are other programs: only rounding may differ
        for field, name in (("cv", "measurement"), ("mv", "position"), ("setpoint", "setpoint")):
            found = getattr(again.trajectory, field)[::4]
            np.testing.assert_allclose(found, row[name].values, rtol=1e-9, atol=1e-9)
    assert f"tiny, scenario {number}: tuning.move_weight.choke = " in again.title
    assert "plant.reservoir_pressure = 7" in again.title
    assert (again.kind, again.actuator) == ("continuous", "step")


def test_a_scenario_run_again_by_other_code_is_named_as_such(serial, monkeypatch):
    monkeypatch.setattr(scenarios, "code_hash", lambda: "other")
    with pytest.warns(UserWarning, match="scenario 0 was stored by other code"):
        rerun(serial, 0)


def test_a_scenario_that_does_not_exist_is_refused(serial, tmp_path):
    with pytest.raises(InputError, match="0 to 7"):
        rerun(serial, 8)
    with pytest.raises(InputError, match=r"none\.zarr"):
        rerun(tmp_path / "none.zarr", 0)


# ----------------------------------------------------------------------------------------------------------- dask


def test_a_missing_dask_is_named_with_the_command_that_installs_it(study, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingToolError, match=r"pip install 'jaxmpc\[dask\]'"):
        run(study, tmp_path / "x.zarr", dask="tcp://127.0.0.1:8786")
    assert not list(tmp_path.iterdir())


def test_a_cluster_and_processes_at_once_are_refused(study, tmp_path):
    with pytest.raises(InputError, match="the cluster has workers of its own"):
        run(study, tmp_path / "x.zarr", dask="tcp://127.0.0.1:8786", workers=2)


@pytest.fixture
def cluster():
    """A cluster in this process, which has no worker yet."""
    distributed = pytest.importorskip("distributed")
    options = dict(
        n_workers=0, threads_per_worker=1, processes=False, protocol="tcp://", dashboard_address=None
    )
    with distributed.LocalCluster(**options) as made:
        yield made


def test_a_cluster_without_workers_is_waited_for(study, serial, cluster, tmp_path):
    said = []

    def say(line):
        said.append(line)
        if "no worker yet" in line:
            cluster.scale(1)

    same(run(study, tmp_path / "x.zarr", dask=cluster.scheduler_address, say=say), serial)
    assert said[0] == "The cluster has no worker yet; the run begins as soon as there is one."


def test_workers_of_other_code_are_refused_with_what_to_do_and_compute_nothing(
    study, cluster, monkeypatch, tmp_path
):
    cluster.scale(1)
    monkeypatch.setattr("studies.run.executors._code", lambda: "of another version")
    monkeypatch.setattr("studies.run.executors.run_chunk", lambda *_: pytest.fail("a chunk was computed"))
    with pytest.raises(
        RunError, match=r"other code.*install the same version on all workers\. 0 of 3 chunks"
    ):
        run(study, tmp_path / "x.zarr", dask=cluster.scheduler_address)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nosuch://host:8786", "no port", ""])
def test_an_address_without_a_scheduler_is_refused_with_nothing_written(
    address, study, monkeypatch, tmp_path
):
    pytest.importorskip("distributed")
    monkeypatch.setattr("studies.run.executors.CONNECT_SECONDS", 1.0)
    with pytest.raises(InputError, match=r"dask.*tcp://host:8786"):
        run(study, tmp_path / "x.zarr", dask=address)
    assert not list(tmp_path.iterdir())
