"""Sweep studies as data: strict reading, scenarios, hashes, groups and chunks, and the shipped definitions."""

import pickle
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from jaxmpc.errors import InputError
from jaxmpc.process.well.plant import WellPlant
from studies import load
from studies.definition.estimate import MODEL_SECONDS
from studies.definition.fields import study_fields
from studies.definition.models import identify_models
from studies.definition.sweep import StudyDefinition, load_definition, shipped_studies
from studies.load import load_study
from studies.store import fingerprint
from studies.thesis.well import WELL

WEIGHT = "tuning.move_weight.choke"
ONE = [{"key": WEIGHT, "values": [250.0]}]
DOCS = Path(__file__).resolve().parents[2] / "docs" / "studies.md"


def define(base=None, axes=ONE, name="made", **sections):
    study = {"name": name, **sections.pop("study", {})}
    return StudyDefinition.from_dict({"study": study, "base": base or {}, "axes": axes, **sections})


def expand(*arguments, **options):
    return load.expand(define(*arguments, **options))


def refused(*arguments, **options) -> InputError:
    with pytest.raises(InputError) as caught:
        expand(*arguments, **options)
    return caught.value


def axis(key, *values):
    return {"key": key, "values": list(values)}


# ---------------------------------------------------------------------------------------------------------- strictness


BAD_BASE = {
    "a misspelt tuning field": (
        {"tuning": {"dead_zone": {"gas_rate": 100}}},
        "base.tuning.dead_zone.gas_rate",
        "tuning.deadzone.gas_rate",
    ),
    "a misspelt setting": ({"predicton_horizon": 100}, "base.predicton_horizon", "prediction_horizon"),
    "an unknown CV": ({"tuning": {"deadzone": {"gas": 1}}}, "base.tuning.deadzone.gas", "deadzone.gas_rate"),
    "one number for all CVs": ({"tuning": {"deadzone": 100}}, "base.tuning.deadzone", "gas_rate, oil_rate"),
    "a negative deadzone": (
        {"tuning": {"deadzone": {"gas_rate": -1}}},
        "base.tuning.deadzone.gas_rate",
        "m3/h",
    ),
    "a section that is a number": ({"tuning": 3}, "base.tuning", "deadzone"),
    "a limit that is not a number": (
        {"tuning": {"mv_high": {"choke": "full"}}},
        "base.tuning.mv_high.choke",
        "[%]",
    ),
    "a cut-off of zero": ({"tuning": {"bias_cutoff": 0}}, "base.tuning.bias_cutoff", "rad/s"),
    "an unknown preset": ({"preset": "theses"}, "base.preset", "thesis"),
    "an unknown controller": ({"controller": "integer"}, "base.controller", "mixed-integer"),
    "an unknown reference": ({"reference": "wide"}, "base.reference", "wide-open"),
    "a run longer than its reference": (
        {"reference": "quick", "duration": 12_001},
        "base.duration",
        "12000 s",
    ),
    "a run without a sample": ({"duration": 5}, "base.duration", "one sample of 10 s"),
    "blocks that do not fill the horizon": (
        {"control_horizon": 100},
        "base.blocks with base.control_horizon",
        "100",
    ),
    "empty blocks": ({"blocks": []}, "base.blocks", "whole samples"),
    "blocks of one MV alone": ({"blocks": {"choke": [1, 1]}}, "base.blocks", "each of choke and gas_lift"),
    "blocks of MVs that end apart": (
        {"blocks": {"choke": [1, 1], "gas_lift": [3]}},
        "base.blocks",
        "sum to control_horizon = 2 samples",
    ),
    "an integer horizon of nothing": ({"integer_horizon": 0}, "base.integer_horizon", "from 1 to 10000"),
    "a choke beyond the step test": ({"model": {"choke": 99}}, "base.model.choke", "from 0 to 98 [%]"),
    "negative noise": ({"noise": {"oil_rate": -0.1}}, "base.noise.oil_rate", "m3/h"),
    "half a seed": ({"seed": 0.5}, "base.seed", "whole number"),
    "a vacuum": ({"plant": {"reservoir_pressure": 0}}, "base.plant.reservoir_pressure", "[bar]"),
    "a well of nothing": ({"plant_scale": {"productivity": 0}}, "base.plant_scale.productivity", "positive"),
    "crossed limits": (
        {"tuning": {"cv_low": {"oil_rate": 300}, "cv_high": {"oil_rate": 200}}},
        "base.tuning.cv_low.oil_rate with base.tuning.cv_high.oil_rate",
        "at most its cv_high [m3/h]",
    ),
    "two ways to set one parameter": (
        {"plant": {"productivity": 2}, "plant_scale": {"productivity": 1}},
        "base.plant_scale.productivity",
        "choose one",
    ),
    "steps out of order": (
        {"disturbance": [{"time": 20, "offset": 1}, {"time": 10, "offset": 1}]},
        "base.disturbance[1].time",
        "20 s",
    ),
    "a step after the run": (
        {"disturbance": [{"time": 1e5, "offset": 1}]},
        "base.disturbance[0].time",
        "78000 s",
    ),
    "an unknown key of a step": (
        {"disturbance": [{"time": 1, "offset": 1, "unit": "bar"}]},
        "base.disturbance[0].unit",
        "time, offset",
    ),
    "a fault of no sensor": (
        {"sensor_fault": [{"cv": "water_rate", "kind": "missing", "time": 1}]},
        "base.sensor_fault[0].cv",
        "gas_rate",
    ),
    "a fault of no kind": (
        {"sensor_fault": [{"cv": "oil_rate", "kind": "lost", "time": 1}]},
        "base.sensor_fault[0].kind",
        "frozen",
    ),
    "a fault after the run": (
        {"sensor_fault": [{"cv": "oil_rate", "kind": "missing", "time": 1e5}]},
        "base.sensor_fault[0].time",
        "78000 s",
    ),
    "a fault that never begins": (
        {"sensor_fault": [{"cv": "oil_rate", "kind": "missing", "time": 1, "duration": 0}]},
        "base.sensor_fault[0].duration",
        "above 0 s",
    ),
    "a spike without an end": (
        {"sensor_fault": [{"cv": "oil_rate", "kind": "spike", "time": 1, "size": float("inf")}]},
        "base.sensor_fault[0].size",
        "finite",
    ),
    "a limit below the least": (
        {"tuning": {"bad_limit": {"oil_rate": 0.5}}},
        "base.tuning.bad_limit.oil_rate",
        "1 or more",
    ),
    "a reference that starts late": (
        {"reference": {"times": [10], "setpoints": [[1, 2]], "duration": 20}},
        "base.reference.times[0]",
        "0 s",
    ),
    "a reference of three CVs": (
        {"reference": {"times": [0], "setpoints": [[1, 2, 3]], "duration": 20}},
        "base.reference.setpoints",
        "gas_rate [m3/h], oil_rate [m3/h]",
    ),
    "a reference without length": (
        {"reference": {"times": [0], "setpoints": [[1, 2]]}},
        "base.reference.duration",
        "missing",
    ),
}


@pytest.mark.parametrize(("base", "field", "said"), BAD_BASE.values(), ids=BAD_BASE)
def test_a_bad_setting_is_refused_with_its_path(base, field, said):
    axes = [axis("tuning.slack_weight.oil_rate", 1.0)]
    error = refused(base, axes)
    assert error.field == field
    assert said in str(error)


BAD_SECTIONS = {
    "an unknown table": ({"samplng": {}}, "samplng", "sampling"),
    "an unknown key of the study": ({"study": {"chunk": 3}}, "study.chunk", "chunk_size"),
    "chunks of nothing": ({"study": {"chunk_size": 0}}, "study.chunk_size", "1 or more [scenarios]"),
    "text for a size": ({"study": {"chunk_size": "64"}}, "study.chunk_size", "whole number"),
    "a name with a slash": ({"name": "../out"}, "study.name", "folder"),
    "an unknown trajectory": ({"store": {"trajectories": ["cvs"]}}, "store.trajectories[0]", "setpoint"),
    "a stride of zero": ({"store": {"every": 0}}, "store.every", "[samples]"),
    "a quick setting that does not exist": (
        {"quick": {"base": {"length": 1}}},
        "quick.base.length",
        "jaxmpc process keys",
    ),
    "a quick cut of no axis": (
        {"quick": {"axes": {"tuning.move_weight.chok": {"keep": [0]}}}},
        'quick.axes."tuning.move_weight.chok"',
        WEIGHT,
    ),
    "a quick cut in two ways": (
        {"quick": {"axes": {WEIGHT: {"keep": [0], "values": [1]}}}},
        f'quick.axes."{WEIGHT}"',
        "exactly one",
    ),
    "a quick count of a grid": ({"quick": {"count": 3}}, "quick.count", "[sampling]"),
}


@pytest.mark.parametrize(("sections", "field", "said"), BAD_SECTIONS.values(), ids=BAD_SECTIONS)
def test_a_bad_section_is_refused_with_its_path(sections, field, said):
    error = refused(**sections)
    assert error.field.startswith(field)
    assert said in str(error)


def test_combinations_that_only_some_scenarios_have_are_found_before_a_run():
    error = refused(axes=[axis("tuning.cv_low.gas_rate", 0, 900), axis("tuning.cv_high.gas_rate", 1000, 800)])
    assert error.field == "axes[0].values[1] with axes[1].values[1]"
    assert error.value == "cv_low 900, cv_high 800"
    error = refused(axes=[axis("first_penalised", 1, 30), axis("prediction_horizon", 250, 20)])
    assert error.field == "axes[0].values[1] with axes[1].values[1]"
    error = refused(axes=[axis("plant.trip_start", 60, 75), axis("plant.trip_end", 80, 70)])
    assert error.field == "axes[0].values[1] with axes[1].values[1]"
    assert "[bar]" in error.expected
    error = refused(axes=[axis("sensor_fault.time", 10)])
    assert "exactly one [[base.sensor_fault]]" in error.expected
    error = refused(axes=[axis("disturbance.time", 10)])
    assert "exactly one [[base.disturbance]]" in error.expected


def test_values_that_are_valid_only_together_are_accepted():
    made = expand(
        axes=[
            {"keys": ["tuning.cv_low.oil_rate", "tuning.cv_high.oil_rate"], "values": [[500, 600], [0, 10]]}
        ]
    )
    assert np.asarray(made.scenario(0).tuning.cv_low).tolist() == [0, 500]


def test_the_smallest_and_largest_of_many_draws_are_checked():
    draws = {
        "key": "tuning.cv_weight.oil_rate",
        "distribution": {"kind": "normal", "mean": 1, "deviation": 0.4},
    }
    error = refused(axes=[draws], sampling={"method": "sobol", "count": 1024})
    assert error.field == "axes[0].distribution"
    assert error.value < 0


def test_a_file_that_is_not_there_or_not_toml_is_refused(tmp_path):
    with pytest.raises(InputError, match="deadzone"):
        load_definition("deadzon")
    (tmp_path / "bad.toml").write_text("[study\n")
    with pytest.raises(InputError, match="a TOML file"):
        load_definition(tmp_path / "bad.toml")


# ----------------------------------------------------------------------------------------------------------- scenarios


def test_a_scenario_without_settings_is_the_thesis_controller_on_the_shipped_well():
    scenario = expand().scenario(0)
    assert scenario.kind == "mixed-integer"
    assert scenario.actuator == "step"
    assert scenario.structure == WELL.structure("moves", integer=True)
    thesis = WELL.tuning(scenario.structure)
    for name in ("cv_weight", "move_weight", "mean_move_limit", "oscillation_rows", "bias_cutoff", "mv_low"):
        np.testing.assert_array_equal(getattr(scenario.tuning, name), getattr(thesis, name))
    assert scenario.plant == {}
    assert scenario.model_point == (50.0, 7500.0)
    assert scenario.samples == 7800
    np.testing.assert_array_equal(scenario.reference.setpoints, WELL.reference("thesis").setpoints)
    assert scenario.noise is None
    assert scenario.disturbance is None


def test_settings_and_axes_reach_the_typed_objects_in_their_units():
    base = {
        "controller": "continuous",
        "plant": {"productivity": 3.0},
        "noise": {"gas_rate": 20},
        "seed": 7,
        "reference": {"times": [0, 50], "setpoints": [[1, 2], [3, 4]], "duration": 200},
        "duration": 100,
        "tuning": {"mv_high": {"gas_lift": float("inf")}},
        "disturbance": [{"time": 15, "offset": 0}, {"time": 30, "offset": -2}],
    }
    made = expand(base, [axis("plant_scale.reservoir_pressure", 1, 1.5), axis("model.choke", 20)])
    scenario = made.scenario(1)
    assert scenario.plant == {"reservoir_pressure": 1.5 * 78.2901, "productivity": 3.0}
    assert scenario.model_point == (20.0, 7500.0)
    assert scenario.noise is not None
    assert scenario.noise.tolist() == [20, 0]
    assert scenario.seed == 7
    assert scenario.samples == 10
    assert np.isposinf(scenario.tuning.mv_high[1])
    assert not np.any(scenario.tuning.oscillation_rows)
    assert scenario.disturbance is not None
    assert scenario.disturbance.tolist() == [[0]] * 3 + [[-2]] * 7


def test_lists_and_dwell_reach_the_structure_of_mixed_integer_controllers_and_may_vary():
    base = {"dwell": {"choke": 3}, "tuning": {"oscillation_rows": False}}
    axes = [
        axis("controller", "mixed-integer", "continuous"),
        axis("integer_values.choke", [0, 10, 24, 100], [0, 50, 100]),
    ]
    uneven, even, *continuous = (expand(base, axes).scenario(k) for k in range(4))
    assert uneven.structure.integer_values == ((0.0, 10.0, 24.0, 100.0), None)
    assert uneven.structure.integer_step == (None, None)
    assert uneven.structure.dwell == even.structure.dwell == (3, 1)
    assert even.structure.steps == (50.0, None)
    assert all(c.structure == c.structure.relaxed() for c in continuous)
    plain = expand({"dwell": {"choke": 1}}).scenario(0).structure
    assert plain == expand().scenario(0).structure
    error = refused({}, [axis("integer_values.choke", [0, 10, 5])])
    assert "axes[0].values[0]" in error.field
    assert "more than 10" in str(error)
    assert refused({"dwell": {"gas_lift": 2}}).field == "base.dwell.gas_lift"


def test_the_offset_of_the_one_pressure_step_can_be_an_axis():
    base = {"duration": 50, "disturbance": [{"time": 20, "offset": 1}]}
    made = expand(base, [axis("disturbance.offset", 0, 3)])
    assert made.scenario(0).disturbance is None
    assert made.scenario(1).disturbance[:, 0].tolist() == [0, 0, 3, 3, 3]


def test_a_cut_run_has_only_the_setpoints_that_it_reaches():
    made = expand({"reference": "quick"}, [axis("duration", 3600, 3610, 12_000)])
    assert [len(made.scenario(k).reference.times) for k in range(3)] == [1, 2, 3]
    assert [group.samples for group in made.groups] == [360, 361, 1200]


def test_soft_mpc_off_is_what_the_preset_says_for_any_tuning():
    made = expand({"tuning": {"soft_quadratic": {"oil_rate": 0.3}}}, [axis("soft", True, False)])
    on, off = made.scenario(0).tuning, made.scenario(1).tuning
    np.testing.assert_allclose(off.cv_weight, [2e-4, 0.4], rtol=1e-15)
    assert not np.any(off.soft_quadratic)
    assert not np.any(off.soft_linear)
    np.testing.assert_allclose(on.soft_quadratic, [1e-4, 0.3])


# -------------------------------------------------------------------------------------------------------------- hashes


def test_presets_and_their_numbers_spelled_out_have_the_same_scenario_hash():
    spelled = {
        "tuning": {
            "cv_weight": {"gas_rate": 2e-4, "oil_rate": 0.2},
            "soft_quadratic": {"gas_rate": 0, "oil_rate": 0},
            "soft_linear": {"gas_rate": 0, "oil_rate": 0},
        },
        "plant": {"reservoir_pressure": 78.2901},
        "controller": "mixed-integer",
        "seed": 3,  # of no noise
    }
    bases = {"preset": "no-soft"}, {"soft": False}, spelled
    assert len({expand(base).scenario_hash(0) for base in bases}) == 1
    assert expand({"preset": "no-soft-plain"}).scenario_hash(0) != expand(spelled).scenario_hash(0)


def test_the_order_of_keys_changes_no_hash_and_every_setting_does():
    one = {
        "preset": "thesis",
        "tuning": {"deadzone": {"gas_rate": 1, "oil_rate": 2}},
        "noise": {"gas_rate": 5},
    }
    other = {
        "noise": {"gas_rate": 5},
        "tuning": {"deadzone": {"oil_rate": 2, "gas_rate": 1}},
        "preset": "thesis",
    }
    assert expand(one).hash == expand(other).hash
    changes = (
        {"controller": "continuous"},
        {"actuator": "continuous"},
        {"blocking": "inputs"},
        {"prediction_horizon": 240},
        {"duration": 6000},
        {"reference": "quick"},
        {"model": {"choke": 40}},
        {"plant_scale": {"slip_base": 1.01}},
        {"noise": {"gas_rate": 6}},
        {"seed": 1},
        {"tuning": {"bias_cutoff": 0.06}},
        {"tuning": {"oscillation_rows": False}},
        {"disturbance": [{"time": 100, "offset": 1}]},
        {"sensor_fault": [{"cv": "oil_rate", "kind": "missing", "time": 100}]},
        {"position_feedback": True},
        {"tuning": {"bad_limit": {"oil_rate": 5}}},
    )
    hashes = [expand({**one, **change}).scenario_hash(0) for change in changes]
    assert len({*hashes, expand(one).scenario_hash(0)}) == len(changes) + 1


def test_equal_scenarios_of_two_studies_have_equal_hashes_and_the_studies_have_not():
    small = expand(axes=[axis(WEIGHT, 100, 200)], name="small")
    large = expand(axes=[axis(WEIGHT, 300, 200, 100)], name="large")
    assert small.scenario_hash(0) == large.scenario_hash(2)
    assert small.scenario_hash(1) == large.scenario_hash(1)
    assert small.scenario_hash(0) != small.scenario_hash(1)
    assert small.hash != large.hash
    assert small.hash != expand(axes=[axis(WEIGHT, 100, 200)], store={"every": 5}).hash


def test_a_change_of_the_code_changes_every_hash(monkeypatch):
    before = expand()
    hashes = before.scenario_hash(0), before.hash
    real = fingerprint.source_hash
    monkeypatch.setattr(
        fingerprint, "source_hash", lambda package: real(package) + (package == "identify") * "x"
    )
    after = expand()
    assert after.scenario_hash(0) != hashes[0]
    assert after.hash != hashes[1]


# ---------------------------------------------------------------------------------------------------- groups and chunks


def test_groups_and_chunks_hold_every_scenario_once_and_agree_in_shape():
    made = expand(
        {"reference": "quick"},
        [
            axis(WEIGHT, *range(1, 8)),
            axis("controller", "continuous", "mixed-integer"),
            axis("tuning.cv_high.gas_rate", 1000.0, float("inf")),
            axis("blocking", "moves", "inputs"),
        ],
        study={"chunk_size": 5},
    )
    assert made.count == 56
    assert len(made.groups) == 4  # the low limits and the oil rate keep CV limits everywhere
    for field in ("groups", "chunks"):
        found = np.concatenate([part.scenarios for part in getattr(made, field)])
        assert sorted(found.tolist()) == list(range(56))
    assert [chunk.index for chunk in made.chunks] == list(range(len(made.chunks)))
    for chunk in made.chunks:
        group = made.groups[chunk.group]
        assert 1 <= len(chunk.scenarios) <= made.chunk_size == 5
        assert np.all(np.diff(chunk.scenarios) > 0)
        for k in chunk.scenarios:
            scenario = made.scenario(int(k))
            assert (scenario.kind, scenario.actuator) == (group.kind, group.actuator)
            assert (scenario.structure, scenario.samples) == (group.structure, group.samples)
            assert scenario.model_point in group.points


def test_limits_and_ideal_values_part_groups_and_steps_do_not():
    no_limits = {
        n: {c: s * float("inf") for c in ("gas_rate", "oil_rate")}
        for n, s in (("cv_low", -1), ("cv_high", 1))
    }
    made = expand({"tuning": no_limits}, [axis("tuning.cv_high.gas_rate", 1e4, float("inf"))])
    assert [group.has_limits for group in made.groups] == [True, False]
    made = expand(axes=[axis("tuning.ideal_weight.choke", 0, 1, 2)])
    assert [(group.has_ideal, len(group.scenarios)) for group in made.groups] == [(False, 1), (True, 2)]
    made = expand(axes=[axis("tuning.move_high.choke", 2, 4)])
    assert len(made.groups) == 1
    made = expand({"controller": "continuous"}, [axis("tuning.move_high.choke", 2, 4)])
    assert len(made.groups) == 1


def test_groups_of_one_size_share_their_program():
    made = expand({"reference": "quick"}, [axis("blocking", "moves", "inputs")])
    assert (len(made.groups), made.describe().compilations) == (2, 1)


@pytest.mark.parametrize("name", [name for name in shipped_studies() if name != "tune"])
@pytest.mark.parametrize("quick", [True, False])
def test_every_shipped_study_has_work_for_several_workers_and_loses_little_when_it_is_killed(name, quick):
    made = load_study(name, quick=quick)
    assert len(made.chunks) >= 8
    assert max(len(chunk.scenarios) for chunk in made.chunks) <= made.count / 8


def test_chunks_follow_from_the_number_of_scenarios_unless_their_size_is_given():
    values = {count: axis(WEIGHT, *range(1, count + 1)) for count in (1, 7, 16, 31, 32, 600)}
    sizes = {count: expand(axes=[entries]).chunk_size for count, entries in values.items()}
    assert sizes == {1: 1, 7: 1, 16: 2, 31: 2, 32: 4, 600: 64}
    assert expand(axes=[values[16]], study={"chunk_size": 50}).chunk_size == 16


def test_a_study_that_grows_a_little_keeps_its_chunks():
    grown = [expand(axes=[axis(WEIGHT, *range(1, count + 1))]) for count in (16, 20)]
    few, more = ([study.scenario_hashes[k] for k in c.scenarios] for study in grown for c in study.chunks[:1])
    assert few == more
    assert [c.scenarios.tolist() for c in grown[1].chunks[:8]] == [
        c.scenarios.tolist() for c in grown[0].chunks
    ]


def test_no_chunk_is_larger_than_the_largest_group():
    axes = [axis("blocking", "moves", "inputs"), axis(WEIGHT, 1, 2, 3)]
    assert expand(axes=axes, study={"chunk_size": 50}).chunk_size == 3


def test_a_scenario_number_outside_the_study_is_refused():
    made = expand()
    for k in (-1, 1, 0.5):
        with pytest.raises(InputError, match="from 0 to 0"):
            made.scenario(k)
        with pytest.raises(InputError, match="from 0 to 0"):
            made.scenario_hash(k)


def test_a_study_survives_pickling():
    made = load_study("robustness", quick=True)
    read = pickle.loads(pickle.dumps(made))
    assert read.hash == made.hash
    assert read.scenario_hash(3) == made.scenario_hash(3)
    assert read.scenario(3).plant == made.scenario(3).plant
    assert [c.scenarios.tolist() for c in read.chunks] == [c.scenarios.tolist() for c in made.chunks]


# ----------------------------------------------------------------------------------------------- quick and shipped ones


def test_the_quick_cut_replaces_what_it_names_and_nothing_else():
    quick = {
        "chunk_size": 3,
        "base": {"duration": 100},
        "axes": {WEIGHT: {"keep": [2, 0]}, "model.gas_lift": {"count": 2}, "soft": {"values": [True]}},
    }
    lift = {"key": "model.gas_lift", "range": {"from": 5000, "to": 9000, "count": 5}}
    axes = [axis(WEIGHT, 1, 2, 3), lift, axis("soft", True, False)]
    definition = define({"reference": "quick"}, axes, quick=quick)
    full, cut = load.expand(definition), load.expand(definition, quick=True)
    assert (full.name, full.count, full.scenario(0).samples, full.chunk_size) == ("made", 30, 1200, 2)
    assert (cut.name, cut.count, cut.scenario(0).samples, cut.chunk_size) == ("made-quick", 4, 10, 3)
    assert cut.columns[0].values.tolist() == [3, 3, 1, 1]
    assert cut.columns[1].values.tolist() == [5000, 9000, 5000, 9000]
    with pytest.raises(InputError, match="no quick version"):
        load.expand(define(), quick=True)


def test_a_dry_run_counts_scenarios_compilations_models_and_bytes():
    base = {"reference": "quick", "duration": 1000}
    axes = [axis("controller", "continuous", "mixed-integer"), axis("model.choke", 20, 50, 80)]
    made = expand(base, axes, store={"every": 10, "trajectories": ["cv", "status"]})
    description = made.describe()
    assert description.scenarios == 6
    assert description.group_sizes == (3, 3)
    assert (description.chunks, description.compilations, description.models) == (6, 2, 3)
    assert description.samples == 600
    assert description.stored_bytes == 6 * 8 * (64 + 10 * 3)
    assert description.seconds == pytest.approx(3 * MODEL_SECONDS + made.work.rest({}))
    assert "scenarios   6" in str(description)
    assert "models      3 to identify" in str(description)
    given = load_study("wood-berry", quick=True).describe()
    assert given.models == 0
    assert "models      given by the process" in str(given)


@pytest.mark.parametrize("name", ["blocking", "deadzone", "mismatch", "robustness"])
def test_a_shipped_study_expands_in_both_sizes(name):
    assert name in shipped_studies()
    full, quick = load_study(name), load_study(name, quick=True)
    assert full.name == name
    assert full.title != name
    assert 100 <= full.count <= 2000
    assert full.describe().seconds < 20 * 60
    assert quick.count < full.count / 5
    assert quick.describe().seconds < 100
    for made in (full, quick):
        assert made.scenario(made.count - 1).number == made.count - 1
        for column in made.columns:
            assert len(column.values) == made.count
            assert column.label


def test_the_deadzone_study_contains_the_thesis_tuning_in_both_sizes():
    thesis = expand({"reference": "thesis"}).scenario_hash(0)
    full = load_study("deadzone")
    assert thesis in [full.scenario_hash(k) for k in range(full.count)]
    of_quick = load_study("deadzone", quick=True)
    assert expand({"reference": "quick"}).scenario_hash(0) in [
        of_quick.scenario_hash(k) for k in range(of_quick.count)
    ]


def test_the_page_of_the_documentation_lists_every_key_with_its_unit():
    text = DOCS.read_text().partition("## `[base]`")[2]
    found = re.findall(r"^\| `([\w.]+)` \| ([^|]*?) ?\|", text, flags=re.M)
    rows = dict(reversed(found))  # the first row of a name is the one of [base]
    fields = study_fields(WELL, WellPlant().parameter_table)
    for key, field in fields.items():
        if key.startswith(("plant_scale.", "disturbance.", "sensor_fault.")):
            continue
        shown = rows[key.removeprefix("plant.")]
        assert shown.strip() == field.unit or key == "blocks"
    assert {p.name for p in WellPlant().parameter_table} <= set(rows)


def test_the_examples_of_the_documentation_expand():
    examples = re.findall(r"```toml\n(\[study\].*?)```", DOCS.read_text(), flags=re.S)
    counts = [load.expand(StudyDefinition.from_dict(tomllib.loads(text))).count for text in examples]
    assert counts == [10, 256, 384]
    assert all(
        load.expand(StudyDefinition.from_dict(tomllib.loads(text)), quick=True).count for text in examples
    )


# -------------------------------------------------------------------------------------------------------------- models


def test_models_are_identified_once_per_working_point():
    ticks = []
    points = [(50, 7500.0), (20.0, 7500.0), (50.0, 7500.0)]
    found = identify_models(WELL, points, progress=lambda *now: ticks.append(now))
    assert list(found) == [(50.0, 7500.0), (20.0, 7500.0)]
    assert ticks == [(1, 2), (2, 2)]
    for (choke, lift), model in found.items():
        assert model.samples == 250
        assert dict(model.working_point)["choke"] == choke
        assert dict(model.working_point)["gas_lift"] == lift
    assert not np.array_equal(found[50.0, 7500.0].coefficients, found[20.0, 7500.0].coefficients)


@pytest.mark.parametrize("point", [(99.0, 7500.0), (-1.0, 7500.0), (50.0, -1.0), (50.0, float("nan"))])
def test_a_working_point_outside_its_range_is_refused_by_name(point):
    with pytest.raises(InputError, match=r"model\.choke = "):
        identify_models(WELL, [(50.0, 7500.0), point])
