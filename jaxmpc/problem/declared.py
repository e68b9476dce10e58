"""What a field of `Tuning` or `Structure` is: unit, default, limits, meaning and equation, declared on the field itself.

Checks, errors, the one-step case file, the keys of studies, the tables of the documentation and what notebooks show follow
from it; `declared` reads it back.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from jaxmpc.check import LARGEST
from jaxmpc.errors import InputError


@dataclasses.dataclass(frozen=True)
class Declared:
    """One field."""

    unit: str  # in terms of "CV unit" and "MV unit"; empty for what is not a number
    meaning: str  # in few words, for legends and tables; ``{}`` stands for the CV or MV
    note: str = ""  # what else there is to know
    equation: str = ""  # symbol and equation of the thesis
    # what it has one value for: every CV, every MV, or nothing (one for all)
    of: Literal["", "cv", "mv"] = ""
    default: Any = None  # None where it must be given
    least: float = 0.0  # least value that is accepted
    infinite: bool = False  # whether it may be infinite, and None in its place
    high: str = ""  # the field that must not lie below it, where the two are a pair of limits
    flag: bool = False  # whether values are true or false
    choices: tuple[str, ...] = ()  # the texts that are accepted, where it is one
    # whether a single step needs it; the rest is about what a controller remembers between steps
    in_step: bool = True
    optional: bool = False  # whether a case file has it only where it is not the default

    @property
    def text(self) -> str:
        """Meaning and note, for any CV or MV."""
        return self.meaning.format(f"the {self.of.upper()}") + (f"; {self.note}" if self.note else "")

    def unit_of(self, unit: str) -> str:
        """Its unit for a CV or MV that has this one, such as ``1/(m3/h)^2``."""
        plain = not self.unit.startswith("1/") or unit.isalnum() or unit == "%"
        return self.unit.replace("CV unit", "MV unit").replace("MV unit", unit if plain else f"({unit})")

    def array(self, path: str, given: Any, names: Sequence[str] = ()) -> np.ndarray:
        """Checked values in the order of `names`; of one number where the field has one for all.

        Args:
            given: a vector, a mapping from name to value, or one value for all; None is infinite where that is allowed.

        Raises:
            InputError: with the path, the value, what was expected and the unit.
        """
        if not self.of:
            return np.asarray(self._value(path, given, ""))
        listed, values = ", ".join(names), given
        expected = f"{len(names)} numbers [{self.unit}] for {listed}"
        if self.flag:
            expected = f"a mapping from name to true or false ({listed})"
            values = {} if given is None else given
        if isinstance(values, dict):
            for name in values:
                if name not in names:
                    raise InputError(f"{path}.{name}", values[name], f"one of the names {listed}")
            missing = [name for name in names if name not in values]
            if missing and not self.flag:
                raise InputError(f"{path}.{missing[0]}", None, expected)
            values = [values.get(name, False) for name in names]
        elif values is None:
            values = [None] * (len(names) if self.infinite else 0)
        elif np.ndim(values) == 0 and not isinstance(values, str):
            values = [np.asarray(values).item()] * len(names)
        elif not isinstance(values, (list, tuple)):
            values = np.asarray(values).tolist()
        if len(values) != len(names):
            raise InputError(path, given if values == [] else values, expected)
        where = [f"{path}.{name}" if self.flag else f"{path}[{i}]" for i, name in enumerate(names)]
        return np.array([self._value(*each) for each in zip(where, values, names, strict=True)])

    def _value(self, path: str, value: Any, name: str) -> float | bool:
        if self.flag:
            if not isinstance(value, (bool, np.bool_)):
                raise InputError(path, value, "true or false")
            return bool(value)
        if value is None and self.infinite:
            return -math.inf if self.high else math.inf
        wrong = ""
        if isinstance(value, bool) or not isinstance(value, (int, float)) or value != value:
            wrong = "a number"
        elif not self.infinite and (value < self.least or math.isinf(value)):
            wrong = "a finite number" + (f", {self.least:g} or more" if self.least > -math.inf else "")
        elif value < self.least:
            wrong = f"{self.least:g} or more"
        elif LARGEST < abs(value) < math.inf:
            wrong = f"a number of size {LARGEST:g} at most" + ", or none for no limit" * self.infinite
        if wrong or value is None:
            raise InputError(path, value, f"{wrong} [{self.unit}]" + (f" for {name}" if name else ""))
        return float(value)


def declare(
    unit: str,
    meaning: str,
    note: str = "",
    equation: str = "",
    *,
    preset: Any = dataclasses.MISSING,
    **more: Any,
) -> Any:
    """A field with its declaration.

    Args:
        preset: what an object has that is made without the field; none where arrays have to be made for it.
        **more: of `Declared`; without a default, what may be infinite is so.
    """
    if preset is not dataclasses.MISSING:
        more["default"] = preset
    if more.get("infinite"):
        more.setdefault("default", -math.inf if "high" in more else math.inf)
    known = Declared(unit, meaning, note, equation, **more)
    return dataclasses.field(default=preset, metadata={"declared": known})


def declared(kind: type) -> dict[str, Declared]:
    """The declarations of a class by field, in its order."""
    return {field.name: field.metadata["declared"] for field in dataclasses.fields(kind)}
