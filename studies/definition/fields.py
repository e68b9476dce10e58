"""The keys of a sweep study: everything that `[base]` can set and an axis can vary, with unit, meaning and default.

A key is the path of the setting below `[base]`, for example ``tuning.deadzone.NAME`` of a CV. `study_fields` makes the one
table of them for a process: definitions are checked against it, axes take units and labels from it, docs list it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from jaxmpc.check import LARGEST
from jaxmpc.errors import InputError, near
from jaxmpc.problem.declared import declared
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS as TUNING
from jaxmpc.problem.tuning import Tuning
from jaxmpc.problem.values import checked_values
from jaxmpc.process.plant import Parameter
from jaxmpc.process.process import BLOCKING, Process

LONGEST = 10_000  # samples of a horizon; more would not fit into memory
Kind = Literal["number", "whole", "flag", "text", "lengths", "values"]


@dataclasses.dataclass(frozen=True)
class Field:
    """One key."""

    key: str  # its path below [base]
    label: str  # what it is, for legends and tables
    unit: str  # of a number ("1" without unit, "" for what is not a number)
    # number, whole number, flag (true or false), text, lengths (of blocks), or values (a list of allowed ones)
    kind: Kind = "number"
    default: Any = None  # what holds where nothing is given; None where another key or the preset decides
    choices: tuple[str, ...] = ()  # the texts that are accepted, where there are few
    shape: bool = False  # whether it fixes the shape of the compiled program
    infinite: bool = False  # whether infinity is accepted, as a limit that does not bind
    low: float = -math.inf  # accepted range, as far as it does not follow from the typed objects
    high: float = math.inf
    names: tuple[str, ...] = ()  # of the MVs, where the value may be one list for each of them

    @property
    def numeric(self) -> bool:
        """Whether its values are numbers, in scenario coordinates too."""
        return self.kind in ("number", "whole")

    @property
    def expected(self) -> str:
        """What a value must be, in words, with the unit."""
        if self.kind == "flag":
            return "true or false"
        if self.kind == "text":
            return "one of " + ", ".join(self.choices)
        if self.kind == "lengths":
            own = " and ".join(self.names)
            return (
                f"lengths of blocks in whole samples, 1 or more and {LONGEST} together at most, such as [1, 1, 2, 4], "
                f"or a list of them for each of {own}"
            )
        if self.kind == "values":
            return f"two or more numbers, increasing [{self.unit}], such as [0, 10, 25, 60, 100]"
        words = "a whole number" if self.kind == "whole" else f"a {'' if self.infinite else 'finite '}number"
        if self.low > -math.inf:
            bounded = self.high < LARGEST
            words += f" from {self.low:.10g} to {self.high:.10g}" if bounded else f" of {self.low:g} or more"
        return f"{words} [{self.unit}]" + (" or inf for no limit" if self.infinite else "")

    def check(self, path: str, value: Any) -> Any:
        """The value in its plain type, or an `InputError` that names `path`.

        Numbers become floats, whole numbers ints, lengths tuples of ints (one for all MVs or one per MV), values of floats.
        """
        shown, hint = value, ""
        if self.kind == "flag":
            good = isinstance(value, bool)
        elif self.kind == "text":
            good = isinstance(value, str) and value in self.choices
            hint = near(value, self.choices) if not good else ""
        elif self.kind == "lengths":
            if isinstance(value, dict):
                value = [value[name] for name in self.names] if set(value) == set(self.names) else None
            own = isinstance(value, (list, tuple)) and any(isinstance(v, (list, tuple)) for v in value)
            lists = tuple(value or ()) if own else (value,)
            good = len(lists) == (len(self.names) if own else 1) and all(map(_are_lengths, lists))
            value = tuple(map(tuple, lists)) if good and own else value
        elif self.kind == "values":
            return checked_values(path, value)
        elif isinstance(value, bool) or not isinstance(value, (int, float)):
            good = False
        elif isinstance(value, int) and value.bit_length() > 63:  # no float has room for some of them
            good, shown = False, f"{value.bit_length()} bits"
        else:
            good = self.low <= value <= self.high and (self.infinite or math.isfinite(value))
            good = good and (self.kind != "whole" or value == int(value))
            if good and LARGEST < abs(value) < math.inf:
                good, hint = False, f"Numbers go up to {LARGEST:g}"
        if not good:
            raise InputError(path, shown, f"{self.expected} for {self.key}", hint)
        return {"whole": int, "number": float, "lengths": tuple}.get(self.kind, lambda same: same)(value)

    def parse(self, path: str, text: str) -> Any:
        """The value of a cell of a CSV file; lengths and values are separated by spaces, lists of the MVs by semicolons."""
        text = text.strip()
        value: Any = text
        try:
            if self.kind == "flag":
                value = {"true": True, "false": False}.get(text.lower(), text)
            elif self.kind == "lengths":
                lists = [[int(part) for part in own.split()] for own in text.split(";")]
                value = lists if len(lists) > 1 else lists[0]
            elif self.kind == "values":
                value = [float(part) for part in text.split()]
            elif self.kind == "whole":
                value = int(text)
            elif self.kind == "number":
                value = float(text)
        except ValueError:
            raise InputError(path, text, f"{self.expected} for {self.key}") from None
        return self.check(path, value)

    def held(self, process: Process, tuning: Tuning) -> Any:
        """What holds where nothing is given: a number of the tuning as that has it, else the default."""
        section, _, rest = self.key.partition(".")
        if section != "tuning" or self.kind != "number":
            return self.default
        name, _, channel = rest.partition(".")
        values = np.asarray(getattr(tuning, name))
        names = {"cv": process.cv_names, "mv": process.mv_names}.get(TUNING[name].of)
        return float(values[names.index(channel)] if names else values)

    def column(self, values: list[Any]) -> np.ndarray:
        """Values as a scenario coordinate: floats, or texts as an object array."""
        if self.numeric:
            return np.array(values, dtype=np.float64)
        out = np.empty(len(values), dtype=object)
        out[:] = [as_text(value) for value in values]
        return out


def as_text(value: Any) -> str:
    """A number, flag, text or list of lengths or values as it stands in a coordinate and in a CSV file."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return value
    if isinstance(value, (int, float)):
        return f"{value:.10g}"
    return (
        "; ".join(map(as_text, value))
        if value and isinstance(value[0], (list, tuple))
        else " ".join(str(v) for v in value)
    )


def _are_lengths(value: Any) -> bool:
    """Whether it is one list of block lengths."""
    good = isinstance(value, (list, tuple)) and not any(isinstance(v, bool) for v in value)
    return good and all(isinstance(v, int) and v >= 1 for v in value) and 1 <= sum(value) <= LONGEST


# ------------------------------------------------------------------------------------------------------- the table


def study_fields(process: Process, parameters: Sequence[Parameter]) -> dict[str, Field]:
    """Every key of studies of a process, in the order of the documentation.

    Args:
        parameters: of the plant, which studies may set and vary.
    """
    fields = [
        *_controller_fields(process),
        *_tuning_fields(process),
        *_model_fields(process),
        *_plant_fields(parameters),
        *_run_fields(process),
    ]
    return {field.key: field for field in fields}


def _controller_fields(process: Process) -> list[Field]:
    structure, defaults = declared(Structure), process.structure_fields
    whole = bool(process.stepped)
    kinds = ("continuous", "mixed-integer")[: 1 + whole]

    def shaping(key: str, **more: Any) -> Field:
        """A field of the structure, in whole samples where it is not one of a few texts."""
        field = structure[key]
        given: dict[str, Any] = dict(kind="text", choices=field.choices)
        given = given if field.choices else dict(kind="whole", low=1, high=LONGEST)
        given |= dict(unit=field.unit, default=defaults.get(key, field.default), shape=True)
        return Field(key, field.meaning.format("the MV"), **(given | more))

    out = [
        Field("controller", "controller", "", "text", kinds[-1], kinds, True),
        Field("actuator", "actuators", "", "text", "step", ("continuous", "step"), True),
        Field("preset", "tuning preset", "", "text", process.default_preset, tuple(process.presets)),
        Field("soft", "Soft MPC", "", "flag", True),
        shaping("blocking", choices=BLOCKING),
        shaping("blocks", kind="lengths", unit="", names=process.mv_names),
        shaping("prediction_horizon"),
        shaping("control_horizon", default=None),
        shaping("first_penalised"),
        shaping("integer_horizon", default=None),
        shaping("mean_move_window"),
        shaping("mean_move_mode"),
    ]
    dwells = (process.stepped and defaults.get("dwell")) or (1,) * len(process.mvs)
    for mv, dwell in zip(process.mvs, dwells, strict=True):
        values = dict(kind="values", unit=mv.unit, low=-math.inf, high=math.inf, default=None)
        for field in (shaping("integer_values", **values), shaping("dwell", default=dwell)):
            label = structure[field.key].meaning.format(f"the {mv.label}")
            out.append(dataclasses.replace(field, key=f"{field.key}.{mv.name}", label=label))
    return out


def _tuning_fields(process: Process) -> list[Field]:
    out: list[Field] = []
    for of, variables in (("cv", process.cvs), ("mv", process.mvs)):
        for key, field in TUNING.items():
            common: dict[str, Any] = dict(infinite=field.infinite, low=field.least)
            for v in variables if field.of == of and not field.flag else ():
                label = field.meaning.format(f"the {v.label}")
                out.append(Field(f"tuning.{key}.{v.name}", label, field.unit_of(v.unit), **common))
    out += [
        Field(f"tuning.{key}", field.meaning, field.unit, infinite=field.infinite, low=field.least)
        for key, field in TUNING.items()
        if not field.of
    ]
    flags = [(key, field.meaning) for key, field in TUNING.items() if field.flag]
    return out + [Field(f"tuning.{key}", meaning, "", "flag", True) for key, meaning in flags]


def _model_fields(process: Process) -> list[Field]:
    """The working point of the step test; nothing to choose where there is none."""
    out = []
    for mv in process.mvs if not process.model.given else ():
        step = abs(process.model.steps[mv.name])  # the step test goes that far, and stays within the range
        label, at = f"{mv.label} of the model's working point", process.model.working_point[mv.name]
        out.append(Field(f"model.{mv.name}", label, mv.unit, default=at, low=mv.low, high=mv.high - step))
    return out


def _plant_fields(parameters: Sequence[Parameter]) -> list[Field]:
    out = []
    for p in parameters:
        out.append(Field(f"plant.{p.name}", f"{p.label} of the plant", p.unit, default=p.default))
        out.append(Field(f"plant_scale.{p.name}", f"{p.label} of the plant, relative", "1", low=0))
    return out


def _run_fields(process: Process) -> list[Field]:
    out = [
        Field(f"noise.{cv.name}", f"noise of the {cv.label}", cv.unit, default=0.0, low=0)
        for cv in process.cvs
    ]
    out += [
        Field(
            f"setpoint_rate.{cv.name}",
            f"largest rate of change of the setpoint of the {cv.label}",
            f"{cv.unit}/s",
            default=math.inf,
            low=0,
            infinite=True,
            shape=True,
        )
        for cv in process.cvs
    ]
    units = {disturbance.unit for disturbance in process.disturbances}
    out += [
        Field("seed", "seed of the noise", "1", "whole", 0, low=0, high=2**32 - 1),
        Field("sensor_fault.time", "time of the sensor fault", "s", low=0),
        Field("sensor_fault.duration", "duration of the sensor fault", "s", low=0),
        Field("sensor_fault.size", "size of the spike", "CV unit"),
        Field("position_feedback", "predictions from the positions of the actuators", "", "flag", False),
        Field("preview", "future setpoints and measured disturbances are told", "", "flag", False),
        Field("setpoint_filter", "time constant of the setpoint filter", "s", default=0.0, low=0, shape=True),
    ]
    if process.disturbances:
        unit = units.pop() if len(units) == 1 else "unit of the disturbance"
        label = process.disturbances[0].label if len(process.disturbances) == 1 else "disturbance"
        out += [
            Field("disturbance.time", f"time of the step of the {label}", "s", low=0),
            Field("disturbance.offset", f"step of the {label}", unit),
        ]
    if process.courses:
        out.append(Field("course", "named disturbances", "", "text", None, tuple(process.courses)))
    references = tuple(process.references)
    return [
        *out,
        Field("reference", "reference", "", "text", process.default_reference, references, True),
        Field("duration", "length of the run", "s", low=0, shape=True),
    ]


def find(fields: Mapping[str, Field], path: str, key: Any, *given: Any) -> Field:
    """The field of a key, or an `InputError` at `path` that names similar keys and shows what is given, else the key."""
    if key not in fields:
        # a last name that exists elsewhere, such as deadzone.NAME without tuning
        alike = [known for known in fields if known.endswith("." + str(key).rpartition(".")[2])][:3]
        hint = near(key, fields) or (f"Did you mean {' or '.join(alike)}?" if alike else "")
        expected = "a key that jaxmpc process keys PROCESS lists for the process of the study"
        raise InputError(path, (*given, key)[0], expected, hint)
    return fields[key]
