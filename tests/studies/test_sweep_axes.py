"""Axes of sweep studies: how entries are made and how they combine into scenarios."""

import csv

import numpy as np
import pytest
from scipy.stats import norm, qmc

from jaxmpc.errors import InputError
from studies.definition.sweep import StudyDefinition
from studies.load import expand

WEIGHT = "tuning.move_weight.choke"
DEADZONE = "tuning.deadzone.gas_rate"
PRESSURE = "plant_scale.reservoir_pressure"


def study(*axes, folder=".", confirmed=False, limit=10_000, **sections):
    body = {"study": {"name": "made", "confirmation_limit": limit}, **sections}
    if axes:
        body["axes"] = list(axes)
    return expand(StudyDefinition.from_dict(body, folder), confirmed=confirmed)


def values(made):
    return {column.key: column.values.tolist() for column in made.columns}


def refused(*axes, **sections) -> InputError:
    with pytest.raises(InputError) as caught:
        study(*axes, **sections)
    return caught.value


def uniform(key, low=0.9, high=1.1):
    return {"key": key, "distribution": {"kind": "uniform", "from": low, "to": high}}


# ------------------------------------------------------------------------------------------------------- combining


def test_a_grid_runs_through_the_last_axis_first():
    made = study({"key": WEIGHT, "values": [1, 2]}, {"key": DEADZONE, "values": [10, 20, 30]})
    assert values(made) == {WEIGHT: [1, 1, 1, 2, 2, 2], DEADZONE: [10, 20, 30, 10, 20, 30]}
    assert [c.unit for c in made.columns] == ["1/%^2", "m3/h"]
    assert [c.label for c in made.columns] == ["move weight of the choke", "deadzone of the gas rate"]


def test_zipped_axes_take_their_entries_together():
    axes = {"key": WEIGHT, "values": [1, 2]}, {"key": DEADZONE, "values": [10, 20]}
    assert values(study(*axes, sampling={"method": "zip"})) == {WEIGHT: [1, 2], DEADZONE: [10, 20]}


def test_zipped_axes_of_different_lengths_are_refused():
    axes = {"key": WEIGHT, "values": [1, 2]}, {"key": DEADZONE, "values": [10, 20, 30]}
    error = refused(*axes, sampling={"method": "zip"})
    assert (error.field, error.value) == ("axes[1]", "3 entries")
    assert "2 entries" in error.expected


def test_linked_keys_move_together_inside_a_grid():
    linked = {
        "keys": ["blocks", "prediction_horizon"],
        "values": [[[1, 1, 2], 40], [[2, 2, 4, 8], 60]],
        "label": ["lengths", "horizon"],
    }
    made = study(linked, {"key": "soft", "values": [True, False]})
    assert values(made) == {
        "blocks": ["1 1 2", "1 1 2", "2 2 4 8", "2 2 4 8"],
        "prediction_horizon": [40, 40, 60, 60],
        "soft": ["true", "false", "true", "false"],
    }
    assert made.scenario(2).structure.blocks == (2, 2, 4, 8)
    assert made.scenario(2).structure.control_horizon == 16
    assert made.scenario(2).structure.prediction_horizon == 60
    assert [c.label for c in made.columns][:2] == ["lengths", "horizon"]


def test_blocks_of_each_mv_and_integer_horizons_vary_like_any_key():
    own = {"choke": [1, 1, 2], "gas_lift": [4]}
    axes = {"key": "blocks", "values": [[1, 3], own]}, {"key": "integer_horizon", "values": [1, 2]}
    made = study(*axes)
    assert values(made) == {
        "blocks": ["1 3", "1 3", "1 1 2; 4", "1 1 2; 4"],
        "integer_horizon": [1, 2, 1, 2],
    }
    structures = [made.scenario(k).structure for k in range(4)]
    assert [s.blocks for s in structures[1:3]] == [(1, 3), ((1, 1, 2), (4,))]
    assert [s.integer_until for s in structures] == [(1, 0), (4, 0), (1, 0), (2, 0)]
    assert {s.control_horizon for s in structures} == {4}


def test_ranges_include_their_ends_and_have_plain_decimals():
    linear = {"key": DEADZONE, "range": {"from": 0, "to": 0.5, "count": 6}}
    assert values(study(linear))[DEADZONE] == [0, 0.1, 0.2, 0.3, 0.4, 0.5]
    log = {"key": WEIGHT, "range": {"from": 1000, "to": 1, "count": 4, "scale": "log"}}
    assert values(study(log))[WEIGHT] == [1000, 100, 10, 1]


def test_only_the_kept_positions_of_an_axis_are_used():
    made = study({"key": WEIGHT, "values": [1, 2, 3, 4], "keep": [3, 0]})
    assert values(made)[WEIGHT] == [4, 1]


# -------------------------------------------------------------------------------------------------------- sampling


def test_sobol_draws_are_those_of_scipy_through_the_inverse_distribution():
    normal = {"key": PRESSURE, "distribution": {"kind": "normal", "mean": 1.0, "deviation": 0.02}}
    log = {"key": WEIGHT, "distribution": {"kind": "log-uniform", "from": 10, "to": 1000}}
    made = values(study(normal, log, sampling={"method": "sobol", "count": 8, "seed": 3}))
    points = qmc.Sobol(2, seed=np.random.default_rng(3)).random_base2(3)
    np.testing.assert_allclose(made[PRESSURE], norm.ppf(points[:, 0], 1.0, 0.02), rtol=1e-12)
    np.testing.assert_allclose(made[WEIGHT], 10 * 100 ** points[:, 1], rtol=1e-12)


def test_sobol_draws_repeat_and_a_longer_study_begins_with_a_shorter_one():
    def drawn(count, seed=5):
        return values(study(uniform(PRESSURE), sampling={"method": "sobol", "count": count, "seed": seed}))[
            PRESSURE
        ]

    assert drawn(20) == drawn(20)
    assert drawn(20)[:6] == drawn(6)
    assert drawn(20, seed=6) != drawn(20)


def test_a_latin_hypercube_has_one_draw_in_every_stratum_of_every_axis():
    axes = uniform(PRESSURE, 0.9, 1.1), uniform(WEIGHT, 100, 200)
    made = values(study(*axes, sampling={"method": "latin-hypercube", "count": 25, "seed": 1}))
    for key, low, high in ((PRESSURE, 0.9, 1.1), (WEIGHT, 100, 200)):
        stratum = np.floor((np.array(made[key]) - low) / (high - low) * 25)
        assert sorted(stratum) == list(range(25))


def test_every_draw_meets_every_listed_combination():
    made = study(
        {"key": "controller", "values": ["continuous", "mixed-integer"]},
        uniform(PRESSURE),
        {"key": WEIGHT, "values": [1, 2]},
        sampling={"method": "sobol", "count": 3},
    )
    columns = values(made)
    assert columns["controller"] == ["continuous"] * 6 + ["mixed-integer"] * 6
    assert columns[WEIGHT] == [1, 1, 1, 2, 2, 2] * 2
    assert columns[PRESSURE] == columns[PRESSURE][:3] * 4
    assert [column.key for column in made.columns] == ["controller", PRESSURE, WEIGHT]


def test_whole_numbers_are_drawn_with_both_ends_equally_often():
    seeds = {"key": "seed", "distribution": {"kind": "uniform", "from": 2, "to": 5}}
    drawn = values(study(seeds, sampling={"method": "latin-hypercube", "count": 40}))["seed"]
    assert sorted(drawn) == sorted([2, 3, 4, 5] * 10)


# -------------------------------------------------------------------------------------------------------------- CSV


@pytest.fixture
def table(tmp_path):
    rows = [
        ["preset", "pr", DEADZONE, "blocks"],
        ["thesis", "0.99", "500", "1 1 2"],
        ["no-soft", "1.01", "250.5", "4 4"],
    ]
    with open(tmp_path / "cases.csv", "w", newline="") as file:
        csv.writer(file).writerows(rows)
    return tmp_path


def test_one_file_gives_several_keys_by_the_names_of_its_columns(table):
    linked = {"keys": [PRESSURE, DEADZONE], "csv": {"file": "cases.csv", "columns": ["pr", DEADZONE]}}
    assert values(study(linked, folder=table)) == {PRESSURE: [0.99, 1.01], DEADZONE: [500, 250.5]}
    single = {"key": PRESSURE, "csv": {"file": "cases.csv", "column": "pr"}}
    own = {"key": "blocks", "csv": {"file": "cases.csv"}}
    made = values(study(single, own, folder=table))
    assert made["blocks"] == ["1 1 2", "4 4"] * 2


def test_a_cell_holds_the_blocks_of_each_mv_separated_by_a_semicolon(tmp_path):
    (tmp_path / "own.csv").write_text("blocks,integer_horizon\n1 1 2; 4,1\n1 3,4\n")
    made = study(sampling={"method": "list", "file": "own.csv"}, folder=tmp_path)
    assert values(made) == {"blocks": ["1 1 2; 4", "1 3"], "integer_horizon": [1, 4]}
    assert made.scenario(0).structure.blocks == ((1, 1, 2), (4,))


def test_a_list_takes_every_row_of_a_file_as_a_scenario(tmp_path):
    (tmp_path / "all.csv").write_text(f"soft,{WEIGHT},blocks\ntrue,100,1 1 2\nfalse,200,4 4\n")
    made = study(sampling={"method": "list", "file": "all.csv"}, folder=tmp_path)
    assert values(made) == {"soft": ["true", "false"], WEIGHT: [100, 200], "blocks": ["1 1 2", "4 4"]}
    assert made.scenario(1).structure.blocks == (4, 4)


def test_a_bad_cell_is_named_by_row_and_column(table):
    with open(table / "cases.csv", "a") as file:
        file.write("thesis,high,1,1 1 2\n")
    error = refused({"key": PRESSURE, "csv": {"file": "cases.csv", "column": "pr"}}, folder=table)
    assert error.field == "axes[0].csv (cases.csv, row 4, column pr)"
    assert error.value == "high"


def test_a_column_that_is_not_there_is_refused_with_a_near_match(table):
    (table / "near.csv").write_text("pressure\n1\n")
    error = refused({"key": PRESSURE, "csv": {"file": "near.csv", "column": "presure"}}, folder=table)
    assert error.field == "axes[0].csv"
    assert "pressure" in error.hint
    assert refused({"key": WEIGHT, "csv": {"file": "none.csv"}}).field == "axes[0].csv"


# --------------------------------------------------------------------------------------------------------- refusals


GOOD = {"key": WEIGHT, "values": [1]}


def test_without_axes_the_base_is_the_one_scenario():
    study = expand(StudyDefinition.from_dict({"study": {"name": "alone"}, "base": {"seed": 7}}))
    assert (study.count, study.columns, study.scenario(0).seed) == (1, (), 7)


BAD_AXES = {
    "a misspelt key": ([{"key": "tuning.deadzone.gas_rat", "values": [1]}], "axes[0].key", DEADZONE),
    "a key without its section": ([{"key": "deadzone.gas_rate", "values": [1]}], "axes[0].key", DEADZONE),
    "a wrong unit": ([{"key": WEIGHT, "unit": "%", "values": [1]}], "axes[0].unit", "1/%^2"),
    "no entries": ([GOOD, {"key": DEADZONE, "values": []}], "axes[1].values", "one entry or more"),
    "a key on two axes": ([GOOD, GOOD], "axes[1].key", "axes[0].key"),
    "two ways to set one parameter": (
        [{"key": "plant.productivity", "values": [2]}, {"key": "plant_scale.productivity", "values": [1]}],
        "axes[1].key",
        "axes[0].key",
    ),
    "not a number": ([{"key": DEADZONE, "values": [1, float("nan")]}], "axes[0].values[1]", "m3/h"),
    "an infinite deadzone": ([{"key": DEADZONE, "values": [float("inf")]}], "axes[0].values[0]", "finite"),
    "a negative deadzone": (
        [{"key": DEADZONE, "values": [1, 2, 3, -4]}],
        "axes[0].values[3]",
        "0 or more [m3/h]",
    ),
    "text for a number": ([{"key": DEADZONE, "values": ["1"]}], "axes[0].values[0]", "m3/h"),
    "true for a number": ([{"key": DEADZONE, "values": [True]}], "axes[0].values[0]", "m3/h"),
    "an unknown choice": (
        [{"key": "blocking", "values": ["move"]}],
        "axes[0].values[0]",
        "moves, inputs, none",
    ),
    "a part of a sample": ([{"key": "prediction_horizon", "values": [1.5]}], "axes[0].values[0]", "samples"),
    "a short linked entry": (
        [{"keys": [WEIGHT, DEADZONE], "values": [[1, 2], [1]]}],
        "axes[0].values[1]",
        "a list of 2 values",
    ),
    "a bad value in a linked entry": (
        [{"keys": [WEIGHT, DEADZONE], "values": [[1, 2], [1, -1]]}],
        "axes[0].values[1][1]",
        "0 or more",
    ),
    "two sources": (
        [{**GOOD, "range": {"from": 1, "to": 2, "count": 2}}],
        "axes[0]",
        "exactly one of values",
    ),
    "no source": ([{"key": WEIGHT}], "axes[0]", "exactly one of values"),
    "no key": ([{"values": [1]}], "axes[0].key", "one of the two"),
    "a range of texts": (
        [{"key": "preset", "range": {"from": 1, "to": 2, "count": 2}}],
        "axes[0].range",
        "values",
    ),
    "a logarithmic range from 0": (
        [{"key": WEIGHT, "range": {"from": 0, "to": 2, "count": 2, "scale": "log"}}],
        "axes[0].range.from",
        "above 0",
    ),
    "a range of nothing": (
        [{"key": WEIGHT, "range": {"from": 0, "to": 2, "count": 0}}],
        "axes[0].range.count",
        "1",
    ),
    "an unknown key of a range": (
        [{"key": WEIGHT, "range": {"form": 0, "to": 2, "count": 2}}],
        "axes[0].range.form",
        "from",
    ),
    "a distribution in a grid": ([uniform(WEIGHT)], "axes[0].distribution", "latin-hypercube or sobol"),
    "a position beyond the end": ([{**GOOD, "keep": [1]}], "axes[0].keep[0]", "from 0 to 0"),
}


@pytest.mark.parametrize(("axes", "field", "said"), BAD_AXES.values(), ids=BAD_AXES)
def test_a_bad_axis_is_refused_with_its_path(axes, field, said):
    error = refused(*axes)
    assert error.field == field
    assert said in str(error)


BAD_DRAWS = {
    "no axes to zip": ({"method": "zip"}, None, "axes", "one axis or more"),
    "no count": ({"method": "sobol"}, uniform(WEIGHT), "sampling.count", "number of draws"),
    "a count of a grid": ({"count": 3}, GOOD, "sampling.count", "sobol"),
    "nothing to draw": ({"method": "sobol", "count": 3}, GOOD, "sampling.method", "distribution"),
    "an empty interval": (
        {"method": "sobol", "count": 3},
        uniform(WEIGHT, 2, 1),
        "axes[0].distribution.to",
        "1/%^2",
    ),
    "a mean of a uniform one": (
        {"method": "sobol", "count": 3},
        {"key": WEIGHT, "distribution": {"kind": "uniform", "from": 1, "to": 2, "mean": 1}},
        "axes[0].distribution.mean",
        "from and to",
    ),
    "no deviation": (
        {"method": "sobol", "count": 3},
        {"key": WEIGHT, "distribution": {"kind": "normal", "mean": 1}},
        "axes[0].distribution.deviation",
        "mean and deviation",
    ),
    "draws below zero": (
        {"method": "sobol", "count": 64},
        {"key": WEIGHT, "distribution": {"kind": "normal", "mean": 1, "deviation": 5}},
        "axes[0].distribution",
        "0 or more [1/%^2]",
    ),
    "normal seeds": (
        {"method": "sobol", "count": 3},
        {"key": "seed", "distribution": {"kind": "normal", "mean": 1, "deviation": 5}},
        "axes[0].distribution.kind",
        "uniform",
    ),
    "an unknown method": (
        {"method": "random", "count": 3},
        uniform(WEIGHT),
        "sampling.method",
        "latin-hypercube",
    ),
    "a list with axes": ({"method": "list", "file": "x.csv"}, GOOD, "axes", "no axes"),
}


@pytest.mark.parametrize(("sampling", "axis", "field", "said"), BAD_DRAWS.values(), ids=BAD_DRAWS)
def test_bad_sampling_is_refused_with_its_path(sampling, axis, field, said):
    error = refused(*filter(None, [axis]), sampling=sampling)
    assert error.field == field
    assert said in str(error)


def test_more_scenarios_than_the_limit_must_be_confirmed():
    axes = {"key": WEIGHT, "values": [1, 2, 3]}, {"key": DEADZONE, "values": [1, 2]}
    error = refused(*axes, limit=5)
    assert (error.field, error.value) == ("study.confirmation_limit", "6 scenarios")
    assert study(*axes, limit=5, confirmed=True).count == 6
    assert study(*axes, limit=6).count == 6
    many = {"method": "sobol", "count": 10**6}  # refused before anything is drawn
    assert refused(uniform(WEIGHT), sampling=many).field == "study.confirmation_limit"
