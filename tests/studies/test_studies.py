"""Presets, references, definitions and the reports of a comparison."""

import csv
import io

import msgspec
import numpy as np
import pytest

from jaxmpc.errors import InputError
from jaxmpc.process.reference import Reference
from studies import report
from studies.definition.comparison import ControllerDefinition, ReferenceDefinition
from studies.kpi import evaluate
from studies.run import comparison
from studies.store import fingerprint
from studies.store.reading import open_results
from studies.thesis import catalogue, claims, reach
from studies.thesis.report import write_thesis_summary
from studies.thesis.well import WELL
from tests import studies_synthetic as made


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    return made.stored(tmp_path_factory.mktemp("made-up"))


@pytest.fixture(scope="module")
def results(stored):
    return open_results(stored).load()


# presets


def test_the_thesis_preset_is_table_1_with_the_choke_weight_in_percent():
    tuning = WELL.tuning(WELL.structure(integer=True))
    np.testing.assert_allclose(tuning.cv_weight, [1e-4, 0.1])
    np.testing.assert_allclose(tuning.soft_quadratic, [1e-4, 0.1])
    np.testing.assert_allclose(tuning.soft_linear, [1e-4, 0.1])
    np.testing.assert_allclose(tuning.deadzone, [1000, 5])
    np.testing.assert_allclose(tuning.move_weight, [1000 / 2**2, 0.2])
    np.testing.assert_allclose(tuning.cv_high, [20_000, 400])
    np.testing.assert_allclose(tuning.slack_weight, 1000)
    np.testing.assert_allclose(tuning.mv_high, [100, 10_000])
    np.testing.assert_allclose(tuning.move_high, [2, 200])
    np.testing.assert_allclose(tuning.move_low, [-2, -200])
    np.testing.assert_allclose(tuning.mean_move_limit, [0.55, np.inf])
    assert float(tuning.bias_cutoff) == 1 / 20
    assert tuning.oscillation_rows.tolist() == [True, False]


def test_only_the_mixed_integer_controller_has_oscillation_rows():
    assert not WELL.tuning(WELL.structure()).oscillation_rows.any()


@pytest.mark.parametrize("name", WELL.presets)
@pytest.mark.parametrize("blocking", ["moves", "inputs", "none"])
@pytest.mark.parametrize("integer", [False, True])
def test_every_preset_builds_for_every_structure(name, blocking, integer):
    structure = WELL.structure(blocking, integer=integer)
    assert structure.block_count == (200 if blocking == "none" else 16)
    WELL.tuning(structure, name)


def test_without_soft_mpc_the_weight_far_outside_the_deadzone_stays():
    soft, hard = (WELL.tuning(WELL.structure(), name) for name in ("thesis", "no-soft"))
    np.testing.assert_allclose(hard.cv_weight, soft.cv_weight + soft.soft_quadratic)
    assert not hard.soft_quadratic.any()
    assert not hard.soft_linear.any()


def test_unknown_presets_and_fields_are_refused():
    with pytest.raises(InputError, match="one of the presets"):
        WELL.tuning(WELL.structure(), "thesys")
    with pytest.raises(InputError, match=r"tuning\.cv_wieght"):
        WELL.tuning(WELL.structure(), changes={"cv_wieght": 1})
    with pytest.raises(InputError, match="'moves', 'inputs' or 'none'"):
        WELL.structure("block")


def test_changes_do_not_reach_the_preset():
    WELL.tuning_fields("thesis")["cv_weight"]["gas_rate"] = 7.0
    assert WELL.presets["thesis"]["cv_weight"]["gas_rate"] == 1e-4


# references


def test_the_thesis_reference_has_7800_samples_in_13_windows():
    reference = WELL.reference("thesis")
    setpoint = reference.sample(10.0)
    assert setpoint.shape == (7800, 2)
    np.testing.assert_allclose(
        setpoint[[0, 599, 600, 7799]], [[11013, 185]] * 2 + [[12600, 175], [16500, 230]]
    )
    assert np.bincount(reference.window(10.0)).tolist() == [600] * 13


def test_the_quick_reference_uses_windows_of_the_thesis_reference():
    thesis_targets = set(map(tuple, WELL.reference("thesis").setpoints.tolist()))
    assert set(map(tuple, WELL.reference("quick").setpoints.tolist())) <= thesis_targets
    assert len(WELL.reference("quick").sample(10.0)) <= 1200


def test_a_change_between_two_samples_counts_from_the_next_sample():
    reference = Reference([0, 15], [[1.0], [2.0]], 40)
    assert reference.sample(10.0)[:, 0].tolist() == [1, 1, 2, 2]


def test_samples_and_changes_give_the_same_reference():
    rows = np.array([[1.0, 2.0], [1.0, 2.0], [3.0, 2.0]])
    reference = Reference.from_samples(rows, 10.0)
    assert reference.times.tolist() == [0, 20]
    np.testing.assert_array_equal(reference.sample(10.0), rows)


@pytest.mark.parametrize(
    ("times", "setpoints", "duration", "field"),
    [
        ([0, 10], [[1, 1]], 20, "reference.setpoints"),
        ([0, 10, 10], [[1, 1]] * 3, 20, r"reference.times\[2\]"),
        ([5], [[1, 1]], 20, r"reference.times\[0\]"),
        ([], np.zeros((0, 2)), 20, r"reference.times\[0\]"),
        ([0], [[1, np.nan]], 20, r"reference.setpoints\[0\]\[1\]"),
        ([0, np.inf], [[1, 1]] * 2, 20, r"reference.times\[1\]"),
        ([0, 30], [[1, 1]] * 2, 30, "reference.duration"),
        ([0], [[1, 1]], np.nan, "reference.duration"),
        ([0, 10], [[1, 1], [1]], 20, "reference.setpoints"),
        ([0], [[]], 20, "reference.setpoints"),
    ],
)
def test_a_bad_reference_names_the_field(times, setpoints, duration, field):
    with pytest.raises(InputError, match=field):
        Reference(times, setpoints, duration)


def test_setpoints_shorter_than_the_run_are_refused():
    with pytest.raises(InputError, match="at least 50 s of setpoints for a run of 5 samples"):
        Reference([0], [[1.0]], 40).sample(10.0, samples=5)


# definitions and hashes


def test_the_thesis_definition_is_checked_and_survives_json():
    definition = catalogue.comparison_of("thesis", True, "jax").definition
    definition.check(WELL)
    assert msgspec.json.decode(msgspec.json.encode(definition), type=type(definition)) == definition
    assert [c.structure(WELL).integer_mvs for c in definition.controllers] == [(), (), (0,)]
    weights = {float(c.build_tuning(WELL).move_weight[0]) for c in definition.controllers}
    assert weights == {250.0}


def test_a_definition_names_what_is_wrong():
    with pytest.raises(InputError, match="distinct names"):
        made.definition(controllers=made.CONTROLLERS[:1] * 2).check(WELL)
    with pytest.raises(InputError, match="plant"):
        made.definition(plant="fmy").check(WELL)
    with pytest.raises(InputError, match="one per CV"):
        made.definition(reference=ReferenceDefinition((0.0,), ((1.0,),), 100.0)).check(WELL)
    with pytest.raises(msgspec.ValidationError, match=r"unknown field `tunnig`"):
        msgspec.convert({"name": "a", "tunnig": "thesis"}, ControllerDefinition)


def test_hashes_follow_content_and_nothing_else():
    a = {"x": 1, "y": np.arange(3.0)}
    same = {"y": np.arange(3.0), "x": 1}
    assert fingerprint.content_hash(a) == fingerprint.content_hash(same)
    assert fingerprint.content_hash(a) != fingerprint.content_hash({**a, "y": np.arange(3)})
    assert fingerprint.content_hash(a) != fingerprint.content_hash({**a, "x": 2})
    with pytest.raises(TypeError):
        fingerprint.content_hash(object())


def test_the_source_hash_ignores_comments_and_sees_statements(tmp_path, monkeypatch):
    package = tmp_path / "small_package"
    package.mkdir()
    monkeypatch.syspath_prepend(tmp_path)

    def hash_of(text):
        (package / "__init__.py").write_text(text)
        fingerprint.source_hash.cache_clear()
        return fingerprint.source_hash("small_package")

    first = hash_of('"""Doc."""\nx = 1\n')
    assert hash_of('"""Other words."""\nx = 1  # one\n') == first
    assert hash_of('"""Doc."""\nx = 2\n') != first
    fingerprint.source_hash.cache_clear()


# running


@pytest.fixture
def stubbed(monkeypatch):
    """Replaces the closed loop by made-up runs and counts them."""
    ran = []

    def run(definition, comparison, process, model, make_plant, progress):
        ran.append(definition.name)
        return made.trajectory(made.RUNS[definition.name])

    monkeypatch.setattr(comparison, "run_controller", run)
    return ran


def run_made_up(folder, definition=None, plant="one", lines=None):
    return comparison.run_comparison(
        definition or made.definition(),
        WELL,
        folder,
        model=made.model(),
        make_plant=lambda actuator: None,
        plant_facts={"kind": plant},
        extra=made.extra,
        progress=False,
        say=(lines if lines is not None else []).append,
    )


def test_a_second_run_computes_nothing(tmp_path, stubbed):
    run_made_up(tmp_path)
    assert stubbed == list(made.RUNS)
    lines = []
    run_made_up(tmp_path, lines=lines)
    assert stubbed == list(made.RUNS)
    assert sum("stored already" in line for line in lines) == 3


def test_a_changed_tuning_recomputes_that_controller_only(tmp_path, stubbed):
    run_made_up(tmp_path)
    stubbed.clear()
    changed = msgspec.structs.replace(made.CONTROLLERS[1], tuning="thesis-light")
    run_made_up(tmp_path, made.definition(controllers=(made.CONTROLLERS[0], changed, made.CONTROLLERS[2])))
    assert stubbed == ["step-choke"]
    assert len(list(tmp_path.glob("results-*.zarr"))) == 1


def test_another_plant_recomputes_everything(tmp_path, stubbed):
    run_made_up(tmp_path)
    stubbed.clear()
    run_made_up(tmp_path, plant="two")
    assert stubbed == list(made.RUNS)


def test_an_interrupted_run_keeps_what_was_done(tmp_path, monkeypatch, stubbed):
    run = comparison.run_controller

    def interrupted(definition, *rest):
        if definition.name == "mixed-integer":
            raise KeyboardInterrupt
        return run(definition, *rest)

    monkeypatch.setattr(comparison, "run_controller", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_made_up(tmp_path)
    monkeypatch.setattr(comparison, "run_controller", run)
    stubbed.clear()
    run_made_up(tmp_path)
    assert stubbed == ["mixed-integer"]


def test_bad_requests_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(InputError, match="plant"):
        catalogue.run_thesis("thesis", tmp_path / "out", plant="fmy")
    assert not (tmp_path / "out").exists()


# reports


def test_key_figures_of_the_made_up_runs(results):
    figures = evaluate.key_figures(results)
    hunting = figures.sel(controller="step-choke")
    # ten moves of 2 %, then 2 % every ten samples from sample 30 on: 37 swings
    assert float(hunting.travel.sel(mv="choke")) == pytest.approx(20 + 2 * 37)
    assert hunting.late_reversals.sel(mv="choke").values.tolist() == [9, 9]
    assert reach.reversals_near_closed(results, "step-choke") == 18
    smooth = figures.sel(controller="mixed-integer")
    assert float(smooth.travel.sel(mv="choke")) == 20
    assert smooth.late_reversals.sel(mv="choke").values.tolist() == [0, 0]
    assert float(smooth.shortest_dwell.sel(mv="choke")) == 20
    assert float(smooth.largest_mean_rise.sel(mv="choke")) == pytest.approx(20 / 25)
    assert figures.window.values.tolist() == [0, 2000]
    deviation = smooth.mean_absolute_deviation.sel(cv="gas_rate")
    cos = np.abs(10 * np.cos(np.arange(200) / 5)).sum()
    assert float(deviation) == pytest.approx((cos + 200 * 15_000) / 400)


def test_reach_is_judged_by_the_map_and_deviation_by_the_run(results):
    away = reach.distance_to_reach(results)
    assert away[0] == pytest.approx(0.0, abs=1e-9)  # 100 % choke gives exactly 10000 and 150
    assert away[1] == pytest.approx(30.0)  # oil 300 against at most 150, 5 per half width
    off = evaluate.final_deviation(results, "mixed-integer")
    np.testing.assert_allclose(off[1], [-15.0, -10.0])


def test_verdicts_follow_from_the_numbers(results):
    rows = {claim.statement: claim for claim in claims.claims(results)}
    assert [claim.verdict for claim in rows.values()] == [
        "holds",  # smooth
        "holds",  # rounded oscillates
        "holds",  # below 50 %
        "holds",  # mixed-integer quiet
        "does not hold",  # equal deviations are not smaller
        "holds",  # travel
        "holds",  # stationary
        "holds in part",  # the made-up controller opens above the limit, and pauses
    ]
    swapped = results.assign_coords(controller=results.controller.values)
    swapped = swapped.assign(position=results.position.copy(data=results.position.values[[1, 0, 1]]))
    verdicts = [claim.verdict for claim in claims.claims(swapped)]
    assert verdicts[:4] == ["does not hold", "does not hold", "not tested", "does not hold"]


def test_the_report_holds_every_controller_and_claim(results):
    text = "\n".join(report.markdown(results, evaluate.key_figures(results)))
    for controller in made.CONTROLLERS:
        assert controller.label in text
    assert text.count("\n| ") > 10
    rows = list(csv.DictReader(io.StringIO(report.table_csv(evaluate.key_figures(results)))))
    travel = {
        row["controller"]: row for row in rows if row["key_figure"] == "travel" and row["of"] == "choke"
    }
    assert float(travel["mixed-integer"]["value"]) == 20
    assert travel["mixed-integer"]["unit"] == "%"
    assert {row["of"] for row in rows if row["key_figure"] == "mean_absolute_deviation"} == {
        "gas_rate",
        "oil_rate",
    }


@pytest.mark.parametrize(("study", "statements"), [("thesis", True), ("soft", False)])
def test_the_summary_of_a_study_lies_beside_its_results(stored, results, study, statements):
    paths = write_thesis_summary(stored, study)
    assert paths == [stored / "summary.md", stored / "summary.csv"]
    text = paths[0].read_text()
    assert "| choke travel [%] | " in text
    assert ("the thesis says" in text) == statements
    assert paths[1].read_text() == report.table_csv(evaluate.key_figures(results))


def test_results_without_a_finished_run_are_refused():
    with pytest.raises(InputError, match="no finished run"):
        evaluate.key_figures(made.empty())
