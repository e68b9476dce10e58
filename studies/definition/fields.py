"""The keys of a sweep study: everything that `[base]` can set and an axis can vary, with unit, meaning and default.

A key is the path of the setting below `[base]`, for example ``tuning.deadzone.gas_rate``. `FIELDS` is the one table of them:
the definition is checked against it, axes take their units and labels from it, and `docs/studies.md` lists it.
"""

from __future__ import annotations

import dataclasses
import math
from decimal import Decimal
from typing import Any, Literal

import numpy as np

from jaxmpc.check import LARGEST
from jaxmpc.errors import InputError, near
from jaxmpc.problem.declared import declared
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS as TUNING
from jaxmpc.problem.values import checked_values
from jaxmpc.process.well.equations import CV_NAMES, CV_UNITS, MV_NAMES, MV_UNITS, WellParameters
from studies.definition import presets, references

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
            own = " and ".join(MV_NAMES)
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
                value = [value[name] for name in MV_NAMES] if set(value) == set(MV_NAMES) else None
            own = isinstance(value, (list, tuple)) and any(isinstance(v, (list, tuple)) for v in value)
            lists = tuple(value or ()) if own else (value,)
            good = len(lists) == (len(MV_NAMES) if own else 1) and all(map(_are_lengths, lists))
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

    def column(self, values: list[Any]) -> np.ndarray:
        """Values as a scenario coordinate: floats, or texts as an object array."""
        if self.numeric:
            return np.array(values, dtype=np.float64)
        out = np.empty(len(values), dtype=object)
        out[:] = [as_text(value) for value in values]
        return out


def as_text(value: Any) -> str:
    """A flag, text or list of lengths or values as it stands in a coordinate and in a CSV file."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return value
    return (
        "; ".join(map(as_text, value))
        if isinstance(value[0], (list, tuple))
        else " ".join(str(v) for v in value)
    )


def _are_lengths(value: Any) -> bool:
    """Whether it is one list of block lengths."""
    good = isinstance(value, (list, tuple)) and not any(isinstance(v, bool) for v in value)
    return good and all(isinstance(v, int) and v >= 1 for v in value) and 1 <= sum(value) <= LONGEST


# -------------------------------------------------------------------------------------------------------- the well

_PRESSURES = ("reservoir_pressure", "manifold_pressure", "supply_pressure", "supply_droop", "supply_limit")
_IN_UNIT = {
    "bar": (*_PRESSURES, "trip_start", "trip_end", "root_width"),
    "kg/s/bar": ("productivity",),
    "m": ("tubing_length", "tubing_diameter", "perforation_depth"),
    "m2": ("choke_conductance", "injection_conductance"),
    "m3": ("annulus_volume",),
    "m3/m3": ("gas_oil_ratio",),
    "m/s": ("slip_velocity", "slip_floor"),
    "s": ("near_well_time", "choke_time", "lift_time"),
    "1/s": ("equalising_rate",),
    "K": ("tubing_temperature", "annulus_temperature"),
    "kg/m3": ("liquid_density",),
    "kg/mol": ("molar_mass",),
}
PLANT_UNITS = {name: unit for unit, names in _IN_UNIT.items() for name in names}  # of the others: 1
SI_POWERS = {"bar": 5, "kg/s/bar": -5}  # of ten, of the units that are no SI units
PLANT_FIELDS = tuple(field.name for field in dataclasses.fields(WellParameters))
SHIPPED = {name: float(getattr(WellParameters(), name)) for name in PLANT_FIELDS}  # SI units


def plant_si(name: str, value: float) -> float:
    """A well parameter in SI units; shifting the decimal point keeps 78.2901 bar equal to 7829010 Pa."""
    power = SI_POWERS.get(PLANT_UNITS.get(name, "1"), 0)
    return float(Decimal(repr(float(value))).scaleb(power)) if power else float(value)


# ------------------------------------------------------------------------------------------------------- the table

_SPOKEN = {
    name: "the " + {"gas_lift": "gas lift"}.get(name, name.replace("_", " "))
    for name in (*CV_NAMES, *MV_NAMES)
}


def _table() -> dict[str, Field]:
    structure = declared(Structure)

    def shaping(key: str, **more: Any) -> Field:
        """A field of the structure, in whole samples where it is not one of a few texts."""
        field = structure[key]
        given: dict[str, Any] = dict(kind="text", choices=field.choices)
        given = given if field.choices else dict(kind="whole", low=1, high=LONGEST)
        given |= dict(unit=field.unit, default=field.default, shape=True)
        return Field(key, field.meaning.format(_SPOKEN["choke"]), **(given | more))

    out = [
        Field("controller", "controller", "", "text", "mixed-integer", ("continuous", "mixed-integer"), True),
        Field("actuator", "choke actuator", "", "text", "step", ("continuous", "step"), True),
        Field("preset", "tuning preset", "", "text", "thesis", tuple(presets.TUNINGS)),
        Field("soft", "Soft MPC", "", "flag", True),
        shaping("blocking", choices=("moves", "inputs", "none")),
        shaping("blocks", kind="lengths", unit=""),
        shaping("prediction_horizon"),
        shaping("control_horizon", default=None),
        shaping("first_penalised"),
        shaping("integer_horizon", default=None),
        shaping("mean_move_window"),
        shaping("mean_move_mode"),
    ]
    for name, unit in zip(MV_NAMES, MV_UNITS, strict=True):
        values = dict(kind="values", unit=unit, low=-math.inf, high=math.inf, default=None)
        for field in (shaping("integer_values", **values), shaping("dwell", default=1)):
            label = structure[field.key].meaning.format(_SPOKEN[name])
            out.append(dataclasses.replace(field, key=f"{field.key}.{name}", label=label))
    for of, names, units in (("cv", CV_NAMES, CV_UNITS), ("mv", MV_NAMES, MV_UNITS), ("", ("",), ("",))):
        for key, field in TUNING.items():
            common: dict[str, Any] = dict(infinite=field.infinite, low=field.least)
            for name, unit in zip(names, units, strict=True) if field.of == of and not field.flag else ():
                label = field.meaning.format(_SPOKEN.get(name))
                out.append(Field(f"tuning.{key}.{name}".rstrip("."), label, field.unit_of(unit), **common))
    out += [
        Field(f"tuning.{key}", field.meaning, "", "flag", True) for key, field in TUNING.items() if field.flag
    ]
    out += [
        # the step test moves the choke by 2 % from here, and stays within its range
        Field("model.choke", "choke of the model's working point", "%", default=50.0, low=0, high=98),
        Field("model.lift", "gas lift of the model's working point", "m3/h", default=7500.0, low=0),
    ]
    for name in PLANT_FIELDS:
        label = name.replace("_", " ")
        out.append(Field(f"plant.{name}", f"{label} of the well", PLANT_UNITS.get(name, "1")))
        out.append(Field(f"plant_scale.{name}", f"{label} of the well, relative", "1", low=0))
    for name, unit in zip(CV_NAMES, CV_UNITS, strict=True):
        out.append(Field(f"noise.{name}", f"noise of {_SPOKEN[name]}", unit, default=0.0, low=0))
    out += [
        Field("seed", "seed of the noise", "1", "whole", 0, low=0, high=2**32 - 1),
        Field("sensor_fault.time", "time of the sensor fault", "s", low=0),
        Field("sensor_fault.duration", "duration of the sensor fault", "s", low=0),
        Field("sensor_fault.size", "size of the spike", "CV unit"),
        Field("position_feedback", "predictions from the positions of the actuators", "", "flag", False),
        Field("disturbance.time", "time of the pressure step", "s", low=0),
        Field("disturbance.offset", "step of the reservoir pressure", "bar"),
        Field("reference", "reference", "", "text", "thesis", tuple(references.NAMED), True),
        Field("duration", "length of the run", "s", low=0, shape=True),
    ]
    return {field.key: field for field in out}


FIELDS = _table()


def find(path: str, key: Any, *given: Any) -> Field:
    """The field of a key, or an `InputError` at `path` that names similar keys and shows what is given, else the key."""
    if key not in FIELDS:
        # a last name that exists elsewhere, such as deadzone.gas_rate without tuning
        alike = [known for known in FIELDS if known.endswith("." + str(key).rpartition(".")[2])][:3]
        hint = near(key, FIELDS) or (f"Did you mean {' or '.join(alike)}?" if alike else "")
        raise InputError(path, (*given, key)[0], "a key of docs/studies.md", hint)
    return FIELDS[key]
