"""The well as an FMU: building it, and running it as a plant (thesis 3.2).

`build_fmu` compiles the generated sources once and keeps the result in a cache that is keyed by content.
`WellFmuPlant` steps it with the inputs and outputs of the JAX plant.
"""

from __future__ import annotations

import hashlib
import platform
import sys
from pathlib import Path

import numpy as np

from identify import fmu_build
from identify.fmu import FmuPlant
from identify.fmu_build import COMPILER_FLAGS
from identify.fmu_process import TIME_LIMIT
from identify.well_fmu_source import MODEL_IDENTIFIER, fmu_files
from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically
from jaxmpc.process.well.choke import CHOKES, LIFT, check_choke
from jaxmpc.process.well.equations import (
    DEFAULT_CHOKE,
    DEFAULT_LIFT,
    INPUTS,
    OUTPUTS,
    STATES,
    WellParameters,
    check_parameters,
)
from jaxmpc.process.well.plant import STATE_SCALE, WellOutputs, check_inputs
from jaxmpc.programs.cache import cache_folder, read_sealed, sealed

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
        content = sealed(fmu_build.compiled(contents))
        write_atomically(cached, content)
    return cached if out is None else write_atomically(out, content)


class WellFmuPlant(FmuPlant):
    """An FMU of the well, stepped like `jaxmpc.process.well.plant.WellPlant`; it starts in a steady state.

    Args:
        path: of the FMU; by default the shipped well, built on first use (FMI 2.0).
        actuator: ``continuous`` or ``step``, see `jaxmpc.process.well.choke`.
        dt: sampling interval [s].
        time_limit: for one call of the FMU [s].

    Attributes:
        settled: whether the last `init` found a steady state within 48 hours.

    Raises:
        InputError: for a file that is not an FMU of the well, with the reason.
        MissingToolError: if it has to be built and cannot.
        PlantError: as of `FmuPlant`.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        actuator: str = "continuous",
        dt: float = 10.0,
        time_limit: float = TIME_LIMIT,
    ):
        self.actuator = check_choke(actuator, "plant.actuator")
        super().__init__(
            build_fmu() if path is None else path,
            dict(zip(INPUT_NAMES, (CHOKES[actuator], LIFT), strict=False)),
            OUTPUT_NAMES,
            INPUT_NAMES[2:],
            dt=dt,
            start={SWITCH: True},  # false again after every reset
            working_point=dict(zip(INPUT_NAMES, (DEFAULT_CHOKE, DEFAULT_LIFT), strict=False)),
            time_limit=time_limit,
        )
        try:
            self.init()
        except BaseException:
            self.close()
            raise

    def _check_description(self) -> None:
        number = "Float64" if self.fmi == 3 else "Real"
        wanted = dict.fromkeys((*INPUT_NAMES, *OUTPUT_NAMES, *STATE_NAMES), number) | {SWITCH: "Boolean"}
        found = {name: variable.type for name, variable in self.description.variables.items()}
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
        inputs = (choke, lift), disturbance
        self._begin(*inputs, {} if x is None else _floats(x))
        self.settled = True
        if x is None and (choke, lift, disturbance) != (DEFAULT_CHOKE, DEFAULT_LIFT, 0.0):
            self._begin(*inputs, _floats(self._settled()))  # again, so that time is zero
        return self.measure()

    reset = init

    def _settled(self) -> list[float]:
        before = self._fmu.get(STATE_NAMES)
        for _ in range(STEADY_SAMPLES // 60):
            after = self._fmu.step(self.dt, outputs=STATE_NAMES, count=60)
            drift = np.max(np.abs(np.subtract(after, before)) / STATE_SCALE)
            self.settled = bool(drift < STEADY_DRIFT * 60 * self.dt)
            before = after
            if self.settled:
                break
        return before

    def _measured(self, values) -> WellOutputs:
        y = self._numbers(values)
        return WellOutputs(y[:2], self._position, *y[2:])

    @property
    def x(self) -> np.ndarray:
        """``"8"``, the states in the order and units of `jaxmpc.process.well.equations.STATES`."""
        return np.array(self._fmu.get(STATE_NAMES))


def _floats(x) -> dict[str, float]:
    return {name: float(value) for name, value in zip(STATE_NAMES, x, strict=True)}
