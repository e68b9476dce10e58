"""The FMU of the well: its build, its conformance, and its agreement with the JAX plant."""

import ctypes
import gc
import io
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import fmpy
import jax
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

from identify import fmu_build
from identify.fmu import validate_fmu
from identify.well_fmu import WellFmuPlant, build_fmu
from identify.well_fmu_source import INPUT_SEQUENCE, fmu_files
from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.process.well.equations import SHIPPED_STEADY_STATE, WellParameters
from jaxmpc.process.well.plant import WellPlant, WellState, steady_state_of
from tests.process.test_plant import random_demands

PLANT = WellPlant()
run = jax.jit(PLANT.run)
run_stepped = jax.jit(PLANT.with_actuator("step").run)


@pytest.fixture(scope="module", params=[2, 3], ids=["FMI 2.0", "FMI 3.0"])
def path(request):
    try:
        return build_fmu(request.param)
    except MissingToolError as error:
        pytest.skip(str(error))


@pytest.fixture
def plant(path):
    with WellFmuPlant(path) as plant:
        yield plant


def resident_bytes(process="self"):
    with open(f"/proc/{process}/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_validator_finds_nothing(path):
    assert validate_fmu(path) == []


def test_variables_have_the_names_of_the_thesis_and_units(path):
    description = fmpy.read_model_description(str(path))
    variables = {v.name: v for v in description.modelVariables}
    for name, unit in (("choke", "%"), ("gas_lift", "m3/h"), ("reservoir_pressure_offset", "bar")):
        assert variables[name].causality == "input"
        assert variables[name].unit == unit
    assert variables["SepticControl"].type == "Boolean"
    assert variables["SepticControl"].start == "false"
    assert {v.name for v in description.modelVariables if v.causality == "output"} >= {"gas_rate", "oil_rate"}


def test_every_function_of_the_standard_is_exported(path, tmp_path):
    fmi = 3 if "fmi3" in path.name else 2
    header = Path(fmpy.__file__).parent / "c-code" / f"fmi{fmi}Functions.h"
    names = re.findall(rf"^\s*FMI{fmi}_Export\s+\w+\s+(fmi{fmi}\w+);", header.read_text(), flags=re.MULTILINE)
    assert len(names) > 40
    fmpy.extract(str(path), str(tmp_path))
    library = ctypes.cdll.LoadLibrary(str(next(tmp_path.glob("binaries/*/*.so"))))
    assert [name for name in names if not hasattr(library, name)] == []


def test_generated_source_multiplies_instead_of_calling_pow():
    header = fmu_files(2, WellParameters())[0]["sources/model.h"]
    assert "pow(" not in header
    assert header.count("const double t") > 20  # common subexpressions


@pytest.mark.parametrize("seed", range(4))
def test_fmu_agrees_with_the_jax_plant(plant, seed):
    # Even seeds cover the whole box with shut-ins; odd ones stay where the well swings.
    limits = {} if seed % 2 == 0 else {"lift_high": 2000.0}
    demands, offsets = random_demands(np.random.default_rng(seed), 1, 800, **limits)
    _, expected = run(PLANT.init(), demands[0], offsets[0])
    expected = jax.tree.map(np.asarray, expected)
    plant.init()
    for i, (mv, offset) in enumerate(zip(demands[0], offsets[0], strict=True)):
        outputs = plant.step(mv, offset)
        for a, b in zip(outputs, expected, strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-9, atol=1e-9)


def test_fmu_agrees_from_any_state(plant):
    x = np.array(SHIPPED_STEADY_STATE) * np.random.default_rng(3).uniform(0.7, 1.3, 8)
    mv = np.array([35.0, 1500.0])
    state, expected = jax.jit(PLANT.step)(WellState(*map(np.asarray, (x, mv[0], mv[1]))), mv)
    plant.init(*mv, x=x)
    np.testing.assert_allclose(plant.step(mv).cv, expected.cv, rtol=1e-12)
    np.testing.assert_allclose(plant.x, state.x, rtol=1e-12)


def test_step_choke_moves_alike_on_both_plants(path):
    demands = np.cumsum(np.random.default_rng(4).uniform(-1.5, 1.5, 200)) + 50.0
    mv = np.stack([demands, np.full(200, 7000.0)], axis=-1)
    _, expected = run_stepped(PLANT.init(), mv)
    with WellFmuPlant(path, actuator="step") as plant:
        positions = [plant.step(row).mv[0] for row in mv]
    np.testing.assert_array_equal(positions, expected.mv[:, 0])
    assert len(set(positions)) > 3


def test_settling_elsewhere_finds_the_steady_state(plant):
    outputs = plant.init(20.0, 5000.0, -2.0)
    assert plant.settled
    expected = steady_state_of(20.0, 5000.0, -2.0, WellParameters())
    np.testing.assert_allclose(outputs.cv, expected.outputs.cv, rtol=1e-8)


def test_init_repeats_a_run_exactly(plant):
    demands, offsets = random_demands(np.random.default_rng(11), 1, 50)
    runs = []
    for _ in range(2):
        plant.init()
        steps = [plant.step(mv, d).cv for mv, d in zip(demands[0], offsets[0], strict=True)]
        runs.append(np.array(steps))
    np.testing.assert_array_equal(*runs)


def test_built_in_sequence_drives_the_well_until_septic_control_is_set(path):
    result = fmpy.simulate_fmu(
        str(path),
        stop_time=16000.0,
        step_size=10.0,
        output_interval=10.0,
        output=["oil_rate", "choke_opening"],
    )
    starts = np.array([row[0] for row in INPUT_SEQUENCE])
    which = np.searchsorted(starts, result["time"][:-1] + 1e-6, side="right") - 1
    demands = np.array(INPUT_SEQUENCE)[which, 1:]
    _, expected = run(PLANT.init(), demands, np.zeros(len(demands)))
    np.testing.assert_allclose(result["oil_rate"][1:], expected.cv[:, 1], rtol=1e-9)
    held = fmpy.simulate_fmu(
        str(path),
        stop_time=2000.0,
        output_interval=10.0,
        start_values={"SepticControl": True},
        output=["oil_rate"],
    )
    np.testing.assert_allclose(held["oil_rate"], held["oil_rate"][0], rtol=1e-9)


def test_fmu_state_is_saved_serialised_and_restored(path, tmp_path):
    fmi = 3 if "fmi3" in path.name else 2
    fmu = loaded(path, tmp_path)
    names = {2: ("FMUstate", "deSerializeFMUstate"), 3: ("FMUState", "deserializeFMUState")}[fmi]
    get, set_, free = (getattr(fmu, f"{verb}{names[0]}") for verb in ("get", "set", "free"))
    serialise, restore = getattr(fmu, f"serialize{names[0]}"), getattr(fmu, names[1])
    references = {v.name: v.valueReference for v in fmpy.read_model_description(str(path)).modelVariables}
    read, write = (fmu.getFloat64, fmu.setFloat64) if fmi == 3 else (fmu.getReal, fmu.setReal)
    time = 0.0

    def step(mv):
        nonlocal time
        write([references["choke"], references["gas_lift"]], mv)
        fmu.doStep(time, 10.0)
        time += 10.0
        return read([references["gas_rate"], references["oil_rate"]])

    fmu.setBoolean([references["SepticControl"]], [True])
    step([40.0, 6000.0])
    saved, then = get(), time
    stored = serialise(saved)
    first = step([60.0, 9000.0])
    step([0.0, 0.0])
    set_(saved)
    time = then
    assert step([60.0, 9000.0]) == first
    again = restore(stored)
    set_(again)
    time = then
    assert step([60.0, 9000.0]) == first
    free(saved)
    free(again)
    fmu.terminate()
    fmu.freeInstance()


def loaded(path, folder):
    """The FMU in this process, initialised, with everything that its standard offers."""
    description = fmpy.read_model_description(str(path))
    slave = FMU3Slave if description.fmiVersion.startswith("3") else FMU2Slave
    fmu = slave(
        guid=description.guid,
        unzipDirectory=str(fmpy.extract(str(path), str(folder))),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="well",
    )
    fmu.instantiate()
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    return fmu


def test_2000_consecutive_runs_leak_nothing(plant):
    demands = np.random.default_rng(12).uniform((0, 0), (100, 10000), (10, 2))

    def runs(count):
        for _ in range(count):
            plant.init()
            for mv in demands:
                plant.step(mv)
        gc.collect()
        return resident_bytes() + resident_bytes(plant._process._process.pid)

    before = runs(200)
    assert runs(2000) - before < 2e6  # bytes: less than 1 kB per run


def test_loading_and_closing_leaves_neither_files_nor_processes_open(path):
    def load(count):
        for _ in range(count):
            with WellFmuPlant(path) as plant:
                folder = plant._process.folder
                assert folder.is_dir()
            assert not folder.exists()
        gc.collect()
        return len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))

    before = load(2)
    assert load(5) == before
    with WellFmuPlant(path) as plant:
        plant.close()
        with pytest.raises(InputError, match="closed"):
            plant.step([50.0, 7500.0])


def test_a_second_build_builds_nothing(path, monkeypatch, tmp_path):
    fmi = 3 if "fmi3" in path.name else 2

    def refuse(*_):
        raise AssertionError("built again")

    monkeypatch.setattr(fmu_build, "compiled", refuse)
    assert build_fmu(fmi) == path
    copy = build_fmu(fmi, tmp_path / "copy.fmu")
    assert copy.read_bytes() == path.read_bytes()
    with pytest.raises(AssertionError, match="built again"):
        build_fmu(fmi, parameters=WellParameters(reservoir_pressure=81e5))


@pytest.mark.parametrize("how", ["cut off", "garbage", "one bit", "empty", "another archive"])
def test_a_damaged_fmu_in_the_cache_is_built_anew_and_named(monkeypatch, tmp_path, capsys, how):
    monkeypatch.setenv("JAXMPC_CACHE", str(tmp_path))
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as zipped:
        zipped.writestr("modelDescription.xml", "<fmiModelDescription/>")
    monkeypatch.setattr(fmu_build, "compiled", lambda contents: archive.getvalue())
    cached = build_fmu()
    sound = cached.read_bytes()
    assert zipfile.ZipFile(cached).testzip() is None
    assert build_fmu() == cached
    assert capsys.readouterr().err == ""
    middle = len(sound) // 2
    cached.write_bytes(
        {
            "cut off": sound[:middle],
            "garbage": b"garbage",
            "one bit": sound[:middle] + bytes([sound[middle] ^ 1]) + sound[middle + 1 :],
            "empty": b"",
            "another archive": archive.getvalue(),
        }[how]
    )
    assert build_fmu(out=tmp_path / "copy.fmu").read_bytes() == sound
    assert cached.read_bytes() == sound
    assert capsys.readouterr().err == f"jaxmpc: {cached} is damaged; it is made anew\n"


def test_an_fmu_of_other_parameters_starts_in_their_steady_state(path, monkeypatch, tmp_path):
    monkeypatch.setenv("JAXMPC_CACHE", str(tmp_path))
    parameters = WellParameters(reservoir_pressure=80e5)
    with WellFmuPlant(build_fmu(2, tmp_path / "other.fmu", parameters)) as plant:
        first = plant.measure().cv
        np.testing.assert_allclose(plant.step([50.0, 7500.0]).cv, first, rtol=1e-9)
        expected = steady_state_of(50.0, 7500.0, 0.0, parameters).outputs.cv
        np.testing.assert_allclose(first, expected, rtol=1e-9)


def test_missing_tools_are_named_and_the_jax_well_still_runs(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("JAXMPC_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(MissingToolError, match=r"a C compiler.*apt install gcc"):
        build_fmu()
    assert not [file for file in (tmp_path / "cache").rglob("*") if file.is_file()]
    assert np.isfinite(jax.jit(PLANT.step)(PLANT.init(), np.array([50.0, 7500.0]))[1].cv).all()


def test_a_c_compiler_and_the_python_package_of_cmake_are_enough(path, monkeypatch, tmp_path):
    pytest.importorskip("cmake")
    tools = tmp_path / "bin"
    tools.mkdir()
    for tool in ("make", "ld", "as", "ar", "ranlib", "uname", "sh"):
        found = fmu_build.shutil.which(tool)
        if found:
            (tools / tool).symlink_to(found)
    compiler = fmu_build.shutil.which("gcc") or fmu_build.shutil.which("cc")
    # A gcc without its C++ half, as on a machine where only gcc was installed.
    (tools / "gcc").write_text(
        f'#!/bin/sh\ncase "$*" in *.cpp*|*.cxx*) exit 1;; esac\nexec {compiler} "$@"\n'
    )
    (tools / "gcc").chmod(0o755)
    monkeypatch.setenv("PATH", str(tools))
    monkeypatch.setenv("JAXMPC_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    fmi = 3 if "fmi3" in path.name else 2
    built = build_fmu(fmi)
    assert validate_fmu(built) == []
    with WellFmuPlant(built) as plant:
        np.testing.assert_allclose(plant.measure().cv, [11012.70003, 185.004338], rtol=1e-8)


@pytest.mark.slow
def test_concurrent_builds_leave_one_sound_fmu(path, tmp_path):
    environment = {**os.environ, "JAXMPC_CACHE": str(tmp_path)}
    code = "from identify.well_fmu import build_fmu; print(build_fmu())"
    runs = [
        subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    paths = {run.communicate(timeout=300)[0].strip() for run in runs}
    assert all(run.returncode == 0 for run in runs)
    assert len(paths) == 1
    assert validate_fmu(paths.pop()) == []
    assert len(list((tmp_path / "fmu").iterdir())) == 1


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda p: p.step([50.0, float("nan")]), "mv"),
        (lambda p: p.step([50.0]), "mv"),
        (lambda p: p.step([50.0, 7500.0], float("inf")), "reservoir_pressure_offset"),
        (lambda p: p.init(choke=200.0), "choke"),
        (lambda p: p.init(lift=-1.0), "gas_lift"),
        (lambda p: p.init(x=[1.0, 2.0]), "x"),
    ],
)
def test_bad_input_is_refused_by_name_and_moves_nothing(plant, call, field):
    plant.step([45.0, 7000.0])
    before = plant.x
    with pytest.raises(InputError) as caught:
        call(plant)
    assert caught.value.field == field
    np.testing.assert_array_equal(plant.x, before)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda folder: build_fmu(1), "fmi"),
        (lambda folder: build_fmu(2, folder), "out"),
        (lambda folder: build_fmu(2, folder / "well.zip"), "out"),
        (lambda folder: build_fmu(parameters=WellParameters(molar_mass=0.0)), "well.molar_mass"),
        (lambda folder: WellFmuPlant(folder / "none.fmu"), "plant.path"),
        (lambda folder: WellFmuPlant(folder / "text.fmu"), "plant.path"),
        (lambda folder: WellFmuPlant(actuator="other"), "plant.actuator"),
        (lambda folder: WellFmuPlant(dt=0.0), "plant.dt"),
    ],
)
def test_bad_builds_and_files_are_refused_by_name(tmp_path, call, field):
    (tmp_path / "text.fmu").write_text("not a zip file")
    with pytest.raises(InputError) as caught:
        call(tmp_path)
    assert caught.value.field == field
    assert sorted(p.name for p in tmp_path.iterdir()) == ["text.fmu"]


def test_token_is_a_digest_of_the_sources():
    tokens = {fmu_files(fmi, WellParameters(gas_oil_ratio=g))[1] for fmi in (2, 3) for g in (26.0, 27.0)}
    assert len(tokens) == 4
