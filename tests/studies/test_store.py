"""The results store: labelled, never half written, never overwritten by another question."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from jaxmpc.errors import InputError
from studies.store import comparison as store
from studies.store.comparison import ResultStore, open_results
from tests import studies_synthetic as made

NAMES = [controller.name for controller in made.CONTROLLERS]


def begin(folder, study_hash="study", hashes=("a", "b", "c"), lines=None):
    say = lines.append if lines is not None else (lambda line: None)
    return ResultStore.begin(folder, NAMES, study_hash, lambda: made.template(study_hash, hashes), say)


def test_what_is_written_is_read_back_with_names_and_units(tmp_path):
    written = made.trajectory("hunting")
    begin(tmp_path).write("step-choke", written, wall_time=1.5)
    data = open_results(tmp_path)
    run = data.sel(controller="step-choke")
    np.testing.assert_array_equal(run.measurement.sel(cv="oil_rate"), written.cv[:, 1])
    np.testing.assert_array_equal(run.position.sel(mv="choke"), written.mv[:, 0])
    np.testing.assert_array_equal(run.fallback, 0)
    assert run.complete == 1
    assert data.time.attrs["units"] == "s"
    assert data.mv_unit.sel(mv="choke").item() == "%"
    assert data.solve_time.attrs == {"long_name": "time of one controller step", "units": "s"}
    assert float(run.tuning_deadzone.sel(cv="oil_rate")) == 5.0
    assert store.provenance(data, "definition")["name"] == "made-up"
    assert store.provenance(data, "versions")["python"]


def test_xarray_opens_the_store_without_a_warning_before_during_and_after_a_run(tmp_path):
    results = begin(tmp_path)
    for finished in range(len(NAMES) + 1):
        with xr.open_zarr(results.path, chunks=None) as data:  # a warning is an error here
            xr.testing.assert_identical(data.load(), xr.open_zarr(results.path, consolidated=False).load())
            assert data.complete.values.tolist() == [1] * finished + [0] * (len(NAMES) - finished)
        if finished < len(NAMES):
            results.write(NAMES[finished], made.trajectory("hunting"), 1.0)


def test_a_run_that_is_not_there_reads_as_empty_and_incomplete(tmp_path):
    begin(tmp_path).write("step-choke", made.trajectory("hunting"), 1.0)
    run = open_results(tmp_path).sel(controller="mixed-integer")
    assert run.complete == 0
    assert np.isnan(run.measurement).all()
    assert (run.status == -1).all()


def test_a_second_begin_with_the_same_hash_keeps_everything_and_makes_no_template(tmp_path):
    begin(tmp_path).write("mixed-integer", made.trajectory("smooth"), 1.0)

    def fail():
        raise AssertionError("the template is not needed")

    again = ResultStore.begin(tmp_path, NAMES, "study", fail)
    assert [again.complete(name) for name in NAMES] == [False, False, True]


def test_results_of_another_study_are_set_aside_and_unchanged_runs_taken_over(tmp_path):
    first = begin(tmp_path)
    first.write("continuous-choke", made.trajectory("smooth"), 1.0)
    first.write("mixed-integer", made.trajectory("creeping"), 2.0)
    lines = []
    second = begin(tmp_path, "changed", ("a", "b", "new"), lines)
    assert [second.complete(name) for name in NAMES] == [True, False, False]
    kept = tmp_path / "results-study.zarr"
    assert open_results(kept).sel(controller="mixed-integer").complete == 1
    xr.testing.assert_equal(
        open_results(kept).measurement.sel(controller="continuous-choke").load(),
        open_results(tmp_path).measurement.sel(controller="continuous-choke").load(),
    )
    assert any("results-study.zarr" in line for line in lines)
    # and back again: everything that was computed is still there
    third = begin(tmp_path, "study")
    assert [third.complete(name) for name in NAMES] == [True, False, True]


def test_a_damaged_store_is_set_aside_and_named(tmp_path):
    begin(tmp_path).write("step-choke", made.trajectory("hunting"), 1.0)
    (tmp_path / store.RESULTS / "zarr.json").write_text("{ damaged")
    lines = []
    again = begin(tmp_path, lines=lines)
    assert not again.complete("step-choke")
    assert (tmp_path / "results-unreadable.zarr").exists()
    assert any("results-unreadable.zarr" in line for line in lines)


def hurt(path, how):
    content = bytearray(path.read_bytes())
    if how == "deleted":
        path.unlink()
    elif how == "cut off":
        path.write_bytes(content[: len(content) // 2])
    elif how == "garbage":
        path.write_bytes(b"garbage")
    else:
        content[len(content) // 2] ^= 4
        path.write_bytes(content)


def filled(folder, lines=None):
    """The store with two of its runs; what is there already is not written again."""
    results = begin(folder, lines=lines)
    written = []
    for name, kind in (("continuous-choke", "smooth"), ("step-choke", "hunting")):
        if not results.complete(name):
            results.write(name, made.trajectory(kind), 1.0)
            written.append(name)
    return written


@pytest.mark.parametrize(
    ("file", "how"),
    [
        ("position/c/1/0/0", "deleted"),
        ("position/c/1/0/0", "cut off"),
        ("position/c/1/0/0", "one bit"),
        ("complete/c/1", "deleted"),
        ("complete/files.1.json", "garbage"),
    ],
)
def test_a_run_with_a_damaged_file_is_named_and_computed_again_and_the_others_stay(tmp_path, file, how):
    assert filled(tmp_path) == ["continuous-choke", "step-choke"]
    sound = open_results(tmp_path).load()
    assert filled(tmp_path) == []
    assert store.undamaged(tmp_path / store.RESULTS, range(2))
    hurt(tmp_path / store.RESULTS / file, how)
    assert not store.undamaged(tmp_path / store.RESULTS, range(2))
    lines = []
    assert filled(tmp_path, lines) == ["step-choke"]
    assert store.undamaged(tmp_path / store.RESULTS, range(2))
    xr.testing.assert_identical(open_results(tmp_path).load(), sound)
    assert len(lines) == 1
    assert lines[0].startswith("step-choke: the results are damaged")
    assert file in lines[0]


@pytest.mark.parametrize(
    ("file", "how"),
    [
        ("measurement/zarr.json", "deleted"),
        ("setpoint/c/0/0", "one bit"),
        ("complete/files.fixed.json", "cut off"),
        ("complete/files.fixed.json", "deleted"),
        ("zarr.json", "garbage"),
    ],
)
def test_results_with_damage_that_concerns_all_runs_are_set_aside_and_computed_again(tmp_path, file, how):
    filled(tmp_path)
    sound = open_results(tmp_path).load()
    hurt(tmp_path / store.RESULTS / file, how)
    assert not store.undamaged(tmp_path / store.RESULTS, range(2))
    lines = []
    assert filled(tmp_path, lines) == ["continuous-choke", "step-choke"]
    again = open_results(tmp_path).load()
    xr.testing.assert_equal(again, sound)
    assert lines[0].startswith(f"The results in {tmp_path / store.RESULTS} are damaged (")
    assert len(list(tmp_path.glob("results-*.zarr"))) == 1


def test_a_run_killed_while_it_writes_leaves_no_finished_run(tmp_path):
    script = """
        import os, signal, sys
        from pathlib import Path
        import xarray as xr
        from tests.studies import test_store as t
        from tests import studies_synthetic as made
        store = t.begin(Path(sys.argv[1]))
        store.write("continuous-choke", made.trajectory("smooth"), 1.0)
        write = xr.Dataset.to_zarr
        def dying(self, *a, **k):
            if "complete" in self and "measurement" not in self:
                os.kill(os.getpid(), signal.SIGKILL)
            return write(self, *a, **k)
        xr.Dataset.to_zarr = dying
        store.write("step-choke", made.trajectory("hunting"), 1.0)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path)],
        cwd=Path(__file__).parents[2],
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    again = begin(tmp_path)
    assert [again.complete(name) for name in NAMES] == [True, False, False]
    again.write("step-choke", made.trajectory("hunting"), 1.0)
    assert again.complete("step-choke")


def test_remains_of_a_store_that_was_being_made_are_removed(tmp_path):
    (tmp_path / ".new-results-abc" / "results.zarr").mkdir(parents=True)
    begin(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["results.zarr"]


def test_missing_results_say_what_to_do(tmp_path):
    with pytest.raises(InputError, match="Run the study first"):
        open_results(tmp_path)


def test_two_runs_on_one_folder_are_refused(tmp_path):
    with (
        store.locked(tmp_path),
        pytest.raises(InputError, match="no other run"),
        store.locked(tmp_path),
    ):
        pass
    with store.locked(tmp_path):
        pass


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="can be written"):
        store.check_writable(tmp_path / "results")


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "results").write_text("in the way")
    with pytest.raises(InputError, match=r"out.*can be written"):
        store.check_writable(tmp_path / "results" / "thesis")


def test_a_store_in_the_older_format_which_can_hold_pickles_is_not_read(tmp_path):
    xr.Dataset({"complete": ("controller", [1])}, attrs={"format": store.FORMAT}).to_zarr(
        tmp_path / store.RESULTS, zarr_format=2
    )
    with pytest.raises(InputError, match="readable store"):
        open_results(tmp_path)


def test_the_store_is_plain_zarr_with_json_metadata(tmp_path):
    begin(tmp_path)
    body = json.loads((tmp_path / store.RESULTS / "zarr.json").read_text())
    assert body["zarr_format"] == 3
    assert body["attributes"]["format"] == store.FORMAT
