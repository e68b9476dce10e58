"""The well as an FMU: building it, and running it as a plant (thesis 3.2). The only importer of FMPy.

`build_fmu` compiles the generated sources once and keeps the result in a cache that is keyed by content.
`FmuPlant` steps an FMU with the inputs and outputs of the JAX plant. FMPy would interpolate continuous inputs
between samples; the plant sets them and steps explicitly, which holds them.
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import weakref
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from identify.fmu_source import MODEL_IDENTIFIER, fmu_files
from jaxmpc import files
from jaxmpc.actuator import check_actuator, move_choke
from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.files import write_atomically
from jaxmpc.plant import STATE_SCALE, WellOutputs, check_inputs
from jaxmpc.well import DEFAULT_CHOKE, DEFAULT_LIFT, INPUTS, OUTPUTS, STATES, WellParameters, check_parameters

# No fused multiply-adds: the FMU and the JAX plant then round alike.
COMPILER_FLAGS = "-O2 -ffp-contract=off -fno-math-errno"
STEADY_DRIFT = 1e-12  # scaled drift [1/s] below which `init` stops settling
STEADY_SAMPLES = 17280  # 48 h


def cache_folder() -> Path:
    """Where built FMUs are kept, see `jaxmpc.files.cache_folder`."""
    return files.cache_folder("fmu")


def build_fmu(
    fmi: int = 2, out: str | Path | None = None, parameters: WellParameters | None = None, force: bool = False
) -> Path:
    """Build the well as an FMI co-simulation FMU for this machine; a second call builds nothing.

    Args:
        fmi: 2 or 3, the FMI version.
        out: where to put the ``.fmu`` (replaced in one go); by default it stays in the cache.
        parameters: of the well; the shipped ones by default.
        force: build although the cache has it.

    Returns:
        Path of the FMU. It contains its C sources.

    Raises:
        InputError: for an unknown FMI version, a bad parameter, or a folder as `out`.
        MissingToolError: without a C compiler or cmake, saying what to install.
    """
    if isinstance(fmi, bool) or fmi not in (2, 3):
        raise InputError("fmi", fmi, "2 or 3, the FMI version")
    if out is not None and (Path(out).is_dir() or Path(out).suffix != ".fmu"):
        raise InputError("out", str(out), "the path of a file that ends in .fmu")
    parameters = check_parameters(WellParameters() if parameters is None else parameters)
    contents, token = fmu_files(fmi, parameters)
    machine = hashlib.sha256(repr((token, sys.platform, platform.machine(), COMPILER_FLAGS)).encode())
    cached = cache_folder() / f"{MODEL_IDENTIFIER}-fmi{fmi}-{machine.hexdigest()[:16]}.fmu"
    if force or not cached.exists():
        write_atomically(cached, _compiled(contents))
    return cached if out is None else write_atomically(out, cached.read_bytes())


def _compiler() -> str | None:
    """Path of a C compiler, the one of ``$CC`` first."""
    names = (os.environ.get("CC", ""), "cc", "gcc", "clang", "cl")
    return next((found for name in names if name and (found := shutil.which(name.split()[0]))), None)


def _cmake_options() -> dict[str, str]:
    if os.name != "posix":
        return {}
    return {
        "CMAKE_C_FLAGS:STRING": COMPILER_FLAGS,
        "CMAKE_C_STANDARD_LIBRARIES:STRING": "-lm",
        # FMPy's project asks for a C++ compiler too and never uses it: any path that needs no check will do.
        "CMAKE_CXX_COMPILER:FILEPATH": _compiler() or "",
        "CMAKE_CXX_COMPILER_WORKS:BOOL": "TRUE",
        "CMAKE_CXX_COMPILER_FORCED:BOOL": "TRUE",
    }


def _tools() -> dict[str, str]:
    """Environment in which cmake and a C compiler are found; cmake's PyPI package serves if PATH has none."""
    environment = dict(os.environ)
    missing = []
    if not shutil.which("cmake"):
        package = importlib.util.find_spec("cmake")
        if package and package.origin:
            folder = str(Path(package.origin).parent / "data" / "bin")
            environment["PATH"] = folder + os.pathsep + environment.get("PATH", "")
        if not shutil.which("cmake", path=environment.get("PATH")):
            missing.append("cmake")
    if not _compiler():
        missing.append("a C compiler")
    if not missing and not shutil.which("make") and not shutil.which("ninja") and os.name == "posix":
        missing.append("make")
    if missing:
        raise MissingToolError(
            f"Cannot build the FMU: {' and '.join(missing)} not found. On Debian or Ubuntu: "
            "apt install gcc libc6-dev make (and cmake, or: pip install cmake); on macOS: "
            "xcode-select --install. The JAX well needs none of this: --plant jax."
        )
    return environment


def _compiled(contents: dict[str, str]) -> bytes:
    """Compile the sources in a temporary folder and return the zipped FMU."""
    environment = _tools()
    with tempfile.TemporaryDirectory(prefix="jaxmpc-fmu-") as folder:
        tree, build = Path(folder, "fmu").resolve(), Path(folder, "build").resolve()
        build.mkdir()
        for name, content in contents.items():
            path = tree / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
        # A process of its own keeps cmake's output and the changed PATH out of this one.
        code = (
            "from fmpy.build import build_platform_binary as build; "
            f"build({str(tree)!r}, {str(build)!r}, cmake_options={_cmake_options()!r})"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            raise MissingToolError(
                "Building the FMU failed. A C compiler with its headers is needed (Debian or Ubuntu: "
                f"apt install gcc libc6-dev make). Its last words:\n{(done.stdout + done.stderr)[-3000:]}"
            )
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as zipped:
            for path in sorted(p for p in tree.rglob("*") if p.is_file()):
                # A fixed date keeps equal FMUs equal.
                zipped.writestr(zipfile.ZipInfo(path.relative_to(tree).as_posix()), path.read_bytes())
        return archive.getvalue()


def validate_fmu(path: str | Path) -> list[str]:
    """Problems that FMPy's validator finds in an FMU; empty if there are none."""
    from fmpy.validation import validate_fmu as validate

    return list(validate(str(path)))


class FmuPlant:
    """An FMU of the well, stepped like `jaxmpc.plant.WellPlant`, with its state inside.

    Use it as a context manager, or `close` it; that unloads the library and removes the unpacked files. One
    instance serves any number of runs: `init` resets it.

    Args:
        path: of the FMU; by default the shipped well, built on first use (FMI 2.0).
        actuator: ``continuous`` or ``step``, see `jaxmpc.actuator`.
        dt: sampling interval [s].

    Attributes:
        token: instantiation token of the FMU, a digest of its contents.
        fmi: major FMI version.
        settled: whether the last `init` found a steady state within 48 hours.

    Raises:
        InputError: for a file that is not an FMU of the well.
        MissingToolError: if it has to be built and cannot.
    """

    def __init__(self, path: str | Path | None = None, actuator: str = "continuous", dt: float = 10.0):
        self.actuator = check_actuator(actuator, "plant.actuator")
        if isinstance(dt, bool) or not isinstance(dt, (int, float)) or not 0 < dt < np.inf:
            raise InputError("plant.dt", dt, "a positive number of seconds")
        self.dt = float(dt)
        self.path = Path(path) if path is not None else build_fmu()
        if not self.path.is_file():
            raise InputError("plant.path", str(self.path), "an existing .fmu file")
        self._folder = tempfile.mkdtemp(prefix="jaxmpc-fmu-")
        self._finalizer = weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        try:
            self._load()
        except Exception:
            self._finalizer()
            raise
        self.init()

    def _load(self) -> None:
        import fmpy
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        try:
            description = fmpy.read_model_description(str(self.path))
            fmpy.extract(str(self.path), self._folder)
        except Exception as error:
            raise InputError("plant.path", str(self.path), f"a readable FMU ({error})") from error
        references = {v.name: v.valueReference for v in description.modelVariables}
        names = {
            "input": [row[0] for row in INPUTS],
            "output": [row[0] for row in OUTPUTS],
            "state": [f"state.{row[0]}" for row in STATES],
        }
        wanted = [*names["input"], *names["output"], *names["state"], "SepticControl"]
        missing = [name for name in wanted if name not in references]
        if missing or not description.coSimulation:
            raise InputError(
                "plant.path", str(self.path), f"a co-simulation FMU of the well with the variables {missing}"
            )
        self._references = {kind: [references[n] for n in group] for kind, group in names.items()}
        self._switch = [references["SepticControl"]]
        self.token = description.guid
        self.fmi = 3 if str(description.fmiVersion).startswith("3") else 2
        slave = FMU3Slave if self.fmi == 3 else FMU2Slave
        self._fmu: Any = slave(
            guid=description.guid,
            unzipDirectory=self._folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="well",
        )
        self._fmu.instantiate()

    def _get(self, kind: str) -> list[float]:
        read = self._fmu.getFloat64 if self.fmi == 3 else self._fmu.getReal
        return read(self._references[kind])

    def _set(self, kind: str, values) -> None:
        write = self._fmu.setFloat64 if self.fmi == 3 else self._fmu.setReal
        write(self._references[kind], [float(v) for v in values])

    def init(
        self, choke: float = DEFAULT_CHOKE, lift: float = DEFAULT_LIFT, disturbance: float = 0.0, x=None
    ) -> WellOutputs:
        """Start a new run in the steady state of the given inputs, and measure.

        At the working point that is the steady state stored in the FMU; elsewhere the FMU is simulated with
        held inputs until it has settled, for 48 hours at most.

        Args:
            choke: position [%], 0..100.
            lift: lift rate [m3/h], 0 or more.
            disturbance: offset of the reservoir pressure [bar].
            x: ``"8"``, states to start from instead, in the order and units of `jaxmpc.well.STATES`.

        Raises:
            InputError: for inputs outside their range, or states of the wrong shape or not finite.
        """
        self._open()
        check_inputs(choke, lift, disturbance)
        if x is not None and (np.shape(x) != (len(STATES),) or not np.isfinite(x).all()):
            raise InputError("x", x, f"{len(STATES)} finite states")
        self._start(choke, lift, disturbance, x)
        self.settled = True
        if x is None and (choke, lift, disturbance) != (DEFAULT_CHOKE, DEFAULT_LIFT, 0.0):
            settled = self._settle()
            # Start again, so that time is zero.
            self._start(choke, lift, disturbance, settled)
        self._position, self._lift = float(choke), float(lift)
        return self.measure()

    reset = init

    def _start(self, choke, lift, disturbance, x) -> None:
        self._time = 0.0
        self._fmu.reset()
        if x is not None:
            self._set("state", x)
        if self.fmi == 3:
            self._fmu.enterInitializationMode(startTime=0.0)
        else:
            self._fmu.setupExperiment(startTime=0.0)
            self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        # The switch returns to false with every reset.
        self._fmu.setBoolean(self._switch, [True])
        self._set("input", (choke, lift, disturbance))

    def _settle(self) -> list[float]:
        before = np.array(self._get("state"))
        for _ in range(STEADY_SAMPLES // 60):
            for _ in range(60):
                self._advance()
            after = np.array(self._get("state"))
            self.settled = bool(np.max(np.abs(after - before) / STATE_SCALE) < STEADY_DRIFT * 60 * self.dt)
            before = after
            if self.settled:
                break
        return before.tolist()

    def _advance(self) -> None:
        self._fmu.doStep(self._time, self.dt)
        self._time += self.dt

    def step(self, mv, disturbance: float = 0.0) -> WellOutputs:
        """One sample: move the actuators, hold the inputs for `dt`, and measure at the end.

        Args:
            mv: choke demand [%] (limited to 0..100 by the choke) and lift demand [m3/h] (0 or more).
            disturbance: offset of the reservoir pressure during the sample [bar].

        Raises:
            InputError: for anything but two finite numbers and a finite disturbance; nothing has moved then.
        """
        self._open()
        demand = np.asarray(mv, dtype=np.float64)
        if demand.shape != (2,) or not np.isfinite(demand).all():
            raise InputError("mv", mv, "choke [%] and lift [m3/h], two finite numbers")
        if not np.isfinite(disturbance):
            raise InputError("reservoir_pressure_offset", disturbance, "a finite pressure change [bar]")
        self._position = float(move_choke(self.actuator, self._position, demand[0]))
        self._lift = max(float(demand[1]), 0.0)
        self._set("input", (self._position, self._lift, disturbance))
        self._advance()
        return self.measure()

    def measure(self) -> WellOutputs:
        """What the FMU measures now."""
        self._open()
        y = self._get("output")
        return WellOutputs(np.array(y[:2]), np.array([self._position, self._lift]), *y[2:])

    @property
    def x(self) -> np.ndarray:
        """``"8"``, the states in the order and units of `jaxmpc.well.STATES`."""
        self._open()
        return np.array(self._get("state"))

    def _open(self) -> None:
        if not self._finalizer.alive:
            raise InputError("plant", "closed", "an FMU plant that has not been closed")

    def close(self) -> None:
        """Free the FMU, unload its library, and remove the unpacked files; twice is once."""
        if not self._finalizer.alive:
            return
        self._fmu.terminate()
        self._fmu.freeInstance()
        self._fmu.freeLibrary()
        self._finalizer()

    def __enter__(self) -> FmuPlant:
        return self

    def __exit__(self, *_) -> None:
        self.close()
