"""The benchmark: what is recorded, how rows are judged, and what a run leaves behind. Nothing here judges a time."""

import dataclasses
import json

import numpy as np
import pytest

from figures.thesis.solve_time import draw_benchmark
from identify.step_test import identify_step_response
from jaxmpc.cli import main as cli
from jaxmpc.cli.options import parser as make_parser
from jaxmpc.controller.case import case_to_dict, make_case
from jaxmpc.controller.plan import Planner
from jaxmpc.errors import InputError
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant
from studies.bench import forms, instances, peers, rows, run
from studies.bench.context import Context, Size
from studies.bench.instances import Recordings, replay
from studies.bench.judge import Judge
from studies.bench.problem import objective
from tests import problems
from tests.oracles import steps as oracles

MODE = "inputs"
TINY = Size(
    modes=(MODE,),
    run=25,
    relaxed=3,
    exact=2,
    lanes=3,
    batches=(2,),
    cut_off=2.0,
    growth=(("blocks", (4,)),),
)
PIQP = peers.QP_PEERS[0]
ROW_KEYS = {
    "name",
    "section",
    "status",
    "instances",
    "solved",
    "median_ms",
    "p99_ms",
    "rate",
    "seconds",
    "megabytes",
    "ratio",
    "ratio_to",
    "ratio_is_lower_bound",
    "worst_error",
    "counts",
    "goals",
    "note",
    "found",
}


@pytest.fixture(scope="module")
def model():
    return identify_step_response(WellPlant())


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A cache of recordings of its own; compiled programs stay where they are."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(instances, "cache_folder", lambda kind: folder)
        yield folder


@pytest.fixture
def reference():
    return Reference([0.0, 100.0], [[11013.0, 185.0], [9640.0, 152.0]], 400.0)


def peer(name: str, **changes) -> peers.Peer:
    """PIQP under another name."""
    return dataclasses.replace(PIQP, name=name, **changes)


def wrong(tolerance, seconds):
    """A solver that is off by a thousandth and says it is optimal."""
    right = PIQP.begin(tolerance, seconds)

    def solve(form):
        answer = right(form)
        return dataclasses.replace(answer, z=answer.z * 0.999)

    return solve


def measure(only: str, qp=(PIQP,), miqp=(), **options) -> rows.Report:
    """A run of the smallest size, silently."""
    return run.run_bench(only=only, size=TINY, quick=True, peers=(qp, miqp), say=lambda line: None, **options)


# --------------------------------------------------------------------------------------------- forms and judge


@pytest.mark.parametrize("situation", ["step", "saturated"])
@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_every_form_of_a_problem_has_the_optimum_of_the_full_form(situation, blocking):
    case = problems.thesis_case(np.random.default_rng(2), situation, blocking=blocking)
    case["structure"]["integer_step"], case["tuning"]["oscillation_rows"] = {}, {}
    wanted = oracles.solve_qp(case, "piqp").objective
    for build in (forms.lifted, forms.dense, lambda case: forms.dense(case).scaled()):
        form = build(case)
        answer = peers.clarabel(1e-10, 10.0)(form)
        assert objective(case, form.moves(answer.z)) == pytest.approx(wanted, rel=1e-8)


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_whole_moves_of_a_form_are_those_of_the_oracle(blocking):
    rng = np.random.default_rng(4)
    case = problems.small_case(rng, blocks=[1, 1, 2, 2], blocking=blocking)
    wanted = oracles.brute_force(case)
    for begin, build in ((peers.scip, forms.lifted), (peers.daqp, forms.dense)):
        form = build(case)
        answer = begin(1e-8, 20.0)(form)
        assert answer.status == "optimal"
        moves = form.moves(answer.z)
        assert oracles.violation(case, moves) < 1e-6
        assert objective(case, moves) == pytest.approx(wanted.objective, rel=1e-5)


def test_the_limit_of_the_first_move_alone_holds_for_the_first_move_alone():
    case = problems.small_case(np.random.default_rng(3), blocks=[1, 1, 2, 2], integer={})
    free = forms.lifted(case)
    first = free.moves(peers.piqp(1e-9, 10.0)(free).z)[0]
    case["first_move_high"] = [0.0 if move > 0 else np.inf for move in first]
    case["first_move_low"] = [0.0 if move < 0 else -np.inf for move in first]
    held = forms.lifted(case)
    moves = held.moves(peers.piqp(1e-9, 10.0)(held).z)
    assert np.abs(moves[0]).max() < 1e-6 < np.abs(moves[1:]).max()
    assert oracles.violation(case, moves) < 1e-7 < oracles.violation(case, np.vstack([first, moves[1:]]))


def test_a_plan_is_judged_against_the_best_feasible_one():
    case = problems.small_case(np.random.default_rng(5), blocks=[1, 1, 2, 2], integer={})
    form = forms.lifted(case)
    best = form.moves(peers.piqp(1e-10, 10.0)(form).z)
    judge = Judge([case, case])
    judge.hear("good", [best, None])
    judge.hear("worse", [best * 0.9, best])
    judge.hear("outside its limits", [best + 100.0], at=[1])
    assert judge.errors("good")[0] == 0.0
    assert np.isnan(judge.errors("good")[1])
    assert judge.errors("worse")[0] > 1e-6
    assert judge.errors("worse")[1] == 0.0
    assert judge.errors("outside its limits")[0] > 1e-6


# ------------------------------------------------------------------------------------------------- recordings


@pytest.mark.slow
def test_a_replayed_sample_is_the_problem_that_the_controller_solved(model, reference, cache):
    recordings = Recordings(model, reference, 20)
    recording = recordings.live("mixed-integer", MODE)
    controller = instances.make_controller("mixed-integer", MODE, model)
    replayed = replay(controller, recording)
    np.testing.assert_allclose(replayed.mv_now[1:], recording.mv_demand[:-1], rtol=1e-12)
    np.testing.assert_allclose(replayed.last_move[1:], recording.move[:-1])
    planner = Planner(controller.structure, controller.tuning, model)
    for k in (12, 15):
        plan = planner.solve(**replayed.at(k), recover=True)
        np.testing.assert_allclose(plan.moves[0], recording.move[k], atol=1e-4 * 200)


def test_a_recording_is_made_once_and_read_again(model, reference, cache, monkeypatch):
    first = Recordings(model, reference, 20).instances("continuous", MODE, 4)
    assert len(first) == 4
    monkeypatch.setattr(instances, "simulate", lambda *a, **k: pytest.fail("the loop ran again"))
    again = Recordings(model, reference, 20).instances("continuous", MODE, 4)
    np.testing.assert_array_equal(first.sample, again.sample)
    np.testing.assert_array_equal(first.now.free_response, again.now.free_response)
    assert np.isin(again.sample, np.arange(2, 20)).all()


def test_another_model_reference_length_or_mode_is_another_recording(model, reference, cache):
    other = dataclasses.replace(model, coefficients=model.coefficients * 1.001)
    shifted = Reference([0.0, 110.0], [[11013.0, 185.0], [9640.0, 152.0]], 400.0)
    one = Recordings(model, reference, 20)
    assert one.path("continuous", MODE) == Recordings(model, reference, 20).path("continuous", MODE)
    paths = {
        one.path("continuous", MODE),
        one.path("continuous", "moves"),
        one.path("mixed-integer", MODE),
        Recordings(other, reference, 20).path("continuous", MODE),
        Recordings(model, shifted, 20).path("continuous", MODE),
        Recordings(model, reference, 21).path("continuous", MODE),
    }
    assert len(paths) == 6


def test_a_damaged_recording_is_made_again_and_named(model, reference, cache, capsys):
    recordings = Recordings(model, reference, 8)
    path = recordings.path("continuous", MODE)
    made = recordings.kept("continuous", MODE)
    assert len(made.cv) == 8
    sound = path.read_bytes()
    for content in (b"half a file", sound[:-100], sound.replace(b"PK", b"KP"), bytes(len(sound))):
        path.write_bytes(content)
        capsys.readouterr()
        assert instances._load(path) is None
        assert capsys.readouterr().err == f"jaxmpc: {path} is damaged; it is made anew\n"
    again = Recordings(model, reference, 8).kept("continuous", MODE)
    np.testing.assert_array_equal(instances._load(path).cv, again.cv)


# ---------------------------------------------------------------------------------------------- rows and runs


def test_a_wrong_peer_is_flagged_and_a_missing_one_is_named(cache, tmp_path):
    path = tmp_path / "new" / "bench.json"
    absent = peer("Nowhere", package="no-such-solver")
    report = measure("relaxed", (PIQP, peer("Liar", begin=wrong), absent), json_path=path)
    assert report.complete
    found = {row.name.partition(": ")[2]: row for row in report.rows}
    assert found["PIQP sparse"].counts
    assert found["jaxmpc warm"].counts
    assert found["jaxmpc cold"].solved == 3
    assert found["Liar"].worst_error > 1e-6
    assert not found["Liar"].counts
    assert found["Nowhere"].status == "missing"
    assert "no-such-solver is not installed" in found["Nowhere"].note
    assert run.wrong(report) == ["relaxed QP, inputs: Liar"]  # not one of the known peers: taken for ours
    text = rows.table(report)
    assert "! does not count" in text
    assert "missing" in text
    assert "no-such-solver is not installed" in text
    body = json.loads(path.read_text())
    assert body["complete"] is True
    assert {"python", "jax", "cores", "device"} <= set(body["machine"])
    assert all(set(row) == ROW_KEYS for row in body["rows"])
    (warm,) = [row for row in body["rows"] if row["name"].endswith("warm")]
    assert [goal["quantity"] for goal in warm["goals"]] == ["ratio"]
    assert isinstance(warm["goals"][0]["met"], bool)
    assert warm["ratio_to"] == "PIQP sparse"


def test_exact_rows_are_judged_beside_a_peer_that_cannot_be_used(cache):
    def unlicensed(tolerance, seconds):
        raise RuntimeError("model too large for the licence")

    broken = peer("Costly", begin=unlicensed)
    report = measure("exact", (), (broken,))
    assert report.complete
    found = {row.name.partition(": ")[2]: row for row in report.rows}
    assert found["Costly"].status == "failed"
    assert "licence" in found["Costly"].note
    assert found["jaxmpc"].counts
    assert found["jaxmpc, HiGHS finish"].worst_error <= 1e-6
    assert [goal.quantity for goal in found["jaxmpc"].goals] == ["median_ms", "p99_ms", "ratio"]
    assert found["jaxmpc"].goals[2].met(found["jaxmpc"]) is None  # nobody to be faster than


@pytest.mark.slow
def test_batches_have_rates_and_figures(cache, tmp_path):
    report = measure("batch,growth")
    assert [row.section for row in report.rows] == ["batch", "batch", "growth"]
    assert all(row.counts and row.rate > 0 and row.ratio > 0 for row in report.rows)
    assert report.series["batch inputs"]["batch"] == [2]
    report.series["run mixed-integer moves"] = {"solve_ms": [1.0, 30.0, 2.0]}
    paths = draw_benchmark(json.loads(report.to_json()), tmp_path)
    assert {path.name for path in paths} == {
        f"{name}.{kind}"
        for name in ("figure_39_time_per_sample", "bench_rate_over_batch")
        for kind in ("png", "pdf")
    }
    assert draw_benchmark({"rows": [], "series": {}}, tmp_path / "none") == []
    with pytest.raises(InputError, match="benchmark results"):
        draw_benchmark(tmp_path / "none.json", tmp_path)


def test_the_foreign_section_has_a_row_per_solver_and_their_times():
    tiny = dataclasses.replace(TINY, foreign=("quadtank",), cut_off=60.0)
    scip = peers.MIQP_PEERS[0]
    lost = dataclasses.replace(
        peer("Lost", bounds=True),
        build=forms.lifted,
        begin=lambda *_: lambda form: peers.PeerAnswer("limit", seconds=1.0),
    )
    report = run.run_bench(
        only="foreign", size=tiny, peers=((), (scip, lost, peer("No bounds"))), say=lambda line: None
    )
    assert report.complete
    assert run.wrong(report) == []
    found = {row.name.partition(": ")[2]: row for row in report.rows}
    assert list(found) == ["jaxmpc", "jaxmpc, HiGHS finish", "SCIP", "Lost"]
    assert (found["jaxmpc"].solved, found["jaxmpc"].instances) == (2, 2)
    assert found["SCIP"].worst_error <= 1e-6
    assert found["Lost"].solved == 0
    assert {name: len(times) for name, times in report.series["foreign"].items()} == dict.fromkeys(found, 2)
    assert np.isinf(report.series["foreign"]["Lost"]).all()


def test_recorded_samples_are_case_files(model, reference, cache):
    recorded = Recordings(model, reference, 20).instances("continuous", MODE, 4)
    files = recorded.files()
    assert set(files) == {f"well_{MODE}_{sample}" for sample in recorded.sample}
    for body in files.values():
        assert case_to_dict(make_case(json.loads(json.dumps(body)))) == body


def test_a_row_without_a_measurement_meets_nothing_and_a_wrong_one_misses():
    goal = rows.Goal("median_ms", 10.0)
    good = rows.timed("a", [1e-3], [0.0], goals=(goal,))
    assert goal.met(good) is True
    assert goal.met(rows.timed("a", [1e-3], [1e-3])) is False
    assert goal.met(rows.timed("a", [1.0], [0.0])) is False
    assert goal.met(rows.Row(name="a", status="not measured")) is None
    ratio = rows.Goal("ratio", 1000.0)
    cut_off = rows.timed("a", [1e-3], [0.0], ratio=500.0, ratio_is_lower_bound=True)
    assert ratio.met(cut_off) is None
    unsolved = rows.timed("a", [1.0], [np.nan])
    assert (unsolved.solved, unsolved.worst_error, unsolved.counts) == (0, None, False)


def test_an_interrupt_leaves_the_rows_so_far(tmp_path, monkeypatch):
    def stopped(context: Context):
        yield rows.timed("done", [1e-3], [0.0])
        raise KeyboardInterrupt

    monkeypatch.setitem(run.SECTIONS, "relaxed", stopped)
    monkeypatch.setitem(run.SECTIONS, "batch", lambda context: pytest.fail("went on"))
    path = tmp_path / "bench.json"
    kept = []
    with pytest.raises(KeyboardInterrupt):
        measure("relaxed,batch", json_path=path, stopped=kept.append)
    body = json.loads(path.read_text())
    assert body["complete"] is False
    assert [row["name"] for row in body["rows"]] == ["done"]
    (report,) = kept
    assert not report.complete
    assert "Not complete" in rows.table(report)


def test_an_error_ends_its_section_alone(monkeypatch):
    def broken(context: Context):
        yield rows.timed("done", [1e-3], [0.0])
        raise ValueError("no such thing")

    monkeypatch.setitem(run.SECTIONS, "relaxed", broken)
    monkeypatch.setitem(run.SECTIONS, "batch", lambda context: iter([rows.timed("next", [1.0], [0.0])]))
    report = measure("relaxed,batch")
    assert [row.name for row in report.rows] == ["done", "relaxed: ended early", "next"]
    assert not report.complete
    assert run.wrong(report) == ["relaxed: ended early"]


@pytest.mark.parametrize("only", ["speed", "relaxed,", ""])
def test_an_unknown_section_is_refused_before_anything_is_measured(only, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "machine", lambda *a: pytest.fail("it started"))
    out = tmp_path / "bench.json"
    assert cli.main(["bench", "--only", only, "--json", str(out)]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "growth" in captured.err
    assert not out.exists()


def test_the_command_prints_the_table_and_tells_by_its_status_whether_it_came_to_its_end(monkeypatch, capsys):
    row = rows.timed("done", [1e-3], [0.0])
    monkeypatch.setitem(run.SECTIONS, "relaxed", lambda context: iter([row]))
    assert cli.main(["bench", "--only", "relaxed"]) == 0
    assert "done" in capsys.readouterr().out
    monkeypatch.setitem(
        run.SECTIONS, "relaxed", lambda context: iter([dataclasses.replace(row)] if 0 else [wrong_row()])
    )
    assert cli.main(["bench", "--only", "relaxed"]) == 1


def wrong_row() -> rows.Row:
    return rows.timed("relaxed QP, moves: jaxmpc warm", [1e-3], [1.0])


def test_the_sections_that_the_help_names_are_those_there_are():
    parser = make_parser(cli.COMMANDS)
    text = parser._subparsers._group_actions[0].choices["bench"].format_help()
    assert ", ".join(run.SECTIONS) in " ".join(text.split())
