"""Sweep studies from the command line: options, exit status, and that a run goes on after anything that ends it."""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxmpc.cli.main import main
from jaxmpc.cli.study import ALONE
from studies.definition.catalogue import shipped_comparisons
from studies.definition.sweep import shipped_studies
from studies.load import load_study
from studies.run import runner
from studies.run.chunk import study_layout
from studies.run.runner import RunError
from studies.store.reading import chunk_facts, open_study
from studies.store.writing import Store
from tests.sweep_hazards import TEXT, computed, processes

ROOT = Path(__file__).parents[2]
CLOCK = ("solve_time_median", "solve_time_p99", "solve_time_max")
WITH_HAZARD = [sys.executable, "-c", "from tests.sweep_hazards import main; main()"]
PLAIN = [sys.executable, "-m", "jaxmpc.cli"]


@pytest.fixture
def file(tmp_path):
    """A definition of eight scenarios in three chunks."""
    path = tmp_path / "tiny.toml"
    path.write_text(TEXT)
    return path


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """The store of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("serial")
    (folder / "tiny.toml").write_text(TEXT)
    study = load_study(folder / "tiny.toml")
    return runner.run_study(study, folder / "tiny.zarr", progress=False, say=lambda _: None)


@pytest.fixture
def no_figures(monkeypatch):
    """Figures have tests of their own."""
    drawn = []
    monkeypatch.setattr("figures.sweep.draw.draw_sweep", lambda store, folder: drawn.append((store, folder)))
    monkeypatch.setattr("figures.closed_loop.draw_run", lambda *given, **options: drawn.append(given) or [])
    return drawn


def start(arguments, folder, hazard=None, index=1, **options):
    """A command in a process and group of its own."""
    words = PLAIN if hazard is None else [*WITH_HAZARD, hazard, str(index), str(folder)]
    return subprocess.Popen(
        [*words, *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **options,
    )


def finish(process):
    """Exit status, standard output and standard error."""
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def same(store, other):
    with open_study(store) as data, open_study(other) as wanted:
        for name in set(wanted.variables) - set(CLOCK):
            np.testing.assert_array_equal(data[name].values, wanted[name].values, err_msg=str(name))
        assert data.complete.values.all()


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until_ended(pids):
    """A limit only for what never comes."""
    end = time.monotonic() + 300
    while any(map(alive, pids)):
        assert time.monotonic() < end
        time.sleep(0.1)


# ------------------------------------------------------------------------------------------------ a run that ends


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_killed_run_goes_on_with_the_same_command_and_leaves_no_process(workers, file, serial, tmp_path):
    store = tmp_path / "x.zarr"
    command = ["study", "run", file, "--store", store, "--workers", workers]
    assert finish(start(command, tmp_path, "kill-main", index=2))[0] == -signal.SIGKILL
    wait_until_ended(processes(tmp_path))
    kept = set(chunk_facts(store))
    assert kept < {0, 1, 2}
    (tmp_path / "computed").unlink()
    status, out, _ = finish(start(command, tmp_path, "none"))
    assert status == 0
    assert set(computed(tmp_path)) == {0, 1, 2} - kept
    assert str(store) in out
    same(store, serial)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_ctrl_c_ends_a_run_with_status_130_and_what_to_do(workers, file, serial, tmp_path):
    store = tmp_path / "x.zarr"
    command = ["study", "run", file, "--store", store, "--workers", workers]
    status, out, err = finish(start(command, tmp_path, "interrupt"))
    assert status == 130, err
    last = err.splitlines()[-1]
    assert re.fullmatch(
        r"jaxmpc: stopped: [012] of 3 chunks are stored\. Give the same command again .*", last
    )
    assert "Traceback" not in out + err
    wait_until_ended(processes(tmp_path))
    status, _, err = finish(start(command, tmp_path, "none"))
    assert (status, "Traceback" in err) == (0, False)
    same(store, serial)


def test_a_second_run_on_a_store_is_refused_and_the_first_goes_on(file, tmp_path, no_figures, capsys):
    store = tmp_path / "x.zarr"
    with Store.begin(store, study_layout(load_study(file)), lambda _: None) as first:
        before = sorted(path for path in store.rglob("*"))
        assert main(["study", "run", str(file), "--store", str(store)]) == 2
        assert "no other run is writing" in capsys.readouterr().err
        assert sorted(path for path in store.rglob("*")) == before
        assert first.pending() == [0, 1, 2]
        assert main(["study", "status", str(store)]) == 0
        assert "A run is writing it now." in capsys.readouterr().out
    assert no_figures == []


def test_failed_chunks_give_status_one_and_their_names(file, monkeypatch, no_figures, capsys):
    def fail(*_, **__):
        raise RunError("1 of 3 chunks failed: chunk 1\n(scenarios 3 to 5)")

    monkeypatch.setattr(runner, "run_study", fail)
    assert main(["study", "run", str(file)]) == 1
    assert capsys.readouterr().err == "jaxmpc: 1 of 3 chunks failed: chunk 1 (scenarios 3 to 5)\n"
    assert no_figures == []


# -------------------------------------------------------------------------------------------------------- options


@pytest.fixture
def started(monkeypatch, no_figures):
    """Arguments of the run that a command would start."""
    given = []

    def run_study(study, store, **options):
        given.append({"name": study.name, "count": study.count, "store": store, **options})
        return Path(store)

    monkeypatch.setattr(runner, "run_study", run_study)
    return given


def test_options_reach_the_run(file, started, no_figures, tmp_path, capsys):
    store = tmp_path / "x.zarr"
    assert main(["study", "run", str(file), "--store", str(store), "--workers", "3"]) == 0
    assert main(["study", "run", str(file), "--quick", "--out", str(tmp_path), "--dask", "tcp://h:1"]) == 0
    assert main(["study", "run", "deadzone", "--quick"]) == 0
    whole, quick, shipped = started
    common = {"dask": None, "workers": 1}
    assert whole == {
        **common,
        "name": "tiny",
        "count": 8,
        "store": store,
        "workers": 3,
        "command": str(file),
    }
    assert quick == {
        **common,
        "name": "tiny-quick",
        "count": 4,
        "store": tmp_path / "tiny-quick.zarr",
        "dask": "tcp://h:1",
        "command": f"{file} --quick",
    }
    assert shipped["command"] == "deadzone --quick"
    assert no_figures[0] == (store, tmp_path / "x-figures")
    assert f"jaxmpc study export {store}" in capsys.readouterr().out


def test_a_dry_run_says_what_to_expect_and_writes_nothing(file, started, tmp_path, capsys):
    assert main(["study", "run", str(file), "--dry-run", "--store", str(tmp_path / "x.zarr")]) == 0
    out = capsys.readouterr().out
    for line in ("scenarios   8", "chunks      3", "models      2", "MB", "minutes"):
        assert line in out
    assert out.endswith("To run it, give the command without --dry-run.\n")
    assert started == []
    assert list(tmp_path.iterdir()) == [file]


def test_a_dry_run_of_a_study_that_has_begun_says_how_much_is_stored(file, serial, tmp_path, capsys):
    assert main(["study", "run", str(file), "--dry-run", "--store", str(serial)]) == 0
    out = capsys.readouterr().out
    assert "so far      8 of 8 scenarios (100%), 3 of 3 chunks" in out
    assert "scenarios per second" in out
    file.write_text(TEXT.replace("values = [100, 200]", "values = [100, 300]"))
    assert main(["study", "run", str(file), "--dry-run", "--store", str(serial)]) == 0
    assert "so far" not in capsys.readouterr().out  # the store is of another definition


def test_more_scenarios_than_the_limit_need_a_confirmation(file, started, capsys):
    file.write_text(TEXT.replace("confirmation_limit = 8", "confirmation_limit = 7"))
    assert main(["study", "run", str(file)]) == 2
    err = capsys.readouterr().err
    assert "8" in err
    assert "--yes" in err
    assert started == []
    assert main(["study", "run", str(file), "--dry-run"]) == 0
    assert "without --dry-run and with --yes: it has more than 7 scenarios" in capsys.readouterr().out
    assert main(["study", "run", str(file), "--yes"]) == 0
    assert started[0]["command"] == f"{file} --yes"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["thesis", "--workers", "2"], ["--workers", "a sweep study"]),
        (["thesis", "--store", "x.zarr"], ["--store"]),
        (["thesis", "--dask", "tcp://h:1"], ["--dask"]),
        (["thesis", "--dry-run"], ["--dry-run"]),
        (["thesis", "--yes"], ["--yes"]),
        (["deadzone", "--plant", "jax"], ["--plant", "thesis"]),
        (["deadzon"], ["deadzone", "blocking", "mismatch", "robustness"]),
        (["tesis"], ["Did you mean thesis?"]),
        (["fine-regulaton"], ["Did you mean fine-regulation?"]),
        (["nosuch"], [*shipped_comparisons(), *ALONE, *shipped_studies(), "a definition file"]),
        (["nosuch.toml"], ["nosuch.toml", "definition file"]),
    ],
)
def test_options_and_names_that_do_not_fit_are_refused_with_what_does(
    arguments, words, started, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main(["study", "run", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    for word in words:
        assert word in captured.err
    assert started == []
    assert list(tmp_path.iterdir()) == []


def test_a_mistake_in_a_definition_names_the_path_of_its_key(file, tmp_path, capsys):
    file.write_text(TEXT.replace("prediction_horizon = 30", "prediction_horizont = 30"))
    assert main(["study", "run", str(file), "--store", str(tmp_path / "x.zarr")]) == 2
    err = capsys.readouterr().err
    assert "base.prediction_horizont: got 30" in err
    assert "Did you mean prediction_horizon" in err
    assert list(tmp_path.iterdir()) == [file]


# -------------------------------------------------------------------------------------------- status and export


@pytest.mark.parametrize("quick", [False, True])
def test_status_gives_the_command_that_goes_on(quick, file, tmp_path, monkeypatch, no_figures, capsys):
    spaced = tmp_path / "my studies"
    spaced.mkdir()
    file = file.rename(spaced / "tiny.toml")
    monkeypatch.chdir(spaced)

    def stop(study):
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "prepare_study", stop)
    words = ["tiny.toml", "--store", "my x.zarr", *(["--quick"] if quick else [])]
    assert main(["study", "run", *words]) == 130
    assert "Give the same command again" in capsys.readouterr().err
    assert main(["study", "status", "my x.zarr"]) == 0
    out = capsys.readouterr().out
    assert f"0 of {4 if quick else 8} scenarios (0%)" in out
    again = out.splitlines()[-1].strip()
    assert again == f"jaxmpc study run '{file}'{' --quick' if quick else ''} --store 'my x.zarr'"


def test_suggested_commands_are_quoted_for_a_shell(file, tmp_path, no_figures, monkeypatch, capsys):
    store = tmp_path / "it's $HOME; a store.zarr"
    monkeypatch.setattr(runner, "run_study", lambda study, path, **options: path)
    assert main(["study", "run", str(file), "--store", str(store)]) == 0
    *_, last = capsys.readouterr().out.splitlines()
    words = shlex.split(last.partition("with: ")[2])
    assert words == ["jaxmpc", "study", "export", str(store), f"{store.stem}.csv"]


def test_status_of_a_shipped_study_names_it(tmp_path, monkeypatch, no_figures, capsys):
    def stop(study):
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "prepare_study", stop)
    store = tmp_path / "x.zarr"
    assert "deadzone" in shipped_studies()
    assert main(["study", "run", "deadzone", "--quick", "--store", str(store)]) == 130
    assert main(["study", "status", str(store)]) == 0
    assert f"jaxmpc study run deadzone --quick --store {store}" in capsys.readouterr().out


def test_status_of_a_finished_study_and_its_damage(serial, tmp_path, capsys):
    assert main(["study", "status", str(serial)]) == 0
    out = capsys.readouterr().out
    assert "8 of 8 scenarios (100%), 3 of 3 chunks" in out
    assert "scenarios per second" in out
    assert main(["study", "status", str(tmp_path / "none.zarr")]) == 2
    assert "none.zarr" in capsys.readouterr().err


def test_results_are_exported_as_a_table_and_as_netcdf(serial, tmp_path, monkeypatch, capsys):
    import pandas as pd
    import xarray as xr

    monkeypatch.chdir(tmp_path)
    assert main(["study", "export", str(serial)]) == 0
    assert capsys.readouterr().out == "tiny.csv\n"
    table = pd.read_csv("tiny.csv", index_col="scenario")
    with open_study(serial) as data:
        np.testing.assert_array_equal(table["iae.gas_rate"], data.iae.values[:, 0])
        np.testing.assert_array_equal(table["plant.reservoir_pressure"], data["plant.reservoir_pressure"])
        assert main(["study", "export", str(serial), "all.nc"]) == 0
        with xr.open_dataset("all.nc", engine="scipy") as whole:
            np.testing.assert_array_equal(whole.position.values, data.position.values)
    assert main(["study", "export", str(serial), "--netcdf"]) == 0
    assert Path("tiny.nc").exists()
    capsys.readouterr()
    assert main(["study", "export", str(serial), "tiny.csv"]) == 2
    assert "tiny.csv" in capsys.readouterr().err
    assert main(["study", "export", str(serial), "tiny.csv", "--overwrite"]) == 0
    assert main(["study", "export", str(serial), "tiny.txt"]) == 2


# ------------------------------------------------------------------------------------------------------- simulate


def test_one_scenario_is_run_again_saved_and_drawn(serial, tmp_path, no_figures, capsys):
    import xarray as xr

    assert main(["simulate", f"{serial}#4", "--out", str(tmp_path)]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    target = tmp_path / "tiny-4" / "trajectory.nc"
    assert str(target) in captured.out
    with xr.open_dataset(target, engine="scipy") as found, open_study(serial) as data:
        np.testing.assert_allclose(found.mv_value.values[::4], data.position.values[4], rtol=1e-9, atol=1e-9)
        assert found.sizes["time"] == 30
    trajectory, deadzone, folder, title = no_figures[0]
    assert len(trajectory.time) == 30
    assert deadzone.tolist() == [1000.0, 5.0]
    assert folder == tmp_path / "tiny-4"
    assert "scenario 4" in title


def test_a_scenario_of_other_code_is_run_again_with_a_warning(
    serial, tmp_path, no_figures, monkeypatch, capsys
):
    monkeypatch.setattr("studies.definition.scenarios.code_hash", lambda: "other")
    assert main(["simulate", f"{serial}#0", "--out", str(tmp_path)]) == 0
    assert "jaxmpc: scenario 0 was stored by other code or inputs" in capsys.readouterr().err


@pytest.mark.parametrize("scenario", ["x.zarr", "x.zarr#", "x.zarr#one", "x.zarr#-1", "x.zarr#0", "#0"])
def test_a_scenario_that_cannot_be_is_refused(scenario, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", scenario]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_scenario_number_beyond_the_study_is_refused(serial, tmp_path, capsys):
    assert main(["simulate", f"{serial}#8", "--out", str(tmp_path)]) == 2
    assert "0 to 7" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# ----------------------------------------------------------------------------------------------------------- dask


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers, processes of their own."""
    pytest.importorskip("distributed")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__DASHBOARD__LINK": ""}
    quiet = {"cwd": tmp_path, "env": environment, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    python = [sys.executable, "-m"]
    found = tmp_path / "scheduler.json"
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    begun = [
        subprocess.Popen(
            [
                *python,
                "distributed.cli.dask_scheduler",
                *local,
                "--port",
                "0",
                "--scheduler-file",
                str(found),
            ],
            **quiet,
        )
    ]
    (tmp_path / "scheduler.pid").write_text(str(begun[0].pid))
    try:
        address = None
        while address is None:  # a file that appears may be half written
            assert begun[0].poll() is None
            with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):
                address = json.loads(found.read_text())["address"]
            time.sleep(0.1)
        for _ in range(2):
            worker = ["distributed.cli.dask_worker", address, *local, "--no-nanny", "--nthreads", "1"]
            begun.append(subprocess.Popen([*python, *worker], **quiet))
        yield address
    finally:
        for process in begun:
            process.kill()
        for process in begun:
            process.wait()


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_stores_what_one_process_does(cluster, file, serial, tmp_path):
    store = tmp_path / "x.zarr"
    command = ["study", "run", file, "--store", store, "--dask", cluster]
    status, _, err = finish(start(command, tmp_path, "die-once"))
    assert status == 0, err
    assert "Traceback" not in err
    same(store, serial)
    assert computed(tmp_path).count(1) > 1
    assert len(processes(tmp_path)) == 2


@pytest.mark.slow
def test_a_lost_scheduler_ends_the_run_and_another_way_goes_on(cluster, file, serial, tmp_path):
    store = tmp_path / "x.zarr"
    command = ["study", "run", file, "--store", store]
    status, _, err = finish(start([*command, "--dask", cluster], tmp_path, "kill-scheduler", index=2))
    assert status == 1
    assert "Traceback" not in err
    last = err.splitlines()[-1]
    assert f"the dask scheduler at {cluster} is gone" in last
    kept = set(chunk_facts(store))
    assert f"{len(kept)} of 3 chunks are stored" in last
    (tmp_path / "computed").unlink()
    status, _, err = finish(start(command, tmp_path, "none"))
    assert status == 0, err
    assert set(computed(tmp_path)) == {0, 1, 2} - kept
    same(store, serial)
