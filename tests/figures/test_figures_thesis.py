"""All figures of the thesis: each in the registry, drawn from results alone, run only if missing, shown on one page."""

import dataclasses
import importlib
import json
from fractions import Fraction
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest

from figures import produce, registry, style
from figures.page import heading
from figures.thesis import events, integer_example, plans, soft
from jaxmpc.errors import InputError
from jaxmpc.loop.trajectory import Trajectory
from studies.run import comparison
from studies.run.comparison import comparison_layout
from studies.store.fingerprint import source_hash
from studies.store.reading import open_results
from studies.thesis import catalogue
from studies.thesis import integer_example as example
from studies.thesis.integer_example import EXAMPLE, IntegerProgram, Row
from studies.thesis.well import WELL
from tests import studies_synthetic as made

NUMBERED = [str(number) for number in (3, 4, 5, *range(10, 40))]
SCENARIOS = [registry.FIGURES[str(id)] for id in (3, 4, 5, 12, 13, *range(25, 39))]
WITHOUT_RESULTS = {"3", "4", "5", "13"}


def quiet(line: str) -> None:
    """Says nothing."""


def made_up(definition, controller) -> Trajectory:
    """A run of the definition's length whose choke swings by 2 % every five samples in the middle of each window."""
    structure = controller.structure(WELL)
    reference = definition.reference.build(WELL)
    setpoint = reference.sample(structure.dt)
    samples = len(setpoint)
    k = np.arange(samples)
    choke = 20.0 + 2.0 * ((k // 5) % 2) * (k % 300 > 100)
    mv = np.stack([choke, 7000.0 + 200 * np.sin(k / 50)], axis=1)
    move = np.diff(mv, axis=0, prepend=mv[:1])
    plan = np.zeros((samples, structure.block_count, 2))
    plan[:, 0] = move
    flat = np.ones(samples)
    return Trajectory(
        time=structure.dt * k,
        setpoint=setpoint,
        cv=setpoint + np.stack([100 * np.cos(k / 9), 4 * np.cos(k / 9)], axis=1),
        mv_demand=mv,
        mv=mv,
        move=move,
        bias=0.1 * setpoint,
        bias_raw=0.1 * setpoint,
        quality=np.zeros(setpoint.shape, dtype=int),
        off=np.zeros(setpoint.shape, dtype=bool),
        status=np.zeros(samples, dtype=int),
        fallback=np.zeros(samples, dtype=bool),
        objective=flat,
        bound=flat,
        gap=0 * flat,
        nodes=np.ones(samples, dtype=int),
        solve_time=1e-3 * (1 + k % 7),
        finished_by=np.ones(samples, dtype=int),
        cv_names=structure.cv_names,
        mv_names=structure.mv_names,
        cv_units=structure.cv_units,
        mv_units=structure.mv_units,
        dt=structure.dt,
        plan=plan,
    )


class Runner:
    """Stands in for `studies.thesis.catalogue.run_thesis`: stores made-up runs and remembers what it was asked for."""

    def __init__(self):
        self.asked = []

    def __call__(self, name, out="results", quick=False, plant="fmu", *, progress=True, say=print, only=None):
        self.asked.append(name)
        definition = catalogue.comparison_of(name, quick, plant).definition
        folder = out / definition.name
        folder.mkdir(parents=True, exist_ok=True)
        names = [controller.name for controller in definition.controllers]
        code = {package: source_hash(package) for package in ("jaxmpc", "identify")}
        facts = json.dumps([name, code]), {"kind": plant}, code
        layout = comparison_layout(definition, WELL, made.model(), made.extra, names, *facts)
        store = made.begin(folder, layout, say)
        for i in store.pending()[:only]:
            made.write(store, names[i], made_up(definition, definition.controllers[i]))
        return folder


@pytest.fixture
def runner(monkeypatch):
    fake = Runner()
    monkeypatch.setattr(catalogue, "run_thesis", fake)
    monkeypatch.setitem(style.RC, "savefig.dpi", 40)
    return fake


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Everything, drawn from made-up results of every study: folders of results and figures, and the files."""
    folder = tmp_path_factory.mktemp("all")
    fake = Runner()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(catalogue, "run_thesis", fake)
        patch.setitem(style.RC, "savefig.dpi", 40)
        paths = produce.produce(["all"], folder / "results", folder / "out", True, "jax", say=quiet)
    READ.clear()
    return folder / "results", folder / "out", paths


READ = {}


def results_of(drawn, study):
    """Results of a study, read once."""
    if study not in READ:
        READ[study] = open_results(produce.study_folder(study, drawn[0], True, "jax")).load()
    return READ[study]


# the integer program


def test_the_relaxed_optimum_of_the_example_is_exact_and_proven_by_its_multipliers():
    x = example.relaxed_optimum(EXAMPLE)
    assert x == (Fraction(376, 193), Fraction(950, 193))
    first, second = (row.normal for row in EXAMPLE.rows if row.excess(x) == 0)
    u = np.linalg.solve(np.array([first, second], dtype=float).T, np.array(EXAMPLE.objective, dtype=float))
    assert (u > 0).all()  # no direction that both rows allow improves the objective


def test_rounding_ends_far_from_the_integer_optimum():
    assert example.rounded(EXAMPLE) == (2, 4)
    assert example.optimum(EXAMPLE) == (5, 0)
    assert EXAMPLE.value(example.rounded(EXAMPLE)) < EXAMPLE.value(example.optimum(EXAMPLE)) == 5
    assert not EXAMPLE.holds((Fraction(2), Fraction(5)))  # what plain rounding gives


def test_the_hull_holds_every_integer_point_and_its_corners_are_some_of_them():
    points = example.integer_points(EXAMPLE)
    corners = example.hull(points)
    assert set(corners) <= set(points)
    assert len(points) == 19
    facets = example.facets(corners)
    assert len(facets) == len(corners) == 5
    for row in facets:
        assert all(value.denominator == 1 for value in (*row.normal, row.limit))
        excess = [row.excess(point) for point in points]
        assert max(excess) == 0
        assert excess.count(0) >= 2


def test_the_cut_removes_the_relaxed_optimum_and_no_integer_point_and_follows_from_the_rows():
    cut = example.best_cut(EXAMPLE)
    assert cut.row.excess(example.relaxed_optimum(EXAMPLE)) > 0
    assert all(cut.row.excess(point) <= 0 for point in example.integer_points(EXAMPLE))
    assert cut.optimum == example.optimum(EXAMPLE)
    assert min(cut.multipliers) >= 0
    left = [
        sum(u * row.normal[axis] for u, row in zip(cut.multipliers, cut.rows, strict=True)) for axis in (0, 1)
    ]
    right = sum(u * row.limit for u, row in zip(cut.multipliers, cut.rows, strict=True))
    assert tuple(left) == cut.row.normal
    assert right // 1 == cut.row.limit < right


def test_an_integer_program_without_points_or_without_need_of_a_cut_is_refused():
    signs = EXAMPLE.rows[2:]
    empty = IntegerProgram(EXAMPLE.objective, (*signs, Row.of(1, 1, -1)))
    with pytest.raises(InputError, match=r"program\.rows"):
        example.relaxed_optimum(empty)
    between = IntegerProgram(
        EXAMPLE.objective,
        (Row.of(1, 0, "0.7"), Row.of(-1, 0, "-0.3"), Row.of(0, 1, "0.7"), Row.of(0, -1, 0)),
    )
    with pytest.raises(InputError, match="some integer point"):
        example.integer_points(between)
    square = IntegerProgram(EXAMPLE.objective, (*signs, Row.of(1, 0, 2), Row.of(0, 1, 2)))
    with pytest.raises(InputError, match="outside the integer hull"):
        example.best_cut(square)


def test_a_row_is_written_as_people_write_it():
    assert integer_example.row_text(Row.of(3, 2, 15)) == "3 x₁ + 2 x₂ ≤ 15"
    assert integer_example.row_text(Row.of(-1, 1, -2)) == "−x₁ + x₂ ≤ −2"


# the registry


def test_every_figure_of_the_thesis_is_in_the_registry_with_its_study_and_function():
    assert [id for id in registry.FIGURES if id.isdigit()] == NUMBERED
    names = [entry.name for entry in registry.FIGURES.values()]
    assert len(set(names)) == len(names)
    for id, entry in registry.FIGURES.items():
        assert (entry.study is None) == (id in WITHOUT_RESULTS)
        assert entry.study is None or entry.study in catalogue.STUDIES
        module, _, function = entry.source.rpartition(".")
        assert getattr(importlib.import_module(module), function) is entry.function
        assert entry.caption
        assert entry.alt.endswith(".")
        assert entry.title
        if id.isdigit():
            assert entry.name.startswith(f"figure_{id}_")


def test_a_figure_needs_controllers_that_its_study_has():
    for entry in registry.FIGURES.values():
        if entry.study is not None:
            known = {
                one.name for one in catalogue.comparison_of(entry.study, True, "jax").definition.controllers
            }
            assert set(entry.needs) <= known, entry.id


def test_figures_of_two_studies_are_not_drawn_from_the_results_of_one(drawn, tmp_path):
    data = results_of(drawn, "soft")
    with pytest.raises(InputError, match="figures of one study, not of soft, disturbance"):
        registry.draw(["12", "33"], data, tmp_path)
    with pytest.raises(InputError, match="results of the study soft"):
        registry.draw(["3", "12"], None, tmp_path)
    assert not list(tmp_path.iterdir())
    assert len(registry.draw(["3", "12"], data, tmp_path)) == 4
    assert registry.draw([], data, tmp_path) == []


# the drawings


def test_every_figure_is_drawn_as_png_and_pdf(drawn):
    names = {path.name for path in drawn[2]}
    assert names == {f"{e.name}.{kind}" for e in registry.FIGURES.values() for kind in ("png", "pdf")}
    assert all(path.parent == drawn[1] and path.stat().st_size > 1000 for path in drawn[2])


@pytest.mark.parametrize("entry", SCENARIOS, ids=lambda entry: entry.id)
def test_every_axis_has_a_unit_and_every_panel_a_curve(entry, drawn):
    data = None if entry.study is None else results_of(drawn, entry.study)
    picture = entry.draw(data)
    for axes in picture.axes:
        assert "[" in axes.get_ylabel()
        assert axes.lines
    assert any("[" in axes.get_xlabel() for axes in picture.axes)


@pytest.mark.parametrize("entry", registry.FIGURES.values(), ids=lambda entry: entry.id)
def test_a_caption_is_one_to_three_sentences_without_a_missing_number(entry, drawn):
    data = None if entry.study is None else results_of(drawn, entry.study)
    text = entry.text(data)
    assert text[0].isupper()
    assert text.endswith(".")
    assert 1 <= text.count(". ") + 1 <= 3
    assert not {"nan", "inf", "None"} & set(text.replace("−", " ").split())


def test_the_penalty_is_halved_inside_the_deadzone_and_approaches_the_nominal_one_outside():
    for cv, half in (("gas_rate", 1000.0), ("oil_rate", 5.0)):
        inside, far = half * np.array([-1.0, 0.3, 1.0]), 1e4 * half * np.array([-1.0, 1.0])
        np.testing.assert_allclose(
            soft.penalty("thesis", cv, inside), soft.penalty("no-soft", cv, inside) / 2
        )
        np.testing.assert_allclose(
            soft.penalty("thesis", cv, inside), soft.penalty("no-soft-plain", cv, inside)
        )
        np.testing.assert_allclose(
            soft.penalty("thesis", cv, far), soft.penalty("no-soft", cv, far), rtol=1e-3
        )


def test_the_plan_lies_on_grey_and_the_evolution_on_white(drawn):
    data = results_of(drawn, "predictions")
    at = plans.first_change(data) / 60
    picture = plans.planned(data, "closed-loop")
    for axes in picture.axes:
        (patch,) = axes.patches
        assert patch.get_x() == pytest.approx(at)
    lines = [line for line in picture.axes[0].lines if line.get_label() == "actual"]
    assert max(lines[0].get_xdata()) == pytest.approx(at)  # no measurement of what lies ahead
    picture = plans.evolved(data, "closed-loop")
    assert not any(axes.patches for axes in picture.axes)
    lines = [line for line in picture.axes[0].lines if line.get_label() == "actual"]
    assert max(lines[0].get_xdata()) > at + 30


def test_the_three_moves_of_an_oscillation_turn_the_choke_back_in_one_window(drawn):
    data = results_of(drawn, "without-soft")
    moves = plans.swing_moves(data, "no-soft")
    rows = np.searchsorted(data.time.values, moves)
    assert len(set(data.window.values[rows])) == 1
    position = data.position.sel(controller="no-soft", mv="choke").values
    turns = position[rows] - position[rows - 1]
    np.testing.assert_array_equal(turns[1:], -turns[:-1])
    still = data.assign(position=0 * data.position)
    with pytest.raises(InputError, match="turns back three times"):
        plans.swing_moves(still, "no-soft")


def test_events_are_marked_when_they_happen(drawn):
    data = results_of(drawn, "fine-regulation")
    retuned = catalogue.comparison_of("fine-regulation", True, "jax").definition.controllers[0].then[0].at
    assert events.retuned_at(data, "mixed-integer") == retuned == 3000.0
    pressed = results_of(drawn, "disturbance")
    course = catalogue.comparison_of("disturbance", True, "jax").definition.disturbance
    assert events.disturbed_at(pressed) == course[0][0]
    picture = registry.FIGURES["29"].draw(data)
    for axes in picture.axes:
        (line,) = [line for line in axes.lines if line.get_linestyle() == ":"]
        assert line.get_xdata()[0] == pytest.approx(retuned / 60)
    with pytest.raises(InputError, match="0 bar throughout"):
        events.disturbed_at(data)
    with pytest.raises(InputError, match="tuning changes"):
        events.retuned_at(pressed, "mixed-integer")


def test_tunings_under_the_same_controller_have_their_own_colours(drawn):
    picture = soft.compared(results_of(drawn, "soft"))
    shown = {line.get_label(): line.get_color() for line in picture.axes[0].lines}
    assert shown["nominal"] == style.PURPLE
    assert shown["Soft MPC"] == style.CONTROLLER_COLOURS["mixed-integer", "step"]
    picture = registry.FIGURES["34"].draw(results_of(drawn, "without-soft"))
    assert shown["nominal"] in [line.get_color() for line in picture.axes[0].lines]


def test_computation_times_share_a_logarithmic_axis(drawn):
    picture = registry.FIGURES["39"].draw(results_of(drawn, "thesis"))
    one, two = picture.axes
    assert one.get_yscale() == two.get_yscale() == "log"
    assert one.get_ylim() == two.get_ylim()
    assert {"continuous", "mixed-integer"} == {ax.get_title(loc="left").split()[0] for ax in (one, two)}
    assert max(one.lines[0].get_ydata()) == pytest.approx(7.0)  # ms


# from nothing to figures


def test_only_the_studies_that_are_missing_are_run(runner, tmp_path):
    ask = {
        "results": tmp_path / "results",
        "out": tmp_path / "out",
        "quick": True,
        "plant": "jax",
        "say": quiet,
    }
    assert len(produce.produce(["33", "12", "3", "33"], **ask)) == 6
    assert runner.asked == ["disturbance", "soft"]
    produce.produce(["33", "27"], **ask)
    assert runner.asked == ["disturbance", "soft", "predictions"]


def test_figures_without_results_run_nothing(runner, tmp_path):
    paths = produce.produce(["3", "13"], tmp_path / "results", tmp_path / "out", say=quiet)
    assert len(paths) == 4
    assert runner.asked == []
    assert not (tmp_path / "results").exists()


def test_an_unfinished_study_is_run_again(runner, tmp_path):
    runner("soft", tmp_path / "results", True, "jax", say=lambda line: None, only=1)
    assert not produce.is_current("soft", tmp_path / "results", True, "jax")
    produce.produce(["12"], tmp_path / "results", tmp_path / "out", True, "jax", say=quiet)
    assert runner.asked == ["soft", "soft"]
    assert produce.is_current("soft", tmp_path / "results", True, "jax")
    assert not produce.is_current("soft", tmp_path / "results", False, "jax")


def test_a_study_of_other_code_or_another_definition_is_run_again(runner, tmp_path, monkeypatch):
    runner("soft", tmp_path, True, "jax", say=lambda line: None)
    assert produce.is_current("soft", tmp_path, True, "jax")
    with monkeypatch.context() as patch:
        patch.setattr(comparison, "source_hash", lambda package: "changed")
        assert not produce.is_current("soft", tmp_path, True, "jax")
    other = catalogue.comparison_of("soft", True, "jax")
    longer = catalogue.comparison_of("soft", False, "jax").definition.reference
    changed = dataclasses.replace(
        other, definition=msgspec.structs.replace(other.definition, reference=longer)
    )
    monkeypatch.setattr(catalogue, "comparison_of", lambda name, quick, plant: changed)
    assert not produce.is_current("soft", tmp_path, True, "jax")


@pytest.mark.parametrize("ids", [["12", "9"], [], ["all", "12"]])
def test_unknown_ids_are_refused_before_anything_runs(ids, runner, tmp_path):
    with pytest.raises(InputError, match=r"figure: got .*10, 11, 12, .*39, summary, .*or all"):
        produce.produce(ids, tmp_path / "results", tmp_path / "out", say=quiet)
    assert runner.asked == []
    assert not list(tmp_path.iterdir())


def test_an_unknown_plant_is_refused_before_anything_runs(runner, tmp_path):
    with pytest.raises(InputError, match="plant: got 'steel'"):
        produce.produce(["12"], tmp_path / "results", tmp_path / "out", plant="steel", say=quiet)  # type: ignore[arg-type]
    assert runner.asked == []
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_figure_is_made_from_nothing_and_again_without_a_run(tmp_path):
    said = []
    ask = {"results": tmp_path / "results", "out": tmp_path / "out", "quick": True, "plant": "jax"}
    paths = produce.produce(["31", "32", "33"], **ask, say=said.append)
    assert len(paths) == 6
    assert any("samples in" in line for line in said)
    before = {path: path.read_bytes() for path in paths}
    said.clear()
    assert produce.produce(["31", "32", "33"], **ask, say=said.append) == paths
    assert [line.endswith("complete.") for line in said] == [True]
    assert {path: path.read_bytes() for path in paths} == before


# the page


class Reader(HTMLParser):
    """Tags with their attributes, and the text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.words = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "link", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    def of(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


@pytest.fixture(scope="module")
def page(drawn):
    path = produce.write_gallery(["all"], drawn[0], drawn[1], True, "jax")
    assert path == drawn[1] / "index.html"
    return path.read_text()


def test_the_page_needs_nothing_but_itself(page):
    read = Reader(page)
    assert read.open == []  # every tag is closed
    assert not read.of("script")
    assert not read.of("link")
    assert not read.of("iframe")
    for _, attrs in read.tags:
        for key in ("src", "href", "srcset", "data", "poster"):
            value = attrs.get(key) or ""
            assert value == "" or value.startswith(("#", "data:image/png;base64,"))
    assert "url(" not in page
    assert "@import" not in page
    assert "http" not in "".join(read.words)
    assert len(page.encode()) < 10_000_000


def test_the_page_names_every_figure_with_its_study_function_and_command(page):
    read = Reader(page)
    text = " ".join("".join(read.words).split())
    anchors = {attrs["id"] for _, attrs in read.tags if "id" in attrs}
    targets = [attrs["href"][1:] for attrs in read.of("a")]
    assert set(targets) <= anchors
    for entry in registry.FIGURES.values():
        assert text.count(heading(entry)) == 2  # contents and section
        assert f"figure-{entry.id}" in targets
        assert entry.source in text
        assert f"jaxmpc figures {entry.id}" + (" --quick --plant jax" if entry.study else "") in text, (
            entry.id
        )
        assert entry.study is None or f"{entry.study}-quick-jax" in text
    assert [attrs["alt"] for attrs in read.of("img")] == [e.alt for e in registry.FIGURES.values()]
    assert "prefers-color-scheme: dark" in page
    assert read.of("html")[0]["lang"] == "en"


def test_a_page_without_its_pictures_is_refused(drawn, tmp_path):
    with pytest.raises(InputError, match="the picture of figure 12"):
        produce.write_gallery(["12"], drawn[0], tmp_path, True, "jax")
    assert not list(tmp_path.iterdir())


def test_a_page_of_some_figures_has_only_those(drawn, tmp_path):
    for name in ("figure_3_relaxation", "figure_33_pressure"):
        (tmp_path / f"{name}.png").write_bytes((drawn[1] / f"{name}.png").read_bytes())
    path = produce.write_gallery(["33", "3"], drawn[0], tmp_path, True, "jax")
    assert len(Reader(path.read_text()).of("img")) == 2
