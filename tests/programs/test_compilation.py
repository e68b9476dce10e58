"""Compilation is seen: one line on standard error for a pause of it, nothing from the cache, and a clock without it."""

import contextlib
import json
import os
import re
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest

from jaxmpc.programs import compilation
from jaxmpc.programs.clock import Clock, _heard
from jaxmpc.programs.compilation import Compilation

ROOT = Path(__file__).parents[2]
LINE = "jaxmpc: compiling; once per machine\n"


# ------------------------------------------------------------------------------------------- programs in name only


@pytest.fixture
def heard(monkeypatch):
    """A process that has compiled nothing, and what it says."""
    monkeypatch.delenv("JAXMPC_QUIET", raising=False)
    known, lines = Compilation(), []
    known.listeners.append(lines.append)
    monkeypatch.setattr(compilation, "_compilation", known)
    return lines


def compiles(seconds):
    with compilation._compilation.of_a_program():
        time.sleep(seconds)


def test_what_takes_less_than_a_second_is_not_worth_a_line(heard):
    compiles(0.8)
    assert heard == []


def test_a_long_compilation_is_said_within_a_second_and_once(heard):
    with compilation._compilation.of_a_program():
        time.sleep(1.15)
        assert len(heard) == 1
        time.sleep(0.5)
    compiles(1.2)
    compiles(0.7)
    assert len(heard) == 1


def test_programs_of_one_pause_count_together(heard):
    for _ in range(3):
        compiles(0.6)
    assert len(heard) == 1


def test_many_small_programs_say_nothing_however_long_they_take_together(heard):
    for _ in range(30):
        compiles(0.05)
    assert heard == []


def test_programs_side_by_side_are_one_pause_and_no_thread_is_left(heard):
    before = set(threading.enumerate())
    threads = [threading.Thread(target=compiles, args=(1.2 + 0.2 * k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(heard) == 1
    assert set(threading.enumerate()) <= before


def test_another_pause_has_another_line(heard, monkeypatch):
    monkeypatch.setattr(compilation, "APART", 0.3)
    compiles(1.2)
    time.sleep(0.4)
    compiles(0.8)
    assert len(heard) == 1  # it is short
    time.sleep(0.4)
    compiles(1.2)
    assert len(heard) == 2


def test_the_line_says_what_is_compiled_while_somebody_knows(heard):
    with compilation.compiling_for("32 moves"):
        with pytest.raises(ZeroDivisionError), compilation.compiling_for("64 moves"):
            raise ZeroDivisionError
        compiles(1.2)
    assert [line.removesuffix("; once per machine") for line in heard] == ["compiling for 32 moves"]
    assert compilation.line("") == compilation.line("32 moves").replace(" for 32 moves", "")


def test_somebody_else_can_be_told(heard):
    told = []
    with compilation.told(told.append):
        compiles(1.2)
    assert (len(told), heard) == (1, [])


@pytest.mark.parametrize(("value", "count"), [("1", 0), ("0", 1), ("", 1)])
def test_the_environment_makes_it_quiet(heard, monkeypatch, value, count):
    monkeypatch.setenv("JAXMPC_QUIET", value)
    compiles(1.2)
    assert len(heard) == count


def test_the_clock_leaves_out_what_its_thread_has_compiled():
    clock = Clock()
    time.sleep(0.7)
    _heard("/jax/core/compile/backend_compile_duration", 0.5)
    assert 0.2 <= clock.seconds < 0.2 + 0.3  # a busy machine may add to the wait
    other = threading.Thread(target=_heard, args=("/jax/core/compile/backend_compile_duration", 0.2))
    other.start()
    other.join()
    assert clock.seconds >= 0.2
    _heard("/jax/core/compile/backend_compile_duration", 60.0)
    assert clock.seconds == 0.0


def test_a_compilation_that_fails_or_is_stopped_is_over(heard):
    for error in (ValueError, KeyboardInterrupt):
        with contextlib.suppress(error), compilation._compilation.of_a_program():
            raise error
    time.sleep(1.2)
    assert heard == []
    compiles(1.2)
    assert len(heard) == 1


# --------------------------------------------------------------------------------------------- programs that are


def environment(folder, **more):
    without = ("JAXMPC_QUIET", "JAX_COMPILATION_CACHE_DIR", "JAXMPC_NO_JIT_CACHE")
    kept = {name: value for name, value in os.environ.items() if name not in without}
    return {**kept, "JAXMPC_CACHE": str(folder), **more}


SLOW = """
    import sys, threading, time
    from jax._src import compiler

    def slowly(*arguments, real=compiler.backend_compile_and_load, **options):
        time.sleep(1.3 * ("slow" in str(arguments[1].operation.attributes["sym_name"])))
        return real(*arguments, **options)

    compiler.backend_compile_and_load = slowly  # a machine that is slow with one program, whatever else it is
    import jaxmpc, jax

    def slow(x, k):
        return x + k

    def compile(*numbers):
        for k in numbers:
            jax.jit(slow, static_argnums=1)(1.0, k).block_until_ready()
"""


def run(body, folder, tail="", **more):
    """Status and both outputs of a plain Python script that compiles what takes seconds."""
    script = textwrap.dedent(SLOW) + textwrap.dedent(body)
    command = [sys.executable, "-c", script]
    if tail:
        command = ["sh", "-c", f'exec "$0" "$@" {tail}', *command]
    done = subprocess.run(
        command, env=environment(folder, **more), cwd=ROOT, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A cache, and what the script said that has filled it."""
    folder = tmp_path_factory.mktemp("cache")
    body = "before = threading.active_count(); compile(0, 1); assert threading.active_count() == before"
    return folder, body, run(body, folder)


def test_a_script_says_once_that_it_compiles_and_the_next_one_says_nothing(compiled):
    folder, body, said = compiled
    assert said == (0, "", LINE)
    assert run(body, folder) == (0, "", "")


def test_nothing_is_said_where_it_would_not_be_read(compiled, tmp_path):
    _, body, _ = compiled
    assert run(body, tmp_path / "a", JAXMPC_QUIET="1") == (0, "", "")
    assert run(body, tmp_path / "b", "2>&-") == (0, "", "")


def test_without_a_cache_nothing_is_promised(tmp_path):
    said = run("compile(0)", tmp_path, JAXMPC_NO_JIT_CACHE="1")
    assert said == (0, "", "jaxmpc: compiling\n")


def test_a_process_that_another_one_has_spawned_says_nothing(tmp_path):
    module = tmp_path / "spawned.py"
    body = """
    import multiprocessing
    if __name__ == "__main__":
        worker = multiprocessing.get_context("spawn").Process(target=compile, args=(0,))
        worker.start()
        worker.join()
        sys.exit(worker.exitcode)
    """
    module.write_text(textwrap.dedent(SLOW) + textwrap.dedent(body))
    done = subprocess.run(
        [sys.executable, str(module)],
        env={**environment(tmp_path / "cache"), "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list((tmp_path / "cache" / "jit").glob("*-cache"))


def test_a_bar_stays_whole_below_the_line(tmp_path):
    body = """
    from tqdm import tqdm
    with tqdm(total=2, desc="loops", mininterval=0) as bar:
        compile(0)
        bar.update(2)
    """
    status, out, err = run(body, tmp_path)
    assert (status, out) == (0, "")
    pieces = re.split(r"[\r\n]", err)
    assert pieces.count(LINE.strip()) == 1
    assert all(piece.strip() == "" or piece.startswith(("loops", LINE.strip())) for piece in pieces)


def test_the_command_line_says_it_before_its_answer_and_not_the_second_time(tmp_path):
    case = tmp_path / "case.json"
    case.write_text(re.search(r"```json\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1])
    answers = []
    for said in (r"jaxmpc: compiling(?: for [^\n;]+)?; once per machine\n", ""):
        done = subprocess.run(
            [sys.executable, "-m", "jaxmpc.cli", "plan", str(case)],
            env=environment(tmp_path / "cache"),
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0
        assert re.fullmatch(said, done.stderr), done.stderr
        answers.append(json.loads(done.stdout))
    assert answers[0]["moves"] == answers[1]["moves"]


def test_a_notebook_shows_it_in_the_cell_that_compiles(tmp_path):
    pytest.importorskip("ipykernel")
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    source = textwrap.dedent(SLOW) + "compile(0)"
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    client = nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3")
    client.execute(env={**environment(tmp_path / "cache"), "PYTHONPATH": str(ROOT)})
    outputs = [(output["name"], output["text"]) for output in notebook.cells[0]["outputs"]]
    assert outputs == [("stderr", LINE)]
