"""The well as an FMU: building it, and running it as a plant (thesis 3.2).

`build_fmu` compiles the generated sources once and keeps the result in a cache that is keyed by content.
`FmuPlant` steps an FMU, in a process of its own, with the inputs and outputs of the JAX plant. FMPy would
interpolate continuous inputs between samples; the plant sets them and steps explicitly, which holds them.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import io
import os
import platform
import shutil
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from identify.fmu_process import TIME_LIMIT, FmuProcess
from identify.fmu_source import MODEL_IDENTIFIER, fmu_files
from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.files import write_atomically
from jaxmpc.process.plant import Steady
from jaxmpc.process.well.choke import CHOKES, check_choke
from jaxmpc.process.well.equations import (
    DEFAULT_CHOKE,
    DEFAULT_LIFT,
    INPUTS,
    OUTPUTS,
    STATES,
    WellParameters,
    check_parameters,
)
from jaxmpc.process.well.plant import STATE_SCALE, WellOutputs, WellPlant, check_inputs
from jaxmpc.programs.cache import cache_folder, read_sealed, sealed
from jaxmpc.programs.interrupts import in_the_end, run_program

# No fused multiply-adds: the FMU and the JAX plant then round alike.
COMPILER_FLAGS = "-O2 -ffp-contract=off -fno-math-errno"
CACHE_FORMAT = 2  # of the files in the cache: sealed
STEADY_DRIFT = 1e-12  # scaled drift [1/s] below which `init` stops settling
STEADY_SAMPLES = 17280  # 48 h
INPUT_NAMES = tuple(row[0] for row in INPUTS)
OUTPUT_NAMES = tuple(row[0] for row in OUTPUTS)
STATE_NAMES = tuple(f"state.{row[0]}" for row in STATES)
SWITCH = "SepticControl"


def build_fmu(
    fmi: int = 2, out: str | Path | None = None, parameters: WellParameters | None = None, force: bool = False
) -> Path:
    """Build the well as an FMI co-simulation FMU for this machine; a second call builds nothing.

    A damaged FMU in the cache is built anew, and standard error says so.

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
    key = (CACHE_FORMAT, token, sys.platform, platform.machine(), COMPILER_FLAGS)
    name = f"{MODEL_IDENTIFIER}-fmi{fmi}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.fmu"
    cached = cache_folder("fmu") / name
    content = None if force else read_sealed(cached)
    if content is None:
        content = sealed(_compiled(contents))
        write_atomically(cached, content)
    return cached if out is None else write_atomically(out, content)


def _compiler() -> str | None:
    """Path of a C compiler, the one of ``$CC`` first."""
    names = (os.environ.get("CC", ""), "cc", "gcc", "clang", "cl")
    return next((found for name in names if name and (found := shutil.which(name.split()[0]))), None)


def _cmake_options() -> dict[str, str]:
    options = {
        "CMAKE_C_FLAGS:STRING": COMPILER_FLAGS,
        "CMAKE_C_STANDARD_LIBRARIES:STRING": "-lm",
        # FMPy's project asks for a C++ compiler too and never uses it: any path that needs no check will do.
        "CMAKE_CXX_COMPILER:FILEPATH": _compiler() or "",
        "CMAKE_CXX_COMPILER_WORKS:BOOL": "TRUE",
        "CMAKE_CXX_COMPILER_FORCED:BOOL": "TRUE",
    }
    return options if os.name == "posix" else {}


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
    folder = tempfile.mkdtemp(prefix="jaxmpc-fmu-")
    with in_the_end(functools.partial(shutil.rmtree, folder, ignore_errors=True)):
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
        command = [sys.executable, "-P", "-c", code]
        status, said = run_program(command, {**environment, "TMPDIR": str(build)})
        if status != 0:
            raise MissingToolError(
                "Building the FMU failed. A C compiler with its headers is needed (Debian or Ubuntu: "
                f"apt install gcc libc6-dev make). Its last words:\n{said[-3000:]}"
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
    """An FMU of the well, stepped like `jaxmpc.process.well.plant.WellPlant`, with its state in a process of its own.

    Use it as a context manager, or `close` it; that ends the process and removes the unpacked files. One
    instance serves any number of runs: `init` resets it.

    Args:
        path: of the FMU; by default the shipped well, built on first use (FMI 2.0).
        actuator: ``continuous`` or ``step``, see `jaxmpc.process.well.choke`.
        dt: sampling interval [s].
        time_limit: for one call of the FMU [s].

    Attributes:
        token: instantiation token of the FMU, a digest of its contents.
        fmi: major FMI version.
        settled: whether the last `init` found a steady state within 48 hours.

    Raises:
        InputError: for a file that is not an FMU of the well, with the reason.
        MissingToolError: if it has to be built and cannot.
        PlantError: if the FMU crashes, hangs or reports an error; so do `init`, `step`, `measure` and `x`.
    """

    signals, test_steps, check_mv = WellPlant.signals, WellPlant.test_steps, staticmethod(WellPlant.check_mv)

    def __init__(
        self,
        path: str | Path | None = None,
        actuator: str = "continuous",
        dt: float = 10.0,
        time_limit: float = TIME_LIMIT,
    ):
        self.actuator = check_choke(actuator, "plant.actuator")
        if isinstance(dt, bool) or not isinstance(dt, (int, float)) or not 0 < dt < np.inf:
            raise InputError("plant.dt", dt, "a positive number of seconds")
        self.dt = float(dt)
        self.path = Path(path) if path is not None else build_fmu()
        self._fmu = FmuProcess(self.path, time_limit)
        self.token, self.fmi = self._fmu.token, self._fmu.fmi
        try:
            self._check_variables()
            self.init()
        except BaseException:
            self._fmu.close()
            raise

    def _check_variables(self) -> None:
        """Refuse an FMU of something else."""
        number = "Float64" if self.fmi == 3 else "Real"
        wanted = dict.fromkeys((*INPUT_NAMES, *OUTPUT_NAMES, *STATE_NAMES), number) | {SWITCH: "Boolean"}
        found = {name: kind for name, (kind, _) in self._fmu.variables.items()}
        missing = [name for name in wanted if name not in found]
        wrong = [(name, kind) for name, kind in wanted.items() if found.get(name) != kind]
        if wrong:
            name, kind = wrong[0]
            fault = (
                f"without {', '.join(missing)} it is not"
                if missing
                else f"{name} is {found[name]}, not {kind}"
            )
            raise InputError("plant.path", str(self.path), f"an FMU of the well ({fault})")

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
            x: ``"8"``, states to start from instead, in the order and units of `jaxmpc.process.well.equations.STATES`.

        Raises:
            InputError: for inputs outside their range, or states of the wrong shape or not finite.
        """
        check_inputs(choke, lift, disturbance)
        if x is not None and (np.shape(x) != (len(STATES),) or not np.isfinite(x).all()):
            raise InputError("x", x, f"{len(STATES)} finite states")
        inputs = _floats(INPUT_NAMES, (choke, lift, disturbance))
        self._start(inputs, x)
        self.settled = True
        if x is None and (choke, lift, disturbance) != (DEFAULT_CHOKE, DEFAULT_LIFT, 0.0):
            self._start(inputs, self._settle())  # again, so that time is zero
        self._position, self._lift = float(choke), float(lift)
        return self.measure()

    reset = init

    @property
    def identity(self) -> tuple[str, str]:
        """Its kind, and its token."""
        return "fmu", self.token

    def steady(self, mv, disturbance: float = 0.0) -> Steady:
        """Start in the steady state of a choke [%] and a lift [m3/h], as `init`; the FMU keeps its state."""
        return Steady(None, self.init(float(mv[0]), float(mv[1]), disturbance), self.settled)

    def _start(self, inputs: dict[str, float], x) -> None:
        self._fmu.start({} if x is None else _floats(STATE_NAMES, x))
        # The switch returns to false with every start.
        self._fmu.set({SWITCH: True, **inputs})

    def _settle(self) -> list[float]:
        before = self._fmu.get(STATE_NAMES)
        for _ in range(STEADY_SAMPLES // 60):
            after = self._fmu.step(self.dt, outputs=STATE_NAMES, count=60)
            drift = np.max(np.abs(np.subtract(after, before)) / STATE_SCALE)
            self.settled = bool(drift < STEADY_DRIFT * 60 * self.dt)
            before = after
            if self.settled:
                break
        return before

    def step(self, mv, disturbance: Any = 0.0) -> WellOutputs:
        """One sample: move the actuators, hold the inputs for `dt`, and measure at the end.

        Args:
            mv: choke demand [%] (limited to 0..100 by the choke) and lift demand [m3/h] (0 or more).
            disturbance: offset of the reservoir pressure during the sample [bar].

        Raises:
            InputError: for anything but two finite numbers and a finite disturbance; nothing has moved then.
        """
        demand = np.asarray(mv, dtype=np.float64)
        if demand.shape != (2,) or not np.isfinite(demand).all():
            raise InputError("mv", mv, "choke [%] and lift [m3/h], two finite numbers")
        offset = float(np.asarray(disturbance, dtype=np.float64).reshape(()))
        if not np.isfinite(offset):
            raise InputError("reservoir_pressure_offset", offset, "a finite pressure change [bar]")
        self._position = float(CHOKES[self.actuator].move(self._position, demand[0]))
        self._lift = max(float(demand[1]), 0.0)
        inputs = _floats(INPUT_NAMES, (self._position, self._lift, offset))
        return self._measured(self._fmu.step(self.dt, inputs, OUTPUT_NAMES))

    def measure(self) -> WellOutputs:
        """What the FMU measures now."""
        return self._measured(self._fmu.get(OUTPUT_NAMES))

    def _measured(self, y: list[float]) -> WellOutputs:
        return WellOutputs(np.array(y[:2]), np.array([self._position, self._lift]), *y[2:])

    @property
    def x(self) -> np.ndarray:
        """``"8"``, the states in the order and units of `jaxmpc.process.well.equations.STATES`."""
        return np.array(self._fmu.get(STATE_NAMES))

    def close(self) -> None:
        """Free the FMU, end its process, and remove the unpacked files; twice is once."""
        self._fmu.close()

    def __enter__(self) -> FmuPlant:
        return self

    def __exit__(self, *_) -> None:
        self.close()


def _floats(names: tuple[str, ...], values) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}
