"""The store of sweep studies: whole or absent, resumable after anything, exported as it is."""

import dataclasses
import errno
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from jaxmpc.errors import InputError, MissingToolError
from studies.run.status import status
from studies.store import export as exporting
from studies.store.export import export
from studies.store.fingerprint import content_hash
from studies.store.layout import Column, StoreLayout, Variable
from studies.store.reading import chunk_facts, kpi_frame, open_study, provenance
from studies.store.writing import Store

ROOT = Path(__file__).parents[2]
VARIABLES = (
    Variable("fallbacks", "samples without a plan", "1", (), "i4", -1),
    Variable("deviation", "mean deviation", "m3/h", ("cv",)),
    Variable("position", "MV after the actuator", "%", ("time", "mv"), "f4"),
    Variable("status", "status of the solve", "1", ("time",), "i1", -1),
    Variable("complete", "1 if the scenario ran to its end", "1", (), "i1", 0),
)


def layout(count=11, chunk_size=4, study_hash="first-study", seeds=None, groups=(7,), variables=VARIABLES):
    """Scenarios in two groups, so that the last chunk of each is padded; `seeds` are what a scenario is."""
    seeds = np.arange(count) if seeds is None else np.asarray(seeds)
    order = np.random.default_rng(0).permutation(count)  # numbers do not follow the slots
    chunks = [
        part[i : i + chunk_size]
        for part in np.split(order, list(groups))
        for i in range(0, len(part), chunk_size)
    ]
    return StoreLayout(
        name="made-up",
        title="Made-up study",
        study_hash=study_hash,
        chunk_size=chunk_size,
        chunk_scenarios=tuple(chunks),
        scenario_hashes=tuple(content_hash("scenario", int(seed)) for seed in seeds),
        columns=(
            Column("tuning.deadzone.gas_rate", "deadzone of the gas rate", "m3/h", 10.0 * seeds),
            Column("kind", "controller", "", np.array([f"kind {s % 2} µ" for s in seeds], dtype=object)),
        ),
        variables=variables,
        coords={
            "time": (100.0 * np.arange(5), "s", "time"),
            "cv": (["gas_rate", "oil_rate"], "", "controlled variable"),
            "cv_unit": (["m3/h", "m3/h"], "", "unit of the CV"),
            "mv": (["choke"], "", "manipulated variable"),
        },
        provenance={"definition": {"name": "made-up", "seeds": [1, 2]}, "device": "cpu"},
    )


def compute(study, chunk):
    """A chunk function that depends on the content of its scenarios only."""
    lanes = {v.name: [] for v in study.variables}
    for number in study.chunk_scenarios[chunk]:
        rng = np.random.default_rng(int(study.scenario_hashes[number][:12], 16))
        for v in study.variables:
            value = rng.normal(size=study.shape(v))
            if v.name == "complete":
                value = np.asarray(rng.random() < 0.8)
            lanes[v.name].append(value if np.dtype(v.dtype).kind == "f" else np.int8(10 * value) % 7)
            if v.name == "complete":
                lanes[v.name][-1] = value
    return {
        v.name: np.array(lanes[v.name]).astype("?" if v.name == "complete" else v.dtype)
        for v in study.variables
    }


def run(path, study, chunks=None, lines=None, pause=0.0):
    """Compute what is pending; returns the chunks computed."""
    with Store.begin(path, study, (lambda line: None) if lines is None else lines.append) as store:
        computed = [i for i in store.pending() if chunks is None or i in chunks]
        for i in computed:
            time.sleep(pause)
            store.commit(i, compute(study, i), {"wall_time": 2.0, "worker": 0})
    return computed


def content(path):
    return open_study(path).load()


@pytest.fixture
def reference(tmp_path):
    """An uninterrupted run of the standard layout."""
    run(tmp_path / "reference.zarr", layout())
    return content(tmp_path / "reference.zarr")


def test_what_is_committed_is_read_back_by_scenario_with_names_and_units(tmp_path):
    study = layout()
    run(tmp_path / "a.zarr", study)
    data = open_study(tmp_path / "a.zarr")
    assert data.sizes["scenario"] == 11
    np.testing.assert_array_equal(data.scenario, np.arange(11))
    for i, numbers in enumerate(study.chunk_scenarios):
        values = compute(study, i)
        for name in ("fallbacks", "deviation", "position", "status", "complete"):
            stored = data[name].sel(scenario=numbers).values
            np.testing.assert_array_equal(stored, values[name])
            assert stored.dtype == np.dtype(next(v.dtype for v in VARIABLES if v.name == name))
    assert data.position.dims == ("scenario", "time", "mv")
    assert data.position.attrs == {"long_name": "MV after the actuator", "units": "%"}
    column = data["tuning.deadzone.gas_rate"]
    np.testing.assert_array_equal(column, 10.0 * np.arange(11))
    assert column.attrs == {"long_name": "deadzone of the gas rate", "units": "m3/h"}
    assert data.kind.sel(scenario=3).item() == "kind 1 µ"
    assert data.cv_unit.sel(cv="oil_rate").item() == "m3/h"
    assert data.time.attrs["units"] == "s"
    assert provenance(data, "definition") == {"name": "made-up", "seeds": [1, 2]}
    assert data.attrs["study_hash"] == "first-study"
    assert chunk_facts(tmp_path / "a.zarr")[1] == {"wall_time": 2.0, "worker": 0}


@pytest.mark.parametrize(
    "selection",
    [
        {"scenario": 3, "time": 2},
        {"scenario": slice(2, 9, 3), "mv": 0},
        {"scenario": slice(None, None, -1)},
        {"scenario": [9, 0, 0, 4], "time": [4, 1]},
        {"scenario": []},
        {"scenario": -1, "time": slice(1, 3)},
    ],
    ids=str,
)
def test_a_selection_of_a_lazy_trajectory_equals_the_selection_of_the_loaded_one(tmp_path, selection):
    run(tmp_path / "a.zarr", layout(), chunks=[0, 2])
    lazy, loaded = open_study(tmp_path / "a.zarr").position, content(tmp_path / "a.zarr").position
    xr.testing.assert_identical(lazy.isel(selection).load(), loaded.isel(selection))


def test_trajectories_are_not_read_before_they_are_used(tmp_path, monkeypatch):
    run(tmp_path / "a.zarr", layout())
    data = open_study(tmp_path / "a.zarr")
    expected = content(tmp_path / "a.zarr").position.sel(scenario=5)
    slot = int(np.flatnonzero(np.concatenate(layout().chunk_scenarios) == 5)[0])
    for path in (tmp_path / "a.zarr" / "position").glob("c.*"):
        if path.name != f"c.{slot // 4 if slot < 7 else 2 + (slot - 7) // 4}.0.0":
            path.unlink()
    xr.testing.assert_identical(data.position.sel(scenario=5).load(), expected)


def test_the_store_is_plain_zarr_with_one_zarr_chunk_per_study_chunk(tmp_path):
    run(tmp_path / "a.zarr", layout())
    with xr.open_zarr(tmp_path / "a.zarr", consolidated=False, chunks=None) as raw:
        assert raw.position.encoding["chunks"] == (4, 5, 1)
        raw = raw.isel(slot=np.flatnonzero(raw.scenario >= 0)).sortby("scenario")
        np.testing.assert_array_equal(raw.position, content(tmp_path / "a.zarr").position)
        np.testing.assert_array_equal(raw.deviation, content(tmp_path / "a.zarr").deviation)
    names = sorted(p.name for p in (tmp_path / "a.zarr" / "position").iterdir())
    assert names == [*(f"c.{i}.0.0" for i in range(3)), "zarr.json"]


def test_xarray_opens_the_store_without_a_warning_before_during_and_after_a_run(tmp_path):
    study, path = layout(), tmp_path / "study.zarr"
    for chunks in range(len(study.chunk_scenarios) + 1):
        run(path, study, chunks=range(chunks))
        with xr.open_zarr(path, chunks=None) as plain:  # a warning is an error here
            xr.testing.assert_identical(plain.load(), xr.open_zarr(path, consolidated=False).load())
            rows = plain.isel(slot=plain.scenario.values >= 0)
            ours = content(path).sel(scenario=rows.scenario.values)
            np.testing.assert_array_equal(rows.position, ours.position)
            np.testing.assert_array_equal(rows.kind.astype(object), ours.kind)


def test_scenarios_that_are_not_there_read_as_empty_and_incomplete(tmp_path):
    study = layout()
    run(tmp_path, study, chunks=[1])
    data = content(tmp_path)  # a folder holds it as study.zarr
    missing = data.sel(scenario=np.concatenate([study.chunk_scenarios[0], study.chunk_scenarios[2]]))
    assert (missing.complete == 0).all()
    assert np.isnan(missing.deviation).all()
    assert (missing.status == -1).all()
    assert not np.isnan(data.position.sel(scenario=study.chunk_scenarios[1])).any()


def test_without_a_flag_of_its_own_a_study_has_complete_where_it_is_stored(tmp_path):
    study = layout(variables=VARIABLES[:-1])
    run(tmp_path, study, chunks=[0])
    complete = open_study(tmp_path).complete
    assert complete.sum() == 4
    assert (complete.sel(scenario=study.chunk_scenarios[0]) == 1).all()


def test_the_order_of_commits_does_not_matter(tmp_path, reference):
    for i in (2, 0, 1):
        run(tmp_path / "b.zarr", layout(), chunks=[i])
    xr.testing.assert_identical(content(tmp_path / "b.zarr"), reference)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda f: f.pop("status"), "status"),
        (lambda f: f.update(other=np.zeros(4)), "other"),
        (lambda f: f.update(deviation=np.zeros((3, 2))), r"fields.deviation.*\(4, 2\)"),
        (lambda f: f.update(status=np.zeros((4, 5))), "fields.status.*i1"),
    ],
)
def test_results_of_another_shape_or_type_are_refused_and_nothing_is_written(tmp_path, change, match):
    study = layout()
    fields = compute(study, 0)
    change(fields)
    with Store.begin(tmp_path, study) as store:
        with pytest.raises(InputError, match=match):
            store.commit(0, fields, {})
        assert store.pending() == [0, 1, 2]
    assert not list((tmp_path / "study.zarr" / "deviation").glob("c.*"))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"columns": (Column("time", "t", "s", np.zeros(11)),)}, "time"),
        ({"columns": (Column("a/b", "t", "s", np.zeros(11)),)}, "a/b"),
        ({"columns": (Column("a", "t", "s", np.zeros(10)),)}, "11 scenarios"),
        ({"chunk_scenarios": (np.arange(4), np.arange(4))}, "exactly once"),
        ({"chunk_scenarios": (np.arange(11),)}, "1 to 4"),
        ({"variables": (Variable("a", "a", "1", ("length",)),)}, "a.dims.*length"),
    ],
)
def test_a_layout_that_cannot_be_stored_is_refused_before_anything_is_made(tmp_path, change, match):
    with pytest.raises(InputError, match=match):
        Store.begin(tmp_path / "a" / "a.zarr", dataclasses.replace(layout(), **change))
    assert not (tmp_path / "a").exists()


def child(script, *arguments, check=True):
    """Run a script that knows this module as `t` in another process."""
    body = (
        "import os, signal, sys, time\nfrom tests.studies import test_sweep_store as t\n"
        + textwrap.dedent(script)
    )
    return subprocess.run(
        [sys.executable, "-c", body, *map(str, arguments)],
        cwd=ROOT,
        check=check,
        capture_output=True,
        text=True,
    )


def test_runs_killed_at_random_moments_end_with_the_result_of_an_uninterrupted_run(tmp_path):
    study = layout(count=60)
    run(tmp_path / "whole.zarr", study)
    # Each trial is a process of its own, forked from one that has the imports behind it.
    killed = child(
        """
        import random
        rng = random.Random(7)
        killed = 0
        for trial in range(12):
            pid = os.fork()
            if pid == 0:
                t.run(sys.argv[1], t.layout(count=60), pause=0.004)
                os._exit(0)
            time.sleep(rng.uniform(0.02, 0.3))
            os.kill(pid, signal.SIGKILL)
            killed += os.waitpid(pid, 0)[1] == signal.SIGKILL
        print(killed)
        """,
        tmp_path / "killed.zarr",
    )
    assert int(killed.stdout) >= 2
    run(tmp_path / "killed.zarr", study)
    xr.testing.assert_identical(content(tmp_path / "killed.zarr"), content(tmp_path / "whole.zarr"))
    assert not list(tmp_path.glob(".new-*"))
    assert not [p for p in (tmp_path / "killed.zarr").rglob(".*") if p.is_file()]


@pytest.mark.parametrize(
    ("before", "stride"),
    [
        ("another study", 3),
        pytest.param("another study", 1, marks=pytest.mark.slow),
        pytest.param("nothing", 1, marks=pytest.mark.slow),
    ],
)
def test_a_run_killed_before_any_change_of_a_file_resumes_to_the_same_result(tmp_path, before, stride):
    """Every rename and removal in turn (or every `stride`-th): the process dies right before it."""
    done = child(
        """
        import shutil
        from pathlib import Path
        folder, before, stride = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
        def small(**what):
            study = t.layout(count=6, groups=(), variables=t.VARIABLES[:3], **what)
            return t.dataclasses.replace(study, columns=study.columns[:1])
        def study():
            return small(study_hash="new")
        def in_child(work):
            pid = os.fork()
            if pid == 0:
                work()
                os._exit(0)
            return os.waitpid(pid, 0)[1]
        def begin():
            if before != "nothing":
                t.run(folder / "old.zarr", small(seeds=[0, 1, 2, 3, 9, 9]))
        def dying(n):
            left = [n]
            def wrap(change):
                def changed(*a, **k):
                    if left[0] == 0:
                        os.kill(os.getpid(), signal.SIGKILL)
                    left[0] -= 1
                    return change(*a, **k)
                return changed
            for name in ("replace", "rename", "unlink"):
                setattr(os, name, wrap(getattr(os, name)))
            t.run(folder / "a.zarr", study())
        assert in_child(begin) == 0
        assert in_child(lambda: t.run(folder / "whole.zarr", study())) == 0
        def compare():
            t.run(folder / "a.zarr", study())
            t.xr.testing.assert_identical(t.content(folder / "a.zarr"), t.content(folder / "whole.zarr"))
            if before != "nothing":
                kept, = folder.glob("a-first-stud*.zarr")
                t.xr.testing.assert_identical(t.content(kept), t.content(folder / "old.zarr"))
        n = 0
        while True:
            if before != "nothing":
                shutil.copytree(folder / "old.zarr", folder / "a.zarr")
            died = in_child(lambda: dying(n)) == signal.SIGKILL
            assert in_child(compare) == 0, n
            for store in folder.glob("a*.zarr"):
                shutil.rmtree(store)
            if not died:
                break
            n += stride
        print(n)
        """,
        tmp_path,
        before,
        stride,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 20


def damage(path, how, rng):
    """Hurt a file the way disks and people do."""
    body = path.read_bytes()
    if how == "deleted":
        path.unlink()
    elif how == "truncated":
        path.write_bytes(body[: rng.integers(len(body))])
    else:
        place = rng.integers(len(body))
        path.write_bytes(body[:place] + bytes([body[place] ^ (1 << rng.integers(8))]) + body[place + 1 :])


@pytest.mark.parametrize("how", ["deleted", "truncated", "flipped"])
def test_a_damaged_file_is_named_and_redone_and_never_read_as_a_result(tmp_path, reference, how):
    rng = np.random.default_rng(5)
    path = tmp_path / "a.zarr"
    run(path, layout())
    every = sorted(p for p in path.rglob("*") if p.is_file())
    assert len(every) > 30
    for file in every:
        damage(file, how, rng)
        name = file.relative_to(path).as_posix()
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                read = content(path)
        except InputError:
            pass
        else:
            seen = bool(caught) or not (read.complete == reference.complete).all()
            assert seen or read.equals(reference), name
            stored = ~np.isnan(read.deviation[:, 0].values)
            assert read.isel(scenario=stored).equals(reference.isel(scenario=stored)), name
        lines = []
        redone = run(path, layout(), lines=lines)
        if name == f"commits/c.{redone[0] if redone else 0}" and how == "deleted":
            assert redone, name
        else:
            assert any(name in line for line in lines), name
        assert bool(redone) == (("/c." in name and not _fixed(name)) or "commits/c." in name), name
        xr.testing.assert_identical(content(path), reference)


def _fixed(name):
    return name.split("/")[0] not in {v.name for v in VARIABLES}


def test_a_flipped_byte_is_found_by_verify_and_pending_afterwards(tmp_path):
    path = tmp_path / "a.zarr"
    run(path, layout())
    file = path / "position" / "c.1.0.0"
    with Store.begin(path, layout()) as store:
        assert store.pending() == []
        assert store.verify() == []
        damage(file, "flipped", np.random.default_rng(0))
        assert store.verify() == ["position/c.1.0.0 (checksum differs)"]
        assert store.pending() == [1]
    assert status(path).chunks_done == 2


@pytest.mark.parametrize("how", ["deleted", "truncated"])
def test_a_short_or_lost_file_is_pending_and_empty_without_reading_its_content(tmp_path, how):
    path, lines = tmp_path / "a.zarr", []
    run(path, layout())
    damage(path / "position" / "c.1.0.0", how, np.random.default_rng(0))
    with pytest.warns(UserWarning, match=r"position/c\.1\.0\.0"):
        data = content(path)
    assert (data.complete.sel(scenario=layout().chunk_scenarios[1]) == 0).all()
    assert np.isnan(data.position.sel(scenario=layout().chunk_scenarios[1])).all()
    with Store.begin(path, layout(), lines.append, verify=False) as store:
        assert store.pending() == [1]
    assert len(lines) == 1
    assert "position/c.1.0.0" in lines[0]


def test_a_flipped_byte_of_a_trajectory_raises_when_it_is_read(tmp_path):
    path = tmp_path / "a.zarr"
    run(path, layout())
    damage(path / "position" / "c.1.0.0", "flipped", np.random.default_rng(0))
    data = open_study(path)
    with pytest.raises(InputError, match=r"position.*undamaged"):
        data.position.load()
    assert "position/c.1.0.0 (checksum differs)" in status(path, verify=True).damaged


def test_a_lost_folder_is_made_again(tmp_path, reference):
    path = tmp_path / "a.zarr"
    for lost in ("deviation", "commits", "kind"):
        run(path, layout())
        shutil.rmtree(path / lost)
        lines = []
        assert run(path, layout(), lines=lines) == ([] if lost == "kind" else [0, 1, 2])
        assert any(lost in line for line in lines)
        xr.testing.assert_identical(content(path), reference)


def test_another_definition_sets_the_store_aside_and_takes_over_what_is_unchanged(tmp_path):
    path, lines = tmp_path / "a.zarr", []
    old = layout(seeds=range(11))
    run(path, old)
    before = content(path)
    # other numbers, other places, other chunk size; one scenario is new
    new = layout(
        count=9, chunk_size=2, groups=(4,), study_hash="second-study", seeds=[8, 7, 6, 5, 4, 3, 2, 1, 99]
    )
    changed = [i for i, numbers in enumerate(new.chunk_scenarios) if 8 in numbers]
    assert run(path, new, lines=lines) == changed
    count = 9 - len(new.chunk_scenarios[changed[0]])
    assert any(f"{count} scenarios" in line and "a-first-stud.zarr" in line for line in lines)
    xr.testing.assert_identical(content(tmp_path / "a-first-stud.zarr"), before)
    run(tmp_path / "fresh.zarr", new)
    xr.testing.assert_identical(content(path), content(tmp_path / "fresh.zarr"))
    # and back again: nothing is computed, nothing is lost
    assert run(path, old) == []
    xr.testing.assert_identical(content(path), before)
    names = {p.name for p in tmp_path.glob("a-*.zarr")}
    assert names == {"a-first-stud.zarr", "a-second-stu.zarr"}


def test_two_old_stores_of_one_hash_are_both_kept(tmp_path):
    path = tmp_path / "a.zarr"
    run(path, layout(), chunks=[0])
    run(path, layout(chunk_size=3), chunks=[])
    run(path, layout(chunk_size=5), chunks=[])
    assert {p.name for p in tmp_path.glob("*.zarr")} == {
        "a.zarr",
        "a-first-stud.zarr",
        "a-first-stud-2.zarr",
    }


def test_results_with_other_variables_are_not_taken_over(tmp_path):
    path = tmp_path / "a.zarr"
    run(path, layout())
    changed = dataclasses.replace(VARIABLES[1], unit="m3/d")
    other = layout(study_hash="other", variables=(VARIABLES[0], changed, *VARIABLES[2:]))
    assert run(path, other) == [0, 1, 2]


def test_damaged_results_of_an_older_store_are_named_and_not_taken_over(tmp_path):
    path, lines = tmp_path / "a.zarr", []
    run(path, layout())
    damage(path / "deviation" / "c.1.0", "flipped", np.random.default_rng(0))
    assert run(path, layout(study_hash="other"), lines=lines) == [1]
    assert any("deviation/c.1.0" in line and "a-first-stud" in line for line in lines)
    fresh = tmp_path / "fresh.zarr"
    run(fresh, layout(study_hash="other"))
    xr.testing.assert_identical(content(path), content(fresh))


def test_two_writers_are_refused_and_a_killed_one_leaves_no_lock(tmp_path):
    path = tmp_path / "a.zarr"
    script = """
        store = t.Store.begin(sys.argv[1], t.layout())
        print("open", flush=True)
        signal.pause()
    """
    body = "import signal, sys\nfrom tests.studies import test_sweep_store as t\n" + textwrap.dedent(script)
    writer = subprocess.Popen(
        [sys.executable, "-c", body, str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    try:
        assert writer.stdout.readline() == "open\n"
        with pytest.raises(InputError, match="no other run"):
            Store.begin(path, layout())
        assert status(path).running
        run(tmp_path / "b.zarr", layout())  # a store beside it is another matter
    finally:
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
    assert not status(path).running
    assert run(path, layout()) == [0, 1, 2]


def test_a_refused_begin_releases_the_lock(tmp_path, monkeypatch):
    monkeypatch.setattr(Store, "_prepare", lambda self: (_ for _ in ()).throw(OSError(errno.EIO, "broken")))
    with pytest.raises(InputError, match="broken"):
        Store.begin(tmp_path, layout())
    monkeypatch.undo()
    assert run(tmp_path, layout()) == [0, 1, 2]


@pytest.mark.parametrize("room", [0, 200, 700, 1100, 1600])
def test_a_full_disk_names_the_folder_keeps_what_is_stored_and_resumes(
    tmp_path, monkeypatch, reference, room
):
    path = tmp_path / "a.zarr"
    run(path, layout(), chunks=[0])
    write, left = Path.write_bytes, [room]

    def limited(file, data):
        if len(data) > left[0]:
            write(file, data[: left[0]])
            raise OSError(errno.ENOSPC, "No space left on device")
        left[0] -= len(data)
        return write(file, data)

    store = Store.begin(path, layout())

    def commit_all():
        for i in (1, 2):
            store.commit(i, compute(layout(), i), {})

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", limited)
        with pytest.raises(InputError, match=r"No space left.*Free space") as error:
            commit_all()
    assert str(tmp_path) in str(error.value)
    assert 0 not in store.pending()
    assert store.pending()
    assert store.verify() == []
    store.close()
    assert set(run(path, layout())) <= {1, 2}
    xr.testing.assert_identical(content(path), reference)


def test_a_real_full_disk_ends_with_advice_and_resumes_once_there_is_room(tmp_path):
    """A tiny file system in a private mount name space; some machines do not allow one."""
    if (
        shutil.which("unshare") is None
        or subprocess.run(
            ["unshare", "-rm", "mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(tmp_path)],
            check=False,
            capture_output=True,
        ).returncode
    ):
        pytest.skip("no private mounts here")
    script = """
        import sys
        from pathlib import Path
        from tests.studies import test_sweep_store as t
        folder, study = Path(sys.argv[1]), t.layout(count=60)
        def attempt():
            try:
                t.run(folder / "a.zarr", study)
            except t.InputError as error:
                assert "No space left" in str(error) and str(folder) in str(error), error
                return False
            return True
        filler = folder / "filler"
        free = t.shutil.disk_usage(folder).free
        filler.write_bytes(bytes(free))
        steps = []
        while not attempt():  # a little more room each time
            done = t.status(folder / "a.zarr").chunks_done if (folder / "a.zarr").exists() else 0
            assert not steps or done >= steps[-1], steps
            steps.append(done)
            filler.write_bytes(bytes(filler.stat().st_size - 60_000))
        t.run(sys.argv[2], study)
        t.xr.testing.assert_identical(t.content(folder / "a.zarr"), t.content(sys.argv[2]))
        print(*steps)
    """
    command = 'mount -t tmpfs -o size=2m tmpfs "$1" && exec "$2" -c "$3" "$1" "$4"'
    (tmp_path / "disk").mkdir()
    arguments = [tmp_path / "disk", sys.executable, textwrap.dedent(script), tmp_path / "whole.zarr"]
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", command, "sh", *arguments],
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    steps = [int(step) for step in done.stdout.split()]
    assert steps[0] == 0  # the store could not even be made
    assert any(step > 0 for step in steps)  # and later one was half full


def test_a_path_that_holds_something_else_is_refused_and_left_alone(tmp_path):
    (tmp_path / "other.zarr").mkdir()
    (tmp_path / "other.zarr" / "zarr.json").write_text('{"attributes": {"format": "someone/else"}}')
    with pytest.raises(InputError, match="a path that is free"):
        Store.begin(tmp_path / "other.zarr", layout())
    (tmp_path / "file.zarr").write_text("in the way")
    with pytest.raises(InputError, match="a path that is free"):
        Store.begin(tmp_path / "file.zarr", layout())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file.zarr", "other.zarr"]
    assert (tmp_path / "file.zarr").read_text() == "in the way"


def test_missing_results_say_what_to_do(tmp_path):
    for read in (open_study, kpi_frame, status):
        with pytest.raises(InputError, match="Run the study first"):
            read(tmp_path / "a.zarr")
    for name in ("one", "two"):
        (tmp_path / f"{name}.zarr").mkdir()
    for near in (tmp_path, tmp_path / "three.zarr"):
        with pytest.raises(InputError, match=r"This folder holds one\.zarr, two\.zarr"):
            status(near)


def test_the_table_has_a_row_per_scenario_and_a_column_per_channel(tmp_path, reference):
    table = kpi_frame(tmp_path / "reference.zarr")
    assert list(table.columns) == [
        "tuning.deadzone.gas_rate",
        "kind",
        "fallbacks",
        "deviation.gas_rate",
        "deviation.oil_rate",
        "complete",
    ]
    np.testing.assert_array_equal(table["deviation.oil_rate"], reference.deviation.sel(cv="oil_rate"))
    np.testing.assert_array_equal(table.index, np.arange(11))


def test_a_table_in_csv_reads_back(tmp_path, reference):
    target = export(tmp_path / "reference.zarr", tmp_path / "out" / "table.csv")
    read = pd.read_csv(target, index_col="scenario")
    pd.testing.assert_frame_equal(read, kpi_frame(tmp_path / "reference.zarr"), check_dtype=False)


def test_a_table_in_parquet_is_the_table_with_its_types(tmp_path, reference):
    pytest.importorskip("pyarrow")
    target = export(tmp_path / "reference.zarr", tmp_path / "table.parquet")
    pd.testing.assert_frame_equal(pd.read_parquet(target), kpi_frame(tmp_path / "reference.zarr"))


def test_netcdf_holds_everything(tmp_path, reference):
    target = export(tmp_path / "reference.zarr", tmp_path / "all.nc")
    with xr.open_dataset(target, engine="scipy", decode_times=False) as read:
        assert set(read.variables) == set(reference.variables)
        for name, variable in reference.variables.items():
            np.testing.assert_array_equal(read[name].values.astype(variable.values.dtype), variable.values)
            assert read[name].attrs.get("units") == variable.attrs.get("units")
        assert provenance(read, "definition") == {"name": "made-up", "seeds": [1, 2]}


def test_an_export_does_not_replace_a_file_unless_it_may(tmp_path, reference):
    target = tmp_path / "table.csv"
    target.write_text("precious")
    with pytest.raises(InputError, match="overwrite"):
        export(tmp_path / "reference.zarr", target)
    assert target.read_text() == "precious"
    export(tmp_path / "reference.zarr", target, overwrite=True)
    assert target.read_text().startswith("scenario,")


def test_an_export_that_fails_leaves_the_file_as_it_was(tmp_path, reference, monkeypatch):
    target = tmp_path / "table.csv"
    target.write_text("precious")

    def full(self, path):
        Path(path).write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pd.DataFrame, "to_csv", full)
    with pytest.raises(OSError, match=r"No space left.*table\.csv"):
        export(tmp_path / "reference.zarr", target, overwrite=True)
    assert target.read_text() == "precious"
    assert not list(tmp_path.glob(".table*"))


@pytest.mark.skipif(os.name != "posix", reason="pipes of POSIX")
@pytest.mark.parametrize("kind", ["csv", "netcdf"])
def test_an_export_goes_into_a_pipe_as_into_a_file(tmp_path, reference, kind):
    path, pipe = tmp_path / "reference.zarr", tmp_path / "pipe"
    os.mkfifo(pipe)
    got = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()), daemon=True)
    reader.start()
    export(path, pipe, kind)
    reader.join(timeout=60)
    assert got == [export(path, tmp_path / "file", kind).read_bytes()]
    assert pipe.is_fifo()


def test_an_export_does_not_replace_a_part_of_the_store(tmp_path, reference):
    path = tmp_path / "reference.zarr"
    before = (path / "zarr.json").read_bytes()
    for target in (path, path / "zarr.json", path / "new.csv"):
        with pytest.raises(InputError, match="target"):
            export(path, target, "csv", overwrite=True)
    assert (path / "zarr.json").read_bytes() == before
    assert not (path / "new.csv").exists()


def test_parquet_without_its_library_says_how_to_get_it(tmp_path, reference, monkeypatch):
    monkeypatch.setattr(exporting.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingToolError, match=r"pip install 'jaxmpc\[parquet\]'"):
        export(tmp_path / "reference.zarr", tmp_path / "table.parquet")


def test_an_unknown_format_is_refused_with_the_known_ones(tmp_path):
    with pytest.raises(InputError, match=r"\.csv, \.parquet, \.nc"):
        export(tmp_path, tmp_path / "table.xlsx")
    with pytest.raises(InputError, match="csv, parquet, netcdf"):
        export(tmp_path, tmp_path / "table", format="xlsx")


def test_the_status_counts_and_ends_with_what_to_do(tmp_path, reference):
    path = tmp_path / "a.zarr"
    study = layout()
    run(path, study, chunks=[0, 1])
    half = status(path)
    assert (half.chunks_done, half.chunks_total) == (2, 3)
    assert (half.scenarios_done, half.scenarios_total) == (7, 11)
    stored = np.concatenate(study.chunk_scenarios[:2])
    assert half.failed == int((reference.complete.sel(scenario=stored) == 0).sum())
    assert half.rate == 7 / 4.0
    assert not half.running
    assert half.damaged == ()
    assert str(half).endswith(f"To continue:\n  jaxmpc study run STUDY.toml --store {path}")
    size = sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
    assert 0.4 * size < half.bytes <= size
    damage(path / "fallbacks" / "c.0", "flipped", np.random.default_rng(0))
    hurt = status(path)
    assert hurt.chunks_done == 1
    assert "Damaged: fallbacks/c.0 (checksum differs)" in str(hurt)
    assert "To compute what is damaged or missing again" in str(hurt)
    run(path, study)
    whole = status(path)
    assert whole.failed == int((reference.complete == 0).sum()) > 0
    assert "Complete" in str(whole)
