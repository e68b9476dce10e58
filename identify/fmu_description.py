"""What an FMU says of itself: its variables, how it may be stepped, and for which machines it is.

`identify.fmu_process` makes it from what `identify.fmu_worker` has read; `identify.fmu` checks plants against it, and
``jaxmpc fmu info`` shows it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Iterable
from typing import Any

from jaxmpc.check import among, is_number
from jaxmpc.errors import InputError, near

Value = float | int | bool | str

REALS = ("Real", "Float32", "Float64")
BITS = {"Integer": 32} | {f"{sign}Int{bits}": bits for sign in ("", "U") for bits in (8, 16, 32, 64)}
TOLD = 5  # flaws that are listed
MOST_STEPS = 1000  # in a sampling interval, if nobody asks for more
NUMBERS = (*REALS, *BITS, "Boolean", "Enumeration")  # types that a number can stand for


@dataclasses.dataclass(frozen=True)
class FmuVariable:
    """A variable as its FMU declares it; None where it does not say.

    Attributes:
        name, type, causality, variability, initial, unit: in the words of the standard.
        start: value before a run.
        low, high: least and greatest value.
        items: of an enumeration, value by name.
        shape: of an array; empty for a single value.
        text: description.
    """

    name: str
    type: str
    causality: str
    variability: str
    initial: str | None
    unit: str | None
    start: str | None
    low: float | None
    high: float | None
    items: dict[str, int]
    shape: tuple[int, ...]
    text: str

    @property
    def settable(self) -> bool:
        """Whether a start value may be given."""
        own = self.causality == "input" or self.initial in ("exact", "approx")
        return own and self.variability != "constant" and self.causality != "structuralParameter"

    @property
    def movable(self) -> bool:
        """Whether it may be set while the FMU runs."""
        return self.causality == "input" or (self.causality == "parameter" and self.variability == "tunable")

    @functools.cached_property
    def limits(self) -> tuple[float, float]:
        """What it can hold."""
        low, high = -math.inf, math.inf
        if self.type == "Boolean":
            low, high = 0, 1
        if self.type == "Enumeration":
            low, high = min(self.items.values()), max(self.items.values())
        if self.type in BITS:
            bits, signed = BITS[self.type], not self.type.startswith("U")
            low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        return (
            low if self.low is None else max(low, self.low),
            high if self.high is None else min(high, self.high),
        )

    def nearest(self, number: float) -> Value:
        """The value for a number: within the limits, whole for integers, and for a Boolean whether it is 0.5 or more."""
        if self.type == "Boolean":
            return number >= 0.5
        if self.type == "Enumeration":
            return min(self.items.values(), key=lambda value: abs(value - number))
        low, high = self.limits
        if self.type in BITS:
            number = math.floor(number + 0.5) if math.isfinite(number) else number
            low, high = math.ceil(low), math.floor(high)
        return min(max(number, low), high)

    def exactly(self, field: str, value: Any) -> Value:
        """The value that was given, a name for an enumeration too, or an `InputError` that names the field."""
        if self.type == "String" and isinstance(value, str):
            return value
        if self.type == "Enumeration" and isinstance(value, str):
            among(field, value, self.items)
            return self.items[value]
        if self.type == "Boolean" and isinstance(value, bool):
            return value
        whole = value if not is_number(value) or self.type in REALS else int(value)
        if not is_number(value) or self.type == "String" or self.nearest(whole) != value:
            raise InputError(field, value, self.expected)
        return self.nearest(whole)

    @property
    def expected(self) -> str:
        """In words, what a value has to be."""
        if self.type == "String":
            return "a text"
        if self.type == "Boolean":
            return "true or false"
        if self.type == "Enumeration":
            return f"one of {', '.join(f'{value} ({name})' for name, value in self.items.items())}"
        low, high = self.limits
        kind = "a whole number" if self.type in BITS else "a finite number"
        bounded = math.isfinite(low) or math.isfinite(high)
        within = f" from {low:.15g} to {high:.15g}" if bounded else ""
        return f"{kind}{within}{f' [{self.unit}]' if self.unit else ''}"

    @property
    def number(self) -> float | None:
        """The start value as a number; None where there is none."""
        if self.start is None or self.shape or self.type not in NUMBERS:
            return None
        return {"true": 1.0, "false": 0.0}.get(self.start) if self.type == "Boolean" else float(self.start)


@dataclasses.dataclass(frozen=True)
class FmuDescription:
    """The model description of an FMU; None where it does not say.

    Attributes:
        fmi: major FMI version.
        name, text, tool: of the model, and what made it.
        token: GUID or instantiation token.
        kinds: ``CoSimulation``, ``ModelExchange``, ``ScheduledExecution``.
        platforms: for which it has libraries; ``sources`` too where it has sources.
        here: the platform of this machine, in the words of its standard.
        variables: by name.
        experiment: default ``start``, ``stop`` and ``step`` [s], and ``tolerance``.
        variable_steps: whether its communication steps may differ in size.
        fixed_step: its own step, of which a communication step is a multiple [s].
        flaws: in what it breaks the standard, without harm.
    """

    fmi: int
    name: str
    text: str
    tool: str
    token: str
    kinds: tuple[str, ...]
    platforms: tuple[str, ...]
    here: str
    variables: dict[str, FmuVariable]
    experiment: dict[str, float | None]
    variable_steps: bool
    fixed_step: float | None
    flaws: tuple[str, ...] = ()

    @classmethod
    def of(cls, facts: dict[str, Any]) -> FmuDescription:
        """From what `identify.fmu_worker` sends."""
        own: dict[str, Any] = {name: tuple(facts[name]) for name in ("kinds", "platforms", "flaws")}
        own["variables"] = {
            v["name"]: FmuVariable(**(v | {"shape": tuple(v["shape"])})) for v in facts["variables"]
        }
        return cls(**(facts | own))

    def variable(self, field: str, name: str) -> FmuVariable:
        """A variable with one value by its name, or an `InputError` that names the field.

        An element of an array is one, too: ``x[2,1]``, counted from 1.
        """
        if name not in self.variables and (element := self._element(name)):
            return element
        if name not in self.variables:
            expected = f"a variable of the FMU, which jaxmpc fmu info lists ({len(self.variables)} of them)"
            raise InputError(field, name, expected, near(name, self.variables))
        found = self.variables[name]
        if found.shape:
            size = " x ".join(map(str, found.shape))
            ones = ",".join("1" * len(found.shape))
            expected = f"a variable with one value, such as {name}[{ones}] (it is an array of {size})"
            raise InputError(field, name, expected)
        return found

    def _element(self, name: str) -> FmuVariable | None:
        array, _, index = name.removesuffix("]").rpartition("[")
        if array not in self.variables or not re.fullmatch(r"\d+(,\d+)*", index):
            return None
        whole, indices = self.variables[array], [int(k) for k in index.split(",")]
        inside = (1 <= k <= size for k, size in zip(indices, whole.shape, strict=False))
        if len(indices) != len(whole.shape) or not all(inside):
            return None
        place = 0
        for size, k in zip(whole.shape, indices, strict=True):
            place = place * size + k - 1
        starts = (whole.start or "").split()
        start = starts[place if len(starts) > 1 else 0] if starts else None
        return dataclasses.replace(whole, name=name, start=start, shape=())

    def step_of(self, dt: float, substep: float | None) -> tuple[float, int]:
        """The communication step [s] and how many of them make a sampling interval `dt` [s].

        It is `substep`; without, that of the default experiment or the FMU's own, or the next smaller one if it may vary. An
        FMU for model exchange has none: it is integrated from sample to sample. Of its own steps, several are one where more
        than 1000 would make a sampling interval.

        Raises:
            InputError: where that is no whole number.
        """
        stepped = "CoSimulation" in self.kinds
        own = [step for step in (self.experiment["step"], self.fixed_step) if step and stepped] or [dt]
        steps = own if substep is None else [substep]
        for step in steps:
            count = max(round(dt / step), 1)
            if abs(dt - count * step) <= 1e-9 * dt:
                several = 1 if substep else -(-count // MOST_STEPS)
                count //= next(many for many in range(several, count + 1) if count % many == 0)
                return dt / count, count
        step = steps[0]
        if substep is not None:
            raise InputError("plant.substep", substep, f"a step [s] that divides dt, {dt:g} s")
        if not self.variable_steps:
            expected = f"a whole number of steps of {step:g} s, the only ones that the FMU makes"
            raise InputError("plant.dt", dt, expected)
        count = min(math.ceil(dt / step), MOST_STEPS)
        return dt / count, count

    def table(self) -> str:
        """For people: the facts, and the variables as a table."""
        times = {name: value for name, value in self.experiment.items() if value is not None}
        own = f", its own are of {self.fixed_step:g} s" if self.fixed_step else ""
        facts = {
            "model": self.name,
            "description": self.text,
            "made by": self.tool,
            "FMI": f"{self.fmi}.0, {', '.join(_words(kind) for kind in self.kinds)}",
            "token": self.token,
            "libraries": f"{', '.join(self.platforms) or 'none'} (this machine: {self.here})",
            "experiment": ", ".join(
                f"{name} {value:g}{'' if name == 'tolerance' else ' s'}" for name, value in times.items()
            ),
            "steps": ("of any size" if self.variable_steps else "all of one size") + own,
            "variables": str(len(self.variables)),
            "flaws": " ".join(self.flaws[:TOLD])
            + (f" And {more} more" if (more := len(self.flaws) - TOLD) > 0 else ""),
        }
        if "CoSimulation" not in self.kinds:
            del facts["steps"]
        lines = [f"{name:11} {value}" for name, value in facts.items() if value]
        order = ("input", "structuralParameter", "parameter", "calculatedParameter", "output")
        rank = {causality: k for k, causality in enumerate(order)}
        ranked = sorted(self.variables.values(), key=lambda v: rank.get(v.causality, len(rank)))
        return "\n".join([*lines, "", *_columns(map(_row, ranked))])


HEAD = ("name", "type", "unit", "causality", "variability", "start", "range", "description")


def _row(v: FmuVariable) -> tuple[str, ...]:
    size = f"[{', '.join(map(str, v.shape))}]" if v.shape else ""
    names = {str(value): name for name, value in v.items.items()}
    start = v.start or ""
    start = f"{start} ({names[start]})" if start in names else start
    low, high = ("" if limit is None else f"{limit:g}" for limit in (v.low, v.high))
    within = ", ".join(f"{value} {name}" for value, name in names.items()) or (
        f"{low}..{high}" if low or high else ""
    )
    return v.name, v.type + size, v.unit or "", v.causality, v.variability, start, within, v.text


def _columns(rows: Iterable[tuple[str, ...]]) -> list[str]:
    cells = [HEAD, *(tuple(" ".join(cell.split()) for cell in row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in cells]


def _words(kind: str) -> str:
    """``CoSimulation`` as co-simulation."""
    return {"CoSimulation": "co-simulation", "ModelExchange": "model exchange"}.get(
        kind, "scheduled execution"
    )
