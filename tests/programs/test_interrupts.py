"""Ctrl-C on the command line: status 130, one line and nothing else, whatever is going on.

Only what was said before Ctrl-C precedes the line: that programs are compiled, in one line too.
"""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINUX = pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="looks into /proc")
SOON = 5.0  # s; two on an idle machine
NOTICE = r"jaxmpc: compiling(?: for [^\n;]+)?; once per machine\n"


def start(words, folder, **options):
    """A process in a group of its own, as a shell starts it, without compiled programs."""
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=ROOT,
        env={**os.environ, "JAXMPC_CACHE": str(folder / "cache"), "JAXMPC_QUIET": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **options,
    )


def wait_for(seen, process, seconds=300):
    """Look until `seen` is true of a process that runs; a limit only for what never comes."""
    end = time.monotonic() + seconds
    while not seen():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.005)


def interrupt(process):
    """What Ctrl-C does: all processes of the group hear it. Status, both outputs, and how long it took [s]."""
    begin = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err, time.monotonic() - begin


# --------------------------------------------------------------------------------------- a first compilation


def cpu_seconds(process):
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def imports_jax(process, folder):
    wait_for(lambda: "libjax_common" in Path(f"/proc/{process.pid}/maps").read_text(), process)


def begins_to_compile(process, folder):
    names = lambda: [p.read_text() for p in Path(f"/proc/{process.pid}/task").glob("*/comm")]  # noqa: E731
    wait_for(lambda: any(name.startswith("llvm-worker") for name in names()), process)


def is_done_with_one_program(process, folder):
    wait_for(lambda: list((folder / "cache" / "jit").glob("*-cache")), process)


def is_amid_a_program(process, folder):
    begins_to_compile(process, folder)
    begin = cpu_seconds(process)
    wait_for(lambda: cpu_seconds(process) > begin + 0.5, process)


def has_said_that_it_compiles(process, folder):
    assert re.fullmatch(NOTICE, process.stderr.readline())


@LINUX
@pytest.mark.parametrize(
    ("moment", "before"),
    [
        (imports_jax, ""),
        (begins_to_compile, f"(?:{NOTICE})?"),
        (is_done_with_one_program, f"(?:{NOTICE})?"),
        (is_amid_a_program, f"(?:{NOTICE})?"),
        (has_said_that_it_compiles, ""),  # and does not say it again
    ],
)
def test_ctrl_c_during_a_first_compilation_ends_with_one_line_and_no_crash(moment, before, tmp_path):
    case, out = tmp_path / "case.json", tmp_path / "plan.json"
    case.write_text(re.search(r"```json\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1])
    process = start(["-m", "jaxmpc.cli", "plan", str(case), "--out", str(out)], tmp_path)
    moment(process, tmp_path)
    status, printed, complaint, seconds = interrupt(process)
    assert (status, printed) == (130, "")
    assert re.fullmatch(before + "jaxmpc: stopped\n", complaint), complaint
    assert seconds < SOON
    assert not out.exists()


# -------------------------------------------------------------------------------------- whatever is going on

COMMAND = """
import functools, hashlib, os, signal, sys, threading, time
sys.argv = ["jaxmpc"]
from jaxmpc.programs import interrupts
folder = {folder!r}
def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
@interrupts.front_door
def main(arguments):
{body}
sys.exit(main())
"""


def command(body, folder):
    """Status, both outputs and seconds of a command that does this, with Ctrl-C from within."""
    script = COMMAND.format(folder=str(folder), body=textwrap.indent(textwrap.dedent(body), "    "))
    process = start(["-c", script], folder)
    begin = time.monotonic()
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err, time.monotonic() - begin


@pytest.mark.parametrize(
    "body",
    [
        "interrupt(); time.sleep(60)",
        "interrupt(); interrupt(); interrupt(); time.sleep(60)",
        # compiled code that no signal interrupts
        "threading.Timer(0.2, interrupt).start(); hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)",
        # an extension module that is loaded meanwhile makes another error of it
        "try: interrupt(); time.sleep(60)\nexcept KeyboardInterrupt: raise ImportError('while loading') from None",
        # somebody ignores it
        "try: interrupt(); time.sleep(60)\nexcept KeyboardInterrupt: pass\nwhile True: time.sleep(0.01)",
        "try: interrupt(); time.sleep(60)\nexcept KeyboardInterrupt: pass\nreturn 0",
        # a thread that fails, one that goes on
        "threading.Thread(target=lambda: 1 / (time.sleep(0.3) or 0)).start()\n"
        "threading.Thread(target=time.sleep, args=(60,)).start()\ninterrupt(); time.sleep(60)",
    ],
    ids=["waits", "thrice", "compiled code", "another error", "goes on", "ends", "threads"],
)
def test_a_command_that_is_stopped_says_so_and_nothing_else(body, tmp_path):
    status, out, err, seconds = command(body, tmp_path)
    assert (status, out, err) == (130, "", "jaxmpc: stopped\n")
    assert seconds < 30


@pytest.mark.parametrize(
    "work",
    [
        "interrupt(); time.sleep(60)",
        "threading.Timer(0.2, interrupt).start(); hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)",
    ],
    ids=["waits", "compiled code"],
)
def test_what_is_temporary_is_removed_what_is_printed_arrives_and_the_line_says_what_is_kept(work, tmp_path):
    body = f"""
        made = os.path.join(folder, "temporary")
        os.mkdir(made)
        print("half of it")
        with interrupts.last_words(lambda: "1 of 2 are stored."):
            interrupts.before_leaving(functools.partial(os.rmdir, made))
            {work}
    """
    status, out, err, _ = command(body, tmp_path)
    assert (status, out) == (130, "half of it\n")
    assert err == "jaxmpc: stopped: 1 of 2 are stored.\n"
    assert not (tmp_path / "temporary").exists()


@LINUX
def test_programs_that_were_started_end_with_everything_that_they_started(tmp_path):
    body = """
        inner = "import os, time; open({!r}, 'w').write(str(os.getpid())); time.sleep(600)"
        script = inner.format(os.path.join(folder, "inner"))
        outer = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {script!r}])"
        interrupts.run_program([sys.executable, "-c", outer], dict(os.environ))
    """
    script = COMMAND.format(folder=str(tmp_path), body=textwrap.indent(textwrap.dedent(body), "    "))
    process = start(["-c", script], tmp_path)
    pid = tmp_path / "inner"
    wait_for(lambda: pid.exists() and pid.read_text(), process)
    os.kill(process.pid, signal.SIGINT)  # this process alone
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "jaxmpc: stopped\n")
    status = Path(f"/proc/{pid.read_text()}/stat")
    end = time.monotonic() + 30
    while status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_command_that_is_done_has_its_own_status_and_what_is_registered_for_the_end_happens(tmp_path):
    body = """
        import atexit
        atexit.register(lambda: print("the end"))
        return 3
    """
    assert command(body, tmp_path)[:3] == (3, "the end\n", "")


def test_a_program_that_uses_the_library_hears_of_ctrl_c_as_ever(tmp_path):
    script = """
        import os, signal, jaxmpc
        from jaxmpc.cli import main as cli
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            print("heard")
    """
    process = start(["-c", textwrap.dedent(script)], tmp_path)
    assert process.communicate(timeout=60) == ("heard\n", "")
    assert process.returncode == 0


def test_ctrl_c_that_is_ignored_stays_ignored(tmp_path):
    body = "interrupt(); print('done'); return 0"
    script = COMMAND.format(folder="", body=textwrap.indent(body, "    "))
    script = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n" + script
    process = start(["-c", script], tmp_path)
    assert process.communicate(timeout=60) == ("done\n", "")
    assert process.returncode == 0


def test_every_command_is_stopped_in_the_same_way_where_it_is_called(monkeypatch, capsys, tmp_path):
    from jaxmpc.cli import main as cli

    def stop(options):
        raise KeyboardInterrupt("2 of 3 chunks are stored.")

    monkeypatch.setitem(cli.COMMANDS, "bench", dataclasses.replace(cli.COMMANDS["bench"], run=stop))
    assert cli.main(["bench"]) == 130
    assert capsys.readouterr().err == "jaxmpc: stopped: 2 of 3 chunks are stored.\n"


def test_a_benchmark_that_is_stopped_prints_what_it_has(monkeypatch, capsys, tmp_path):
    from jaxmpc.cli import main as cli
    from studies.bench import rows, run

    def stopped(context):
        yield rows.timed("done", [1e-3], [0.0])
        raise KeyboardInterrupt

    monkeypatch.setitem(run.SECTIONS, "relaxed", stopped)
    kept = tmp_path / "bench.json"
    assert cli.main(["bench", "--only", "relaxed", "--json", str(kept)]) == 130
    captured = capsys.readouterr()
    assert "Not complete" in captured.out
    assert captured.err == "jaxmpc: stopped\n"
    assert [row["name"] for row in json.loads(kept.read_text())["rows"]] == ["done"]
