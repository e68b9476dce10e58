"""Replays of logs: decisions equal those of the run that made the log, and predictions are of what was done, not advised."""

import dataclasses

import msgspec
import numpy as np
import pytest

from identify.plants import model_of, open_plant
from jaxmpc.cli.main import main
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.files import toml_text
from jaxmpc.loop.replay import Done, replay
from jaxmpc.loop.simulate import simulate
from jaxmpc.process.file import process_of
from studies.plans import plan_at
from studies.replay import predicted
from studies.run.replay import ADVICE, run_replay
from studies.store.reading import open_results

BODY = {
    "name": "mixer",
    "dt": 10.0,
    "cv": [{"name": "level", "unit": "m", "tag": "LT-1", "setpoint_tag": "LC-1.SP"}],
    "mv": [
        {
            "name": "valve",
            "unit": "%",
            "low": 0.0,
            "high": 100.0,
            "move": 4.0,
            "tag": "FV-1",
            "actuator": {"kind": "stepped", "step": 1.0},
        }
    ],
    "disturbance": [{"name": "inflow", "unit": "m3/h", "tag": "FT-1"}],
    "model": {
        "samples": 20,
        "working_point": {"level": 2.0, "valve": 50.0},
        "transfer_functions": [
            {"cv": "level", "mv": "valve", "gain": 0.4, "dead_time": 10.0, "time_constants": [30.0]},
            {"cv": "level", "dv": "inflow", "gain": 1.0, "dead_time": 5.0, "time_constants": [20.0]},
        ],
    },
    "structure": {"prediction_horizon": 16, "control_horizon": 4, "blocks": [1, 1, 2]},
    "presets": {
        "default": {"cv_weight": 1.0, "move_weight": 0.02, "bias_cutoff": 0.03},
        "slow": {"base": "default", "move_weight": 2.0},
    },
    "references": {"quick": {"windows": [[0, 2.0], [100, 4.0], [600, 3.0]], "duration": 900.0}},
}
HEADS = "time,LT-1,LC-1.SP,FV-1,FT-1"


@pytest.fixture(scope="module")
def process():
    return process_of(BODY)


def closed(process, kind):
    """A run with noise and a measured disturbance, and its log: a row at rest, then a row per sample."""
    structure = process.structure(integer=kind == "mixed-integer")
    controller = Controller(structure, process.tuning(structure), model_of(process))
    inflow = np.where(np.arange(90) > 30, 0.7, 0.0)
    disturbance = np.stack([inflow, np.zeros(90)], axis=1)
    run = simulate(
        controller,
        open_plant(process),
        process.reference("quick"),
        noise=[0.05],
        seed=2,
        disturbance=disturbance,
        position_feedback=True,
        keep_plans=True,
    )
    rows = np.column_stack([run.time, run.cv, run.setpoint, run.mv, inflow])
    return run, np.concatenate([[[-10.0, 2.0, 2.0, 50.0, 0.0]], rows])


def written(path, rows):
    path.write_text("\n".join([HEADS, *(",".join(repr(float(v)) for v in row) for row in rows)]) + "\n")
    return path


@pytest.fixture(scope="module")
def logged(process):
    """A run of the mixed-integer controller and its log."""
    return closed(process, "mixed-integer")


@pytest.mark.parametrize("kind", ["mixed-integer", "continuous"])
def test_the_log_of_a_run_gives_the_decisions_of_that_run_bit_for_bit(process, logged, tmp_path, kind):
    run, rows = logged if kind == "mixed-integer" else closed(process, kind)
    folder = run_replay(process, written(tmp_path / "log.csv", rows), tmp_path, kind=kind, progress=False)
    data = open_results(folder).isel(controller=0).load()
    fields = "cv setpoint mv mv_demand move bias plan objective status nodes"
    names = {"cv": "measurement", "mv": "position", "mv_demand": "demand"}
    np.testing.assert_array_equal(data.time.values, run.time + 10.0)  # since the first row of the log
    for field in fields.split():
        np.testing.assert_array_equal(getattr(run, field), data[names.get(field, field)].values, field)
    assert (data.status.values == 0).all()


def disturbed(rows):
    """The log with a value missing, a stretch in which somebody else moves the valve, and a gap."""
    rows = rows.copy()
    rows[20:23, 1] = np.nan
    rows[40:50, 3] = 57.5
    return np.delete(rows, range(60, 70), axis=0)


@pytest.fixture(scope="module")
def off(process, logged, tmp_path_factory):
    """Results of the replay of a log that followed no advice, and its rows."""
    folder = tmp_path_factory.mktemp("off")
    rows = disturbed(logged[1])
    out = run_replay(process, written(folder / "log.csv", rows), folder, progress=False)
    return open_results(out).load(), rows


def test_the_same_log_gives_the_same_decisions(process, off, tmp_path):
    data, rows = off
    again = open_results(
        run_replay(process, written(tmp_path / "log.csv", rows), tmp_path, progress=False)
    ).load()
    for name in data.data_vars:
        if name not in ("solve_time", "wall_time"):
            np.testing.assert_array_equal(data[name].values, again[name].values, str(name))


def test_predictions_are_made_of_the_moves_that_were_done(off, process):
    data, rows = off
    run = data.isel(controller=0)
    steps, response = (
        np.asarray(model_of(process).coefficients)[0, 0],
        np.asarray(model_of(process).dv_coefficients)[0, 0],
    )
    raw = []
    for part in (rows[:60], rows[60:]):  # by hand: each stretch from its first row
        moves, changes = (np.diff(part[:, k], prepend=part[0, k]) for k in (3, 4))
        at = lambda table, lag: table[min(lag, len(table) - 1)]  # noqa: E731
        for k in range(1, len(part)):
            effect = sum(
                moves[i] * at(steps, k - i - 1) + changes[i] * at(response, k - i - 1) for i in range(k)
            )
            raw.append(part[k, 1] - part[0, 1] - effect)
    known = np.isfinite(raw)
    assert known.sum() == len(raw) - 3
    # sums in another order: rounding of values of about 5
    np.testing.assert_allclose(run.bias_raw.values[known, 0], np.array(raw)[known], atol=1e-12)


def test_the_controller_goes_on_where_measurements_are_missing_and_begins_anew_behind_a_gap(off):
    data, rows = off
    run = data.isel(controller=0)
    assert run.sizes["time"] == len(rows) - 2
    assert list(np.flatnonzero(run.quality.values[:, 0] > 0)) == [19, 20, 21]
    assert (run.status.values == 0).all()
    assert not run.fallback.values.any()
    before = np.concatenate([rows[:59, 3], rows[60:-1, 3]])
    # an advice is whole steps from where the valve stands, wherever that is
    np.testing.assert_allclose(run.demand.values[:, 0] - run.move.values[:, 0], before, atol=1e-12)
    np.testing.assert_allclose(run.move.values, np.round(run.move.values), atol=1e-12)
    # bias and predictions begin anew with what is measured there
    assert run.base.values[59, 0] == rows[60, 1]


def test_a_stored_plan_is_rebuilt_from_what_was_done(off, process):
    data, _ = off
    run = data.isel(controller=0)
    first = float(model_of(process).coefficients[0, 0, 0]), float(model_of(process).dv_coefficients[0, 0, 0])
    foreseen = predicted(run)[:, 0]
    for k in (5, 41, 45, 57, 62, 75):
        plan = plan_at(data, ADVICE, float(run.time.values[k]))
        otherwise = run.position.values[k, 0] - run.demand.values[k, 0]
        inflow = run.dv.values[k + 1, 0] - run.dv.values[k, 0]
        assert inflow == 0  # its change would be seen one sample later
        assert plan.cv[0, 0] + first[0] * otherwise == pytest.approx(foreseen[k + 1], abs=1e-12)


def test_the_command_draws_and_sums_up_and_keeps_what_is_stored(off, logged, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mixer.toml").write_text(toml_text(BODY))
    written(tmp_path / "day 1.csv", disturbed(logged[1]))
    command = ["replay", "mixer.toml", "day 1.csv", "--preset", "slow", "--controller", "continuous"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "samples: 79 in 2 stretches of the log" in said
    assert "decisions proven optimal [%]: 100" in said
    folder = tmp_path / "results" / "mixer-day-1-replay"
    assert {path.name for path in (folder / "figures").iterdir()} == {
        "replay.png",
        "replay.pdf",
        "index.html",
    }
    assert "agree" in (folder / "summary.md").read_text()
    from figures.choose import points

    assert np.isfinite(points(folder).table[["travel", "deviation"]].to_numpy()).all()
    assert main(command) == 0
    assert "stored already" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("extra", "word"),
    [
        (["--controller", "whole"], "--controller"),
        (["--preset", "fast"], "--preset"),
        (["--reference", "long"], "reference"),
        (["--time", "when"], "when"),
    ],
)
def test_what_does_not_exist_is_refused_before_anything_is_written(
    logged, tmp_path, monkeypatch, capsys, extra, word
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mixer.toml").write_text(toml_text(BODY))
    written(tmp_path / "log.csv", logged[1])
    assert main(["replay", "mixer.toml", "log.csv", *extra]) == 2
    assert word in capsys.readouterr().err
    assert not list((tmp_path).glob("results/*/results.zarr"))


def test_a_missing_tag_is_named(process, logged, tmp_path):
    other = dataclasses.replace(process, mvs=(msgspec.structs.replace(process.mvs[0], tag="FV-2"),))
    with pytest.raises(InputError, match="FV-2"):
        run_replay(other, written(tmp_path / "log.csv", logged[1]), tmp_path, progress=False)


def test_a_clock_must_not_decide(process):
    structure = process.structure(integer=True)
    controller = Controller(structure, process.tuning(structure), model_of(process), time_limit=1.0)
    none = np.zeros((2, 1))
    with pytest.raises(InputError, match="time_limit"):
        replay(controller, Done(np.array([0.0, 10.0]), none, none, none, none, [slice(0, 2)]))
