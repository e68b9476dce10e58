"""The command line: exit status, what is printed and written, and that bad input leaves no trace."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from jaxmpc.cli.main import main
from jaxmpc.errors import InputError, MissingToolError, PlantError
from tests import problems
from tests.oracles import steps as oracles

FIELDS = [
    "status",
    "objective",
    "bound",
    "gap",
    "moves",
    "mv",
    "cv",
    "eps_high",
    "eps_low",
    "nodes",
    "solve_time_s",
    "finished_by",
]


def case_body(*twists: str, seed: int = 1) -> dict:
    """Two CVs, two MVs, Hp = 8, Hu = 6 in four blocks."""
    rng = np.random.default_rng(seed)
    body = problems.small_case(rng, blocks=[1, 1, 2, 2])
    for name in twists:
        problems.TWISTS[name](body, rng)
    return body


@pytest.fixture
def write(tmp_path):
    """Write a case file and return its path as text."""

    def to_file(body) -> str:
        path = tmp_path / "case.json"
        path.write_text(body if isinstance(body, str) else json.dumps(body))
        return str(path)

    return to_file


def answer(**fields) -> SimpleNamespace:
    """What `solve_plan` might return."""
    plan = dict.fromkeys(FIELDS) | {"status": "optimal", "objective": 1.0, "nodes": 1, "solve_time_s": 0.1}
    return SimpleNamespace(**(plan | fields))


@pytest.fixture
def stub(monkeypatch):
    """Replace a module that a command imports."""

    def replace(name: str, **functions):
        module = ModuleType(name)
        module.__dict__.update(functions)
        monkeypatch.setitem(sys.modules, name, module)
        package, _, leaf = name.rpartition(".")
        if package in sys.modules:
            monkeypatch.setattr(sys.modules[package], leaf, module, raising=False)

    return replace


@pytest.fixture
def unsolved(stub):
    """A solver that must not be called."""

    def refuse(*_, **__):
        raise AssertionError("the solver was called")

    stub("jaxmpc.controller.plan", solve_plan=refuse)


# ------------------------------------------------------------------------------------------------------- plan


def test_an_optimal_plan_is_printed_as_json_with_the_fields_and_shapes_of_the_interface(write, capsys):
    body = case_body()
    assert main(["plan", write(body)]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert list(plan) == FIELDS
    assert plan["status"] == "optimal"
    for key, shape in (
        ("moves", (4, 2)),
        ("mv", (6, 2)),
        ("cv", (8, 2)),
        ("eps_high", (2,)),
        ("eps_low", (2,)),
    ):
        assert np.shape(plan[key]) == shape
    assert isinstance(plan["nodes"], int)
    assert plan["solve_time_s"] > 0
    assert plan["finished_by"] in ("relaxation", "fixing", "enumeration", "highs", "branch-and-bound")
    assert oracles.complaints(body, SimpleNamespace(**plan), oracles.brute_force(body)) == []


def test_a_plan_is_written_to_a_file_in_a_new_folder_and_not_printed(write, tmp_path, capsys):
    out = tmp_path / "new" / "plan.json"
    assert main(["plan", write(case_body()), "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "optimal" in captured.err
    assert list(json.loads(out.read_text())) == FIELDS


def test_an_infeasible_case_has_its_own_exit_status_and_a_plan_that_says_so(write, tmp_path, capsys):
    out = tmp_path / "plan.json"
    path = write(case_body("forced_moves_beyond_the_limit"))
    assert main(["plan", path]) == 3
    printed = json.loads(capsys.readouterr().out)
    assert main(["plan", path, "--out", str(out)]) == 3
    assert json.loads(out.read_text())["status"] == printed["status"] == "infeasible"
    assert printed["objective"] is None
    assert printed["finished_by"] is None


@pytest.mark.parametrize(
    ("plan", "status"),
    [
        (answer(), 0),
        (answer(status="infeasible", objective=None), 3),
        (answer(status="limit", objective=2.0, bound=1.0, gap=0.5), 4),
        (answer(status="limit", objective=None), 1),
        (answer(status="failed", objective=None), 1),
        (answer(status="failed", objective=float("nan")), 1),
    ],
)
def test_the_exit_status_tells_how_the_solve_ended(plan, status, write, stub, capsys):
    stub("jaxmpc.controller.plan", solve_plan=lambda *_, **__: plan)
    assert main(["plan", write(case_body())]) == status
    assert json.loads(capsys.readouterr().out)["status"] == plan.status


def test_the_options_and_limits_of_a_case_reach_the_solver(write, stub, capsys):
    given = {}
    stub("jaxmpc.controller.plan", solve_plan=lambda *_, **options: given.update(options) or answer())
    body = case_body("plausible_start")
    body["limits"] = {"time_s": 2.5, "gap": 1e-3}
    for finish in ("auto", "enumeration", "highs", "branch-and-bound"):
        assert main(["plan", write(body), "--finish", finish]) == 0
        assert given["finish"] == finish
    assert (given["time_limit"], given["gap"]) == (2.5, 1e-3)
    assert given["previous_moves"].tolist() == body["previous_moves"]
    assert main(["plan", write(case_body())]) == 0
    assert (given["finish"], given["time_limit"], given["gap"], given["previous_moves"]) == (
        "auto",
        None,
        1e-6,
        None,
    )


@pytest.mark.parametrize(
    ("body", "word"),
    [
        ("{", "JSON"),
        ("[1, 2]", "an object"),
        (case_body() | {"mv_now": [0.0]}, "mv_now"),
        (case_body() | {"typo": 1}, "typo"),
        (json.dumps(case_body()).replace('"dt": 10.0', '"dt": NaN'), "model.dt"),
    ],
    ids=["syntax", "no object", "shape", "unknown", "NaN"],
)
def test_bad_input_ends_with_one_line_and_leaves_no_trace(body, word, write, tmp_path, unsolved, capsys):
    path, old, new = write(body), tmp_path / "old.json", tmp_path / "folder" / "new.json"
    old.write_text("untouched")
    for out in (old, new):
        assert main(["plan", path, "--out", str(out)]) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert word in captured.err
    assert old.read_text() == "untouched"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["case.json", "old.json"]


def test_a_missing_case_file_is_bad_input(tmp_path, unsolved, capsys):
    assert main(["plan", str(tmp_path / "none.json")]) == 2
    assert "none.json" in capsys.readouterr().err


def test_an_output_that_cannot_be_written_is_refused_before_the_solve(write, tmp_path, unsolved, capsys):
    path = write(case_body())
    (tmp_path / "file").write_text("")
    for out in (tmp_path, tmp_path / "file" / "plan.json", tmp_path / "file" / "deep" / "plan.json"):
        assert main(["plan", path, "--out", str(out)]) == 2
        assert "--out" in capsys.readouterr().err
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["case.json", "file"]


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["plan"],
        ["plan", "a.json", "b.json"],
        ["plan", "a.json", "--finish", "cplex"],
        ["plan", "a.json", "--fin", "auto"],
        ["simulate"],
        ["fmu"],
        ["fmu", "build", "--fmi", "1"],
        ["identify", "--samples", "many"],
        ["study", "run"],
        ["bench", "relaxed"],
    ],
)
def test_unknown_commands_and_options_are_bad_input(arguments, unsolved, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "error:" in captured.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["plan", "fmu", "identify", "study", "bench"]),
        (["plan"], ["--out", "standard output", "--finish", "default: auto", "3 infeasible"]),
        (["fmu", "build"], ["--fmi", "default: 2"]),
        (["identify"], ["MV=VALUE", "default: the first", "[samples]", "default: model.json"]),
        (["study", "run", "thesis"], ["default: results", "--quick", "default: that of the study"]),
        (["bench"], ["--quick", "default: all", "default: nowhere", "[ms]", "jaxmpc[bench]", "Ctrl-C"]),
    ],
)
def test_help_shows_defaults_and_units(arguments, words, capsys):
    with pytest.raises(SystemExit) as caught:
        main([*arguments, "--help"])
    assert caught.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for word in words:
        assert word in text


def test_the_installed_command_plans_and_its_help_loads_no_solver(write):
    code = (
        "import sys; from jaxmpc.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'highspy', 'fmpy', 'xarray', 'matplotlib', 'equinox', 'jaxmpc.controller.plan'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    helped = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (helped.returncode, helped.stderr) == (0, "")
    run = [sys.executable, "-m", "jaxmpc.cli", "plan", write(case_body() | {"typo": 1})]
    refused = subprocess.run(run, capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr.count("\n") == 1


# ----------------------------------------------------------------------------------------- the other commands


def test_a_missing_tool_ends_with_one_line_and_status_one(stub, capsys):
    def build_fmu(**_):
        raise MissingToolError("no C compiler:\ninstall gcc")

    stub("identify.well_fmu", build_fmu=build_fmu)
    assert main(["fmu", "build"]) == 1
    assert capsys.readouterr().err == "jaxmpc: no C compiler: install gcc\n"


def test_a_plant_that_fails_ends_with_one_line_and_status_one(stub, tmp_path, capsys):
    def crash(*_):
        raise PlantError("well.fmu: the FMU ended its process with signal SIGABRT during doStep at t = 10 s")

    stub(
        "identify.plants", closing=contextlib.nullcontext, identified=crash, open_plant=lambda *_, **__: None
    )
    assert main(["identify", "--plant", "jax", "--out", str(tmp_path / "model.json")]) == 1
    assert capsys.readouterr().err == (
        "jaxmpc: well.fmu: the FMU ended its process with signal SIGABRT during doStep at t = 10 s\n"
    )
    assert not list(tmp_path.iterdir())


def test_fmu_build_prints_where_the_fmu_is(stub, tmp_path, capsys):
    given = {}
    stub("identify.well_fmu", build_fmu=lambda **options: given.update(options) or "well.fmu")
    assert main(["fmu", "build", "--fmi", "3", "--out", str(tmp_path / "x.fmu")]) == 0
    assert capsys.readouterr().out == "well.fmu\n"
    assert given == {"fmi": 3, "out": tmp_path / "x.fmu"}


def test_identify_writes_a_model_that_says_where_it_comes_from(tmp_path, capsys):
    out = tmp_path / "model.json"
    options = ["--at", "choke=40", "--at", "gas_lift=7000", "--step", "gas_lift=50", "--samples", "20"]
    assert main(["identify", *options, "--out", str(out)]) == 0
    model = json.loads(out.read_text())
    assert (model["working_point"]["choke"], model["working_point"]["gas_lift"]) == (40.0, 7000.0)
    assert model["provenance"]["steps"] == [2.0, 50.0]
    assert np.shape(model["coefficients"]) == (2, 2, 20)
    assert "had not settled by sample 20" in capsys.readouterr().err


def test_identify_refuses_a_working_point_outside_the_well(tmp_path, capsys):
    out = tmp_path / "model.json"
    assert main(["identify", "--plant", "jax", "--at", "choke=101", "--out", str(out)]) == 2
    assert "choke" in capsys.readouterr().err
    assert not out.exists()


def test_the_thesis_study_gets_its_options_and_bad_ones_are_reported(stub, tmp_path, capsys):
    given = []
    stub(
        "studies.thesis.catalogue",
        STUDIES=("thesis",),
        run_thesis=lambda *options: given.append(options) or tmp_path / "r" / "thesis",
    )
    stub("figures.registry", draw_study=lambda *options: given.append(options))
    stub("studies.thesis.report", write_thesis_summary=lambda *options: given.append(options))
    assert main(["study", "run", "thesis", "--out", str(tmp_path / "r"), "--quick", "--plant", "jax"]) == 0
    assert given == [("thesis", tmp_path / "r", True, "jax"), *2 * [(tmp_path / "r" / "thesis", "thesis")]]
    assert str(tmp_path / "r" / "thesis" / "summary.md") in capsys.readouterr().out

    def refuse(*_):
        raise InputError("reference.duration", 10, "at least 20 s")

    stub("studies.thesis.catalogue", STUDIES=("thesis",), run_thesis=refuse)
    assert main(["study", "run", "thesis", "--out", str(tmp_path / "r")]) == 2
    assert "reference.duration" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_plant_that_a_comparison_does_not_have_is_bad_input(tmp_path, capsys):
    assert main(["study", "run", "thesis", "--plant", "septic", "--out", str(tmp_path / "r")]) == 2
    assert "one of fmu, jax" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


def test_every_comparison_can_be_named_on_the_command_line():
    from studies.definition.catalogue import is_comparison
    from studies.thesis.catalogue import STUDIES

    assert all(map(is_comparison, (*STUDIES, "comparison")))
    assert not is_comparison("deadzone")


def test_figures_are_listed_without_an_id_and_produced_with_one(stub, tmp_path, capsys):
    given = []
    stub("figures.registry", FIGURES={"12": SimpleNamespace(title="a title", study="soft")})
    stub(
        "figures.produce",
        produce=lambda ids, **rest: given.append((ids, rest)) or [tmp_path / "f.png"],
        write_gallery=lambda ids, **rest: given.append((ids, rest)) or tmp_path / "index.html",
    )
    assert main(["figures"]) == 0
    assert "12  a title  (soft)" in capsys.readouterr().out
    assert main(["figures", "12", "--out", str(tmp_path), "--results", "there", "--plant", "jax"]) == 0
    asked = {"results": Path("there"), "out": tmp_path, "quick": False, "plant": "jax"}
    assert given == [(["12"], asked), (["12"], asked)]
    out = capsys.readouterr().out
    assert str(tmp_path / "f.png") in out
    assert "index.html" in out
