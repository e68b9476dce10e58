"""Gains and dead times from the log of a closed loop: within their intervals where it tells them, else as before."""

import dataclasses

import numpy as np
import pytest

from identify.logged.knobs import Case, fit_knobs
from identify.logged.proposal import write_proposal
from identify.logged.update import HALF, update_model
from identify.plants import model_of, open_plant
from jaxmpc.cli.main import main
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.files import toml_text
from jaxmpc.loop.simulate import simulate
from jaxmpc.model.step_response import StepResponseModel, make_model
from jaxmpc.process.file import load_process, process_of
from studies.definition.catalogue import load_comparison
from studies.plans import plan_at
from studies.run.named import run_named
from studies.store.reading import open_results

BODY = {
    "name": "mixer",
    "dt": 10.0,
    "cv": [{"name": "level", "unit": "m", "tag": "LT"}],
    "mv": [{"name": "valve", "unit": "%", "tag": "FV"}, {"name": "pump", "unit": "rpm"}],
    "disturbance": [{"name": "leak", "unit": "m"}],
    "plants": {"own": {"kind": "python", "source": "own:Plant"}},
    "model": {
        "samples": 40,
        "working_point": {"level": 2.0, "valve": 50.0, "pump": 10.0},
        "transfer_functions": [
            {"cv": "level", "mv": "valve", "gain": 0.5, "dead_time": 20.0, "time_constants": [60.0]},
            {"cv": "level", "mv": "pump", "gain": -0.8, "dead_time": 10.0, "time_constants": [40.0]},
        ],
    },
    "structure": {"prediction_horizon": 30, "control_horizon": 4, "blocks": [1, 1, 2]},
    "presets": {"default": {"cv_weight": 1.0, "move_weight": 0.1}},
    "references": {"quick": {"windows": [[0, 2.0], [100, 2.5]], "duration": 600.0}},
}
TRUE = np.array([[1.2, 2.0], [0.85, 0.0]])  # factor of the gain, added dead time [samples]


@pytest.fixture(scope="module")
def process():
    return process_of(BODY, files=False)


def first_order(gain, dead_time, lag, count):
    """Step response at 1, 2, ... samples; times in samples."""
    after = np.maximum(np.arange(1, count + 1) - dead_time, 0.0)
    return gain * -np.expm1(-after / lag)


def closed_loop(seed, count=900, moving=(True, True)):
    """``"sample (cv, mv, mv)"`` of a loop that follows setpoints with both MVs, on a plant that is not its model."""
    rng = np.random.default_rng(seed)
    responses = [first_order(0.5 * 1.2, 4.0, 6.0, count), first_order(-0.8 * 0.85, 1.0, 4.0, count)]
    drift, total = np.zeros(count), np.zeros(2)
    u, cv = np.tile([50.0, 10.0], (count, 1)), np.zeros(count)
    setpoint = 2.0 + np.repeat(rng.normal(0, 1.0, count // 40 + 1), 40)[:count]
    effect = np.zeros(count)
    for k in range(count):
        drift[k] = 0.95 * drift[k - 1] * (k > 0) + rng.normal(0, 0.01)
        cv[k] = 2.0 + effect[k] + drift[k] + rng.normal(0, 0.02)
        error = setpoint[k] - cv[k]
        total += error * np.array([0.1, -0.04])
        wanted = [50.0 + total[0] + 0.6 * error, 10.0 + total[1] - 0.3 * error]
        wanted[1] += 1.0 * (k // 25 % 2)  # somebody moves the pump now and then
        before = u[k - 1] if k else [50.0, 10.0]
        u[k] = np.where(moving, wanted, before)
        for response, move in zip(responses, u[k] - before, strict=True):
            effect[k + 1 :] += move * response[: count - k - 1]
    return np.column_stack([cv, u])


def written(path, rows):
    lines = [",".join(map(repr, [10.0 * k, *map(float, row)])) for k, row in enumerate(rows)]
    path.write_text("\n".join(["time,LT,FV,pump", *lines]) + "\n")
    return path


def test_gains_and_dead_times_of_a_closed_loop_are_within_their_intervals(process, tmp_path):
    model = model_of(process)
    found = update_model(process, model, written(tmp_path / "log.csv", closed_loop(1)))
    assert [row.verdict for row in found.verdicts] == ["good", "good"]
    assert found.bands is not None
    final = found.responses[0, :, -1]
    np.testing.assert_array_less(np.abs(final - [0.6, -0.68]), found.bands[0, :, -1])
    assert np.abs(final / [0.5, -0.8] - [1.2, 0.85]).max() < 0.1
    # the old dead time is outside: at 4 samples the plant has not answered yet, the present model has
    np.testing.assert_allclose(
        found.alternatives["present model"][0, :, :40], np.asarray(model.coefficients)[0]
    )
    assert found.alternatives["present model"][0, 0, 3] > found.responses[0, 0, 3] + found.bands[0, 0, 3]
    assert "foreseen" in " ".join(found.notes)


def test_intervals_hold_as_often_as_they_say(process):
    nominal = np.asarray(model_of(process).coefficients)[0]
    hits = []
    for seed in range(8):
        rows = closed_loop(seed, 400)
        found = fit_knobs(Case(nominal, rows[:, 1:] - rows[0, 1:], rows[:, 0], [slice(0, len(rows))]))
        hits.append(np.abs(found.x[:, :2] - TRUE) <= HALF * found.deviations[:, :2])
    # of 32 intervals of 95 %, of which those of one log depend on each other, 26 or fewer hold in one case of fifty
    assert np.sum(hits) > 26


def test_what_the_log_cannot_tell_keeps_its_response(process, tmp_path):
    model = model_of(process)
    rows = closed_loop(2, 600, moving=(True, False))
    found = update_model(process, model, written(tmp_path / "log.csv", rows))
    valve, pump = found.verdicts
    assert valve.verdict in ("good", "look")
    assert pump.verdict == "bad"
    assert "never moves" in pump.says
    kept = found.responses[0, 1]
    np.testing.assert_array_equal(kept[:40], np.asarray(model.coefficients)[0, 1])
    assert (kept[40:] == kept[39]).all()
    assert found.bands is not None
    assert np.isnan(found.bands[0, 1]).all()


def test_moves_that_drown_in_noise_tell_nothing(process, tmp_path):
    rng = np.random.default_rng(0)
    rows = closed_loop(3, 300, moving=(False, False))
    rows[:, 0] = 2.0 + rng.normal(0, 1.0, len(rows))
    rows[:, 1] += 0.01 * (np.arange(len(rows)) // 20 % 2)
    with pytest.raises(InputError, match="cannot tell"):
        update_model(process, model_of(process), written(tmp_path / "log.csv", rows))


def test_a_model_that_is_right_stays_within_its_intervals(process, tmp_path):
    model = model_of(process)
    true = [[0.5, 2.0, 6.0], [-0.8, 1.0, 4.0]]
    right = dataclasses.replace(
        model,
        coefficients=np.array(
            [[first_order(g * 1.2, d + 2 * (j == 0), lag, 40) for j, (g, d, lag) in enumerate(true)]]
        )
        * np.array([1.0, 0.85 / 1.2])[:, None],
    )
    found = update_model(process, right, written(tmp_path / "log.csv", closed_loop(4)))
    assert all("no change within the intervals" in row.says for row in found.verdicts)


def test_the_command_writes_a_proposal_whose_study_runs_both_models(process, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    body = {key: value for key, value in BODY.items() if key != "plants"} | {"disturbance": []}
    (tmp_path / "mixer.toml").write_text(toml_text(body))
    written(tmp_path / "log.csv", closed_loop(1))
    assert main(["update", "mixer.toml", "log.csv", "--out", "new.json"]) == 0
    said = capsys.readouterr().out
    assert "valve on level" in said
    assert {path.name for path in tmp_path.glob("new*")} == {
        *("new.json", "new.html", "new-present.json", "new-process.toml", "new-study.toml")
    }
    study = load_comparison("new-study.toml")
    assert [(one.name, one.model) for one in study.definition.controllers] == [
        *(("present", "new-present.json"), ("updated", "new.json"))
    ]
    data = open_results(run_named(study, progress=False, say=lambda line: None)).load()
    for name, file in (("present", "new-present.json"), ("updated", "new.json")):
        model = StepResponseModel.load(tmp_path / file)
        structure = study.process.structure()
        controller = Controller(structure, study.process.tuning(structure), model)
        alone = simulate(controller, open_plant(study.process), study.process.reference())
        np.testing.assert_array_equal(data.position.sel(controller=name).values, alone.mv)
        with pytest.raises(InputError, match="model of the process"):
            plan_at(data, name, 100.0)
    # a controller whose model is its plant sees no bias but rounding
    assert (
        np.abs(data.bias.sel(controller="updated")).max()
        < 1e-9
        < np.abs(data.bias.sel(controller="present")).max()
    )


@pytest.mark.parametrize("name", ["gas-lifted-well", "pump-tank", "wood-berry"])
def test_the_study_is_accepted_whatever_the_plants_and_disturbances_of_the_process(name, tmp_path):
    known = load_process(name)
    steps = np.tile(np.linspace(0.1, 1.0, 20), (len(known.cvs), len(known.mvs), 1))
    model = make_model(steps, known.dt, known.cv_names, known.mv_names)
    write_proposal(known, model, model, tmp_path / "new.json")
    study = load_comparison(tmp_path / "new-study.toml")
    assert list(study.process.plants) == ["updated"]
    assert open_plant(study.process).cv_names == known.cv_names


def test_a_log_that_tells_nothing_leaves_nothing_behind(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mixer.toml").write_text(
        toml_text({k: v for k, v in BODY.items() if k != "plants"} | {"disturbance": []})
    )
    written(tmp_path / "log.csv", closed_loop(1, 100, moving=(False, False)))
    assert main(["update", "mixer.toml", "log.csv"]) == 2
    assert "never moves" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"mixer.toml", "log.csv"}
