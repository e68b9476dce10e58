"""The results store: labelled, never half written, never overwritten by another question."""

import dataclasses
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
from studies.run.status import status
from studies.store import files, writing
from studies.store.reading import kpi_frame, open_results, provenance
from tests import studies_synthetic as made

NAMES = [controller.name for controller in made.CONTROLLERS]


def begin(folder, study_hash="study", hashes=("a", "b", "c"), lines=None):
    say = lines.append if lines is not None else (lambda line: None)
    return made.begin(folder, made.layout(study_hash, hashes), say)


def complete(results):
    """Per controller whether it is stored undamaged."""
    missing = results.pending()
    return [i not in missing for i in range(len(NAMES))]


def undamaged(folder):
    """Whether the fixed files and those of the first two controllers are what was written."""
    try:
        store, manifest = files.open_manifest(folder / files.RESULTS)
    except InputError:
        return False
    return {0, 1} <= set(files.survey(store, manifest["contents"], deep=True).records)


def test_what_is_written_is_read_back_with_names_and_units(tmp_path):
    written = made.trajectory("hunting")
    made.write(begin(tmp_path), "step-choke", written, wall_time=1.5)
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
    assert float(run.wall_time) == 1.5
    assert provenance(data, "definition")["name"] == "made-up"
    assert provenance(data, "versions")["python"]


def test_xarray_opens_the_store_without_a_warning_before_during_and_after_a_run(tmp_path):
    results = begin(tmp_path)
    for finished in range(len(NAMES) + 1):
        with xr.open_zarr(results.path, chunks=None) as data:  # a warning is an error here
            xr.testing.assert_identical(data.load(), xr.open_zarr(results.path, consolidated=False).load())
            assert data.complete.values.tolist() == [1] * finished + [0] * (len(NAMES) - finished)
        if finished < len(NAMES):
            made.write(results, NAMES[finished], made.trajectory("hunting"))


def test_a_run_that_is_not_there_reads_as_empty_and_incomplete(tmp_path):
    made.write(begin(tmp_path), "step-choke", made.trajectory("hunting"))
    run = open_results(tmp_path).sel(controller="mixed-integer")
    assert run.complete == 0
    assert np.isnan(run.measurement).all()
    assert (run.status == -1).all()


def test_a_second_begin_with_the_same_hash_keeps_everything_and_asks_for_no_shared_results(tmp_path):
    made.write(begin(tmp_path), "mixed-integer", made.trajectory("smooth"))

    def fail():
        raise AssertionError("what all runs share is not needed")

    again = made.begin(tmp_path, dataclasses.replace(made.layout(), shared=fail))
    assert complete(again) == [False, False, True]


def test_results_of_another_study_are_set_aside_and_unchanged_runs_taken_over(tmp_path):
    first = begin(tmp_path)
    made.write(first, "continuous-choke", made.trajectory("smooth"))
    made.write(first, "mixed-integer", made.trajectory("creeping"), 2.0)
    lines = []
    second = begin(tmp_path, "changed", ("a", "b", "new"), lines)
    assert complete(second) == [True, False, False]
    kept = tmp_path / "results-study.zarr"
    assert open_results(kept).sel(controller="mixed-integer").complete == 1
    xr.testing.assert_equal(
        open_results(kept).measurement.sel(controller="continuous-choke").load(),
        open_results(tmp_path).measurement.sel(controller="continuous-choke").load(),
    )
    assert any("results-study.zarr" in line for line in lines)
    # and back again: everything that was computed is still there
    third = begin(tmp_path, "study")
    assert complete(third) == [True, False, True]


def test_a_store_that_does_not_say_what_it_is_is_set_aside_and_named(tmp_path):
    made.write(begin(tmp_path), "step-choke", made.trajectory("hunting"))
    (tmp_path / files.RESULTS / "zarr.json").write_text("{ damaged")
    (tmp_path / files.RESULTS / files.MANIFEST).unlink()
    lines = []
    again = begin(tmp_path, lines=lines)
    assert complete(again) == [False, True, False]  # taken over: its record and files are whole
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
    for i, kind in enumerate(("smooth", "hunting")):
        if not complete(results)[i]:
            made.write(results, NAMES[i], made.trajectory(kind))
            written.append(NAMES[i])
    return written


@pytest.mark.parametrize(
    ("file", "how"),
    [
        ("position/c.1.0.0", "deleted"),
        ("position/c.1.0.0", "cut off"),
        ("position/c.1.0.0", "one bit"),
        ("complete/c.1", "deleted"),
        ("commits/c.1", "garbage"),
    ],
)
def test_a_run_with_a_damaged_file_is_named_and_computed_again_and_the_others_stay(tmp_path, file, how):
    assert filled(tmp_path) == ["continuous-choke", "step-choke"]
    sound = open_results(tmp_path).load()
    assert filled(tmp_path) == []
    assert undamaged(tmp_path)
    hurt(tmp_path / files.RESULTS / file, how)
    assert not undamaged(tmp_path)
    lines = []
    assert filled(tmp_path, lines) == ["step-choke"]
    assert undamaged(tmp_path)
    xr.testing.assert_identical(open_results(tmp_path).load(), sound)
    assert len(lines) == 1
    assert lines[0].startswith("Damaged in results.zarr: ")
    assert lines[0].endswith("step-choke is computed again.")
    assert file in lines[0]


@pytest.mark.parametrize(
    ("file", "how"),
    [
        ("measurement/zarr.json", "deleted"),
        ("setpoint/c.0.0", "one bit"),
        ("manifest/c", "cut off"),
        ("manifest/c", "deleted"),
        ("zarr.json", "garbage"),
    ],
)
def test_a_damaged_file_that_concerns_all_runs_is_named_and_written_again_and_the_runs_stay(
    tmp_path, file, how
):
    filled(tmp_path)
    sound = open_results(tmp_path).load()
    hurt(tmp_path / files.RESULTS / file, how)
    assert not undamaged(tmp_path)
    lines = []
    assert filled(tmp_path, lines) == []
    assert undamaged(tmp_path)
    again = open_results(tmp_path).load()
    xr.testing.assert_equal(again, sound)
    assert len(lines) == 1
    assert lines[0].startswith("Damaged in results.zarr: ")
    assert file in lines[0]
    assert not list(tmp_path.glob("results-*.zarr"))


def test_a_run_killed_while_it_writes_leaves_no_finished_run(tmp_path):
    script = """
        import os, signal, sys
        from pathlib import Path
        from studies.store import writing
        from tests.studies import test_store as t
        from tests import studies_synthetic as made
        store = t.begin(Path(sys.argv[1]))
        made.write(store, "continuous-choke", made.trajectory("smooth"))
        write = writing.write_atomically
        def dying(path, content):
            if path.parent.name in ("complete", "commits"):
                os.kill(os.getpid(), signal.SIGKILL)
            return write(path, content)
        writing.write_atomically = dying
        made.write(store, "step-choke", made.trajectory("hunting"))
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path)],
        cwd=Path(__file__).parents[2],
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    again = begin(tmp_path)
    assert complete(again) == [True, False, False]
    made.write(again, "step-choke", made.trajectory("hunting"))
    assert complete(again) == [True, True, False]


def test_remains_of_a_store_that_was_being_made_are_removed(tmp_path):
    (tmp_path / ".new-results.zarr-abc" / "results.zarr").mkdir(parents=True)
    begin(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["results.zarr"]


def test_missing_results_say_what_to_do(tmp_path):
    with pytest.raises(InputError, match="Run the study first"):
        open_results(tmp_path)


def test_two_runs_on_one_folder_are_refused(tmp_path):
    with (
        writing.locked(tmp_path / files.RESULTS),
        pytest.raises(InputError, match="no other run"),
        writing.locked(tmp_path / files.RESULTS),
    ):
        pass
    with writing.locked(tmp_path / files.RESULTS):
        pass


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="can be written"):
        writing.check_writable(tmp_path / "results")


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "results").write_text("in the way")
    with pytest.raises(InputError, match=r"out.*can be written"):
        writing.check_writable(tmp_path / "results" / "thesis")


def test_a_store_in_the_older_format_which_can_hold_pickles_is_not_read(tmp_path):
    xr.Dataset({"complete": ("controller", [1])}, attrs={"format": files.FORMAT}).to_zarr(
        tmp_path / files.RESULTS, zarr_format=2
    )
    with pytest.raises(InputError, match="readable store"):
        open_results(tmp_path)


def test_the_store_is_plain_zarr_with_json_metadata(tmp_path):
    begin(tmp_path)
    body = json.loads((tmp_path / files.RESULTS / "zarr.json").read_text())
    assert body["zarr_format"] == 3
    assert body["attributes"]["format"] == files.FORMAT


def test_a_comparison_has_a_status_and_a_table_like_any_study(tmp_path):
    results = begin(tmp_path)
    made.write(results, "step-choke", made.trajectory("hunting"), 1.5)
    now = status(tmp_path)
    assert (now.chunks_done, now.scenarios_total, now.failed) == (1, 3, 0)
    assert str(now).endswith("To continue, give the command of the study again.")
    table = kpi_frame(tmp_path)
    assert list(table.index) == NAMES
    assert table.loc["step-choke", "wall_time"] == 1.5
    assert table.loc["mixed-integer", "complete"] == 0
    assert (table["tuning_deadzone.oil_rate"] == 5.0).all()
    assert table.loc["step-choke", "label"] == made.CONTROLLERS[1].label


def test_the_record_of_a_chunk_and_the_manifest_are_texts_that_any_zarr_reader_reads(tmp_path):
    made.write(begin(tmp_path), "step-choke", made.trajectory("hunting"))
    with xr.open_zarr(tmp_path / files.RESULTS, chunks=None) as data:
        records = data.commits.values.tolist()
        manifest = json.loads(data.manifest.item())
    assert [bool(text) for text in records] == [False, True, False]
    assert json.loads(records[1])["content"] == manifest["contents"][1]


@pytest.mark.parametrize("format", files.OLD_FORMATS)
def test_a_store_of_an_older_version_is_named_when_it_is_read_and_kept_when_it_is_written(tmp_path, format):
    old = xr.Dataset({"complete": ("controller", [1])}, attrs={"format": format, "study_hash": "before"})
    old.to_zarr(tmp_path / files.RESULTS, zarr_format=3, consolidated=False)
    with pytest.raises(InputError, match=r"this version.*Give the command of the study again"):
        open_results(tmp_path)
    lines = []
    assert complete(begin(tmp_path, lines=lines)) == [False] * 3
    assert lines == [f"{tmp_path / files.RESULTS} is of an older version; it is kept as results-before.zarr."]
    assert xr.open_zarr(tmp_path / "results-before.zarr", consolidated=False).complete.values.tolist() == [1]
