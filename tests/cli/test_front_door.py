"""What the system does to a command: full disks, closed streams, odd names, missing platforms, files that are no files."""

import json
import os
import shutil
import stat
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from jaxmpc.cli.main import main
from tests import problems

COMMAND = [sys.executable, "-m", "jaxmpc.cli"]
FULL = Path("/dev/full")
pytestmark = pytest.mark.skipif(os.name != "posix", reason="streams, pipes and links of POSIX")
full_disk = pytest.mark.skipif(not FULL.exists(), reason="no full device here")


def command(*words, **options) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own; standard error is read, and standard output where nothing else is said."""
    if "preexec_fn" not in options:
        options = {"stdout": subprocess.PIPE} | options
    options = {"env": {**os.environ, "PYTHONUNBUFFERED": ""}} | options
    return subprocess.run([*COMMAND, *words], stderr=subprocess.PIPE, text=True, check=False, **options)


@pytest.fixture
def case(tmp_path) -> Path:
    """A case file."""
    path = tmp_path / "case.json"
    path.write_text(json.dumps(problems.small_case(np.random.default_rng(1), blocks=[1, 1, 2, 2])))
    return path


@pytest.fixture
def unsolved(monkeypatch):
    """A solver that must not be called."""
    from jaxmpc.controller import plan

    monkeypatch.setattr(plan, "solve_plan", lambda *_, **__: pytest.fail("the solver was called"))


# ------------------------------------------------------------------------------------------- what --out may name


@pytest.mark.parametrize("kind", ["itself", "link", "hard link", "relative"])
def test_a_case_file_is_not_overwritten_by_its_plan(case, kind, unsolved, monkeypatch, capsys):
    monkeypatch.chdir(case.parent)
    before, out = case.read_bytes(), case.with_name("out.json")
    if kind == "link":
        out.symlink_to(case)
    elif kind == "hard link":
        os.link(case, out)
    else:
        out = case if kind == "itself" else Path("case.json")
    assert main(["plan", str(case), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("jaxmpc: --out: got ")
    assert "it is the input" in said
    assert said.count("\n") == 1
    assert case.read_bytes() == before


def test_a_plan_goes_into_a_pipe_and_through_a_link_and_keeps_a_private_mode(case, tmp_path):
    pipe, link, private = (tmp_path / name for name in ("pipe", "link", "private"))
    os.mkfifo(pipe)
    private.write_text("old")
    private.chmod(0o600)
    link.symlink_to(private)
    got = []
    reader = threading.Thread(target=lambda: got.append(json.loads(pipe.read_text())), daemon=True)
    reader.start()
    assert main(["plan", str(case), "--out", str(pipe)]) == 0
    reader.join(timeout=60)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert main(["plan", str(case), "--out", str(link)]) == 0
    assert link.is_symlink()
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert json.loads(private.read_text())["objective"] == got[0]["objective"]


def test_a_case_may_come_from_a_pipe_and_the_plan_go_into_an_open_one(case, tmp_path, capsys):
    given = tmp_path / "given"
    os.mkfifo(given)
    writer = threading.Thread(target=lambda: given.write_bytes(case.read_bytes()), daemon=True)
    writer.start()
    reading, writing = os.pipe()
    assert main(["plan", str(given), "--out", f"/dev/fd/{writing}"]) == 0
    os.close(writing)
    with open(reading) as file:
        assert json.load(file)["status"] == "optimal"


@pytest.mark.parametrize(
    "option", ["identify --plant jax --out", "fmu build --out", "bench --only growth --json"]
)
def test_every_command_refuses_a_file_that_nobody_may_write(option, tmp_path, capsys):
    path = tmp_path / "kept.fmu"
    path.write_text("kept")
    path.chmod(0o444)
    assert main([*option.split(), str(path)]) == 2
    said = capsys.readouterr().err
    assert f"{option.split()[-1]}: got " in said
    assert "0444" in said
    assert path.read_text() == "kept"


def test_a_fit_does_not_overwrite_what_it_reads(tmp_path, capsys):
    from identify.well_fit import main as fit
    from jaxmpc.process.well.equations import WellParameters, save_parameters
    from tests.conftest import second_order

    data, prior = tmp_path / "data.json", tmp_path / "prior.json"
    rows = [[second_order(1.0, 120.0, 15.0, 0.0, 20).tolist()] * 2] * 2
    body = {"format": "jaxmpc/step-response/1", "dt": 10.0, "cv": ["gas_rate", "oil_rate"]}
    body |= {"mv": ["choke", "gas_lift"], "coefficients": rows}
    body |= {"working_point": {"choke": 50.0, "gas_lift": 7500.0}}
    data.write_text(json.dumps(body))
    save_parameters(WellParameters(), prior)
    for out in (data, prior):
        before = out.read_bytes()
        assert fit([str(data), "--prior", str(prior), "--out", str(out)]) == 2
        assert "it is the input" in capsys.readouterr().err
        assert out.read_bytes() == before


# ----------------------------------------------------------------------------------------- full disks and streams


@full_disk
@pytest.mark.parametrize("words", [["figures"], ["--help"]], ids=" ".join)
@pytest.mark.parametrize("buffered", ["", "1"], ids=["buffered", "unbuffered"])
def test_a_full_standard_output_ends_with_one_line(words, buffered):
    if words == ["--help"] and buffered:
        pytest.skip("argparse itself ignores what it cannot print")
    with open(FULL, "w") as full:
        run = command(*words, stdout=full, env={**os.environ, "PYTHONUNBUFFERED": buffered})
    assert run.returncode == 1
    assert run.stderr.startswith("jaxmpc: ")
    assert "No space left on device" in run.stderr
    assert run.stderr.count("\n") == 1


def test_a_full_disk_leaves_the_old_plan_and_ends_with_one_line(case, tmp_path):
    """A file system of one page in a private mount name space; some machines do not allow one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = f"mount -t tmpfs -o size=4k tmpfs {disk} && printf old > {disk}/plan.json"
    if (
        shutil.which("unshare") is None
        or subprocess.run(["unshare", "-rm", "sh", "-c", mount], check=False, capture_output=True).returncode
    ):
        pytest.skip("no private mounts here")
    plan = " ".join([*COMMAND, "plan", str(case), "--out", f"{disk}/plan.json"])
    script = f"{mount} && {plan}; echo $?; cat {disk}/plan.json; ls -A {disk}"
    run = subprocess.run(["unshare", "-rm", "sh", "-c", script], check=False, capture_output=True, text=True)
    assert run.stdout == "1\noldplan.json\n"
    assert run.stderr == f"jaxmpc: {disk}/plan.json: No space left on device\n"


def test_a_closed_standard_output_ends_with_one_line_where_something_was_to_be_printed(case, tmp_path):
    run = command("figures", preexec_fn=lambda: os.close(1))
    assert (run.returncode, run.stderr) == (1, "jaxmpc: standard output: Bad file descriptor\n")
    run = command("plan", str(case), "--out", str(tmp_path / "plan.json"), preexec_fn=lambda: os.close(1))
    assert run.returncode == 0
    assert json.loads((tmp_path / "plan.json").read_text())["status"] == "optimal"


@pytest.mark.parametrize("words", [["figures"], ["process", "list"]], ids=" ".join)
def test_a_reader_that_leaves_ends_the_command_quietly(words):
    reading, writing = os.pipe()
    os.close(reading)
    run = command(*words, stdout=writing)
    os.close(writing)
    assert (run.returncode, run.stderr) == (141, "")


def test_a_name_that_the_terminal_cannot_show_is_printed_in_escapes(tmp_path):
    path = os.fsdecode(bytes(tmp_path) + b"/\xff.json")
    run = command("identify", "--plant", "jax", "--samples", "5", "--out", path)
    assert run.returncode == 0
    assert run.stdout.endswith("\\udcff.json\n")
    assert os.path.exists(path)


def test_the_solver_of_milps_prints_nothing_into_an_answer():
    code = (
        "from jaxmpc.integer.highs import solve_milp\nimport numpy as np\n"
        "one = np.ones(1)\n"
        "print(solve_milp(one, ([0], [0], [1.0]), one, 3 * one, 0 * one, 5 * one, one > 0)[0])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("optimal\n", "")


def test_memory_that_the_system_does_not_give_ends_with_one_line(case, monkeypatch, capsys):
    def greedy(*_):
        return np.zeros(2**58)

    monkeypatch.setattr("jaxmpc.controller.case.load_case", greedy)
    assert main(["plan", str(case)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("jaxmpc: not enough memory: Unable to allocate")
    assert said.count("\n") == 1


def test_a_fault_of_the_program_is_not_hidden(case, monkeypatch):
    monkeypatch.setattr("jaxmpc.controller.case.load_case", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["plan", str(case)])


# --------------------------------------------------------------------------------------- names and input that is read


@pytest.mark.parametrize(
    "scenario", ["x#²", "x#", "#1", "x#-1", "x#1.5", "x#٣", "x#" + "9" * 5000, "x#1_0"], ids=lambda s: s[:8]
)
def test_a_scenario_is_numbered_in_plain_digits(scenario, tmp_path, capsys):
    assert main(["simulate", scenario, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(("jaxmpc: scenario: got ", "jaxmpc: store: got "))
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    "words",
    [
        ["plan", "{}"],
        ["plan", "case.json", "--out", "{}"],
        ["identify", "--plant", "jax", "--out", "{}"],
        ["fmu", "build", "--out", "{}.fmu"],
        ["bench", "--json", "{}"],
        ["bench", "--figures", "{}"],
        ["bench", "--write", "{}"],
        ["bench", "--read", "{}"],
        ["study", "run", "{}"],
        ["study", "run", "thesis", "--out", "{}"],
        ["study", "run", "deadzone", "--quick", "--store", "{}.zarr"],
        ["study", "run", "deadzone", "--quick", "--out", "{}"],
        ["study", "status", "{}"],
        ["study", "export", "{}", "x.csv"],
        ["simulate", "{}#1"],
        ["simulate", "x#1", "--out", "{}"],
        ["figures", "12", "--out", "{}"],
    ],
    ids=lambda words: " ".join(words).replace("{}", "NAME"),
)
@pytest.mark.parametrize("name", ["n" * 260, "file/below"], ids=["long", "below a file"])
def test_a_name_that_no_file_can_have_ends_with_one_line_and_nothing_written(
    words, name, case, unsolved, monkeypatch, capsys
):
    monkeypatch.chdir(case.parent)
    Path("file").write_text("")
    assert main([word.replace("{}", name) for word in words]) in (1, 2)
    captured = capsys.readouterr()
    assert captured.err.startswith("jaxmpc: ")
    assert captured.err.count("\n") == 1
    assert sorted(os.listdir()) == ["case.json", "file"]


@pytest.mark.parametrize(
    "content",
    [b"\xff\xfe\x00", b"[" * 100_000, b"a = " + b"[" * 100_000, b""],
    ids=["bytes", "nested", "toml", "empty"],
)
@pytest.mark.parametrize("words", [["plan"], ["study", "run"]], ids=" ".join)
def test_a_file_that_is_no_text_of_its_kind_ends_with_one_line(words, content, tmp_path, capsys):
    path = tmp_path / "given.toml"
    path.write_bytes(content)
    assert main([*words, str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_case_file_without_an_end_is_not_read_into_memory(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("jaxmpc.controller.case.LARGEST_FILE", 2**20)
    path = tmp_path / "case.json"
    path.write_bytes(b" " * (2**20 + 1))
    assert main(["plan", str(path)]) == 2
    assert "1 MiB at most" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() == 0, reason="root may read everything")
def test_a_case_file_that_may_not_be_read_is_refused(case, capsys):
    case.chmod(0)
    assert main(["plan", str(case)]) == 2
    assert "Permission denied" in capsys.readouterr().err


# ----------------------------------------------------------------------------------------------------- the platform


@pytest.mark.parametrize("variable", ["JAX_PLATFORMS", "JAX_PLATFORM_NAME"])
@pytest.mark.parametrize("platform", ["cuda", "abacus"])
def test_a_platform_that_is_not_there_is_refused_with_those_that_are(variable, platform, case):
    has_gpu = "from jax import devices; print(any(d.platform == 'gpu' for d in devices()))"
    if platform == "cuda" and subprocess.check_output([sys.executable, "-c", has_gpu], text=True) == "True\n":
        pytest.skip("it is there")
    run = command("plan", str(case), env={**os.environ, variable: platform})
    assert run.returncode == 2
    last = run.stderr.splitlines()[-1]
    assert last.startswith(f"jaxmpc: {variable}: got '{platform}', expected ")
    assert "cpu" in last
    assert "Traceback" not in run.stderr


def test_help_needs_no_home_directory(tmp_path):
    code = (
        "import pwd\ndef none(*_): raise KeyError('no entry')\npwd.getpwuid = none\n"
        "import sys\nfrom jaxmpc.cli.main import main\nsys.exit(main(['--help']))"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "JAXMPC_CACHE")}
    run = subprocess.run(
        [sys.executable, "-c", code],
        env=environment | {"TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0
    assert run.stdout.startswith("usage: jaxmpc")
    assert run.stderr.count("\n") == 1
