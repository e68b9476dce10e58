"""Figures of sweep studies: recognised by their columns, drawn from stored numbers only, honest about what is missing."""

import warnings

import matplotlib.pyplot as plt
import numpy as np
import pytest

from figures import closed_loop, style
from figures.sweep import draw as sweep
from figures.sweep import fan, maps, regret, wear
from figures.sweep.data import default_tuning, load, sweep_axes, variants
from jaxmpc.errors import InputError
from studies.store.reading import open_study
from tests import studies_synthetic as made
from tests.sweep_synthetic import (
    ACTUATOR,
    BLOCKS,
    CHOKE,
    CONTROLLER,
    DEADZONE,
    HORIZON,
    LIFT,
    LIMIT,
    MODE,
    OIL_DEADZONE,
    PRESSURE,
    REFERENCE,
    SEED,
    THESIS_BLOCKS,
    WEIGHT,
    grid,
    numbers,
    runs,
    write,
)


@pytest.fixture(scope="module")
def deadzone(tmp_path_factory):
    """Deadzone pair x choke weight, 4 x 3, the tuning of the thesis among them."""
    values = grid([(0, 0), (500, 2.5), (1000, 5), (2000, 10)], [62.5, 250, 1000])
    path = tmp_path_factory.mktemp("deadzone") / "made-up.zarr"
    return write(path, (DEADZONE, OIL_DEADZONE, WEIGHT), values, numbers(12), definition={"base": {}})


def monte_carlo(path, skip=(), draws=12):
    """Two controllers on the same made-up wells."""
    values = grid(["continuous", "mixed-integer"], [(1 + 0.001 * k**1.5, float(k)) for k in range(draws)])
    count = 2 * draws
    return write(path, (CONTROLLER, PRESSURE, SEED), values, numbers(count), runs(count), skip=skip)


def drawn_files(store, folder):
    """Names of what `draw_sweep` writes, without warnings and without open figures."""
    before = plt.get_fignums()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = sweep.draw_sweep(store, folder)
    assert plt.get_fignums() == before
    assert all(path.stat().st_size > 1000 for path in paths)
    assert {path.suffix for path in paths} == {".png", ".pdf"}
    assert sorted(path.name for path in folder.iterdir()) == sorted(path.name for path in paths)
    return {path.stem for path in paths}


def caption(figure):
    """All that is written on a figure outside its panels, in one line."""
    return " ".join(text.get_text() for text in figure.texts).replace("\n", " ")


def ring_points(axes):
    """Where the rings of the default preset are."""
    rings = [line for line in axes.lines if line.get_markersize() > 10 and line.get_marker() == "o"]
    return {(float(x), float(y)) for line in rings for x, y in zip(*line.get_data(), strict=True)}


# ------------------------------------------------------------------------------------------------ which figures


def test_two_numeric_axes_give_a_front_and_maps(deadzone, tmp_path):
    assert drawn_files(deadzone, tmp_path / "figures") == {"pareto", "maps"}


def test_models_and_regions_give_a_matrix_for_every_controller(tmp_path):
    controllers = [("continuous", "step"), ("mixed-integer", "step")]
    values = grid(controllers, ["wide-open", "nearly-closed"], [8, 20, 50], [5000, 9500])
    keys = (CONTROLLER, ACTUATOR, REFERENCE, CHOKE, LIFT)
    store = write(tmp_path / "made-up.zarr", keys, values, numbers(24))
    assert drawn_files(store, tmp_path / "figures") == {"pareto", "mismatch"}


def test_many_wells_give_fans_and_distributions(tmp_path):
    store = monte_carlo(tmp_path / "made-up.zarr")
    assert drawn_files(store, tmp_path / "figures") == {"pareto", "fan", "distributions"}


def test_blocking_gives_its_regret(tmp_path):
    values = grid(["moves", "inputs"], [(THESIS_BLOCKS, 250), ("1 3 12", 120)], [62.5, 250], [1, 2, 3])
    store = write(tmp_path / "made-up.zarr", (MODE, BLOCKS, HORIZON, WEIGHT, SEED), values, numbers(24))
    assert drawn_files(store, tmp_path / "figures") == {"pareto", "blocking"}


def test_a_study_of_one_axis_gives_the_front_alone(tmp_path):
    store = write(tmp_path / "made-up.zarr", (WEIGHT,), [[62.5, 250, 1000]], numbers(3))
    assert drawn_files(store, tmp_path / "figures") == {"pareto"}


@pytest.mark.parametrize(
    ("keys", "values"),
    [
        ((WEIGHT,), [[250.0]]),  # one scenario
        ((CONTROLLER,), [["continuous", "mixed-integer"]]),
        ((LIMIT, WEIGHT), grid([0.5, float("inf")], [62.5, 250])),
        ((REFERENCE, CONTROLLER), grid(["quick", "thesis"], ["continuous", "mixed-integer"])),
    ],
)
def test_few_scenarios_texts_and_limits_that_do_not_bind_are_drawn(tmp_path, keys, values):
    store = write(tmp_path / "made-up.zarr", keys, values, numbers(len(values[0])))
    assert drawn_files(store, tmp_path / "figures") == {"pareto"}


def test_drawing_again_gives_the_same_bytes(deadzone, tmp_path):
    for folder in ("one", "two"):
        drawn_files(deadzone, tmp_path / folder)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_a_store_without_a_finished_scenario_is_refused_and_nothing_is_written(tmp_path):
    store = write(tmp_path / "made-up.zarr", (WEIGHT,), [[62.5, 250, 1000]], numbers(3), skip=(0,))
    with pytest.raises(InputError, match=r"store: got .* expected a finished scenario"):
        sweep.draw_sweep(store, tmp_path / "figures")
    assert not (tmp_path / "figures").exists()
    with pytest.raises(InputError):
        sweep.draw_sweep(tmp_path / "nothing.zarr", tmp_path / "figures")


def test_missing_scenarios_are_counted_in_every_figure_and_not_drawn(tmp_path):
    figures = numbers(24)
    figures["complete"][0] = 0  # computed, but stopped early
    values = grid(["continuous", "mixed-integer"], [(1 + 0.001 * k**1.5, float(k)) for k in range(12)])
    keys = (CONTROLLER, PRESSURE, SEED)
    store = write(tmp_path / "a.zarr", keys, values, figures, runs(24), skip=(7,), chunk_size=3)
    data = load(store)
    assert data.scenario.values.tolist() == list(range(1, 21))
    pages = sweep.pages(data)
    assert set(pages) == {"pareto", "fan", "distributions"}
    for page in pages.values():
        drawn = page()
        assert "4 of 24 scenarios are missing" in caption(drawn)
    whole = load(monte_carlo(tmp_path / "b.zarr"))
    drawn = sweep.pages(whole)["pareto"]()
    assert "missing" not in caption(drawn)


# ------------------------------------------------------------------------------------------------ the front


def beaten(x, y, i):
    """The definition, point by point."""
    better = (x <= x[i]) & (y <= y[i]) & ((x < x[i]) | (y < y[i]))
    return bool(better.any())


@pytest.mark.parametrize("seed", range(20))
def test_the_front_is_what_no_other_point_beats(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 40))
    x, y = rng.integers(0, 8, (2, count)).astype(float)  # many ties
    x[rng.random(count) < 0.1] = np.nan
    y[rng.random(count) < 0.1] = np.nan
    known = np.isfinite(x) & np.isfinite(y)
    expected = [bool(known[i]) and not beaten(x[known], y[known], _place(known, i)) for i in range(count)]
    np.testing.assert_array_equal(wear.front(x, y), expected)


def _place(known, i):
    return int(known[:i].sum())


def test_equal_points_share_the_front_and_a_tie_in_one_is_beaten():
    assert wear.front([1, 1, 1, 2, np.nan], [2, 2, 3, 2, 0]).tolist() == [True, True, False, False, False]
    assert wear.front([], []).tolist() == []


def test_the_points_and_the_front_are_the_stored_numbers(deadzone):
    data = open_study(deadzone)
    axes = wear.pareto(data)
    x = data.travel.sel(mv="choke").values
    y = (data.mean_absolute_deviation.values / (1000.0, 5.0)).mean(1)
    drawn = np.concatenate([np.asarray(points.get_offsets()) for points in axes.collections])
    assert {tuple(p) for p in np.round(drawn, 9)} == {tuple(p) for p in np.round(np.stack([x, y], 1), 9)}
    line = next(line for line in axes.lines if line.get_label() == "front")
    best = [i for i in range(12) if not beaten(x, y, i)]
    expected = sorted((x[i], y[i]) for i in best)
    np.testing.assert_allclose(np.stack(line.get_data(), 1), expected)
    assert "[%]" in axes.get_xlabel()
    assert "[1]" in axes.get_ylabel()
    assert [ax.get_ylabel() for ax in axes.figure.axes][1] == "deadzone of the gas rate [m³/h]"
    assert plt.get_fignums() == []


def test_one_cv_and_another_colour_can_be_chosen(deadzone):
    data = open_study(deadzone)
    axes = wear.pareto(data, color="tuning.move_weight.choke", cv="oil_rate")
    drawn = np.concatenate([np.asarray(points.get_offsets())[:, 1] for points in axes.collections])
    np.testing.assert_allclose(np.sort(drawn), np.sort(data.mean_absolute_deviation.sel(cv="oil_rate")))
    assert "[m³/h]" in axes.get_ylabel()
    colours = np.concatenate([points.get_array() for points in axes.collections])
    assert set(colours) == {62.5, 250, 1000}
    for wrong in ({"color": "nothing"}, {"cv": "water"}, {"x": "nothing"}):
        with pytest.raises(InputError, match=next(iter(wrong.values()))):
            wear.pareto(data, **wrong)


# ------------------------------------------------------------------------------------------------ the thesis


def test_the_thesis_tuning_is_marked_where_it_is(deadzone):
    data = load(deadzone)
    here = np.flatnonzero(default_tuning(data)).tolist()
    assert here == [7]
    assert data["tuning.deadzone.gas_rate"].values[7] == 1000
    assert data["tuning.move_weight.choke"].values[7] == 250
    y = (data.mean_absolute_deviation.values[7] / (1000.0, 5.0)).mean()
    assert ring_points(wear.pareto(data)) == {(float(data.travel.values[7, 0]), y)}
    drawn = sweep.pages(data)["maps"]()
    assert "Framed: thesis tuning" in caption(drawn)
    frame = drawn.axes[0].patches[-1]
    assert frame.get_y() < 250 < frame.get_y() + frame.get_height()


@pytest.mark.parametrize(
    ("oil", "weights", "definition"),
    [
        (4.0, [62.5, 250], {"base": {}}),  # another oil deadzone
        (5.0, [62.5, 1000], {"base": {}}),  # another weight
        (5.0, [62.5, 250], {"base": {"soft": False}}),
        (5.0, [62.5, 250], {"base": {"preset": "no-soft"}}),
    ],
)
def test_another_tuning_is_not_marked(tmp_path, oil, weights, definition):
    values = grid([(500, oil / 2), (1000, oil)], weights)
    keys = (DEADZONE, OIL_DEADZONE, WEIGHT)
    data = load(write(tmp_path / "a.zarr", keys, values, numbers(4), definition=definition))
    assert not default_tuning(data).any()
    assert ring_points(wear.pareto(data)) == set()
    drawn = sweep.pages(data)["maps"]()
    assert "Framed" not in caption(drawn)
    assert not drawn.axes[0].patches


def test_a_study_of_the_weight_alone_is_marked_only_if_its_base_has_the_thesis_deadzone(tmp_path):
    for name, definition, marked in (
        ("default", {"base": {}}, True),
        ("changed", {"base": {"tuning": {"deadzone": {"gas_rate": 500}}}}, False),
        ("unknown", None, False),
    ):
        path = tmp_path / f"{name}.zarr"
        data = load(write(path, (WEIGHT,), [[62.5, 250]], numbers(2), definition=definition))
        assert default_tuning(data).tolist() == [False, marked], name


def test_wells_that_differ_have_no_thesis_mark(tmp_path):
    assert not default_tuning(load(monte_carlo(tmp_path / "a.zarr"))).any()


# ------------------------------------------------------------------------------------------------ maps


def test_maps_show_the_stored_numbers_on_log_axes_where_values_are_log_spaced(deadzone):
    data = load(deadzone)
    drawn = sweep.pages(data)["maps"]()
    panels = [ax for ax in drawn.axes if ax.collections and ax.get_title(loc="left")]
    assert len(panels) == 4
    travel = np.asarray(panels[0].collections[0].get_array())
    np.testing.assert_array_equal(travel, data.travel.values[:, 0].reshape(4, 3).T)
    oil = np.asarray(panels[3].collections[0].get_array())
    np.testing.assert_array_equal(oil, data.mean_absolute_deviation.values[:, 1].reshape(4, 3).T)
    assert panels[0].get_yscale() == "log"
    assert panels[0].get_xscale() == "linear"
    assert all("[" in ax.get_title(loc="left") for ax in panels)
    assert "[m³/h]" in panels[3].get_xlabel()
    assert "[1/%²]" in panels[0].get_ylabel()


def test_cells_are_medians_over_further_axes_and_the_caption_says_so(tmp_path):
    values = grid([500, 1000], [62.5, 250], [1, 2, 3])
    figures = numbers(12)
    data = load(write(tmp_path / "a.zarr", (DEADZONE, WEIGHT, SEED), values, figures))
    drawn = sweep.pages(data)["maps"]()
    table = np.asarray(drawn.axes[0].collections[0].get_array())
    np.testing.assert_allclose(table, np.median(figures["travel"][:, 0].reshape(2, 2, 3), axis=2).T)
    assert "Median over seed of the noise" in caption(drawn)


def test_a_cell_without_a_scenario_stays_empty():
    places = [(np.array([0.0, 0.0, 1.0]), [0.0, 1.0]), (np.array([0.0, 0.0, 1.0]), [0.0, 1.0])]
    table = maps.cells(np.array([1.0, 3.0, np.nan]), places)
    np.testing.assert_array_equal(table, [[2.0, np.nan], [np.nan, np.nan]])


def test_cells_meet_half_way_on_their_scale():
    np.testing.assert_allclose(maps.edges(np.array([1.0, 4.0, 16.0]), "log"), [0.5, 2, 8, 32])
    np.testing.assert_allclose(maps.edges(np.array([0.0, 1.0, 3.0]), "linear"), [-0.5, 0.5, 2, 4])


def test_the_matrix_of_models_has_every_region_and_controller(tmp_path):
    controllers = [("continuous", "continuous"), ("mixed-integer", "step")]
    values = grid(controllers, ["wide-open", "nearly-closed"], [8, 20, 50], [5000, 9500])
    figures = numbers(24)
    keys = (CONTROLLER, ACTUATOR, REFERENCE, CHOKE, LIFT)
    data = load(write(tmp_path / "a.zarr", keys, values, figures))
    drawn = sweep.pages(data)["mismatch"]()
    panels = [ax for ax in drawn.axes if ax.get_title(loc="left").strip()]
    assert [ax.get_title(loc="left") for ax in panels] == [
        "continuous MPC, continuous actuators",
        "mixed-integer MPC, stepped actuators",
    ]
    scaled = (figures["mean_absolute_deviation"] / (1000.0, 5.0)).mean(1).reshape(2, 2, 3, 2)
    for ax, expected in zip(panels, scaled, strict=True):
        table = np.asarray(ax.collections[0].get_array())  # rows: region, in it the lift
        np.testing.assert_allclose(table, expected.transpose(0, 2, 1).reshape(4, 3))
        assert {text.get_text() for text in ax.texts} >= {"wide-open", "nearly-closed"}


# ------------------------------------------------------------------------------------------------ blocking


def blocking_store(
    path, blocks=((THESIS_BLOCKS, 250), ("1 3 12", 120)), cost=None, modes=("moves", "inputs")
):
    values = grid(list(modes), list(blocks), [62.5, 250], [1, 2, 3])
    count = len(values[0])
    figures = numbers(count)
    if cost is not None:
        figures["closed_loop_cost"] = np.array(cost(*values), dtype=float)
    keys = (MODE, BLOCKS, HORIZON, WEIGHT, SEED)
    return load(write(path, keys, values, figures, definition={"base": {}}))


def doubled(mode, blocks, horizon, weight, seed):
    """Cost of each run: the weight plus the seed, and 10 % more with few blocks."""
    return [
        (w + s) * (1.0 if b == THESIS_BLOCKS else 1.1) for b, w, s in zip(blocks, weight, seed, strict=True)
    ]


def test_regret_is_against_the_thesis_blocking_at_the_same_weight_and_seed(tmp_path):
    data = blocking_store(tmp_path / "a.zarr", cost=doubled)
    found = regret.blockings(data)
    assert [(b.mode, b.blocks, b.horizon, b.unknowns, b.default) for b in found] == [
        ("moves", 16, 250, 32, True),
        ("moves", 3, 120, 6, False),
        ("inputs", 16, 250, 32, False),
        ("inputs", 3, 120, 6, False),
    ]
    lost, reference = regret.regret(data, found)
    np.testing.assert_allclose(lost, np.where(data.blocks.values == THESIS_BLOCKS, 0.0, 10.0), atol=1e-9)
    assert reference == "the default blocking"


def test_blocks_of_each_mv_count_their_own_moves(tmp_path):
    data = blocking_store(tmp_path / "a.zarr", blocks=(("1 1 2; 4", 120), ("1 3", 120)), modes=("moves",))
    assert [(b.blocks, b.unknowns) for b in regret.blockings(data)] == [(3, 4), (2, 4)]


def test_regret_is_against_the_best_where_the_thesis_blocking_is_not_in_the_study(tmp_path):
    data = blocking_store(
        tmp_path / "a.zarr",
        blocks=(("1 1 2", 120), ("1 3 12", 120)),
        cost=lambda mode, blocks, *_: [100.0 if b == "1 1 2" else 120.0 for b in blocks],
    )
    lost, reference = regret.regret(data, regret.blockings(data))
    np.testing.assert_allclose(lost, np.where(data.blocks.values == "1 1 2", 0.0, 20.0), atol=1e-9)
    assert reference == "the best blocking"


def test_points_of_blocking_are_medians_with_quartiles_and_the_mode_is_the_marker(tmp_path):
    data = blocking_store(tmp_path / "a.zarr", cost=doubled)
    drawn = sweep.pages(data)["blocking"]()
    first, second, third = drawn.axes
    shown = {}
    for bars in first.containers:
        line = bars.lines[0]
        shown[(float(line.get_xdata()[0]), float(line.get_ydata()[0]))] = line.get_marker()
    times = 1e3 * data.solve_time_median.values.reshape(4, 6)
    for k, row in enumerate(times):
        near = min(shown, key=lambda point, at=row: abs(point[0] - np.median(at)))
        np.testing.assert_allclose(near, (np.median(row), (0.0, 10.0, 0.0, 10.0)[k]), atol=1e-9)
        assert shown[near] == ("o" if k < 2 else "s")
    assert sorted(float(bars.lines[0].get_xdata()[0]) for bars in third.containers) == [6, 6, 32, 32]
    assert all("[" in ax.get_xlabel() for ax in (first, second, third))
    assert "[%]" in first.get_ylabel()
    np.testing.assert_allclose(regret.quartiles(np.array([1.0, 2, 3, 4, 5, np.nan])), [2, 3, 4])


def test_labels_of_blocking_do_not_overlap(tmp_path):
    lengths = [" ".join(["1"] * n) for n in (3, 4, 5, 6, 7, 8)]
    data = blocking_store(tmp_path / "a.zarr", blocks=[(b, 120) for b in lengths])
    drawn = sweep.pages(data)["blocking"]()
    renderer = drawn.canvas.get_renderer()
    for ax in drawn.axes:
        boxes = [text.get_window_extent(renderer) for text in ax.texts]
        assert len(boxes) == 12
        for i, one in enumerate(boxes):
            assert not any(one.shrunk(0.95, 0.8).overlaps(other.shrunk(0.95, 0.8)) for other in boxes[:i])


# ------------------------------------------------------------------------------------------------ Monte Carlo


def test_fans_are_quantiles_of_the_stored_runs_in_the_colour_of_the_controller(tmp_path):
    data = load(monte_carlo(tmp_path / "a.zarr"))
    drawn = sweep.pages(data)["fan"]()
    grid_ = np.array(drawn.axes).reshape(3, 2)
    for j, colour in enumerate((style.VERMILLION, style.GREEN)):
        rows = slice(12 * j, 12 * j + 12)
        gas = data.measurement.values[rows, :, 0]
        lines = {line.get_label(): line for line in grid_[0, j].lines}
        np.testing.assert_allclose(lines["median"].get_ydata(), np.median(gas, axis=0))
        assert lines["median"].get_color() == colour
        np.testing.assert_allclose(lines["setpoint"].get_ydata(), data.setpoint.values[0, :, 0])
        assert lines["setpoint"].get_linestyle() == "--"
        wide = grid_[0, j].collections[0].get_paths()[0].vertices[:, 1]
        low, high = np.percentile(gas, [5, 95], axis=0)
        np.testing.assert_allclose([wide.min(), wide.max()], [low.min(), high.max()])
        choke = next(line for line in grid_[2, j].lines if line.get_label() == "median")
        np.testing.assert_allclose(choke.get_ydata(), np.median(data.position.values[rows, :, 0], axis=0))
    assert all("[" in ax.get_ylabel() for ax in grid_[:, 0])
    assert all("[min]" in ax.get_xlabel() for ax in grid_[-1])


def test_times_that_some_runs_do_not_reach_are_drawn_from_the_others():
    values = np.array([[1.0, 2.0, np.nan], [3.0, np.nan, np.nan]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        median = fan.bands(values)[2]
    np.testing.assert_array_equal(median, [2.0, 2.0, np.nan])


def test_distributions_are_sorted_and_name_the_worst_run_with_its_command(tmp_path):
    store = monte_carlo(tmp_path / "a.zarr")
    data = load(store)
    drawn = sweep.pages(data)["distributions"]()
    first = drawn.axes[0]
    for j, colour in enumerate((style.VERMILLION, style.GREEN)):
        travel = data.travel.values[12 * j : 12 * j + 12, 0]
        line = next(ln for ln in first.lines if ln.get_color() == colour and len(ln.get_xdata()) > 1)
        np.testing.assert_array_equal(line.get_xdata()[1:], np.sort(travel))
        np.testing.assert_allclose(line.get_ydata()[[0, -1]], [0, 100])
        worst = 12 * j + int(np.argmax(travel))
        assert f"worst: #{worst}" in [text.get_text() for text in first.texts]
    assert f"jaxmpc simulate '{fan.shown_store(data)}#" in caption(drawn)
    assert fan.shown_store(data).endswith("a.zarr")
    assert all("[" in ax.get_xlabel() for ax in drawn.axes)


def test_a_run_without_finite_numbers_is_the_worst_and_lowers_the_share():
    assert fan.worst(np.array([1.0, np.nan, 3.0]), np.array([10, 11, 12])) == 11
    assert fan.worst(np.array([1.0, 4.0, 3.0]), np.array([10, 11, 12])) == 11
    values, share = fan.shares(np.array([3.0, np.nan, 1.0, 2.0]))
    np.testing.assert_array_equal(values, [1, 2, 3])
    np.testing.assert_allclose(share, [25, 50, 75])


def test_tunings_that_share_a_controller_have_colours_and_names_of_their_own(tmp_path):
    values = grid(
        [("mixed-integer", 125), ("mixed-integer", 250)], [(1 + 0.001 * k, float(k)) for k in range(9)]
    )
    data = load(write(tmp_path / "a.zarr", (CONTROLLER, WEIGHT, PRESSURE, SEED), values, numbers(18)))
    found = variants(data, sweep_axes(data))
    assert len({variant.colour for variant in found}) == 2
    assert [variant.label for variant in found] == [
        "move weight of the choke 125 1/%²",
        "move weight of the choke 250 1/%²",
    ]
    assert fan.monte_carlo(data, sweep_axes(data))
    assert "fan" not in sweep.pages(data)


def test_columns_that_move_together_are_one_axis(deadzone, tmp_path):
    found = sweep_axes(load(deadzone))
    assert [(axis.key, axis.linked) for axis in found] == [
        ("tuning.deadzone.gas_rate", ("tuning.deadzone.oil_rate",)),
        ("tuning.move_weight.choke", ()),
    ]
    assert [axis.scale for axis in found] == ["linear", "log"]


# ------------------------------------------------------------------------------------------------ one run again


def test_one_run_is_drawn_with_its_deadzone_choke_and_lift(tmp_path):
    run = made.trajectory("hunting")
    paths = closed_loop.draw_run(run, (1000.0, 5.0), tmp_path, "Scenario 3", kind="continuous")
    assert {path.name for path in paths} == {"run.png", "run.pdf"}
    drawn = closed_loop.run(closed_loop.of_trajectory(run, (1000.0, 0.0), "continuous", "step"), "Scenario 3")
    gas, oil, choke, lift = drawn.axes
    assert gas.collections
    assert not oil.collections
    lines = {line.get_label(): line for line in gas.lines}
    np.testing.assert_array_equal(lines["measured"].get_ydata(), run.cv[:, 0])
    assert lines["measured"].get_color() == style.VERMILLION
    np.testing.assert_array_equal(choke.lines[1].get_ydata()[:-1], run.mv[:, 0])
    np.testing.assert_array_equal(lift.lines[0].get_ydata()[:-1], run.mv[:, 1])
    assert all("[" in ax.get_ylabel() for ax in drawn.axes)
    assert "[" in lift.get_xlabel()
    assert drawn.get_suptitle() == "Scenario 3"
