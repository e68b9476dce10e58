"""Figures of any process: three CVs and two MVs of a made-up evaporator, compared and swept without a simulation."""

import itertools
import warnings

import matplotlib.colors
import msgspec
import numpy as np
import pytest
import xarray as xr

from figures import panels, registry, style
from figures.comparison import overview, summary, tracking, wear
from figures.sweep import draw as sweep
from figures.sweep import wear as front
from jaxmpc.errors import InputError
from jaxmpc.files import strict_json
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.model.step_response import make_model
from studies.definition.catalogue import load_comparison
from studies.run.comparison import comparison_layout
from studies.store.reading import open_results
from tests import studies_synthetic as made

PROCESS = """
name = "evaporator"
title = "Evaporator"
dt = 2
[[cv]]
name = "temperature"
unit = "degC"
settled = 0.5
[[cv]]
name = "pressure"
unit = "bar"
settled = 0.03
[[cv]]
name = "level_top"
unit = "mm"
label = "level at the top"
settled = 5
[[mv]]
name = "heater_power"
unit = "kW"
high = 120
move = 10
[[mv]]
name = "valve"
unit = "%"
label = "steam valve"
high = 100
move = 20
actuator = { kind = "stepped", step = 5, threshold = 4 }
[model]
file = "model.json"
[structure]
prediction_horizon = 8
control_horizon = 4
blocks = [1, 1, 2]
[presets.usual]
cv_weight = { temperature = 1, pressure = 100, level_top = 0.01 }
move_weight = { valve = 0.02, heater_power = 0.02 }
deadzone = { temperature = 0.5, pressure = 0.02, level_top = 4 }
soft_quadratic = { temperature = 1, pressure = 100, level_top = 0.01 }
[references.steps]
duration = 600
windows = [[0, 80, 4, 500], [300, 86, 3.9, 520]]
"""
HEATER, VALVE = 0, 1  # positions among the MVs: the stepped one is not the first
SETTLED = (0.5, 0.03, 5.0)


@pytest.fixture(scope="module")
def comparison(tmp_path_factory):
    """Five controllers, the longest labels that a page has to hold."""
    folder = tmp_path_factory.mktemp("process")
    names = ("temperature", "pressure", "level_top"), ("heater_power", "valve")
    units = {"cv_units": ("degC", "bar", "mm"), "mv_units": ("kW", "%")}
    make_model(np.tile(np.arange(1.0, 5.0), (3, 2, 1)), 2.0, *names, **units).save(folder / "model.json")
    (folder / "evaporator.toml").write_text(PROCESS)
    found = load_comparison("comparison", process=folder / "evaporator.toml")
    more = msgspec.structs.replace(
        found.definition.controllers[-1], name="fifth", label="mixed-integer MPC, other weights"
    )
    return found.process, msgspec.structs.replace(
        found.definition, controllers=(*found.definition.controllers, more)
    )


def run_of(process, definition, k) -> Trajectory:
    """A run whose valve swings by a step every 2 (k + 1) samples, and is asked for 1 % more than it does."""
    setpoint = definition.reference.build(process).sample(process.dt)
    samples = len(setpoint)
    at = np.arange(samples)
    position = np.stack([60 + k + np.sin(at / 9), 40 + 5.0 * ((at // (2 * k + 2)) % 2)], axis=1)
    demand = position + np.array([0.0, 1.0])
    cv = setpoint + (k + 1) * np.stack([0.1 * np.cos(at / 5), 0.01 * np.cos(at / 5), np.cos(at / 5)], axis=1)
    flat = np.ones(samples)
    names = {
        f"{kind}_{what}": getattr(process, f"{kind}_names") for kind in ("cv", "mv") for what in ("names",)
    }
    return Trajectory(
        time=process.dt * at,
        setpoint=setpoint,
        cv=cv,
        mv_demand=demand,
        mv=position,
        move=np.diff(demand, axis=0, prepend=demand[:1]),
        bias=0 * cv,
        bias_raw=0 * cv,
        quality=np.zeros(cv.shape, dtype=int),
        off=np.zeros(cv.shape, dtype=bool),
        status=np.zeros(samples, dtype=int),
        fallback=np.zeros(samples, dtype=bool),
        objective=flat,
        bound=flat,
        gap=0 * flat,
        nodes=flat.astype(int),
        solve_time=1e-3 * flat,
        finished_by=flat.astype(int),
        cv_units=tuple(v.unit for v in process.cvs),
        mv_units=tuple(v.unit for v in process.mvs),
        dt=process.dt,
        **names,
    )


@pytest.fixture(scope="module")
def stored(comparison, tmp_path_factory):
    """A study folder with every run but the last; results and folder."""
    process, definition = comparison
    folder = tmp_path_factory.mktemp("study")
    model = make_model(
        np.tile(np.arange(1.0, 5.0), (3, 2, 1)),
        process.dt,
        process.cv_names,
        process.mv_names,
        cv_units=("degC", "bar", "mm"),
        mv_units=("kW", "%"),
    )
    names = [controller.name for controller in definition.controllers]
    layout = comparison_layout(
        definition, process, model, dict, names, "study", {"kind": "model"}, {"jaxmpc": "none"}
    )
    store = made.begin(folder, layout)
    for k, name in enumerate(names[:-1]):
        made.write(store, name, run_of(process, definition, k))
    return open_results(folder).load(), folder


def test_any_comparison_has_a_page_an_overview_bars_and_a_figure_of_each_finished_run(stored, monkeypatch):
    monkeypatch.setitem(style.RC, "savefig.dpi", 40)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = registry.draw_study(stored[1], "mine")
    runs = {"run_continuous", "run_rounded", "run_rounded_from_position", "run_mixed_integer"}
    names = {f"{name}.{kind}" for name in {"summary", "overview", "wear", *runs} for kind in ("png", "pdf")}
    assert {path.name for path in paths} == {*names, "index.html"}
    page = (stored[1] / "figures" / "index.html").read_text()
    assert "Evaporator" in page
    for entry in registry.comparison_figures(stored[0]):
        assert entry.text(stored[0]) in page
        assert not {"nan", "None"} & set(entry.text(stored[0]).split())


def test_a_run_has_a_panel_per_cv_and_mv_with_labels_of_the_process_and_the_demand_of_stepped_ones(stored):
    data = stored[0]
    figure = tracking.draw(data, "rounded")
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "temperature [degC]",
        "pressure [bar]",
        "level at the top [mm]",
        "heater power [kW]",
        "steam valve [%]",
    ]
    *cvs, heater, valve = figure.axes
    assert all(axes.collections for axes in cvs)  # deadzones
    lines = {line.get_label(): line for line in valve.lines}
    run = data.sel(controller="rounded")
    np.testing.assert_array_equal(lines["demanded"].get_ydata()[:-1], run.demand.values[:, VALVE])
    np.testing.assert_array_equal(lines["actual"].get_ydata()[:-1], run.position.values[:, VALVE])
    assert not any(line.get_label().startswith("demanded") for line in heater.lines)
    assert figure.axes[-1].get_xlabel() == "time [min]"


def test_all_controllers_are_over_each_other_in_colours_of_their_own(stored):
    data = stored[0]
    figure = overview.draw(data)
    assert figure.axes[-1].get_ylabel() == "steam valve [%]"
    assert len(figure.axes) == 4  # the continuous MV is in the figures of the runs
    labels = data.label.values[:-1].tolist()
    for axes in figure.axes:
        shown = {line.get_label(): line.get_color() for line in axes.lines if line.get_label() in labels}
        assert list(shown) == labels
        assert len(set(shown.values())) == len(labels)
    colours = panels.run_colours(data)
    assert [colours[name] for name in ("continuous", "rounded", "mixed-integer")] == [
        style.BLUE,
        style.VERMILLION,
        style.GREEN,
    ]
    assert len(set(colours.values())) == 5


def test_bars_are_travel_reversals_and_deviations_in_settled_widths(stored, comparison):
    figure = wear.draw(stored[0])
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == [
        "steam valve travel [%]",
        "steam valve reversals [1]",
        "mean deviation / settled width [1]",
    ]
    travel, reversals, off = (np.array([bar.get_width() for bar in axes.patches]) for axes in figure.axes)
    for k in range(4):
        run = run_of(*comparison, k)
        moves = np.diff(run.mv[:, VALVE])
        turns = moves[moves != 0]
        first = abs(run.mv[0, VALVE] - run.mv_demand[0, VALVE])  # from the demand at which it starts
        np.testing.assert_allclose(travel[k], np.abs(moves).sum() + first)
        assert abs(reversals[k] - (turns[1:] * turns[:-1] < 0).sum()) <= 1
        np.testing.assert_allclose(off[k], (np.abs(run.cv - run.setpoint).mean(axis=0) / SETTLED).mean())
    paint = [matplotlib.colors.to_hex(bar.get_facecolor()).upper() for bar in figure.axes[0].patches]
    assert paint == list(panels.run_colours(stored[0]).values())[:4]


def test_the_page_holds_five_controllers_without_overlaps(stored, comparison):
    data = stored[0]
    whole = xr.concat(
        [data.isel(controller=slice(0, 4)), data.isel(controller=[3])], "controller", data_vars="minimal"
    )
    whole = whole.assign_coords(controller=data.controller, label=data.label)
    figure = summary.draw(whole)
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts if text.get_text()]
    assert len(boxes) > 5 * 10
    for box in boxes:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
    assert not any(
        one.shrunk(1, 0.7).overlaps(two.shrunk(1, 0.7)) for one, two in itertools.combinations(boxes, 2)
    )


# ------------------------------------------------------------------------------------------------ a sweep of it


def swept(process, columns):
    """Made-up key figures over every combination of columns: key, (unit, values)."""
    places = list(itertools.product(*(values for _, values in columns.values())))
    rng = np.random.default_rng(0)
    count = len(places)
    data = xr.Dataset(
        {
            "travel": (
                ("scenario", "mv"),
                rng.uniform(10, 90, (count, 2)),
                {"units": "mv_unit", "long_name": "sum of moves"},
            ),
            "reversals": (("scenario", "mv"), rng.integers(0, 9, (count, 2)).astype(float), {"units": "1"}),
            "mean_absolute_deviation": (
                ("scenario", "cv"),
                rng.uniform(1, 2, (count, 3)),
                {"units": "cv_unit"},
            ),
        },
        {
            "scenario": np.arange(count),
            "cv": list(process.cv_names),
            "mv": list(process.mv_names),
            "cv_unit": ("cv", ["degC", "bar", "mm"]),
            "mv_unit": ("mv", ["kW", "%"]),
        },
        {"process": strict_json(process.body), "definition": {"base": {}}, "title": "Made up"},
    )
    for k, (key, (unit, _)) in enumerate(columns.items()):
        values = np.array([place[k] for place in places], dtype=float if unit else object)
        data = data.assign_coords({key: ("scenario", values, {"units": unit, "long_name": key})})
    return data


def test_a_sweep_shows_the_stepped_mv_unless_another_is_named_and_marks_the_default_preset(comparison):
    process = comparison[0]
    data = swept(
        process,
        {
            "tuning.deadzone.temperature": ("degC", (0.5, 1.0)),
            "tuning.move_weight.valve": ("1/%^2", (0.02, 0.2)),
        },
    )
    axes = front.pareto(data)
    x, y = data.travel.values, (data.mean_absolute_deviation.values / SETTLED).mean(axis=1)
    assert axes.get_xlabel() == "steam valve travel [%]"
    assert axes.get_ylabel().endswith("/ settled width [1]")
    (ring,) = {tuple(np.ravel(line.get_data())) for line in axes.lines if line.get_markersize() > 10}
    np.testing.assert_allclose(ring, (x[0, VALVE], y[0]))
    assert "usual tuning" in [text.get_text() for text in axes.texts]
    other = front.pareto(data, "travel.heater_power")
    assert other.get_xlabel() == "heater power travel [kW]"
    drawn = np.concatenate([np.asarray(points.get_offsets()) for points in other.collections])
    np.testing.assert_allclose(np.sort(drawn[:, 0]), np.sort(x[:, HEATER]))
    with pytest.raises(InputError, match="pump"):
        front.pareto(data, "travel.pump")
    maps = sweep.pages(data)["maps"]()
    titles = [ax.get_title(loc="left") for ax in maps.axes if ax.get_title(loc="left")]
    assert titles == [
        "steam valve travel [%]",
        "steam valve reversals [1]",
        "mean deviation, temperature [degC]",
        "mean deviation, pressure [bar]",
        "mean deviation, level at the top [mm]",
    ]


@pytest.mark.parametrize("keys", [("model.valve", "model.heater_power"), ("model.heater_power",)])
def test_models_of_any_working_points_are_a_matrix_over_the_references(comparison, keys):
    points = dict(zip(keys, (("u", (1.0, 2.0, 3.0)), ("u", (10.0, 20.0))), strict=False))
    data = swept(comparison[0], {"reference": ("", ("low", "high")), **points})
    figure = sweep.pages(data)["mismatch"]()
    table = np.asarray(figure.axes[0].collections[0].get_array())
    scaled = (data.mean_absolute_deviation.values / SETTLED).mean(axis=1).reshape(2, 3, -1)
    np.testing.assert_allclose(table, scaled.transpose(0, 2, 1).reshape(-1, 3))
