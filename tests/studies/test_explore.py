"""The interactive app: what it computes, what it draws, how it is started, and a browser that drives it."""

import contextlib
import csv
import html
import http.client
import importlib.util
import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import jax
import numpy as np
import pytest

from figures import choose
from figures import explore as draw
from jaxmpc import Structure, make_tuning
from jaxmpc.cli import main as cli
from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.file import shipped_processes
from jaxmpc.process.new import new_process
from studies.definition.sweep import StudyDefinition
from studies.load import expand
from studies.notebooks import controls, export, launch
from studies.notebooks.loop import RUN, SHORT, explorer, main, nested, run, shown_figures, written
from studies.plans import plan_at
from studies.rerun import close_loop
from tests import studies_synthetic
from tests.fmu_plants import make_plant, real
from tests.sweep_synthetic import DEADZONE, OIL_DEADZONE, WEIGHT, grid, numbers, runs, write

SHAPE = {"prediction_horizon": 40, "blocks": [1, 1, 2, 4, 8]}  # small, to compile quickly


def rising(gain, delay, time):
    """Step response of first order with dead time, 60 samples."""
    k = np.arange(1, 61)
    return np.where(k > delay, gain * (1 - np.exp(-(k - delay) / time)), 0.0)


@pytest.fixture(scope="module")
def column(tmp_path_factory):
    """A process file that is no well: its model is its plant, and it has a measured disturbance."""
    folder = tmp_path_factory.mktemp("column")
    model = StepResponseModel(
        np.array([[rising(0.8, 2, 8), rising(-0.3, 5, 12)], [rising(0.2, 3, 15), rising(1.5, 1, 6)]]),
        5.0,
        cv_names=("level", "temperature"),
        mv_names=("feed", "steam"),
        cv_units=("m", "degC"),
        mv_units=("t/h", "t/h"),
        dv_names=("ambient",),
        dv_units=("degC",),
        dv_coefficients=np.array([[rising(0.5, 4, 10)], [rising(-0.2, 2, 10)]]),
    )
    model.save(folder / "column.json")
    text, _ = new_process(model, "column.json", "column", steps={"feed": 0.5})
    (folder / "column.toml").write_text(text)
    return folder / "column.toml"


@pytest.fixture(scope="module")
def explored(column):
    return explorer(column)


@pytest.fixture(scope="module")
def well():
    return explorer()


@pytest.fixture(scope="module")
def continuous(explored):
    return run(explored, SHAPE | {"controller": "continuous"})


@pytest.fixture(scope="module")
def mixed(explored):
    return run(explored, SHAPE)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    values = grid([(500.0, 2.5), (1000.0, 5.0)], [62.5, 250.0])
    path = tmp_path_factory.mktemp("sweep") / "made-up.zarr"
    definition = {"study": {"name": "made-up"}, "base": {"controller": "continuous", "actuator": "step"}}
    keys = (DEADZONE, OIL_DEADZONE, WEIGHT)
    return write(path, keys, values, numbers(4), runs(4), definition)


# ------------------------------------------------------------------------------------------------- settings


@pytest.mark.parametrize("process", ["explored", "well"])
def test_controls_that_are_not_touched_say_what_the_preset_says(process, request):
    explored = request.getfixturevalue(process)
    base, preset = controls.first_base(explored), explored.process.tuning(explored.process.structure())
    for field, names in (("deadzone", explored.process.cv_names), ("move_weight", explored.process.mv_names)):
        assert list(base["tuning"][field].values()) == getattr(preset, field).tolist()
        assert list(base["tuning"][field]) == list(names)
    assert base["reference"] == explored.short_step()
    assert (base["controller"], base["actuator"]) == ("mixed-integer", "step")


@pytest.mark.parametrize("name", shipped_processes())
def test_the_first_run_of_every_shipped_process_is_one_scenario(name):
    one = explorer(name)
    made = expand(StudyDefinition.from_dict(one.definition.body | {"base": controls.first_base(one)}))
    assert (made.count, made.scenario(0).samples) == (1, SHORT)


def test_a_slider_can_stand_where_its_preset_is(explored, well):
    for one in (explored, well):
        found = [controls.scenario_sliders(one)]
        found += [controls.tuning_sliders(one, preset) for preset in one.process.presets]
        for sliders in found:
            for key, slider in sliders.items():
                assert slider.value in slider.steps, key
                assert slider.steps == sorted(slider.steps)


def test_every_key_of_studies_has_a_control(explored, well):
    for one in (explored, well):
        own = {*controls.first_base(one), *controls.tuning_sliders(one, one.process.default_preset)}
        own |= {*controls.scenario_sliders(one), *(row["key"] for row in controls.further_fields(one))}
        left = {key for key in one.fields if key not in own and not key.startswith("sensor_fault.")}
        assert left <= {"disturbance.offset"}  # one slider per disturbance in its place


def test_a_further_setting_is_read_checked_and_named(explored):
    chosen, soft, tuning, scenario = start(explored)
    further = {"seed": "3", "blocks": "1 1 2", "tuning.cv_high.level": "inf", "noise.level": ""}
    base = controls.base_of(explored, chosen, soft, tuning, scenario, further)
    assert (base["seed"], base["blocks"], base["tuning"]["cv_high"]) == (3, (1, 1, 2), {"level": np.inf})
    assert "noise" not in base
    with pytest.raises(InputError, match=r"base\.seed") as refused:
        controls.base_of(explored, chosen, soft, tuning, scenario, {"seed": "many"})
    assert "whole number" in str(refused.value)


def start(explored):
    """What the controls say at first: choices, Soft MPC, tuning and scenario."""
    chosen = {name: next(iter(options.values())) for name, options in controls.choices(explored).items()}
    sliders = controls.tuning_sliders(explored, chosen["preset"]), controls.scenario_sliders(explored)
    return chosen, True, *({key: slider.value for key, slider in some.items()} for some in sliders)


def test_each_disturbance_starts_at_its_time(explored):
    chosen, soft, tuning, scenario = start(explored)
    scenario |= {"disturbance.ambient": -2.0, "disturbance.output.level": 1.0, "disturbance.time": 300.0}
    base = controls.base_of(explored, chosen, soft, tuning, scenario, {})
    done = run(explored, base | SHAPE)
    offsets = done.scenario.disturbance
    assert offsets.shape == (180, 3)
    assert offsets[59:61].tolist() == [[0.0, 0.0, 0.0], [-2.0, 1.0, 0.0]]
    assert done.trajectory.cv[61, 0] - done.trajectory.cv[60, 0] > 0.8  # added to the CV


HAPPENING = """
[[base.sensor_fault]]
cv = "level"
kind = "spike"
time = 200
size = 50
[[base.event]]
time = 300
mv_off = ["feed"]
tuning = { deadzone = { level = 0.25 } }
[[base.disturbance]]
time = 100
offset = 1.5
name = "ambient"
"""


def with_events(explored, text, **moved):
    """The base of untouched controls with a text of events, and sliders moved."""
    chosen, soft, tuning, scenario = start(explored)
    base = controls.base_of(explored, chosen, soft, tuning, scenario | moved, {}, text)
    return base | SHAPE | {"controller": "continuous"}


@pytest.fixture(scope="module")
def eventful(explored):
    return run(explored, with_events(explored, HAPPENING, **{"disturbance.ambient": 2.0}))


def test_what_is_listed_happens_beside_what_sliders_say(eventful, explored, continuous):
    scenario, t = eventful.scenario, eventful.trajectory
    assert scenario.disturbance[[19, 20, 89, 90], 0].tolist() == [0.0, 1.5, 1.5, 2.0]  # the slider's is later
    assert scenario.faults[40].tolist() == [50.0, 0.0]
    assert np.count_nonzero(scenario.faults) == 1  # one sample, as no duration is given
    assert np.ptp(t.mv[60:, 0]) == 0.0  # held
    assert np.ptp(t.mv[30:60, 0]) > 0.0
    assert [row[1:] for row in export.differences([continuous, eventful])] == [
        [
            "disturbance",
            "–",
            "time 100, offset 1.5, name ambient; time 450, offset 2, name ambient",
            "",
        ],
        ["event", "–", "time 300, tuning deadzone level 0.25, mv_off feed", ""],
        ["sensor_fault", "–", "cv level, kind spike, time 200, size 50", ""],
    ]


def test_what_is_listed_leaves_the_app_as_a_study_and_as_python(eventful):
    study = expand(StudyDefinition.from_dict(tomllib.loads(export.as_toml(eventful))))
    assert study.scenario_hash(0) == expand(eventful.definition).scenario_hash(0)
    made = {}
    exec(export.as_python(eventful), made)
    assert tuple(made["events"]) == eventful.scenario.events
    np.testing.assert_array_equal(made["faults"], eventful.scenario.faults)
    np.testing.assert_array_equal(made["disturbance"], eventful.scenario.disturbance)


@pytest.mark.parametrize("name", ["explored", "well"])
def test_examples_of_events_do_nothing_until_they_are_uncommented(name, request):
    explored = request.getfixturevalue(name)
    text = controls.example_lists(explored)
    assert controls.listed(text) == {}
    body = explored.definition.body | {"base": controls.listed(text.replace("# ", ""))}
    scenario = expand(StudyDefinition.from_dict(body)).scenario(0)
    assert len(scenario.events) == 2
    assert np.isnan(scenario.faults).any()
    assert scenario.disturbance.any()


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("[[base.event]", "events"),
        ("[[event]]", "events"),
        ("base = 1", "events"),
        ("[base]\nseed = 1", "events"),
        ("[base]\ndisturbance = 1", "base.disturbance"),
        ('[[base.sensor_fault]]\ncv = "flow"\nkind = "missing"\ntime = 5', "base.sensor_fault[0].cv"),
        ('[[base.sensor_fault]]\ncv = "level"\nkind = "frozen"\ntime = 1e9', "base.sensor_fault[0].time"),
        ("[[base.event]]\ntime = 2000-01-01", "base.event[0].time"),
        ('[[base.event]]\ntime = 5\nmv_off = ["pump"]', "base.event[0].mv_off"),
        ('[[base.disturbance]]\ntime = 600\noffset = 1\nname = "ambient"', "base.disturbance[1].time"),
    ],
)
def test_a_list_that_cannot_be_is_refused_by_its_place_before_anything_runs(text, field, explored):
    with pytest.raises(InputError) as refused:
        run(explored, with_events(explored, text, **{"disturbance.ambient": 1.0}))
    assert refused.value.field == field


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"controller": "fuzzy"}, "base.controller"),
        (
            {"blocking": "none", "control_horizon": 200},
            "base.blocking",
        ),  # whole moves without blocks take seconds
        ({"tuning.move_weight.feed": -1.0}, "base.tuning.move_weight.feed"),
        ({"tuning.move_weight.choke": 1.0}, "base.tuning.move_weight.choke"),
        ({"duration": float("nan")}, "base.duration"),
    ],
)
def test_what_no_controller_has_is_refused_by_key_before_anything_runs(changes, field, explored):
    with pytest.raises(InputError) as refused:
        run(explored, nested(changes))
    assert refused.value.field == field


# ------------------------------------------------------------------------------------------------------ runs


def test_a_run_follows_its_setpoints_with_whole_moves(mixed, explored):
    t = mixed.trajectory
    before, after = explored.process.reference().setpoints[:2]
    assert t.samples == 180
    np.testing.assert_array_equal(t.setpoint[[29, 30]], [before, after])
    np.testing.assert_allclose(t.move[:, 0] / 0.5, np.round(t.move[:, 0] / 0.5), atol=1e-9)
    assert abs(t.cv[-1, 0] - after[0]) < explored.process.cvs[0].span / 10


def test_the_key_figures_are_those_of_the_run(mixed):
    t = mixed.trajectory
    moves = np.diff(t.mv[:, 0], prepend=t.mv_demand[0, 0] - t.move[0, 0])
    assert mixed.kpis["travel.feed"] == pytest.approx(np.abs(moves).sum())
    deviation = np.abs(t.cv - t.setpoint).mean(axis=0)
    for name, value in zip(("level", "temperature"), deviation, strict=True):
        assert mixed.kpis[f"mean_absolute_deviation.{name}"] == pytest.approx(value)
    shown = {key: (words, unit) for key, words, unit in shown_figures(mixed.definition.process)}
    assert shown["travel.feed"] == ("feed, travel", "t/h")
    assert "reversals.steam" not in shown  # it takes every value


@pytest.mark.parametrize("name", ["continuous", "mixed"])
def test_the_first_planned_move_is_the_one_that_was_made(name, request):
    done = request.getfixturevalue(name)
    for sample in (0, 30, 179):
        plan = plan_at(done.data, RUN, 5.0 * sample)
        np.testing.assert_allclose(plan.move[0], done.trajectory.move[sample], atol=1e-6)
        np.testing.assert_allclose(plan.mv[0], done.trajectory.mv_demand[sample], atol=1e-6)
        assert plan.cv.shape == (40, 2)


def test_plans_of_blocks_of_their_own_are_expanded_for_each_mv(explored):
    blocks = [[1, 1, 2, 12], [4, 4, 8]]
    done = run(explored, {"controller": "continuous", "prediction_horizon": 40, "blocks": blocks})
    plan, made = plan_at(done.data, RUN, 150.0), np.asarray(done.trajectory.plan)[30]
    np.testing.assert_allclose(plan.move[:, 0], np.repeat(made[:4, 0], blocks[0]))
    np.testing.assert_allclose(plan.move[:, 1], np.repeat(made[:3, 1], blocks[1]))


def test_a_plan_knows_what_a_measured_disturbance_will_do(explored):
    steps = [
        {"time": 50.0, "offset": 2.0, "name": "ambient"},
        {"time": 100.0, "offset": -1.0, "name": "ambient"},
    ]
    held = nested({f"tuning.move_weight.{mv}": 1e9 for mv in ("feed", "steam")})
    still = {"times": [0.0], "setpoints": [[0.0, 0.0]], "duration": 900.0}
    done = run(
        explored, SHAPE | held | {"controller": "continuous", "disturbance": steps, "reference": still}
    )
    for sample in (10, 15, 20, 30):  # the model is the plant, and nothing moves: it comes as it was predicted
        plan = plan_at(done.data, RUN, 5.0 * sample)
        later = done.trajectory.cv[sample + 1 : sample + 41]
        known = later if sample >= 20 else later[: 20 - sample]  # until the next step of the disturbance
        np.testing.assert_allclose(plan.cv[: len(known)], known, atol=1e-3)
    assert np.abs(done.trajectory.cv).max() > 0.3


@pytest.mark.parametrize("kind", ["continuous", "mixed-integer"])
@pytest.mark.usefixtures("continuous", "mixed")
def test_other_numbers_compile_nothing_again(kind, explored):
    compiled = []

    def heard(event, duration, **_):
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(heard)
    changed = nested({"tuning.move_weight.feed": 3.0, "tuning.deadzone.level": 0.1, "soft": False})
    run(explored, SHAPE | {"controller": kind} | changed)
    run(explored, SHAPE | {"controller": kind, "reference": explored.short_step([1.0, 1.0])})
    assert compiled == []
    jax.jit(lambda x: x + len(compiled))(1.0)  # the ear is not deaf
    assert compiled


FROM_FILE = """
name = "tank"
dt = 1
cv = [{ name = "level", unit = "m", span = 1 }]
mv = [{ name = "valve", unit = "%", span = 5, low = 0, high = 10, move = 1, actuator = { kind = "stepped", step = 1 } }]
disturbance = [{ name = "rain", unit = "m" }]
model = { working_point = { valve = 0 }, steps = { valve = 1 }, samples = 30 }
structure = { prediction_horizon = 20, control_horizon = 8, blocks = [1, 1, 2, 4] }
presets.default = { cv_weight = 1, move_weight = 0.01, deadzone = 0.1 }
references.quick = { duration = 60, windows = [[0, 0], [30, 1.5]] }
"""
TANK = """
from typing import NamedTuple
import numpy as np

class Outputs(NamedTuple):
    cv: np.ndarray
    mv: np.ndarray

class Tank:
    dt, disturbance_names = 1.0, ("rain",)
    def __init__(self, actuators):
        self.actuators = actuators
    def init(self):
        self.cv, self.mv = np.zeros(1), np.zeros(1)
        return Outputs(self.cv, self.mv)
    def step(self, mv, disturbance):
        self.mv = np.array([a.move(now, to) for a, now, to in zip(self.actuators, self.mv, mv)])
        self.cv = self.cv + (1 - np.exp(-1 / 4.0)) * (0.5 * self.mv + disturbance - self.cv)
        return Outputs(self.cv, self.mv)
"""


@pytest.fixture(scope="module")
def tank(tmp_path_factory):
    """A run on a tank, a lag of 4 s and a gain of 0.5, that a Python class computes; folder and run."""
    folder = tmp_path_factory.mktemp("tank")
    (folder / "own_tank.py").write_text(TANK)
    plant = 'plants.tank = { kind = "python", source = "own_tank:Tank" }'
    (folder / "tank.toml").write_text(FROM_FILE + plant)
    one = explorer(folder / "tank.toml")
    return folder, run(one, controls.first_base(one) | nested({"controller": "continuous"}))


def test_a_run_on_a_class_in_python_has_its_plan_and_is_a_study(tank):
    _, done = tank
    t = done.trajectory
    assert abs(t.cv[-1, 0] - 1.5) < 0.25  # half of what a step of the valve does
    np.testing.assert_allclose(t.mv[:, 0], np.round(t.mv[:, 0]))
    np.testing.assert_allclose(plan_at(done.data, RUN, 30.0).move[0], t.move[30], atol=1e-6)
    body = tomllib.loads(export.as_toml(done))
    assert expand(StudyDefinition.from_dict(body)).scenario_hash(0) == expand(done.definition).scenario_hash(
        0
    )


def test_a_run_on_an_fmu_is_that_on_a_class_with_its_equations(tank):
    folder, done = tank
    variables = [real("valve", 0, start=0), real("rain", 1, start=0), real("level", 10, "output")]
    rates, outputs = "d[0] = (0.5 * u[0] + u[1] - x[0]) / 4", "y[0] = x[0]"
    fmu = make_plant(folder, variables, rates=rates, outputs=outputs)
    (folder / "fmu.toml").write_text(f'{FROM_FILE}plants.tank = {{ kind = "fmu", source = "{fmu.name}" }}')
    one = explorer(folder / "fmu.toml")
    base = controls.first_base(one) | nested({"controller": "continuous"})
    same = run(one, base)
    # its steps of 0.25 s are off by 1e-7, which a demand between two positions would show as a whole step
    np.testing.assert_allclose(same.trajectory.cv, done.trajectory.cv, atol=1e-5)
    assert {k: v for k, v in same.kpis.items() if k.startswith(("travel", "reversals"))} == {
        k: v for k, v in done.kpis.items() if k.startswith(("travel", "reversals"))
    }
    run(one, base)  # each run has an FMU of its own


def test_progress_ends_with_all_samples(explored):
    seen = []
    run(explored, SHAPE | {"controller": "continuous"}, lambda done, total: seen.append((done, total)))
    assert seen[-1] == (180, 180)


def test_short_times_are_written_in_milliseconds_and_large_numbers_in_full():
    assert written(0.0123, "s") == ("12.3", "ms")
    assert written(1450.0, "s") == ("1,450", "s")
    assert written(0.0, "s") == ("0", "s")
    assert written(123456.7, "m3") == ("123,457", "m³")
    assert written(3.0, "1") == ("3", "")
    assert written(float("nan"), "1") == ("nan", "")


def test_the_script_prints_every_key_figure(column, capsys):
    main(["--process", str(column), "controller=continuous", "prediction_horizon=40", "blocks=1 1 2 4 8"])
    printed = capsys.readouterr().out
    for _, words, _ in shown_figures(explorer(column).process):
        assert words in printed


def test_the_script_refuses_bad_input(column, capsys):
    for setting in ("tuning.move_weight.feed=-1", "tuning.moveweight.feed=1"):
        with pytest.raises(SystemExit) as left:
            main(["--process", str(column), setting])
        assert left.value.code == 2
        assert "tuning.move_weight.feed" in capsys.readouterr().err


# --------------------------------------------------------------------------------------- pins, differences, export


def test_pins_have_names_and_colours_of_their_own(mixed, continuous):
    pins = controls.pinned(controls.pinned((), "A", mixed), "", continuous)
    runs, colours = controls.named(mixed, pins)
    assert list(runs) == ["now", "A", "B"]
    assert len(set(colours)) == 3
    left = controls.unpinned(pins, "A")
    again = controls.pinned(left, "B", mixed)  # in place of the one of that name
    assert [pin.run for pin in again] == [mixed]


def test_what_differs_between_runs_is_told_by_key_with_units(explored, mixed, continuous):
    changed = run(explored, SHAPE | {"controller": "continuous", "tuning": {"deadzone": {"level": 0.25}}})
    (row,) = export.differences([continuous, changed])
    own = mixed.scenario.tuning.deadzone[0]
    assert row == ["deadzone of the level", "tuning.deadzone.level", f"{own:g}", "0.25", "m"]
    assert [row[1:] for row in export.differences([continuous, mixed])] == [
        ["controller", "continuous", "mixed-integer", ""]
    ]
    assert export.differences([mixed, mixed]) == []


def test_an_exported_run_is_a_study_that_repeats_it(explored, tmp_path):
    steps = [{"time": 300.0, "offset": 1.5, "name": "output.level"}]
    more = {"controller": "continuous", "noise": {"level": 0.1}, "disturbance": steps, "soft": False}
    done = run(explored, SHAPE | more | nested({"tuning.mv_high.steam": float("inf")}))
    body = tomllib.loads(export.as_toml(done, "mine"))
    study = expand(StudyDefinition.from_dict(body))
    assert (study.name, study.count) == ("mine", 1)
    again = close_loop(study, study.scenario(0))
    np.testing.assert_array_equal(again.cv, done.trajectory.cv)


def test_exported_python_makes_the_same_tuning(mixed):
    made = {}
    exec(export.as_python(mixed), made)
    assert made["structure"] == mixed.scenario.structure
    assert isinstance(made["structure"], Structure)
    assert made["make_tuning"] is make_tuning
    for ours, theirs in zip(
        jax.tree.leaves(mixed.scenario.tuning), jax.tree.leaves(made["tuning"]), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.skipif(not draw.can_be_sent(), reason="not installed: vl-convert")
def test_a_page_to_send_has_chart_figures_differences_and_settings(mixed, continuous):
    page = export.as_page({"now": mixed, "</script><i>": continuous}, draw.COLOURS[:2])
    assert "</script><i>" not in page
    assert "&lt;/script&gt;&lt;i&gt;" in page
    assert "<script " not in page  # scripts are in it
    assert not re.search("src=|href=", re.sub("<script>.*?</script>", "", page, flags=re.DOTALL))
    for text in ("feed, travel", "what differs", "prediction_horizon = 40", "vegaEmbed('#chart'"):
        assert text in page


def test_without_what_draws_it_a_page_is_not_made(mixed, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingToolError, match=r"pip install 'jaxmpc\[notebook\]'"):
        export.as_page({"now": mixed}, draw.COLOURS[:1])


# --------------------------------------------------------------------------------------------------- figures


def rows_of(chart):
    """The rows of the first data of a chart."""
    data = chart["data"] if "data" in chart else chart["vconcat"][0]["hconcat"][0]["data"]
    return list(csv.DictReader(io.StringIO(data["values"])))


def test_runs_share_a_time_axis_and_its_zoom(mixed, continuous):
    shown = [
        draw.Shown("now", draw.COLOURS[0], mixed.data),
        draw.Shown("A", draw.COLOURS[1], continuous.data),
    ]
    spec = draw.tracking(shown, zoom=(2.0, 5.0))
    titles = [panel["title"]["text"] for panel in spec["vconcat"][:-1]]
    assert titles == ["level [m]", "temperature [degC]", "feed [t/h]", "steam [t/h]"]
    (brush,) = spec["vconcat"][-1]["params"]
    assert brush["name"] == draw.ZOOM
    assert brush["value"] == {"x": [2.0, 5.0]}
    for panel in spec["vconcat"][:-1]:
        for layer in panel["layer"]:
            assert layer["encoding"]["x"]["scale"]["domain"] == {"param": draw.ZOOM}
    rows = rows_of(draw.tracking(shown))
    of = {name: [row for row in rows if row["run"] == name] for name in ("now", "A")}
    assert len(of["now"]) == len(of["A"]) == 181  # the end of the last sample, too
    np.testing.assert_allclose(
        [float(row["c1"]) for row in of["A"][:-1]], continuous.trajectory.cv[:, 1], rtol=1e-6
    )
    np.testing.assert_allclose(
        [float(row["d0"]) for row in of["now"][:-1]], mixed.trajectory.mv_demand[:, 0], rtol=1e-6
    )


def test_the_plan_of_a_time_is_drawn_from_that_time_on(mixed):
    rows = [row for row in rows_of(draw.planned(mixed.data, 300.0)) if row["what"] == "plan"]
    expected = plan_at(mixed.data, RUN, 300.0)
    np.testing.assert_allclose([60 * float(row["t"]) for row in rows], expected.cv_time, rtol=1e-5)
    np.testing.assert_allclose([float(row["y"]) for row in rows], expected.cv[:, 0], rtol=1e-5, atol=1e-6)
    for at in (0.0, 895.0):
        assert draw.planned(mixed.data, at)["vconcat"]


def test_the_runs_of_a_sweep_become_points_with_what_varies_and_the_front(sweep):
    table = choose.points(sweep).table
    expected = numbers(4)
    np.testing.assert_allclose(table[choose.X], expected["travel"][:, 0])
    zones = (1000.0, 5.0)
    np.testing.assert_allclose(table[choose.Y], (expected["mean_absolute_deviation"] / zones).mean(axis=1))
    assert table["number"].tolist() == [0, 1, 2, 3]
    assert table["best"][int(np.argmin(table[choose.X]))] == "on the front"
    assert all("250" in text for text in table["run"][1::2])


def test_ranges_that_are_dragged_keep_the_runs_within_all_of_them(sweep):
    runs = choose.points(sweep)
    zone, weight = runs.axes
    selected = {"axis": [zone, weight], "position": [1.05, 0.6]}
    assert choose.within(runs, choose.conditions(selected)).tolist() == [False, False, False, True]
    (low, *_) = choose.conditions({"axis": [weight], "position": [-0.1, 0.3]})
    assert choose.within(runs, [low]).tolist() == [True, False, True, False]
    assert choose.in_words(runs, low) == f"{weight}: 62.5 1/%²"
    for nothing in (None, {}, {"axis": [], "position": []}):
        assert choose.within(runs, choose.conditions(nothing)).all()
    travel = runs.table[choose.X].to_numpy()
    half = choose.Condition(runs.titles[choose.X], -1.0, 0.5)
    assert (choose.within(runs, [half]) == (travel <= (travel.min() + travel.max()) / 2)).all()
    lines = choose.parallel(runs, choose.within(runs, [half]))["layer"][0]["data"]["values"]
    assert len(lines) == 4 * 4  # runs and axes, travel and deviation among these


def test_an_axis_is_as_important_as_the_variance_that_it_explains(tmp_path):
    values = grid([1.0, 2.0, 3.0], [10.0, 20.0], [0, 1, 2, 3])
    noise = np.random.default_rng(5).normal(size=24)
    made = numbers(24)
    made["travel"][:, 0] = 100 * np.array(values[0])
    made["mean_absolute_deviation"][:] = (50 * np.array(values[1]) + noise)[:, None] * (1.0, 0.0)
    keys = (DEADZONE, WEIGHT, ("seed", "seed of the noise", "1"))
    shares = choose.importance(choose.points(write(tmp_path / "made.zarr", keys, values, made)))
    of = {(row.axis, row.figure): row.share for row in shares.itertuples()}
    zone, weight, seed = dict.fromkeys(shares["axis"])
    travel, away = dict.fromkeys(shares["figure"])
    assert of[zone, travel] == 1
    assert of[weight, travel] == of[seed, travel] == of[zone, away] == 0
    groups = (50 * np.array(values[1]) + noise).reshape(3, 2, 4).transpose(1, 0, 2).reshape(2, 12)
    left, total = groups.var(axis=1, ddof=1).mean(), groups.var(ddof=1)
    assert of[weight, away] == pytest.approx(1 - left / total)


def test_a_stored_scenario_is_drawn_as_it_is_stored(sweep):
    data = choose.stored(sweep, 2)
    np.testing.assert_allclose(data.measurement.values[0], runs(4)["measurement"][2])
    assert data.tuning_deadzone.values.tolist() == [[1000.0, 5.0]]
    assert (data.kind.item(), data.actuator.item()) == ("continuous", "step")
    assert draw.tracking([draw.Shown("2", draw.COLOURS[0], data)])["vconcat"]
    with pytest.raises(InputError, match="number"):
        choose.stored(sweep, 4)


def test_the_controllers_of_a_comparison_become_points_too(tmp_path):
    studies_synthetic.stored(tmp_path)
    assert len(choose.points(tmp_path).table) == 3
    data = choose.stored(tmp_path, 1)
    assert data.controller.values.tolist() == [RUN]
    assert draw.tracking([draw.Shown("1", draw.COLOURS[0], data)])["vconcat"]


def test_the_points_can_be_picked_from_a_chart(sweep):
    pytest.importorskip("altair")
    spec = choose.scatter(choose.points(sweep)).to_dict()
    assert spec["encoding"]["x"]["title"] == "choke travel [%]"
    assert {"number", "travel", "deviation", "best"} <= set(next(iter(spec["datasets"].values()))[0])


def test_what_is_no_store_is_refused(tmp_path):
    for path in (tmp_path / "none.zarr", tmp_path):
        with pytest.raises(InputError):
            choose.points(path)


# --------------------------------------------------------------------------------------------------- starting


def test_a_port_or_store_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(InputError, match="port"):
        launch.explore(port=0)
    with pytest.raises(InputError, match="process"):
        launch.explore(tmp_path / "none.toml")
    with pytest.raises(InputError, match="store"):
        launch.explore(store=tmp_path / "none.zarr")


def test_a_missing_marimo_is_named_with_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingToolError, match=r"pip install 'jaxmpc\[notebook\]'"):
        launch.explore()


# ----------------------------------------------------------------------------------------------------- server


SERVED = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("marimo", "altair")),
    reason="not installed: marimo",
)


@contextlib.contextmanager
def serving(log, *options, **environment):
    """``jaxmpc explore`` in a process of its own: the process, and the address that it prints."""
    words = [sys.executable, "-m", "jaxmpc.cli", "explore", *map(str, options)]
    with open(log, "w") as errors:
        server = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=errors, text=True, env={**os.environ, **environment}
        )
    try:
        assert server.stdout is not None
        line = server.stdout.readline()
        assert line.startswith("jaxmpc: http://127.0.0.1:"), log.read_text()
        yield server, line.split()[1]
    finally:
        server.kill()
        server.communicate()


@pytest.fixture(scope="module")
def address(sweep, tmp_path_factory):
    with serving(tmp_path_factory.mktemp("server") / "log", "--headless", "--store", sweep) as (_, found):
        yield urlsplit(found)


def ask(address, path, method="GET", **headers):
    """Status, headers and body of an answer; a header that is None is left out."""
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=60)
    connection.putrequest(method, path, skip_host=True)
    for name, value in {"Host": address.netloc, **headers}.items():
        if value is not None:
            connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    with contextlib.closing(connection):
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def cookie_of(address):
    """What the browser of the user holds once it has opened the address."""
    status, headers, _ = ask(address, f"/?{address.query}")
    assert status == 200
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["Set-Cookie"].split("; "))
    return headers["Set-Cookie"].split(";")[0]


FOREIGN = [
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "https://127.0.0.1"},
    {"Host": "evil.example"},
    {"Host": None},
    {"Host": "127.0.0.1"},
    {"Host": "evil.example", "Origin": "http://evil.example"},
]
PATHS = ["/", "/auth/login", "/health", "/api/version", "/assets/", "/@file/x", "/openapi.json"]


@SERVED
@pytest.mark.parametrize("path", PATHS)
def test_nothing_is_served_without_the_token(path, address):
    assert ask(address, path)[0] == 403
    assert ask(address, f"{path}?token=wrong")[0] == 403
    assert ask(address, f"{path}?access_token={address.query.partition('=')[2]}")[0] == 403
    assert ask(address, path, Cookie=cookie_of(address) + "x")[0] == 403


@SERVED
def test_what_browsers_ask_for_without_their_cookies_is_answered_and_says_nothing(address):
    status, _, body = ask(address, "/manifest.json")
    assert (status, json.loads(body)) == (200, {"name": "jaxmpc explore"})
    assert ask(address, "/manifest.json", Origin="http://evil.example")[0] == 403


@SERVED
@pytest.mark.parametrize("foreign", FOREIGN)
def test_a_page_of_another_site_is_refused_also_with_the_token(foreign, address):
    for path in ("/", "/api/kernel/set_ui_element_value"):
        for method in ("GET", "POST", "OPTIONS"):
            status, headers, body = ask(address, f"{path}?{address.query}", method, **foreign)
            assert status in (400, 403)  # a server may refuse a request without a host by itself
            assert len(body) < 200
            assert "Access-Control-Allow-Origin" not in headers


@SERVED
def test_controls_are_not_moved_without_the_token(address):
    path, own = "/api/kernel/set_ui_element_value", f"http://{address.netloc}"
    assert ask(address, path, "POST", Origin=own)[0] == 403
    cookie = cookie_of(address)
    assert ask(address, path, "POST", Cookie=cookie, Sec_Fetch_Site="same-site")[0] == 403
    assert ask(address, path, "POST", Cookie=cookie, Sec_Fetch_Site="same-origin", Origin=own)[0] != 403


@SERVED
def test_the_token_opens_the_app_and_the_cookie_keeps_it_open(address):
    status, _, body = ask(address, f"/?{address.query}")
    assert (status, b"jaxmpc explore" in body) == (200, True)
    named = address._replace(netloc=f"localhost:{address.port}")
    assert ask(named, f"/?{address.query}", Origin=f"http://localhost:{address.port}")[0] == 200
    status, headers, body = ask(address, "/", Cookie=cookie_of(address), Sec_Fetch_Site="none")
    assert (status, b"jaxmpc explore" in body) == (200, True)
    assert "Set-Cookie" not in headers


def listen(address, query, headers, origin=None, tries=3):
    """The first message of a WebSocket, or the status that refuses it; as a browser does, it connects again when dropped."""
    from websockets.exceptions import ConnectionClosedError, InvalidStatus
    from websockets.sync.client import connect

    uri = f"ws://127.0.0.1:{address.port}/ws?session_id=s_{os.urandom(4).hex()}{query}"
    host = headers.pop("Host", None)
    if host is not None:
        uri = uri.replace(f"127.0.0.1:{address.port}", host)
    with socket.create_connection(("127.0.0.1", address.port)) as connection:
        try:
            with connect(
                uri, sock=connection, origin=origin, additional_headers=headers, proxy=None
            ) as opened:
                return opened.recv(60)
        except InvalidStatus as refused:
            return refused.response.status_code
        except ConnectionClosedError:  # now and then, while the server ends the session before
            if tries == 1:
                raise
    return listen(address, query, {"Host": host, **headers} if host else headers, origin, tries - 1)


@SERVED
def test_a_websocket_is_refused_without_the_token_and_to_other_sites(address):
    pytest.importorskip("websockets")
    cookie, own, token = cookie_of(address), f"http://{address.netloc}", f"&{address.query}"
    assert listen(address, "", {}) == 403
    assert listen(address, "", {}, own) == 403
    assert listen(address, "&token=wrong", {}, own) == 403
    assert listen(address, "", {"Cookie": cookie}, "http://evil.example") == 403
    assert listen(address, token, {}, "http://evil.example") == 403
    assert listen(address, token, {"Host": f"evil.example:{address.port}"}) == 403
    assert listen(address, "", {"Cookie": cookie, "Sec-Fetch-Site": "same-site"}) == 403
    assert "kernel-ready" in listen(address, "", {"Cookie": cookie}, own)
    assert "kernel-ready" in listen(address, token, {})


SLOW = """
import time
from jax._src import compilation_cache, compiler

def slowly(*arguments, real=compiler.backend_compile_and_load, waits=[1.3], **options):
    time.sleep(waits.pop() if waits else 0.0)
    return real(*arguments, **options)

def missed(*arguments, real=compilation_cache.get_executable_and_time, misses=[(None, None)], **options):
    return misses.pop() if misses else real(*arguments, **options)

compiler.backend_compile_and_load = slowly  # a machine that is slow with its first program
compilation_cache.get_executable_and_time = missed  # and does not know it yet
"""


@SERVED
def test_the_page_shows_that_programs_are_compiled_until_they_are(tmp_path):
    client = pytest.importorskip("websockets.sync.client")
    (tmp_path / "sitecustomize.py").write_text(SLOW)
    found, more = os.environ.get("PYTHONPATH", ""), {"JAXMPC_QUIET": ""}
    with serving(tmp_path / "log", "--headless", PYTHONPATH=f"{tmp_path}{os.pathsep}{found}", **more) as (
        _,
        at,
    ):
        at = urlsplit(at)
        uri = f"ws://127.0.0.1:{at.port}/ws?session_id=s_{os.urandom(4).hex()}&{at.query}"
        shown, cell = [], None  # outputs of the cell that has said so
        with client.connect(uri, proxy=None, max_size=None) as page:
            while not shown or "compiling" in shown[-1]:
                said = json.loads(page.recv(300))
                output = said["data"].get("output") if said["op"] == "cell-op" else None
                if output and ("compiling" in output["data"] or said["data"]["cell_id"] == cell):
                    cell = said["data"]["cell_id"]
                    shown.append(output["data"])
    assert len(shown) == 2
    assert "compiling; once per machine" in shown[0]
    assert "compiling" not in shown[1]
    assert (tmp_path / "log").read_text() == ""


@SERVED
def test_the_app_is_served_on_the_loopback_interface_only_and_ends_with_its_process(tmp_path):
    for number, status in ((signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM), (signal.SIGKILL, -9)):
        log = tmp_path / "log"
        with serving(log, "--headless") as (server, found):
            port = urlsplit(found).port
            with socket.socket() as elsewhere:
                elsewhere.bind(("127.0.0.2", port))  # of all interfaces it would be in use
            assert ask(urlsplit(found), "/")[0] == 403
            server.send_signal(number)
            assert server.wait(60) == status
            with socket.socket() as probe:
                assert probe.connect_ex(("127.0.0.1", port)) != 0
        assert log.read_text() == ("jaxmpc: stopped\n" if number == signal.SIGINT else "")


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals as on POSIX")
@SERVED
@pytest.mark.parametrize("goes_on", [False, True], ids=["", "nohup"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["terminated", "killed"])
def test_the_server_ends_with_the_process_that_has_started_it_unless_it_is_told_to_go_on(
    number, goes_on, tmp_path
):
    ignoring = "trap '' HUP; " if goes_on else ""
    command = f'{ignoring}"{sys.executable}" -m jaxmpc.cli explore --headless & echo $!; wait'
    shell = subprocess.Popen(["sh", "-c", command], stdout=subprocess.PIPE, text=True, start_new_session=True)
    pid = int(shell.stdout.readline())
    try:
        port = urlsplit(shell.stdout.readline().split()[1]).port
        os.kill(shell.pid, number)  # this process alone
        shell.wait(60)
        if goes_on:
            time.sleep(3 * launch.LOOK)
            assert is_served(port)
        else:
            until(lambda: not is_served(port), 60)
            until(lambda: not is_running(pid), 60)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        shell.stdout.close()


def is_served(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")  # a container may have nobody who asks for the status of orphans
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals as on POSIX")
@SERVED
def test_the_server_ends_with_its_terminal_and_leaves_no_address_behind(tmp_path):
    import pty

    home, browser = tmp_path / "home", tmp_path / "browser"
    home.mkdir()
    browser.write_text("#!/bin/sh\nexec sleep 600\n")  # does not read its page
    browser.chmod(0o755)
    owns = "import fcntl, os, sys, termios; fcntl.ioctl(1, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
    terminal, inner = pty.openpty()
    server = subprocess.Popen(
        [sys.executable, "-c", owns, sys.executable, "-m", "jaxmpc.cli", "explore"],
        env={**os.environ, "HOME": str(home), "BROWSER": str(browser)},
        stdin=inner,
        stdout=inner,
        stderr=inner,
        start_new_session=True,
    )
    os.close(inner)
    said = b""
    while not said.endswith(b"\n"):
        said += os.read(terminal, 1000)
    port = urlsplit(said.decode().split()[1]).port
    until(lambda: list(home.glob("jaxmpc-*/open.html")))
    os.close(terminal)
    assert server.wait(60) == -signal.SIGHUP
    assert not is_served(port)
    assert list(home.glob("jaxmpc-*")) == []


@SERVED
def test_a_port_that_is_in_use_is_refused_before_anything_is_served(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert cli.main(["explore", "--headless", "--port", port]) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert port in captured.err


@SERVED
def test_the_browser_is_sent_to_the_address_which_no_argument_of_a_program_holds(tmp_path):
    seen, home = tmp_path / "seen", tmp_path / "home"
    home.mkdir()
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$@" > "{seen}.part" && mv "{seen}.part" "{seen}"\n')
    browser.chmod(0o755)
    with serving(tmp_path / "log", HOME=str(home), BROWSER=str(browser)) as (server, found):
        until(seen.exists)
        page = Path(urlsplit(seen.read_text().strip()).path)
        assert html.escape(found) in page.read_text()
        assert page.parent.stat().st_mode & 0o077 == 0
        arguments = Path(f"/proc/{server.pid}/cmdline")
        shown = arguments.read_text() if arguments.exists() else ""
        assert urlsplit(found).query.partition("=")[2] not in seen.read_text() + shown
        assert ask(urlsplit(found), f"/?{urlsplit(found).query}")[0] == 200
        until(lambda: list(home.glob("jaxmpc-*")) == [])


def until(condition, seconds=300):
    """Wait for what is to be seen; a limit only for what never comes."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.1)
    return found


# ---------------------------------------------------------------------------------------------------- browser


def _missing():
    tools = [tool for tool in ("chromium", "chromedriver") if shutil.which(tool) is None]
    modules = ("marimo", "altair", "selenium")
    return ", ".join(tools + [name for name in modules if importlib.util.find_spec(name) is None])


FIND = """
return [...document.querySelectorAll(arguments[0])].find(e => (e.dataset.label || '').includes(arguments[1])
  && e.shadowRoot && [...e.shadowRoot.querySelectorAll('*')].some(x => x.getBoundingClientRect().width > 0))
"""
SECOND_PAGE = """
[...document.querySelectorAll('marimo-radio')].flatMap(e => [...e.shadowRoot.querySelectorAll('[role=radio]')])
  .filter(e => e.getBoundingClientRect().width > 0)[1].click()
"""
POINTS = """
const chart = document.querySelector('marimo-vega');
return [...(chart?.shadowRoot?.querySelectorAll('.mark-symbol.role-mark path') || [])].map(e => {
  const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2] })
"""


CHARTS = """
return [...document.querySelectorAll('marimo-vega')].map(e => e.shadowRoot?.querySelector('svg.marks'))
  .filter(e => e).map(e => e.textContent + [...e.querySelectorAll('path')].map(p => p.getAttribute('d')).join())
"""


PLACE = """
const chart = document.querySelectorAll('marimo-vega')[arguments[0]];
const r = chart.shadowRoot.querySelector('svg.marks').getBoundingClientRect(); return [r.x, r.y, r.width, r.height]
"""


class Page:
    """The app in a browser without a window."""

    def __init__(self, driver):
        self.driver, self.script = driver, driver.execute_script

    def figures(self):
        return self.script("return (document.querySelector('#key-figures') || {}).innerText || ''")

    def differences(self):
        return self.script("return (document.querySelector('#differences') || {}).innerText || ''")

    def charts(self):
        return self.script(CHARTS)

    def complaints(self):
        said = [e["message"] for e in self.driver.get_log("browser") if e["level"] == "SEVERE"]
        # of the frame of the page, which may draw its sidebar a moment before it knows of it
        return "\n".join(message for message in said if "handleFillUpdated" not in message)

    def move_slider(self, label, key):
        thumb = self.script(
            "return arguments[0].shadowRoot.querySelector('[role=slider]')", self.find("slider", label)
        )
        self.script("arguments[0].focus()", thumb)
        thumb.send_keys(key)

    def drag(self, chart, start, end):
        """From one place of a chart to another, as parts of its width and height."""
        from selenium.webdriver.common.action_chains import ActionChains

        x, y, width, height = self.script(PLACE, chart)
        places = [(int(x + width * across), int(y + height * down)) for across, down in (start, end)]
        (x, y), (x_end, y_end) = places
        hand = ActionChains(self.driver)
        hand.w3c_actions.pointer_action.move_to_location(x, y).pointer_down()
        hand.w3c_actions.pointer_action.move_to_location((x + x_end) // 2, (y + y_end) // 2)
        hand.w3c_actions.pointer_action.move_to_location(x_end, y_end).pointer_up()
        hand.perform()

    def press(self, label):
        self.script("arguments[0].shadowRoot.querySelector('button').click()", self.find("button", label))

    def find(self, kind, label):
        return until(lambda: self.script(FIND, f"marimo-{kind}", label))


@contextlib.contextmanager
def opened(address):
    """A page in a browser without a window."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,943"):
        options.add_argument(word)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        driver.get(address)
        yield Page(driver)
    finally:
        driver.quit()


BROWSER = pytest.mark.skipif(bool(_missing()), reason=f"not installed: {_missing()}")


@BROWSER
def test_in_a_browser_a_slider_changes_charts_and_key_figures_beside_a_pinned_run(column, tmp_path):
    from selenium.webdriver.common.keys import Keys

    with serving(tmp_path / "log", column, "--headless") as (_, found), opened(found) as page:
        until(lambda: page.figures() and len(page.charts()) == 2)
        before, (run_before, plan_before) = page.figures(), page.charts()
        page.press("Pin this run")
        until(lambda: "what differs" not in page.differences() and "Nothing differs" in page.differences())
        page.move_slider("level, deadzone", Keys.END)
        until(lambda: "tuning.deadzone.level" in page.differences())
        until(
            lambda: (
                len(page.charts()) == 2 and page.charts()[0] != run_before and page.charts()[1] != plan_before
            )
        )
        travel = before.splitlines()[1].split("\t")[1]
        assert page.figures().splitlines()[0].split() == ["now", "A"]
        assert page.figures().splitlines()[1].split("\t")[2] == travel  # the pinned run stays
        run_before, plan_before = page.charts()
        page.move_slider("plan made at", Keys.ARROW_RIGHT)
        until(lambda: len(page.charts()) == 2 and page.charts()[1] != plan_before)
        assert page.charts()[0] == run_before
        page.drag(0, (0.4, 0.965), (0.6, 0.965))  # over the strip
        until(lambda: page.charts()[0] != run_before and "4.0" in page.charts()[0])
        run_before = page.charts()[0]
        page.move_slider("feed, move weight", Keys.HOME)
        until(lambda: page.charts()[0] != run_before)
        assert "4.0" in page.charts()[0]  # minutes with a digit: still zoomed in
        page.driver.save_screenshot(str(tmp_path / "run.png"))
        assert page.complaints() == ""
    assert (tmp_path / "log").read_text() == ""


@BROWSER
def test_in_a_browser_a_point_of_a_study_shows_its_run(address, tmp_path):
    from selenium.webdriver.common.actions.action_builder import ActionBuilder

    with opened(address.geturl()) as page:
        until(page.figures)
        page.script(SECOND_PAGE)
        assert len(until(lambda: page.script(POINTS))) == 4

        def picked():
            """The run of a point; a click that comes while the page still moves has to be made again."""
            if "choke [%]" in "".join(page.charts()):
                return True
            actions = ActionBuilder(page.driver)
            actions.pointer_action.move_to_location(*map(int, page.script(POINTS)[0])).click()
            actions.perform()
            time.sleep(2)
            return False

        until(picked)
        page.drag(1, (0.02, 0.45), (0.3, 0.9))  # over the first axis
        until(lambda: "deadzone of the gas rate: 500 m³/h" in page.script("return document.body.innerText"))
        page.driver.save_screenshot(str(tmp_path / "study.png"))
        assert page.complaints() == ""


@pytest.mark.skipif(importlib.util.find_spec("marimo") is None, reason="not installed: marimo")
def test_the_app_is_a_script_too():
    words = [sys.executable, "-m", "studies.notebooks.explore", "--help"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    assert "KEY=VALUE" in done.stdout
