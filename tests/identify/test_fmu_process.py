"""FMUs in processes of their own: what they exchange, what is refused, and that nothing they do reaches the caller."""

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest

from identify import fmu_file, fmu_worker
from identify.fmu import FmuPlant
from identify.fmu_file import RefusedError, check_archive
from identify.fmu_process import FmuProcess
from identify.well_fmu import WellFmuPlant
from jaxmpc.errors import InputError, PlantError
from tests import fmus

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="looks at processes in /proc")
SLOW_STEP = "usleep(300000);"


def step(fmu, **options):
    """One step of 10 s; returns the sum and the time."""
    return fmu.step(10.0, {"u": 2.0}, ["sum", "time"], **options)


def runs(process):
    """Whether a process is there and has not ended."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def wait_until(condition, what):
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end, f"still waiting: {what}"
        time.sleep(0.01)


# ------------------------------------------------------------------------------------------------ what is exchanged


def test_reals_integers_and_booleans_are_set_held_over_the_steps_and_read(tmp_path):
    with FmuProcess(fmus.make_fmu(tmp_path)) as fmu:
        assert fmu.description.fmi == 2
        assert fmu.description.token == fmus.GUID
        assert fmu.description.variables["n"].type == "Integer"
        fmu.start({"u": 1.5})
        assert fmu.get(["sum", "time"]) == [1.5, 0.0]
        assert fmu.step(10.0, {"u": 0.1 + 0.2, "n": 3, "b": True}, ["time", "sum"]) == [
            10.0,
            100 + 3 + (0.1 + 0.2),
        ]
        assert fmu.step(10.0, outputs=["time", "sum"], count=3) == [40.0, 100 + 3 + (0.1 + 0.2)]
        fmu.set({"b": np.False_, "n": np.int64(-2)})
        assert fmu.get(["sum"]) == [0.1 + 0.2 - 2]
        fmu.start()
        assert fmu.get(["sum", "time"]) == [0.0, 0.0]


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.0, 5e-324, 1.7976931348623157e308, 1 / 3])
def test_every_number_arrives_as_it_was_sent(tmp_path, value):
    with FmuProcess(fmus.make_fmu(tmp_path)) as fmu:
        fmu.start()
        (got,) = fmu.step(10.0, {"u": value}, ["u"])
        assert (
            math.isnan(got)
            if math.isnan(value)
            else (got, math.copysign(1, got)) == (value, math.copysign(1, value))
        )


def test_an_unknown_variable_is_refused_by_name(tmp_path):
    with FmuProcess(fmus.make_fmu(tmp_path)) as fmu:
        fmu.start()
        with pytest.raises(InputError, match="a variable pressure"):
            fmu.get(["pressure"])
        assert step(fmu) == [2.0, 10.0]


def test_what_an_fmu_prints_is_no_output_of_the_command(tmp_path, capfd):
    with FmuProcess(fmus.make_fmu(tmp_path, do_step='printf("hello"); fflush(stdout);')) as fmu:
        fmu.start()
        step(fmu)
    assert capfd.readouterr() == ("", "hello")


def test_a_file_of_the_folder_of_the_command_is_no_module_of_the_process(tmp_path, monkeypatch):
    path = fmus.make_fmu(tmp_path)
    (tmp_path / "json.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    with FmuProcess(path) as fmu:
        fmu.start()
        assert step(fmu) == [2.0, 10.0]


# ------------------------------------------------------------------------------------- an FMU that fails while it runs


@pytest.mark.parametrize(
    ("code", "what"),
    [
        ("abort();", "ended its process with signal SIGABRT during doStep at t = 1230 s"),
        ("*(volatile int *)0 = 1;", "ended its process with signal SIGSEGV during doStep at t = 1230 s"),
        ("exit(0);", "ended its process with exit status 0 during doStep at t = 1230 s"),
        (
            'system("sleep 5 &"); abort();',
            "ended its process with signal SIGABRT during doStep at t = 1230 s",
        ),
        ("for (;;);", r"did not come back from doStep at t = 1230 s within 2 s; its process was ended"),
    ],
)
def test_an_fmu_that_takes_its_process_along_is_named_with_the_call_and_the_time(tmp_path, code, what):
    path = fmus.make_fmu(tmp_path, do_step=f"if (t == 1230) {{ {code} }}")
    with FmuProcess(path, time_limit=2.0) as fmu:
        fmu.start()
        assert step(fmu, count=123) == [2.0, 1230.0]
        for _ in range(2):  # and whatever is asked of it afterwards
            with pytest.raises(PlantError, match=what) as caught:
                step(fmu, count=5)
            assert str(caught.value).startswith(f"{path}: the FMU ")
            assert "\n" not in str(caught.value)
        assert not fmu.folder.exists()


def test_an_error_of_the_fmu_is_told_and_a_new_run_may_follow(tmp_path):
    with FmuProcess(fmus.make_fmu(tmp_path, do_step="if (t == 20) { return 3; }")) as fmu:
        for _ in range(2):
            fmu.start()
            with pytest.raises(PlantError, match=r"failed during doStep at t = 20 s: .*error"):
                step(fmu, count=5)


@pytest.mark.parametrize(
    ("code", "what"),
    [
        (
            {"on_load": "__attribute__((constructor)) static void f(void) { abort(); }"},
            "the loading of its library",
        ),
        ({"instantiate": "abort()"}, "its instantiation"),
    ],
)
def test_a_crash_while_an_fmu_is_loaded_is_told(tmp_path, code, what):
    path = fmus.make_fmu(tmp_path, **code)
    with FmuProcess(path) as fmu, pytest.raises(PlantError, match=f"signal SIGABRT during {what}"):
        fmu.load()


@pytest.mark.parametrize("code", ["abort();", "exit(3);", "for (;;);"])
def test_an_fmu_that_fails_when_it_is_freed_does_not_spoil_the_run(tmp_path, code):
    with FmuProcess(fmus.make_fmu(tmp_path, terminate=code), time_limit=1.0) as fmu:
        fmu.start()
        assert step(fmu) == [2.0, 10.0]
    assert not fmu.folder.exists()


def test_the_time_limit_is_for_one_call_and_not_for_all_steps_of_a_request(tmp_path):
    with FmuProcess(fmus.make_fmu(tmp_path, do_step=SLOW_STEP), time_limit=1.0) as fmu:
        fmu.start()
        assert step(fmu, count=5) == [2.0, 50.0]  # 1.5 s


@pytest.mark.parametrize("limit", [0, -1.0, True, "long", math.nan, math.inf])
def test_a_time_limit_that_is_no_time_is_refused(limit):
    with pytest.raises(InputError) as caught:
        FmuProcess("any.fmu", limit)
    assert caught.value.field == "plant.time_limit"


# ------------------------------------------------------------------------------------------- one process ends the other


@LINUX
@pytest.mark.parametrize("code", ["", "for (;;);"], ids=["idle", "in a call that hangs"])
def test_the_process_of_an_fmu_and_its_files_go_when_the_caller_is_killed(tmp_path, code):
    path = fmus.make_fmu(tmp_path, do_step=f"fflush(stdout); {code}")
    script = """
import sys
from identify.fmu_process import FmuProcess
fmu = FmuProcess(sys.argv[1])
fmu.start()
print(fmu._process.pid, fmu.folder, flush=True)
fmu.step(10.0)
input()
"""
    caller = subprocess.Popen(
        [sys.executable, "-c", script, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        number, _, folder = caller.stdout.readline().strip().partition(" ")
        note = Path(folder, fmu_worker.NOTE)
        wait_until(lambda: "doStep" in note.read_text(), "the step")
        assert runs(number)
    finally:
        caller.kill()
        caller.communicate()
    wait_until(lambda: not runs(number), "the end of the process")
    assert not Path(folder).exists()


@LINUX
def test_ctrl_c_stops_the_caller_and_no_traceback_comes_from_the_fmu(tmp_path):
    path = fmus.make_fmu(tmp_path, do_step='printf("steps\\n"); fflush(stdout); usleep(1000);')
    script = """
import sys
from identify.fmu_process import FmuProcess
with FmuProcess(sys.argv[1]) as fmu:
    fmu.start()
    print(fmu._process.pid, fmu.folder, flush=True)
    try:
        while True:
            fmu.step(10.0)
    except KeyboardInterrupt:
        print("stopped", flush=True)
"""
    caller = subprocess.Popen(
        [sys.executable, "-c", script, path],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        number, _, folder = caller.stdout.readline().strip().partition(" ")
        assert caller.stderr.readline() == "steps\n"
        os.kill(int(number), signal.SIGINT)  # also one that is meant for it
        os.killpg(caller.pid, signal.SIGINT)  # as a terminal does
        out, errors = caller.communicate(timeout=60)
    finally:
        caller.kill()
    assert out == "stopped\n"
    assert set(errors.splitlines()) <= {"steps"}
    assert not runs(number)
    assert not Path(folder).exists()


def interrupt_in(seconds):
    def interrupt(*_):
        raise KeyboardInterrupt

    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds)


def test_after_an_interrupted_call_the_next_answer_is_its_own(tmp_path):
    before = signal.getsignal(signal.SIGALRM)
    try:
        with FmuProcess(fmus.make_fmu(tmp_path, do_step=SLOW_STEP)) as fmu:
            fmu.start()
            interrupt_in(0.1)
            with contextlib.suppress(KeyboardInterrupt):
                step(fmu)
            fmu.start()
            assert fmu.step(10.0, {"u": 5.0}, ["sum", "time"]) == [5.0, 10.0]
    finally:
        signal.signal(signal.SIGALRM, before)


def test_closing_in_the_middle_of_a_call_does_not_wait_for_it(tmp_path):
    before = signal.getsignal(signal.SIGALRM)
    fmu = FmuProcess(fmus.make_fmu(tmp_path, do_step="for (;;);"))
    try:
        fmu.start()
        interrupt_in(0.1)
        with contextlib.suppress(KeyboardInterrupt):
            step(fmu)
    finally:
        signal.signal(signal.SIGALRM, before)
    fmu.close()
    assert not fmu.folder.exists()
    with pytest.raises(InputError, match="closed"):
        step(fmu)


# -------------------------------------------------------------------------------------------- files that are refused


def plant_of(path):
    return FmuPlant(path, ["u"], ["sum"], dt=10.0)


def archive(folder, **changes):
    """A sound description and a text in the place of the library, with changes to the content."""
    library = f"binaries/{fmpy.platform}/sum{fmpy.sharedLibraryExtension}"
    content = {"modelDescription.xml": fmus.describe(), library: "text"} | changes.pop("more", {})
    return fmus.pack(folder / "test.fmu", {name: data for name, data in content.items() if data is not None})


def description(old, new):
    return {"modelDescription.xml": fmus.describe().replace(old, new)}


def test_a_description_that_breaks_rules_without_harm_is_used_and_its_flaws_are_told(tmp_path):
    text = (
        fmus.describe()
        .replace('<Unit name="m3/h"/>', '<Unit name="bar"/>')
        .replace('<Integer start="0"/>', "<Integer/>")
    )
    path = fmus.make_fmu(tmp_path, text)
    with plant_of(path) as plant:
        assert plant.description.flaws == (
            'Variable "n" (line 9) has no start value.',
            'The unit "m3/h" of variable "u" (line 8) is not defined.',
        )
        assert 'flaws       Variable "n"' in plant.description.table()


LIBRARY = f"binaries/{fmpy.platform}/sum{fmpy.sharedLibraryExtension}"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({"modelDescription.xml": None}, "an FMU, with a modelDescription.xml"),
        ({"modelDescription.xml": "text"}, "that is XML"),
        (description("<Real/>", "<Rel/>"), "that follows the standard .*line 13.*'Rel'"),
        (description('fmiVersion="2.0"', 'fmiVersion="1.0"'), r"FMI 2.0 or 3.0 \(its version is 1.0\)"),
        (description("CoSimulation", "ModelExchange"), r"whose library can be loaded \(.*\)$"),
        ({LIBRARY: None, "binaries/win32/sum.dll": "x"}, r"a library for \w+ \(it has one for win32\)"),
        (
            {LIBRARY: None, "sources/sum.c": "int x;"},
            r"a library for \w+ \(it has only sources\).*fmpy compile",
        ),
        ({LIBRARY: None}, r"a library for \w+ \(it has none\)"),
        ({}, r"whose library can be loaded \(.*\)$"),
        ({"../outside.txt": "x"}, r"files stay in its folder \('../outside.txt' does not\)"),
        ({"resources/../../outside.txt": "x"}, "files stay in its folder"),
        ({"/outside.txt": "x"}, "files stay in its folder"),
        ({"c:/outside.txt": "x"}, "files stay in its folder"),
        ({"resources\\outside.txt": "x"}, "files stay in its folder"),
        ({"resources/zeros": bytes(50_000_000)}, "grows at most 200 times"),
    ],
)
def test_a_file_that_is_no_fmu_for_here_is_refused_with_its_reason(tmp_path, content, reason):
    path = archive(tmp_path, more=content)
    with pytest.raises(InputError, match=reason) as caught:
        plant_of(path)
    assert caught.value.field == "plant.path"
    assert caught.value.value == str(path)
    assert "jaxmpc-fmu-" not in str(caught.value)
    assert sorted(tmp_path.iterdir()) == [path]


def test_a_library_of_another_guid_is_refused_with_its_reason(tmp_path):
    path = fmus.make_fmu(tmp_path, fmus.describe(guid="{another}"))
    with pytest.raises(InputError, match=r"the GUID \{another\} of its description is not in its library"):
        plant_of(path)


def test_a_library_that_declines_is_refused(tmp_path):
    path = fmus.make_fmu(tmp_path, instantiate="if (type == 1) return 0")
    with pytest.raises(InputError, match=r"lets itself be instantiated \(it declined\)"):
        plant_of(path)


def test_a_library_without_a_function_of_the_standard_is_refused_by_its_name(tmp_path):
    path = fmus.make_fmu(tmp_path, without="fmi2CancelStep")
    with pytest.raises(InputError, match=r"every function of FMI 2 \(fmi2CancelStep is missing\)"):
        plant_of(path)


def test_an_fmu_of_something_else_is_refused_with_the_variables_that_it_lacks(tmp_path):
    with pytest.raises(InputError, match=r"an FMU of the well \(without choke, gas_lift, .* it is not\)"):
        WellFmuPlant(fmus.make_fmu(tmp_path))


def test_an_archive_that_is_damaged_inside_is_refused(tmp_path):
    path = archive(tmp_path)
    content = bytearray(path.read_bytes())
    start = content.index(b"modelDescription.xml") + 60
    content[start : start + 20] = bytes(20)
    path.write_bytes(content)
    with pytest.raises(InputError, match="an undamaged FMU"):
        plant_of(path)


def test_an_archive_that_is_cut_off_is_refused(tmp_path):
    path = archive(tmp_path)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError, match="a readable FMU, which is a zip archive"):
        plant_of(path)


def test_a_symbolic_link_is_refused(tmp_path):
    path = archive(tmp_path)
    link = zipfile.ZipInfo("resources/link")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(path, "a") as more:
        more.writestr(link, "/etc/hostname")
    with pytest.raises(InputError, match=r"without symbolic links \('resources/link' is one\)"):
        plant_of(path)


def test_an_archive_larger_than_allowed_or_than_the_disk_is_refused(tmp_path, monkeypatch):
    path = archive(tmp_path)
    check_archive(path, free=10**9)
    with pytest.raises(RefusedError, match="fits on the disk"):
        check_archive(path, free=100)
    monkeypatch.setattr(fmu_file, "MAX_FILES", 1)
    with pytest.raises(RefusedError, match="at most 1 files"):
        check_archive(path, free=10**9)
    monkeypatch.undo()
    monkeypatch.setattr(fmu_file, "MAX_BYTES", 100)
    with pytest.raises(RefusedError, match="at most 100 bytes"):
        check_archive(path, free=10**9)
    monkeypatch.undo()
    monkeypatch.setattr(fmu_file, "MAX_DESCRIPTION_BYTES", 100)
    with pytest.raises(RefusedError, match=r"a modelDescription.xml of at most 100 bytes"):
        check_archive(path, free=10**9)


def test_a_table_of_contents_that_lies_about_a_size_unpacks_no_more_than_it_says(tmp_path):
    path = archive(tmp_path, more={"resources/zeros": bytes(1_000_000)})
    content = path.read_bytes().replace((1_000_000).to_bytes(4, "little"), (1_000).to_bytes(4, "little"))
    path.write_bytes(content)
    check_archive(path, free=100_000)
    with pytest.raises(RefusedError, match="an undamaged FMU"):
        fmu_file.unpack(path, tmp_path / "out")
    assert sum(file.stat().st_size for file in (tmp_path / "out").rglob("*") if file.is_file()) < 100_000
