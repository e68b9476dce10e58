"""An FMU of any process, for co-simulation or model exchange, as a plant for loops (`jaxmpc.process.plant.StatefulPlant`).

`FmuPlant` maps MVs, CVs and disturbances to variables of the FMU by name, moves the actuators, and steps the FMU in a
process of its own (`identify.fmu_process`). FMPy's own simulation would interpolate continuous inputs between samples; the
plant sets them and steps explicitly, which holds them.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from identify.fmu_description import NUMBERS, FmuDescription, FmuVariable, Value
from identify.fmu_process import TIME_LIMIT, FmuProcess
from jaxmpc.check import among, is_number
from jaxmpc.errors import InputError, PlantError
from jaxmpc.process.actuator import Actuator
from jaxmpc.process.plant import Outputs, Parameter, Signals, checked_parameters

MvActuator = Actuator | tuple[float, float] | None


def validate_fmu(path: str | Path) -> list[str]:
    """Problems that FMPy's validator finds in an FMU; empty if there are none.

    Raises:
        InputError: for a file that is no FMU of FMI 2.0 or 3.0, with the reason.
    """
    from fmpy.validation import validate_fmu as validate

    FmuProcess(path).close()
    return list(validate(str(path)))


def fmu_digest(path: str | Path) -> str:
    """Of the content of an FMU."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


class FmuPlant:
    """An FMU as a plant that keeps its state, in a process of its own.

    Use it as a context manager, or `close` it; that ends the process and removes the unpacked files. One
    instance serves any number of runs, one at a time: `init` begins a new one.

    Numbers are rounded to whole ones for integers, to the nearest value for enumerations, and are true from 0.5 on for
    Booleans; they stay within the least and greatest value that the FMU declares.

    Args:
        path: of the FMU.
        mv: names of the MVs, inputs or tunable parameters of the FMU, in order; or by name what moves them: an `Actuator`,
            limits ``(low, high)`` of the demand [MV unit], or None.
        cv: names of the CVs, in order.
        disturbances: names of variables that are disturbed, or their undisturbed values by name; by default those that they
            start with. The loop gives how far off they are.
        dt: sampling interval [s].
        variables: variables of the FMU by the names of MVs, CVs and disturbances that are called otherwise in it.
        start: start values and parameters by their names in the FMU; enumerations by name or value.
        working_point: of MVs by name, if not their start values.
        positions: variables by MV that tell where its actuator stands; it is where the demand moves it if not given.
        substep: step of the FMU [s], a whole number of them in `dt`; by default its own, or that of its default experiment.
        settle: simulated with the MVs at their working point before `init` returns [s].
        stop_time: end of the longest run [s], for FMUs that want to know it, settling included.
        time_limit: for one call of the FMU [s].
        description: of the FMU, if it has been read.

    Attributes:
        description: what the FMU says of itself.
        token: its GUID or instantiation token.
        fmi: its major FMI version.
        disturbance_names: variables that are disturbed.
        substep: step of the FMU [s].
        working_point: ``"mv"`` [MV unit].

    Raises:
        InputError: for a file that is no such FMU, or for variables that it has not, with near names, or that cannot be used
            in this way, before anything runs.
        PlantError: if the FMU crashes, hangs, reports an error or gives what is no number; so do `init`, `step`, `measure`.
    """

    def __init__(
        self,
        path: str | Path,
        mv: Sequence[str] | Mapping[str, MvActuator],
        cv: Sequence[str],
        disturbances: Sequence[str] | Mapping[str, Value] = (),
        *,
        dt: float,
        variables: Mapping[str, str] | None = None,
        start: Mapping[str, Value] | None = None,
        working_point: Mapping[str, Value] | None = None,
        positions: Mapping[str, str] | None = None,
        substep: float | None = None,
        settle: float = 0.0,
        stop_time: float | None = None,
        time_limit: float = TIME_LIMIT,
        description: FmuDescription | None = None,
    ):
        self._arguments = {
            name: value for name, value in locals().items() if name not in ("self", "description")
        }
        for name, value in (("dt", dt), ("substep", substep), ("stop_time", stop_time)):
            given = value is not None or name == "dt"
            if given and not (is_number(value) and value > 0):  # type: ignore[operator]
                raise InputError(f"plant.{name}", value, "a positive number of seconds")
        if not is_number(settle) or settle < 0:
            raise InputError("plant.settle", settle, "a number of seconds, 0 or more")
        self.path, self.dt, self.time_limit = Path(path), float(dt), time_limit
        self._stop, self._begun = stop_time, False
        self._process: FmuProcess | None = None
        if description is None:
            self._process = FmuProcess(path, time_limit)
            description = self._process.description
        self.description = description
        try:
            self.token, self.fmi = self.description.token, self.description.fmi
            self._check_description()
            self.substep, self._count = self.description.step_of(self.dt, substep)
            self._settle = math.ceil(settle / self.substep - 1e-9)
            self._variables = dict(variables or {})
            self._take_start(start or {})
            self._take_mvs(mv, working_point or {}, positions or {})
            self._take_cvs(cv)
            self._take_disturbances(disturbances)
            if self._process:
                self._process.load()
        except BaseException:
            self.close()
            raise

    # ------------------------------------------------------------------------------------------------ what is given

    def _check_description(self) -> None:
        """Refuse an FMU of another process; for plants of a single one."""

    def _take_start(self, start: Mapping[str, Value]) -> None:
        self._start_values: dict[str, Value] = {}
        for name, value in start.items():
            found = self.description.variable("plant.start", name)
            if not found.settable or found.type not in (*NUMBERS, "String"):
                expected = f"a start value or a parameter (this is {_kind(found)})"
                raise InputError("plant.start", name, expected)
            self._start_values[name] = found.exactly(f"plant.start.{name}", value)

    def _take_mvs(self, mv: Any, working_point: Mapping[str, Value], positions: Mapping[str, str]) -> None:
        actuators = dict(mv) if isinstance(mv, Mapping) else dict.fromkeys(_names("plant.mv", mv))
        self.mv_names = tuple(actuators)
        self._mvs = [self._moved("plant.mv", name) for name in actuators]
        self._actuators = [_actuator(name, given) for name, given in actuators.items()]
        for field, given in (("working_point", working_point), ("positions", positions)):
            for name in given:
                among(f"plant.{field}", name, actuators, "one of the MVs")
        self.working_point = np.array(
            [
                self._rest("plant.working_point", name, found, working_point)
                for name, found in zip(self.mv_names, self._mvs, strict=True)
            ]
        )
        self._positions = {
            self.mv_names.index(name): self._read("plant.positions", told).name
            for name, told in positions.items()
        }

    def _take_cvs(self, cv: Sequence[str]) -> None:
        self.cv_names = _names("plant.cv", cv)
        self._cvs = [self._read("plant.cv", name) for name in self.cv_names]
        self._outputs = (*(found.name for found in self._cvs), *self._positions.values())

    def _take_disturbances(self, disturbances: Any) -> None:
        given = disturbances if isinstance(disturbances, Mapping) else {}
        self.disturbance_names = _names("plant.disturbances", disturbances)
        self._disturbed = [self._moved("plant.disturbances", name) for name in self.disturbance_names]
        twice = {v.name for v in self._disturbed} & {v.name for v in self._mvs}
        if twice:
            raise InputError("plant.disturbances", min(twice), "a variable that is no MV")
        found = zip(self.disturbance_names, self._disturbed, strict=True)
        self._undisturbed = np.array([self._rest("plant.disturbances", name, v, given) for name, v in found])

    def _moved(self, field: str, name: str) -> FmuVariable:
        """A variable that is set while the FMU runs."""
        found = self.description.variable(field, self._variables.get(name, name))
        if not found.movable or found.type not in NUMBERS:
            expected = f"an input or a tunable parameter that holds a number (this is {_kind(found)})"
            raise InputError(field, name, expected)
        return found

    def _read(self, field: str, name: str) -> FmuVariable:
        """A variable that is measured."""
        found = self.description.variable(field, self._variables.get(name, name))
        if found.causality not in ("output", "local") or found.type not in NUMBERS:
            expected = f"an output or a local variable that holds a number (this is {_kind(found)})"
            raise InputError(field, found.name, expected)
        return found

    def _rest(self, field: str, name: str, found: FmuVariable, given: Mapping[str, Value]) -> float:
        """The value of a moved variable at rest: the given one, or that which it starts with."""
        if name in given:
            return float(found.exactly(f"{field}.{name}", given[name]))
        start = self._start_values.get(found.name)
        value = found.number if start is None else float(start)
        if value is None:
            raise InputError(f"{field}.{name}", "nothing", f"{found.expected}: the FMU has no start value")
        return value

    # ------------------------------------------------------------------------------------------------------- a run

    def init(self) -> Any:
        """Begin a new run with the MVs at their working point, let it settle, and measure."""
        self._begin(self.working_point, 0.0)
        if self._settle:
            self._fmu.step(self.substep, count=self._settle)
        return self.measure()

    def _begin(self, mv: Any, disturbance: Any, values: Mapping[str, Value] | None = None) -> None:
        """Begin a new run with these MVs and disturbances held, and more start values."""
        if self._process is None:
            self._process = FmuProcess(self.path, self.time_limit)
        self._position, self._begun = np.array(mv, dtype=np.float64), True
        moved = [v.nearest(x) for v, x in zip(self._mvs, self._position, strict=True)]
        inputs = self._inputs(moved, disturbance)
        self._fmu.start(self._start_values | dict(values or {}), inputs, self._stop)

    def step(self, mv, disturbance: Any = 0.0) -> Any:
        """One sample: move the actuators, hold the inputs for `dt`, and measure at the end.

        Args:
            mv: demands [MV unit].
            disturbance: how far the disturbed variables are off during the sample, in the order of `disturbance_names`, or
                one number.

        Raises:
            InputError: for anything but finite numbers, one per MV and disturbance; nothing has moved then.
        """
        fmu = self._fmu
        inputs = self._demanded(mv, disturbance)
        return self._measured(fmu.step(self.substep, inputs, self._outputs, self._count))

    def hold(self, mv, samples: int) -> Float[np.ndarray, "sample cv"]:
        """As `step`, for many samples of the same demands, undisturbed, in a tenth of the time; CVs at their ends."""
        fmu = self._fmu
        rows = fmu.hold(self.substep, self._demanded(mv, 0.0), self._outputs, self._count, samples)
        bad = next((row for row in rows if not np.isfinite(np.array(row, dtype=np.float64)).all()), [])
        self._numbers(bad)
        return np.array(rows, dtype=np.float64)[:, : len(self.cv_names)]

    def _demanded(self, mv: Any, disturbance: Any) -> dict[str, Value]:
        """Move the actuators; returns what is given to the FMU."""
        demand = np.asarray(mv, dtype=np.float64)
        if demand.shape != self.working_point.shape or not np.isfinite(demand).all():
            units = ", ".join(f"{v.name} [{v.unit}]" if v.unit else v.name for v in self._mvs)
            raise InputError("mv", mv, f"finite numbers, one per MV: {units}")
        moves = zip(self._mvs, self._actuators, self._position, demand, strict=True)
        moved = [v.nearest(one.move(now, to)) for v, one, now, to in moves]
        inputs = self._inputs(moved, disturbance)
        self._position = np.array(moved, dtype=np.float64)
        return inputs

    def _inputs(self, moved: Sequence[Value], disturbance: Any) -> dict[str, Value]:
        """What is given to the FMU with the actuators at these positions."""
        given = {v.name: value for v, value in zip(self._mvs, moved, strict=True)}
        off = np.asarray(disturbance, dtype=np.float64)
        if off.shape not in ((), self._undisturbed.shape):
            expected = f"one number, or one each for {', '.join(self.disturbance_names) or 'no disturbance'}"
            raise InputError("disturbance", disturbance, expected)
        values = self._undisturbed + off
        for v, value in zip(self._disturbed, values.tolist(), strict=True):
            if not math.isfinite(value):
                raise InputError(v.name, value, f"a finite change{f' [{v.unit}]' if v.unit else ''}")
            given[v.name] = v.nearest(value)
        return given

    def measure(self) -> Any:
        """What the FMU measures now."""
        return self._measured(self._fmu.get(self._outputs))

    def _measured(self, values: Sequence[Any]) -> Any:
        """Outputs from the values of `_outputs`."""
        y = self._numbers(values)
        mv = self._position.copy()
        for k, told in zip(self._positions, y[len(self.cv_names) :], strict=True):
            mv[k] = told
        return Outputs(y[: len(self.cv_names)], mv)

    def _numbers(self, values: Sequence[Any]) -> np.ndarray:
        y = np.array(values, dtype=np.float64)
        if not np.isfinite(y).all():
            bad = int(np.flatnonzero(~np.isfinite(y))[0])
            raise PlantError(f"{self.path}: the FMU gives {y[bad]:g} for {self._outputs[bad]}")
        return y

    @property
    def _fmu(self) -> FmuProcess:
        if self._process is None or not self._begun:
            raise InputError("plant", "closed", "a plant after init()")
        return self._process

    # -------------------------------------------------------------------------------------------------- other plants

    @property
    def parameter_table(self) -> tuple[Parameter, ...]:
        """What `replaced` takes: the parameters of the FMU that hold one number and have a start value."""
        found = []
        for v in self.description.variables.values():
            default = self._start_values.get(v.name, v.number)
            if (
                v.causality == "parameter"
                and v.settable
                and v.type in NUMBERS
                and default is not None
                and not v.shape
            ):
                found.append(Parameter(v.name, v.unit or "1", float(default), v.text, *v.limits))
        return tuple(found)

    def replaced(self, values: Mapping[str, Any]) -> FmuPlant:
        """The same plant with other parameters; its process starts with its first `init`.

        Raises:
            InputError: at ``plant.NAME`` for a name that is not in `parameter_table`, or a value that cannot be.
        """
        checked = checked_parameters(self.parameter_table, values)
        found = {name: self.description.variables[name] for name in checked}
        new = {
            name: found[name].exactly(f"plant.{name}", np.asarray(v).tolist()) for name, v in checked.items()
        }
        start = {**(self._arguments["start"] or {}), **new}
        return FmuPlant(**(self._arguments | {"start": start, "description": self.description}))

    @property
    def signals(self) -> Signals:
        """Names and units of its CVs, MVs and disturbances."""
        units = (tuple(v.unit or "" for v in own) for own in (self._cvs, self._mvs, self._disturbed))
        return Signals(self.cv_names, self.mv_names, *units)

    def facts(self) -> dict[str, Any]:
        """What the plant is, with a digest of everything that decides its responses."""
        how = (
            (self.mv_names, self._actuators, self.working_point.tolist(), self._positions),
            (self.cv_names, self.disturbance_names, self._undisturbed.tolist(), self._variables),
            (sorted(self._start_values.items()), self.substep, self._count, self._settle, self._stop),
        )
        digest = hashlib.sha256(self.path.read_bytes() + repr(how).encode())
        return {"kind": "fmu", "hash": digest.hexdigest()[:32], "fmi": self.fmi}

    def close(self) -> None:
        """Free the FMU, end its process, and remove the unpacked files; twice is once. `init` starts another."""
        process, self._process, self._begun = self._process, None, False
        if process is not None:
            process.close()

    def __enter__(self) -> FmuPlant:
        return self

    def __exit__(self, *_) -> None:
        self.close()


def _names(field: str, given: Any) -> tuple[str, ...]:
    """Names that are given as a list or as keys, each once."""
    names = () if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    empty = not names and field != "plant.disturbances"
    if (
        isinstance(given, str)
        or empty
        or len(set(names)) != len(names)
        or not all(isinstance(n, str) for n in names)
    ):
        raise InputError(field, given, "names of variables of the FMU, each once")
    return names


def _actuator(name: str, given: MvActuator) -> Actuator:
    if isinstance(given, Actuator):
        return given
    if given is None:
        return Actuator()
    if not isinstance(given, (tuple, list)) or len(given) != 2:
        raise InputError(f"plant.mv.{name}", given, "an Actuator, limits (low, high) [MV unit], or None")
    try:
        return Actuator(low=given[0], high=given[1])
    except (InputError, TypeError):
        raise InputError(f"plant.mv.{name}", given, "limits (low, high), low below high [MV unit]") from None


def _kind(found: FmuVariable) -> str:
    """In words, what a variable is."""
    return f"{found.type}, {found.variability} {found.causality}"
