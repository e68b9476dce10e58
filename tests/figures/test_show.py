"""Objects that show themselves in a notebook, and the quick looks `figures.plot` and `figures.pareto`."""

import dataclasses
import subprocess
import sys
from html.parser import HTMLParser

import jax
import numpy as np
import pytest

import figures
from jaxmpc import html
from jaxmpc.controller.plan import Plan
from jaxmpc.errors import InputError
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.model.step_response import make_model
from jaxmpc.problem.tuning import make_tuning, stack_tunings
from jaxmpc.process.file import load_process

HOSTILE = '<script>alert("1")</script>&'
VOID = {"line", "path", "br", "img"}


class Reader(HTMLParser):
    """Checks nesting and collects tags, attributes and text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.words = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(self.words)


def read(thing):
    """The parsed HTML of a thing, which must neither run nor load anything."""
    reader = Reader(thing._repr_html_())
    assert not {"script", "link", "iframe", "style", "img"} & set(reader.tags)
    for name, value in reader.attributes:
        assert name not in ("href", "src")
        assert not name.startswith("on")
        assert not any(mark in (value or "") for mark in ("url(", "//"))
    return reader


@pytest.fixture
def model():
    steps = np.linspace(0.1, 1.0, 40)
    return make_model(
        [[steps, -2 * steps], [3 * steps, 0 * steps]],
        10.0,
        ["gas", HOSTILE],
        ["choke", "lift"],
        cv_units=["m3/h", "<m>"],
        mv_units=["%", "m3/h"],
        working_point={"choke": 50.0, "lift": 7500.0},
        provenance={"plant": HOSTILE},
    )


@pytest.fixture
def run():
    samples = 700
    t = 10.0 * np.arange(samples)
    two = np.stack([np.sin(t / 500), np.cos(t / 500)], axis=1)
    one = np.ones(samples)
    return Trajectory(
        time=t,
        setpoint=np.zeros((samples, 2)),
        cv=two,
        mv_demand=two,
        mv=two,
        move=np.diff(two, axis=0, prepend=two[:1]),
        bias=0 * two,
        bias_raw=0 * two,
        quality=np.zeros((samples, 2), dtype=int),
        off=np.zeros((samples, 2), dtype=bool),
        status=np.r_[1, np.zeros(samples - 1, dtype=int)],
        fallback=one > 2,
        objective=one,
        bound=one,
        gap=0 * one,
        nodes=one,
        solve_time=1e-3 * one,
        finished_by=one,
        cv_names=("gas", HOSTILE),
        mv_names=("choke", "lift"),
        cv_units=("m3/h", "m3/h"),
        mv_units=("%", "m3/h"),
        dt=10.0,
    )


@pytest.fixture
def plan():
    moves = np.array([[2.0, 10.0], [0.0, -5.0]])
    mv = np.cumsum(np.repeat(moves, 3, axis=0), axis=0)
    cv = np.linspace([1.0, 2.0], [3.0, 1.0], 9)
    return Plan("optimal", 3.5, 3.5, 0.0, moves, mv, cv, np.zeros(2), np.zeros(2), 1, 0.002, "relaxation")


def test_a_model_shows_a_curve_for_each_response_with_names_units_and_working_point(model):
    reader = read(model)
    assert reader.tags.count("svg") == 4
    for words in ("choke [%]", "lift [m3/h]", f"{HOSTILE} [<m>]", "7500", "10 s", "settles at", "−2"):
        assert words in reader.text


def test_a_batched_model_shows_its_shape_instead_of_curves(model):
    batched = dataclasses.replace(model, coefficients=np.stack([model.coefficients] * 3))
    reader = read(batched)
    assert "svg" not in reader.tags
    assert "[3, 2, 2, 40]" in reader.text


def test_a_tuning_shows_value_unit_and_default_of_each_field(small_tuning):
    reader = read(small_tuning)
    assert reader.tags.count("tr") == 1 + len(dataclasses.fields(small_tuning))
    for words in ("cv weight", "0.0001, 0.1", "1/CV unit^2", "required", "rad/s", "∞", "yes, no"):
        assert words in reader.text


def test_a_batch_of_tunings_and_a_traced_tuning_show_shapes(small_tuning):
    assert "shape [2, 2]" in read(stack_tunings([small_tuning] * 2)).text
    seen = []
    jax.jit(lambda tuning: seen.append(read(tuning).text) or tuning.deadzone)(small_tuning)
    assert "traced, shape [2]" in seen[0]


def test_a_plan_shows_status_objective_moves_and_curves(plan):
    reader = read(plan)
    assert reader.tags.count("svg") == 4
    for words in ("Plan: optimal", "3.5", "relaxation", "block moves 10 −5"):
        assert words in reader.text
    none = dataclasses.replace(plan, status="infeasible", objective=None, moves=None, mv=None, cv=None)
    assert "infeasible" in read(none).text


def test_a_run_shows_cvs_mvs_and_how_many_samples_were_not_optimal(run):
    reader = read(run)
    assert reader.tags.count("svg") == 4
    assert "700 samples of 10 s" in reader.text
    assert reader.words[reader.words.index("samples not optimal ") + 1] == "1"


def test_a_run_of_no_samples_and_one_that_failed_show_themselves(run):
    arrays = {f.name: getattr(run, f.name) for f in dataclasses.fields(run)}
    empty = {k: v[:0] if isinstance(v, np.ndarray) else v for k, v in arrays.items()}
    assert "0 samples" in read(Trajectory(**empty)).text
    lost = dataclasses.replace(run, cv=np.full_like(run.cv, np.nan), gap=np.full_like(run.gap, np.nan))
    assert "no finite value" in read(lost).text


def test_a_study_shows_what_varies_and_what_it_takes():
    from studies.load import load_study

    study = load_study("deadzone", quick=True)
    reader = read(study)
    for column in study.columns:
        assert {column.key, column.label} <= set(reader.words)
    assert str(study.count) in reader.words


def test_a_long_curve_keeps_its_extremes_in_few_points():
    y = np.zeros(10_000)
    y[4321], y[7000] = 5.0, -5.0
    drawn = html.chart("spikes", [html.Curve(y)], height=48)
    assert len(drawn) < 10_000
    path = drawn[drawn.rindex(' d="') :]
    assert all(edge in path for edge in (" 2.0", " 46.0"))  # top and bottom of the chart


def test_a_gap_of_a_curve_is_not_bridged():
    drawn = html.chart("gap", [html.Curve([1.0, 2.0, np.nan, 1.0, 2.0])])
    assert drawn.count("M") == 2


def test_importing_figures_is_light_and_its_quick_looks_are_there_when_asked_for():
    code = (
        "import sys, figures\n"
        "assert 'matplotlib' not in sys.modules and 'jax' not in sys.modules\n"
        "assert {'plot', 'pareto'} <= set(dir(figures))\n"
        "assert callable(figures.pareto) and callable(figures.plot)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_a_model_is_drawn_with_one_panel_per_response(model):
    axes = figures.plot(model)
    assert axes.shape == (2, 2)
    assert axes[0, 1].get_ylabel() == "gas [m³/h per m³/h]"
    np.testing.assert_allclose(axes[1, 0].lines[-1].get_ydata()[[0, -1]], [0.0, 3.0])
    assert axes._repr_png_().startswith(b"\x89PNG")


def test_a_tuning_is_drawn_as_the_cost_of_a_deviation(small_tuning, small_structure):
    axes = figures.plot(small_tuning, structure=small_structure)
    cost = axes[0, 1].lines[-1]
    e, y = cost.get_xdata()[-1], cost.get_ydata()[-1]
    assert e == 12.5  # two and a half deadzones of 5
    assert y == pytest.approx(0.1 * e**2 + 0.1 * 7.5**2 + 0.1 * 7.5)
    assert "oil" in axes[0, 1].get_xlabel()


def test_a_plan_is_drawn_over_time_where_the_interval_is_known(plan, small_structure):
    assert "samples" in figures.plot(plan)[0, 0].get_xlabel()
    axes = figures.plot(plan, structure=small_structure)
    assert axes[0, 0].lines[0].get_xdata()[0] == 10.0  # the first prediction is one sample ahead
    assert axes[1, 0].lines[0].get_xdata()[0] == 0.0
    with pytest.raises(InputError, match="moves"):
        figures.plot(dataclasses.replace(plan, moves=None))


def test_a_run_is_drawn_with_the_deadzones_of_its_tuning(run, small_structure, thesis_fields):
    tuning = make_tuning(small_structure, **thesis_fields)
    assert len(figures.plot(run)[0, 0].collections) == 0
    axes = figures.plot(run, tuning=tuning)
    assert axes.shape == (4, 1)
    assert len(axes[0, 0].collections) == 1


def test_what_cannot_be_drawn_is_refused_by_its_type():
    with pytest.raises(InputError, match=r"'int'.*StepResponseModel"):
        figures.plot(3)
    with pytest.raises(InputError):
        figures.plot("no-such-store.zarr")


def test_a_process_shows_its_variables_with_units_and_what_studies_may_name():
    process = load_process("wood-berry")
    text = read(process).text
    for v in (*process.cvs, *process.mvs, *process.disturbances):
        assert v.name in text
        assert v.unit in text
    assert all(name in text for name in (*process.presets, *process.references))
    assert "stepped, 0.02 lb/min" in text
