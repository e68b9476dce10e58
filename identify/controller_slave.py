"""The program inside the FMU of a controller (FMI 2.0, co-simulation): one step of the controller at every sampling instant.

`identify.controller_fmu` puts this file into the FMU beside the controller; PythonFMU's library runs it there, in the Python
of the program that loads the FMU. It stands alone: of this project it needs `jaxmpc` only.
"""

from __future__ import annotations

import atexit
import contextlib
import copy
import ctypes
import json
import math
import os
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pythonfmu import (
    Boolean,
    DefaultExperiment,
    Fmi2Causality,
    Fmi2Slave,
    Fmi2Variability,
    Integer,
    Real,
    String,
)

from jaxmpc import load_controller
from jaxmpc import status as codes
from jaxmpc.controller.measurement import IMPLAUSIBLE
from jaxmpc.errors import InputError

CONTROLLER, START = "controller.json", "start.json"  # files in the FMU
NOT_STARTED = -1  # status before the first sample
NEARLY = 1e-6  # of a sampling interval: how far from an instant is still at it
INPUT, OUTPUT, PARAMETER = Fmi2Causality.input, Fmi2Causality.output, Fmi2Causality.parameter


class Number(Real):
    """A real variable with its unit, whose start value is written in full."""

    def __init__(self, name: str, unit: str = "", **more: Any):
        super().__init__(name, **more)
        self.unit = unit

    def to_xml(self) -> Element:
        """PythonFMU's element with what it leaves out."""
        element = super().to_xml()
        number = next(element.iter("Real"))
        if self.unit:
            number.set("unit", self.unit)
        if self.start is not None:
            number.set("start", "NaN" if math.isnan(self.start) else repr(self.start))
        return element


def samples_in(since: float, step: float, interval: float) -> int:
    """Sampling instants from the begin of a communication step to before its end.

    Args:
        since: when the step begins, from the start of the run on [s].
        step: its length [s].
        interval: sampling interval [s].

    Raises:
        InputError: for a step that is neither a whole number of sampling intervals nor a whole fraction of one, and one that
            begins between two instants and passes the second: nobody knows what is measured there.
    """
    ratio = step / interval
    parts = max(ratio, 1 / ratio) if 0 < ratio < math.inf else 0.5
    if abs(parts - round(parts)) > NEARLY * parts:
        expected = f"a whole number of sampling intervals of {interval:g} s, or a whole fraction of one"
        raise InputError("communication step size [s]", step, expected)
    begin, end = since / interval, (since + step) / interval
    first, after = (math.ceil(time - NEARLY) for time in (begin, end))
    if after > first and first - begin > NEARLY:
        expected = f"no step over the sampling instant at {first * interval:g} s that begins before it"
        raise InputError("communication step [s]", f"{since:g} to {since + step:g}", expected)
    return after - first


def leave_soundly(folder: Path) -> None:
    """Let PythonFMU's library forget its state before the process ends, when it would free it twice and corrupt memory.

    Only where the process is one of Python: elsewhere this state is what keeps Python running.
    """
    if sys.platform != "linux" or not sys.orig_argv:
        return
    for library in (folder.parent / "binaries" / "linux64").glob("*.so"):
        # not loaded, where this file is used without FMI; or a version without this function
        with contextlib.suppress(OSError, AttributeError):
            atexit.register(ctypes.CDLL(str(library), os.RTLD_NOLOAD).finalizePythonInterpreter)


class JaxmpcController(Fmi2Slave):
    """A controller that a master of a co-simulation steps.

    A measurement, position or measured disturbance that is not a number was not received; a setpoint that is not a number
    stays as it was. The first sample is taken for a steady state: a CV without a sound measurement then is at its setpoint.
    """

    def __init__(self, **given: Any):
        super().__init__(**given)
        folder = Path(self.resources or "")
        content = (folder / CONTROLLER).read_bytes()
        self.guid = uuid.uuid5(uuid.NAMESPACE_OID, content.hex())  # the same controller has the same
        with self._aloud():
            self._controller: Any = load_controller(folder / CONTROLLER)[0]
        self._start: dict[str, float] = json.loads((folder / START).read_text())
        structure, model = self._controller.structure, self._controller.model
        self._structure, self._dvs = structure, model.dv_names
        self._begin, self._state = 0.0, None
        self._setpoint = np.full(structure.cv_count, np.nan)
        self._values: dict[str, Any] = {}
        self.default_experiment = DefaultExperiment(start_time=0.0, step_size=structure.dt)
        self._declare(structure, model)
        leave_soundly(folder)

    def _declare(self, structure: Any, model: Any) -> None:
        """Every variable; the same in every instance, as the description in the FMU was made from one."""
        start = self._start

        def number(name: str, unit: str, value: float, causality: Any, variability: Any, text: str) -> None:
            own = Number(name, unit, causality=causality, variability=variability, description=text)
            self._declared(own, value)

        held, moves, fixed = Fmi2Variability.continuous, Fmi2Variability.discrete, Fmi2Variability.fixed
        units = dict(zip(structure.cv_names, structure.cv_units, strict=False))
        for name in structure.cv_names:
            unit, setpoint = units.get(name, ""), start.get(name, math.nan)
            text = "measurement; not a number where none was received"
            number(name, unit, math.nan, INPUT, held, text)
            text = "not a number: as before, or as first measured"
            number(f"{name}.setpoint", unit, setpoint, INPUT, held, text)
        units = dict(zip(model.dv_names, model.dv_units, strict=False))
        for name in model.dv_names:
            text = "measured disturbance; not a number: as before"
            number(name, units.get(name, ""), math.nan, INPUT, held, text)
        units = dict(zip(structure.mv_names, structure.mv_units, strict=False))
        for name in structure.mv_names:
            unit = units.get(name, "")
            text = "where the actuator stands; not a number: the demand counts as followed"
            number(f"{name}.position", unit, math.nan, INPUT, held, text)
            text = "somebody else moves it: it is predicted from its position, and not moved"
            manual = Boolean(f"{name}.manual", causality=INPUT, variability=moves, description=text)
            self._declared(manual, False)
            text = "where it stands at the start, if its position is not a number"
            number(f"{name}.start", unit, start[name], PARAMETER, fixed, text)
            number(name, unit, start[name], OUTPUT, moves, "demand")
        meanings = ", ".join(f"{code} {word}" for code, word in enumerate(codes.STATUS))
        text = f"of the last step: {meanings}; {NOT_STARTED} before the first"
        own: dict[str, Any] = dict(causality=OUTPUT, variability=moves)
        self._declared(Integer("status", description=text, **own), NOT_STARTED)
        self._declared(String("status_text", description="the same as a word", **own), "")
        text = "there was no plan in the last step: the MVs were held"
        self._declared(Boolean("fallback", description=text, **own), False)
        number("objective", "", math.nan, OUTPUT, moves, "of the last plan")
        number("gap", "", math.nan, OUTPUT, moves, "relative, proven of the last plan")

    def _declared(self, variable: Any, value: Any) -> None:
        name, values = variable.name, self._values
        if name in values:
            raise InputError("controller", name, "a name that stands for one variable of the FMU")
        values[name] = value
        variable.getter = lambda: values[name]
        variable.setter = lambda given: values.__setitem__(name, given)
        self.register_variable(variable)

    def to_xml(self, *options: Any) -> Element:
        """The description; with the units, and names that need not be those of a program."""
        root = super().to_xml(*options)
        root.set("variableNamingConvention", "flat")
        units = dict.fromkeys(v.unit for v in self.vars.values() if isinstance(v, Number) and v.unit)
        if units:
            defined = Element("UnitDefinitions")
            for unit in units:
                SubElement(defined, "Unit", name=unit)
            root.insert(1, defined)  # after CoSimulation, as the schema has it
        found = root.find("ModelStructure/Outputs")
        assert found is not None
        initial = copy.deepcopy(found)  # outputs have values at the start, too
        initial.tag = "InitialUnknowns"
        root[-1].append(initial)
        return root

    def setup_experiment(
        self, start_time: float, stop_time: float | None = None, tolerance: float | None = None
    ) -> None:
        """Sampling instants count from the start on."""
        self._begin = start_time

    def exit_initialization_mode(self) -> None:
        """Compile, so that no sample waits for it."""
        rest = np.nan_to_num(self._read(f"{name}.setpoint" for name in self._structure.cv_names))
        stand = self._read(f"{name}.start" for name in self._structure.mv_names)
        with self._aloud():
            self._controller.step(self._controller.init(rest, stand), rest, rest)
        self._values.update(zip(self._structure.mv_names, stand.tolist(), strict=True))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Step the controller at the sampling instants from now to before the end of the step, with the inputs of now.

        Raises:
            InputError: of `samples_in`.
        """
        with self._aloud():
            for _ in range(samples_in(current_time - self._begin, step_size, self._structure.dt)):
                self._sample()
        return True

    @contextlib.contextmanager
    def _aloud(self) -> Iterator[None]:
        """PythonFMU makes the status "fatal" of an error, and loses its words where logging is off."""
        try:
            yield
        except Exception as error:
            print(f"{self.instance_name}: {error}", file=sys.stderr, flush=True)
            raise

    def _read(self, names: Any) -> np.ndarray:
        return np.array([self._values[name] for name in names], dtype=np.float64)

    def _sample(self) -> None:
        """One step of the controller."""
        cvs, mvs = self._structure.cv_names, self._structure.mv_names
        cv, dv = self._read(cvs), self._read(self._dvs)
        told = self._read(f"{name}.setpoint" for name in cvs)
        position = self._read(f"{name}.position" for name in mvs)
        manual = np.array([bool(self._values[f"{name}.manual"]) for name in mvs])
        self._setpoint = np.where(np.isfinite(told), told, self._setpoint)
        if self._state is None and not self._started(cv, position, dv):
            return
        given = dict(mv=position, manual=manual, dv=dv if len(self._dvs) else None)
        self._state, info = self._controller.step(self._state, cv, self._setpoint, **given)
        self._values.update(zip(mvs, np.asarray(info.mv).tolist(), strict=True))
        status = int(info.status)
        self._values.update(status=status, status_text=codes.STATUS[status], fallback=bool(info.fallback))
        self._values.update(objective=float(info.objective), gap=float(info.gap))

    def _started(self, cv: np.ndarray, position: np.ndarray, dv: np.ndarray) -> bool:
        """Whether enough is known to start, which is then done; until then the MVs stay at their start."""
        tuning = self._controller.tuning
        sound = (abs(cv) < IMPLAUSIBLE) & (cv >= tuning.measurement_low) & (cv <= tuning.measurement_high)
        sound = np.asarray(sound)
        self._setpoint = np.where(np.isfinite(self._setpoint), self._setpoint, np.where(sound, cv, np.nan))
        if not np.isfinite(self._setpoint).all():
            return False
        stand = self._read(f"{name}.start" for name in self._structure.mv_names)
        stand = np.where(np.isfinite(position), position, stand)
        self._state = self._controller.init(np.where(sound, cv, self._setpoint), stand, np.nan_to_num(dv))
        return True
