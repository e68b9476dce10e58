"""Instances as folders of case files: what is shipped, what is read, what is said of answers. Nothing here judges a time."""

import dataclasses
import json
import math
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from figures.thesis.solve_time import draw_benchmark
from jaxmpc.cli import main as cli
from jaxmpc.controller.case import case_to_dict
from jaxmpc.errors import InputError
from studies.bench import folder, peers, run
from studies.bench.context import QUICK, Context
from studies.bench.folder import Known, faults, shipped, solve
from studies.bench.forms import lifted
from studies.bench.judge import FEASIBLE, Judge, performance_profile
from studies.bench.problem import objective, violation

SCIP = peers.MIQP_PEERS[0]
CASES, KNOWN = shipped()
SMALL = [name for name in CASES if name.split("_")[0] in ("woodberry", "quadtank", "quadzero", "vinante")]
ONE = "quadtank_moves_1"


def context(*others: peers.Peer) -> Context:
    """With these peers, silently."""
    return Context(QUICK, True, lambda line: None, (), others)


@pytest.fixture
def few(tmp_path):
    """A folder of two instances with their optima."""
    names = (ONE, "woodberry_both_1")
    known = {name: KNOWN[name] for name in names}
    folder.write(tmp_path, {name: case_to_dict(CASES[name]) for name in names}, known)
    return tmp_path


def table(path) -> dict:
    """The content of ``truth.json``."""
    return json.loads((path / "truth.json").read_text())


# ------------------------------------------------------------------------------------------ what is shipped


def test_every_machine_writes_the_same_files(tmp_path):
    for name in ("one", "two"):
        assert cli.main(["bench", "--write", str(tmp_path / name)]) == 0
    written = [sorted(path for path in (tmp_path / name).rglob("*.json")) for name in ("one", "two")]
    assert len(written[0]) == len(CASES) + 1
    for one, two in zip(*written, strict=True):
        assert one.name == two.name
        assert one.read_bytes() == two.read_bytes()
    assert sum(path.stat().st_size for path in written[0]) < 1e6


def test_what_is_written_reads_back(tmp_path):
    run.write_instances(tmp_path)
    for given in (tmp_path, tmp_path / "cases"):
        cases, known = folder.read(given)
        assert set(cases) == set(CASES)
        assert known == KNOWN
        for name, case in cases.items():
            assert case_to_dict(case) == case_to_dict(CASES[name])


@pytest.mark.parametrize("name", CASES)
def test_the_plan_in_the_table_is_feasible_and_costs_what_it_says(name):
    case, known = case_to_dict(CASES[name]), KNOWN[name]
    assert violation(case, known.moves) <= FEASIBLE
    assert objective(case, known.moves) == pytest.approx(known.objective, rel=1e-9)
    assert known.bound <= known.objective
    assert known.open == (len(known.certified) < 2)
    if not known.open:
        assert known.certified[0] == "jaxmpc"


def test_most_optima_are_certified():
    assert set(KNOWN) == set(CASES)
    assert sum(known.optimum is not None for known in KNOWN.values()) >= 0.8 * len(KNOWN)


@pytest.mark.parametrize("name", SMALL)
def test_the_certified_optimum_of_a_small_instance_is_found(name):
    case = CASES[name]
    _, plan = solve(case, 60.0)
    assert plan.status == "optimal"
    assert faults(case_to_dict(case), KNOWN[name], plan) == []


# --------------------------------------------------------------------------------- what is said of answers


def test_a_folder_is_solved_and_every_answer_is_told(few, tmp_path, capsys):
    out = tmp_path / "rows.json"
    assert cli.main(["bench", "--quick", "--read", str(few), "--json", str(out)]) == 0
    text = capsys.readouterr().out
    assert "known" in text
    assert "rate /s" not in text  # a column without an entry
    rows = json.loads(out.read_text())["rows"]
    assert [row["name"] for row in rows] == [ONE, "woodberry_both_1"]
    for row in rows:
        found, known = row["found"], KNOWN[row["name"]]
        assert found["status"] == "optimal"
        assert found["certified"]
        assert found["best"] == known.objective == pytest.approx(found["objective"], rel=1e-6)
        assert found["gap"] <= 1e-6
        assert found["finished_by"]
        assert row["seconds"] > 0


@pytest.mark.parametrize(
    ("factor", "words"), [(1.01, "better than the certified"), (0.99, "best plan known is better")]
)
def test_a_wrong_entry_of_the_table_ends_with_an_error(few, factor, words, capsys):
    body = table(few)
    body[ONE]["objective"] *= factor
    (few / "truth.json").write_text(json.dumps(body))
    assert cli.main(["bench", "--quick", "--read", str(few)]) == 1
    assert words in capsys.readouterr().out


def test_a_folder_without_a_table_is_solved_too(few):
    (few / "truth.json").unlink()
    report = run.run_bench(folder=few, quick=True, say=lambda line: None)
    assert [row.counts for row in report.rows] == [True, True]
    assert not any(row.found.certified for row in report.rows)


def test_claims_that_do_not_hold_are_faults():
    case, known = case_to_dict(CASES[ONE]), KNOWN[ONE]
    best, moves = known.objective, np.array(known.moves)
    right = SimpleNamespace(status="optimal", moves=moves, objective=best, bound=best)

    def said(**changes) -> str:
        return "; ".join(faults(case, known, SimpleNamespace(**{**vars(right), **changes})))

    worse = moves * 0.0
    cost = objective(case, worse)
    assert cost > 1.001 * best
    assert said() == ""
    assert said(status="limit", moves=worse, objective=cost, bound=0.0) == ""
    assert "the best plan known is better" in said(moves=worse, objective=cost)
    assert "the plan costs" in said(status="limit", moves=worse, objective=best)
    assert "the bound is above" in said(status="limit", bound=1.001 * best)
    assert "hard constraints" in said(moves=moves + 100.0)
    assert "infeasible, but" in said(status="infeasible", moves=None, objective=None, bound=None)
    assert faults(case, Known(infeasible=True), right) == ["there is no plan"]
    assert faults(case, Known(open=True), right) == []
    assert faults(case, Known(objective=2 * best, open=True), right) == []  # better than what was known


def test_a_case_that_is_refused_is_named_with_its_file(few, capsys):
    path = few / "cases" / f"{ONE}.json"
    body = json.loads(path.read_text())
    body["tuning"]["cv_weight"] = [1.0]
    path.write_text(json.dumps(body))
    assert cli.main(["bench", "--read", str(few)]) == 2
    said = capsys.readouterr().err
    assert f"{ONE}.json: tuning.cv_weight" in said
    assert said.count("\n") == 1


def test_what_is_no_folder_of_instances_is_refused(few, tmp_path):
    with pytest.raises(InputError, match="a folder with case files"):
        folder.read(tmp_path / "nowhere")
    (few / "truth.json").write_text('{"a": {"objective": "low"}}')
    with pytest.raises(InputError, match="optima by the name"):
        folder.read(few)
    assert cli.main(["bench", "--certify"]) == 2
    assert cli.main(["bench", "--write", str(tmp_path), "--only", "loop"]) == 2


# ----------------------------------------------------------------------------------------------- certifying


def test_an_optimum_that_two_solvers_prove_is_certified(few):
    body = table(few)
    report = run.run_bench(folder=few, quick=True, certify=True, peers=((), (SCIP,)), say=lambda line: None)
    assert all(row.counts for row in report.rows)
    for name, entry in table(few).items():
        assert entry["objective"] == pytest.approx(body[name]["objective"], rel=1e-7)
        assert [who.split()[0] for who in entry["certified"]] == ["jaxmpc", "SCIP"]
        assert "open" not in entry


def test_an_optimum_that_one_solver_proves_is_open():
    def broken(tolerance, seconds):
        raise RuntimeError("model too large for the licence")

    def stopped(tolerance, seconds):
        right = SCIP.begin(tolerance, seconds)
        return lambda form: dataclasses.replace(right(form), status="limit")

    for begin in (broken, stopped):
        other = dataclasses.replace(SCIP, begin=begin)
        known = folder.certified(context(other), CASES[ONE])
        assert known.certified == ["jaxmpc"]
        assert known.open
        assert known.optimum is None
        assert known.objective == pytest.approx(KNOWN[ONE].objective, rel=1e-7)


@pytest.mark.parametrize("own", [{"integer_horizon": 2}, {"blocks": {"pump 1": [8], "pump 2": [1, 7]}}])
def test_structures_that_other_solvers_are_not_given_are_refused(own):
    case = case_to_dict(CASES[ONE])
    case["structure"] |= own
    with pytest.raises(InputError, match="no integer_horizon"):
        lifted(case)


@pytest.mark.parametrize("own", [{"integer_values": {"pump 1": [0, 1, 4]}}, {"dwell": {"pump 1": 3}}])
def test_lists_and_dwells_that_other_solvers_do_not_know_are_refused(own):
    case = case_to_dict(CASES[ONE])
    case["structure"] |= own
    with pytest.raises(InputError, match="for other solvers"):
        lifted(case)


def test_a_certified_optimum_is_what_plans_are_judged_by():
    case, known = case_to_dict(CASES[ONE]), KNOWN[ONE]
    judge = Judge([case, case], [known.objective * 1.01, None])
    judge.hear("ours", [np.array(known.moves)] * 2)
    assert judge.errors("ours")[0] == pytest.approx(0.01 / 1.01)  # a table that is too high is seen
    assert judge.errors("ours")[1] == 0.0


# -------------------------------------------------------------------------------------- performance profile


def test_a_performance_profile_has_the_numbers_of_its_definition():
    seconds = {
        "quick": [1.0, 2.0, 4.0, None],
        "steady": [2.0, 2.0, 1.0, math.inf],
        "never": [math.inf, None, math.nan, math.inf],
    }
    found = performance_profile(seconds)
    np.testing.assert_array_equal(found["quick"][0], [1.0, 1.0, 4.0])
    np.testing.assert_array_equal(found["quick"][1], [0.25, 0.5, 0.75])  # nobody solves the last
    np.testing.assert_array_equal(found["steady"][0], [1.0, 1.0, 2.0])
    assert [len(values) for values in found["never"]] == [0, 0]


def test_performance_profiles_are_drawn(tmp_path):
    series = {"foreign": {"jaxmpc": [0.1, 0.2, 3.0], "SCIP": [1.0, 5.0, None], "Gurobi": [None, None, None]}}
    paths = draw_benchmark({"rows": [], "series": series}, tmp_path)
    assert {path.name for path in paths} == {"bench_performance_profile.png", "bench_performance_profile.pdf"}
    assert all(path.stat().st_size > 5000 for path in paths)


def test_the_table_has_nothing_but_what_it_means():
    body = msgspec.json.decode(folder.OPTIMA.read_bytes())
    fields = {field.name for field in msgspec.structs.fields(Known)}
    assert all(set(entry) <= fields for entry in body.values())
