"""The real-time optimisation (thesis 6.7) against one linear programme per triangle, and on hand-made maps."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

import figures.thesis.rto
from identify.steady_map import steady_map
from identify.sweep import steady_sweep
from jaxmpc.errors import InputError
from jaxmpc.process.well.plant import WellPlant
from jaxmpc.steady.map import SteadyMap
from jaxmpc.steady.optimise import optimise
from studies.store.reading import open_results
from studies.thesis.rto import PRICES, demands, run_rto, targets_of

RANGES = ((0.0, 0.0), (2000.0, 10_000.0))
BAND = {"gas_lift": RANGES}
ANYWHERE = {"gas_lift": [(0.0, 10_000.0)]}
UNITS = {"cv_units": ("m3/h", "m3/h"), "mv_units": ("%", "m3/h")}


def steps_of(choke):
    """Steps of the choke, None for any position."""
    return {} if choke is None else {"choke": choke}


def random_map(rng, chokes=5, lifts=6, holes=0):
    """A well-like random map with 0 and 2000 m3/h inside cells, not on grid lines, now and then."""
    choke = np.sort(rng.choice(np.arange(1.0, 100.0, 3.0), chokes, replace=False))
    lift = np.r_[0.0, np.sort(rng.choice(np.arange(600.0, 10_000.0, 450.0), lifts - 1, replace=False))]
    gas = 60 * choke[None] + 0.9 * lift[:, None] + rng.normal(0, 300, (lifts, chokes))
    oil = 40 * np.log(choke)[None] + 0.01 * lift[:, None] + rng.normal(0, 15, (lifts, chokes))
    cv = np.stack([gas, oil])
    for _ in range(holes):
        cv[:, rng.integers(lifts), rng.integers(chokes)] = np.nan
    return SteadyMap(dict(choke=choke, gas_lift=lift), cv, ("gas", "oil"), **UNITS)


def pieces(steady, lift_ranges, choke, step):
    """Every triangle with every choke position (None for a range) and every lift range: the convex parts."""
    positions = [None]
    if step is not None:
        positions = [step * n for n in range(101) if choke[0] <= step * n <= choke[1]]
    for corners, position, (least, most) in itertools.product(steady.triangles, positions, lift_ranges):
        low, high = steady.points[corners].min(axis=0), steady.points[corners].max(axis=0)
        reached = position is None or low[0] <= position <= high[0]
        if reached and low[1] <= most and high[1] >= least:
            yield corners, position, (least, most)


def brute_force(
    steady, price, low, high, *, ranges=RANGES, choke=(0.0, 100.0), step=None, target=None, weight=None
):
    """Best value by one linear programme per convex part: -profit, or the weighted distance to a target; inf if none."""
    best = np.inf
    for corners, position, (least, most) in pieces(steady, ranges, choke, step):
        u, y = steady.points[corners], steady.values[corners]
        cost = -(y @ price[:2] - price[2] * u[:, 1])
        rows = [-u[:, 1], u[:, 1], *(-y.T), *y.T]
        sides = [-least, most, *(-low), *high]
        equal, right = [np.ones(3)], [1.0]
        if position is None:
            rows += [-u[:, 0], u[:, 0]]
            sides += [-choke[0], choke[1]]
        else:
            equal, right = [*equal, u[:, 0]], [1.0, position]
        rows, sides, equal = np.array(rows), np.array(sides), np.array(equal)
        if target is not None:  # |y - target| in two further variables
            wide = lambda a: np.hstack([a, np.zeros((len(a), 2))])  # noqa: E731
            outside = np.vstack([np.hstack([y.T, -np.eye(2)]), np.hstack([-y.T, -np.eye(2)])])
            rows, sides, equal = np.vstack([wide(rows), outside]), np.r_[sides, target, -target], wide(equal)
            cost = np.r_[np.zeros(3), weight]
        keep = np.isfinite(sides)
        solved = linprog(cost, rows[keep], sides[keep], equal, right, bounds=(0, None))
        if solved.status == 0:
            best = min(best, solved.fun)
    return best


@pytest.mark.parametrize("seed", range(8))
def test_the_profit_is_the_best_over_all_triangles(seed):
    rng = np.random.default_rng(seed)
    steady = random_map(rng, holes=seed % 4)
    price = rng.uniform([0.0, 0.0, 0.0], [1.0, 60.0, 1.5])
    low = np.array([rng.uniform(0, 4000), -np.inf])
    high = np.array([np.inf, rng.uniform(100, 250)])
    step = (None, 2.0)[seed % 2]
    known = -brute_force(steady, price, low, high, step=step)
    found = optimise(
        steady,
        dict(gas=price[0], oil=price[1], gas_lift=price[2]),
        dict(gas=low[0]),
        dict(oil=high[1]),
        mv_ranges=BAND,
        mv_steps=steps_of(step),
    )
    assert np.isfinite(known)
    assert found.feasible
    assert found.profit == pytest.approx(known, rel=1e-7, abs=1e-6)
    assert found.bound == pytest.approx(found.profit, rel=1e-6, abs=1e-6)
    assert found.mv[1] == 0.0 or 2000.0 <= found.mv[1] <= 10_000.0
    assert step is None or found.mv[0] % step == 0.0
    assert found.cv == pytest.approx(steady.interpolate(*found.mv), rel=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_a_demand_is_met_as_closely_as_over_all_triangles(seed):
    rng = np.random.default_rng(100 + seed)
    steady = random_map(rng, holes=seed % 3)
    demand = rng.uniform([0.0, 20.0], [12_000.0, 300.0])
    weight = rng.uniform([1e-4, 1e-3], [1e-3, 1e-1])
    step = (None, 2.0)[seed % 2]
    none = np.full(2, -np.inf), np.full(2, np.inf)
    known = brute_force(steady, np.zeros(3), *none, step=step, target=demand, weight=weight)
    found = optimise(
        steady,
        target=dict(gas=demand[0], oil=demand[1]),
        weights=dict(gas=weight[0], oil=weight[1]),
        mv_ranges=BAND,
        mv_steps=steps_of(step),
    )
    assert found.distance == pytest.approx(known, rel=1e-6, abs=1e-6)
    assert found.deviation == pytest.approx(found.cv - demand, abs=1e-2)
    assert found.bound <= found.distance + 1e-6
    assert found.feasible == (known < 1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_what_is_left_of_a_map_with_many_holes_is_all_that_is_used(seed):
    rng = np.random.default_rng(200 + seed)
    steady = random_map(rng, chokes=6, lifts=6, holes=7)
    price, none = rng.normal(0, [1.0, 60.0, 1.5]), (np.full(2, -np.inf), np.full(2, np.inf))
    known = -brute_force(steady, price, *none, ranges=ANYWHERE["gas_lift"])
    found = optimise(steady, dict(gas=price[0], oil=price[1], gas_lift=price[2]), mv_ranges=ANYWHERE)
    assert found.profit == pytest.approx(known, rel=1e-7)
    demand = rng.uniform([0.0, 20.0], [12_000.0, 300.0])
    weight = np.array([1e-3, 1e-2])
    known = brute_force(steady, np.zeros(3), *none, ranges=ANYWHERE["gas_lift"], target=demand, weight=weight)
    near = optimise(
        steady,
        target=dict(gas=demand[0], oil=demand[1]),
        weights=dict(gas=weight[0], oil=weight[1]),
        mv_ranges=ANYWHERE,
    )
    assert near.distance == pytest.approx(known, rel=1e-6, abs=1e-6)


def test_a_steady_state_without_a_triangle_is_not_used():
    steady = plane()
    cv = steady.cv.copy()
    cv[:, 0, 1] = cv[:, 1, 0] = np.nan  # cuts off the corner without lift and choke
    holed = SteadyMap(steady.grid, cv, steady.cv_names)
    assert holed.loose_edges.tolist() == [[0, 4]]
    found = optimise(holed, dict(gas=-1.0), mv_ranges=ANYWHERE)
    assert found.mv == pytest.approx([100.0, 0.0])
    assert found.profit == pytest.approx(-1000.0)


def plane():
    """Gas = lift + 10 choke, oil = choke, over two cells in each direction."""
    choke, lift = np.array([0.0, 50.0, 100.0]), np.array([0.0, 5000.0, 10_000.0])
    gas = lift[:, None] + 10 * choke[None]
    return SteadyMap(dict(choke=choke, gas_lift=lift), [gas, np.tile(choke, (3, 1))], ("gas", "oil"), **UNITS)


def test_lift_in_the_forbidden_band_is_never_asked_for_even_at_a_tiny_loss():
    steady = plane()
    free = optimise(steady, target=dict(gas=1900.0, oil=30.0), mv_ranges=ANYWHERE)
    assert free.feasible
    assert free.mv == pytest.approx([30.0, 1600.0])
    found = optimise(steady, target=dict(gas=1999.0, oil=0.0), mv_ranges=BAND)
    assert not found.feasible
    assert found.mv[1] == 2000.0
    assert found.mv[0] == pytest.approx(0.0, abs=1e-6)
    low = optimise(steady, target=dict(gas=100.0, oil=0.0), mv_ranges=BAND)
    assert low.mv[1] == 0.0


def test_a_demand_that_can_be_reached_is_reached_and_the_cheaper_of_two_ways_is_taken():
    steady = plane()
    exact = optimise(steady, target=dict(gas=5500.0, oil=50.0), mv_ranges=BAND)
    assert exact.feasible
    assert exact.status == "optimal"
    assert exact.message == "Within all limits."
    assert exact.mv == pytest.approx([50.0, 5000.0])
    assert exact.distance == 0.0
    cheap = optimise(steady, dict(gas_lift=1.0), target=dict(gas=5000.0), mv_ranges=BAND)
    assert cheap.feasible
    assert cheap.mv == pytest.approx([100.0, 4000.0])
    assert np.isnan(cheap.deviation[1])


def test_limits_out_of_reach_give_the_closest_point_and_say_so():
    found = optimise(plane(), dict(oil=1.0), dict(oil=120.0), mv_ranges=BAND)
    assert not found.feasible
    assert found.status == "closest"
    assert found.violation == pytest.approx([0.0, 20.0])
    assert found.mv[0] == pytest.approx(100.0)
    assert found.message == "Out of reach: oil 100 m3/h is 20 m3/h outside its limits."
    both = optimise(
        plane(), None, dict(gas=3000), dict(gas=3500), target=dict(oil=140.0, gas=0.0), weights=dict(oil=1.0)
    )
    assert both.violation.tolist() == [0.0, 0.0]
    assert both.cv == pytest.approx([3000.0, 100.0])
    assert both.deviation == pytest.approx([3000.0, -40.0])


def test_the_weights_decide_which_limit_gives():
    limits = dict(cv_low=dict(gas=9000.0), cv_high=dict(gas=9000.0))
    gives = []
    for weight in (1e-6, 1.0):
        found = optimise(
            plane(),
            cv_low=dict(gas=limits["cv_low"]["gas"], oil=90.0),
            cv_high=limits["cv_high"],
            weights=dict(gas=1e-3, oil=weight),
            mv_ranges=dict(choke=[(0.0, 50.0)], gas_lift=[(0.0, 0.0), (8600.0, 8700.0)]),
        )
        gives.append(found.mv.tolist())
    assert gives[0][1] + 10 * gives[0][0] == pytest.approx(9000.0)
    assert gives[1][0] == pytest.approx(50.0)


def test_a_limit_that_can_just_be_met_counts_as_met():
    found = optimise(plane(), dict(gas=1.0), dict(oil=100.0), dict(oil=100.0), mv_ranges=BAND)
    assert found.feasible
    assert found.mv == pytest.approx([100.0, 10_000.0])


def test_without_prices_any_point_within_the_limits_is_as_good():
    found = optimise(plane(), {}, dict(gas=4000.0), dict(gas=4500.0), mv_ranges=BAND, mv_steps=steps_of(2.0))
    assert found.feasible
    assert found.profit == 0.0
    assert 4000.0 - 1e-6 <= found.cv[0] <= 4500.0 + 1e-6
    assert found.mv[0] % 2.0 == 0.0


def test_of_two_equally_profitable_points_one_is_returned_with_the_profit_of_both():
    found = optimise(plane(), dict(gas=1.0, gas_lift=1.0), mv_ranges=BAND | dict(choke=[(20.0, 40.0)]))
    assert found.profit == pytest.approx(400.0)
    assert found.mv[0] == pytest.approx(40.0)


def test_the_choke_stands_on_whole_steps_inside_its_range():
    inside = dict(mv_ranges=BAND | dict(choke=[(3.0, 61.0)]), mv_steps=steps_of(7.0))
    assert optimise(plane(), dict(oil=1.0), **inside).mv[0] == 56.0
    assert optimise(plane(), dict(oil=-1.0), **inside).mv[0] == 7.0


@pytest.mark.parametrize("seed", range(4))
def test_bands_steps_and_costs_of_both_mvs_hold_at_once(seed):
    rng = np.random.default_rng(300 + seed)
    steady = random_map(rng)
    first, second = ((10.0, 18.0), (44.0, 70.0)), ((700.0, 2500.0), (5000.0, 8100.0))
    price = dict(gas=1.0, oil=rng.uniform(-20.0, 20.0), choke=rng.uniform(-50.0, 90.0), gas_lift=1.0)
    chosen = [6.0 * n for n in range(20) if any(low <= 6.0 * n <= high for low, high in first)]
    lifts = [700.0 * n for n in range(1, 12) if any(low <= 700.0 * n <= high for low, high in second)]
    choke, lift = np.meshgrid(chosen, lifts)
    profit = np.tensordot([price["gas"], price["oil"]], steady.interpolate(choke, lift), 1)
    known = np.nanmax(profit - price["choke"] * choke - price["gas_lift"] * lift)
    found = optimise(
        steady, price, mv_ranges=dict(choke=first, gas_lift=second), mv_steps=dict(choke=6.0, gas_lift=700.0)
    )
    assert found.profit == pytest.approx(known, rel=1e-7)
    assert found.mv[0] in chosen
    assert found.mv[1] in lifts


def test_triangles_without_a_steady_state_are_left_out():
    steady = plane()
    cv = steady.cv.copy()
    cv[0, 2, 2] = np.nan  # highest lift and choke
    holed = SteadyMap(steady.grid, cv, steady.cv_names, **UNITS)
    assert len(steady.triangles) == 8
    assert len(holed.triangles) == 6
    found = optimise(holed, dict(gas=1.0))
    assert found.profit == pytest.approx(10_500.0)  # on the edge of what is left
    assert np.isnan(holed.interpolate(99.0, 9900.0)).all()
    assert holed.interpolate(51.0, 4900.0) == pytest.approx([5410.0, 51.0])


def test_interpolation_is_exact_at_the_grid_and_nan_outside():
    steady = random_map(np.random.default_rng(3))
    choke, lift = np.meshgrid(*steady.grid.values())
    assert steady.interpolate(choke, lift) == pytest.approx(steady.cv)
    assert np.isnan(steady.interpolate(choke[0, 0] - 0.1, 0.0)).all()
    assert plane().interpolate([10.0, 77.0], [3000.0, 1.0]) == pytest.approx(
        np.array([[3100, 771], [10, 77]])
    )


def test_a_map_survives_its_file(tmp_path):
    steady = random_map(np.random.default_rng(4), holes=2)
    again = SteadyMap.load(steady.save(tmp_path / "map.json"))
    assert np.array_equal(again.cv, steady.cv, equal_nan=True)
    assert again.cv_names == steady.cv_names
    assert again.mv_units == ("%", "m3/h")
    assert [values.tolist() for values in again.grid.values()] == [v.tolist() for v in steady.grid.values()]
    (tmp_path / "bad.json").write_text('{"grid": {"valve": [1, 2], "pump": [0, 1]}, "cv": ["gas"]}')
    with pytest.raises(InputError, match=r"map.values: got 'nothing'"):
        SteadyMap.load(tmp_path / "bad.json")
    with pytest.raises(InputError, match="map file"):
        SteadyMap.load(tmp_path / "none.json")


def test_a_map_file_of_the_first_format_is_read(tmp_path):
    path = tmp_path / "old.json"
    path.write_text(
        '{"format": "jaxmpc/steady-map/1", "choke": [2, 4], "lift": [0, 10, 20], "cv": ["gas"], "mv": ["choke", "gas_lift"],'
        ' "cv_units": ["m3/h"], "mv_units": ["%", "m3/h"], "provenance": {}, "values": [[[1, 2], [3, 4], [5, null]]]}'
    )
    old = SteadyMap.load(path)
    assert {name: values.tolist() for name, values in old.grid.items()} == {
        "choke": [2, 4],
        "gas_lift": [0, 10, 20],
    }
    assert old.interpolate(4.0, 10.0).tolist() == [4.0]
    assert old.mv_units == ("%", "m3/h")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            dict(prices=dict(gold=1.0)),
            r"prices.gold: got 1.0, expected one of the names gas, oil, choke, gas_lift",
        ),
        (dict(prices=dict(oil=np.nan)), r"prices.oil.*price per unit"),
        (dict(cv_low=[1.0]), r"cv_low.*2 numbers for gas, oil"),
        (dict(cv_low=dict(gas="much")), r"cv_low.gas.*\[m3/h\]"),
        (dict(cv_low=dict(gas=2.0), cv_high=dict(gas=1.0)), r"cv_low.gas: got 2.0, expected at most"),
        (dict(mv_ranges=dict(gas_lift=[])), r"mv_ranges.gas_lift.*m3/h"),
        (dict(mv_ranges=dict(gas_lift=[(5.0, 1.0)])), r"mv_ranges.gas_lift\[0\].*m3/h"),
        (dict(mv_ranges=dict(gas_lift=[(2e4, 3e4)])), r"mv_ranges, mv_steps.*gas_lift 0 to 10000 m3/h"),
        (
            dict(mv_ranges=dict(choke=[(10.1, 11.9)]), mv_steps=steps_of(2.0)),
            r"mv_ranges, mv_steps.*choke 10.1 to 11.9 % on whole steps of 2 %",
        ),
        (dict(mv_ranges=dict(choke=[(-1.0, np.inf)])), r"mv_ranges.choke\[0\].*\[%\]"),
        (dict(mv_ranges=dict(choke=(0.0, 50.0))), r"mv_ranges.choke\[0\].*pair"),
        (dict(mv_ranges=[(0.0, 50.0)]), r"mv_ranges.*by|mv_ranges.*name"),
        (dict(mv_steps=dict(valve=1.0)), r"mv_steps.valve.*choke, gas_lift"),
        (dict(mv_steps=steps_of(0.0)), r"mv_steps.choke.*positive step \[%\]"),
        (dict(target=dict(water=1.0)), r"target.water"),
        (dict(target=dict(oil=1.0), weights=dict(oil=-1.0)), r"weights.*1/CV unit"),
    ],
)
def test_bad_input_is_refused_by_field(options, message):
    with pytest.raises(InputError, match=message):
        optimise(plane(), **options)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        (dict(grid=dict(choke=[0.0, 0.0, 1.0], gas_lift=[0.0, 1.0])), "map.grid.choke"),
        (dict(grid=dict(choke=[0.0, 1.0], gas_lift=[0.0])), "map.grid.gas_lift"),
        (dict(grid=dict(choke=[0.0, 1.0])), "map.grid"),
        (dict(cv=[[1.0]]), "map.cv"),
        (dict(cv=np.full((2, 3, 3), np.nan)), "map.cv"),
        (dict(cv=np.full((2, 3, 3), np.inf)), "map.cv"),
        (dict(cv_names=("gas", "gas")), "map.cv, map.grid"),
        (dict(cv_units=("m3/h",)), "map.cv_units"),
        (dict(mv_units=("%",)), "map.mv_units"),
    ],
)
def test_a_map_that_is_none_is_refused(changes, field):
    good = plane()
    given = dict(grid=good.grid, cv=good.cv, cv_names=good.cv_names) | changes
    with pytest.raises(InputError) as caught:
        SteadyMap(**given)
    assert caught.value.field == field


@pytest.fixture(scope="module")
def well_map():
    """The map of the shipped well on a coarse grid."""
    lifts = [0.0, 1000.0, 2000.0, 3000.0, 7500.0]
    return steady_map(WellPlant(), {"choke": [2.0, 4.0, 12.0, 30.0, 50.0, 100.0], "gas_lift": lifts})


def test_the_map_of_the_well_is_its_steady_sweep(well_map):
    sweep = steady_sweep(WellPlant(), well_map.grid | {"gas_lift": [2000.0, 7500.0]})
    assert sweep.converged.all()
    assert well_map.cv[:, [2, 4]] == pytest.approx(sweep.cv, rel=1e-9)
    assert well_map.cv_names == ("gas_rate", "oil_rate")
    assert np.isfinite(well_map.cv).all()


def test_low_demands_of_the_study_get_a_lift_outside_the_band_and_rates_within_the_deadzone(well_map):
    demanded, deadzone = demands(), np.array([1000.0, 5.0])
    for rates, found in zip(demanded.setpoints, targets_of(well_map, demanded, deadzone), strict=True):
        assert 2000.0 <= found.mv[1] <= 10_000.0
        assert found.feasible
        assert (np.abs(found.cv - rates) <= deadzone * (1 + 1e-6)).all()
        priced = PRICES["gas_rate"] * found.cv[0] + PRICES["oil_rate"] * found.cv[1]
        assert found.profit == pytest.approx(priced - PRICES["gas_lift"] * found.mv[1])
    inside = optimise(well_map, target={"gas_rate": 2700.0, "oil_rate": 81.0}, mv_ranges=ANYWHERE)
    assert 0.0 < inside.mv[1] < 2000.0


def test_the_examples_of_the_page_run_as_typed(capsys):
    page = (Path(__file__).resolve().parents[2] / "docs" / "rto.md").read_text()
    examples = "".join(re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE))
    exec(compile(examples, "docs/rto.md", "exec"), {"__name__": "__main__"})
    said = capsys.readouterr().out
    (shown,) = re.findall(r"^```text\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert said == shown


@pytest.mark.slow
def test_the_quick_study_keeps_the_lift_out_of_the_band_only_with_the_optimisation(tmp_path):
    folder = run_rto(tmp_path, quick=True, progress=False, say=lambda line: None)
    data = open_results(folder).load()
    last = data.position.sel(mv="gas_lift").values[:, -100:]
    assert ((last[0] > 1.0) & (last[0] < 1999.0)).all()
    assert (last[1] > 1999.0).all()
    assert not data.fallback.values.any()
    ideal = data.target.sel(controller="with-rto").values[-1]
    assert data.position.sel(controller="with-rto").values[-1] == pytest.approx(ideal, rel=0.02)
    assert len(figures.thesis.rto.draw_all(folder)) == 2
    lines = []
    run_rto(tmp_path, quick=True, progress=False, say=lines.append)
    assert sum("stored already" in line for line in lines) == 2
    with pytest.raises(InputError, match="plant"):
        run_rto(tmp_path, plant="steam")
