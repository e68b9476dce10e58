"""How a statement of the thesis becomes a measured row: what is said, how it is measured, when it holds, what came out.

The words of a row stand once, in ``rows.toml``; `claim_of` adds the numbers and the verdict that follows from them by the
rule of the row. A statement that fails is shown as failing.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import xarray as xr

from studies.kpi.evaluate import completed, key_figures
from studies.kpi.loop import travel
from studies.thesis.claims import limits
from studies.thesis.claims.limits import LATE
from studies.thesis.reach import choke_moves
from studies.thesis.well import CHOKE, GAS, LIFT, OIL

VERDICTS = ("holds", "holds in part", "does not hold", "not tested")
ROLES = {  # by kind of controller and actuator, whatever the run is called
    ("continuous", "continuous"): "smooth",
    ("continuous", "step"): "rounded",
    ("mixed-integer", "step"): "integer",
}
Condition = bool | np.bool_
Run = xr.Dataset  # the results with one controller
# times of the controller steps of a run [s], "sample", by its name; the stored ones if None
Clock = Callable[[str], np.ndarray] | None


class Statement(msgspec.Struct, frozen=True):
    """One statement of the thesis."""

    id: str  # short and unique
    section: str  # of the thesis that says it
    statement: str  # the thesis, in our words
    definition: str  # how it is measured
    rule: str  # when it counts as holding
    study: str  # of `studies.thesis.catalogue.STUDIES`, whose results are measured
    figures: tuple[str, ...]  # ids of the figures that show it


class Claim(Statement, frozen=True):
    """A statement and what the results say."""

    value: str  # the numbers, with units
    verdict: str  # one of `VERDICTS`
    reason: str  # what the data say about why it does not hold; empty if it does

    def written(self) -> dict[str, Any]:
        """The fields by name in the order of the files."""
        words = ("id", "section", "statement", "definition", "rule", "value", "verdict", "reason")
        return {name: getattr(self, name) for name in (*words, "figures", "study")}


class Finding(NamedTuple):
    """What a measurement gives."""

    conditions: tuple[Condition, ...]  # those of the rule; none if it cannot be tested on these results
    numbers: dict[str, Any]  # for the words of the row, by name
    why: str = ""  # which of its reasons is shown unless all conditions are met, where it has several
    instead: str = ""  # of the words of the row on its numbers


class Row(Statement, frozen=True, forbid_unknown_fields=True):
    """A statement that can be measured, from ``rows.toml``."""

    needs: tuple[str, ...]  # roles or names of the runs that the measurement is given
    measure: str  # function that takes the evidence and the runs of `needs`, as module.function
    value: str  # words for its numbers
    reason: str | dict[str, str]  # words for why it fails, or several by what the measurement says


class Rates:
    """One number per CV, formatted as ``oil +1.2 and gas -30``."""

    def __init__(self, values: np.ndarray, cvs: np.ndarray):
        self.by_name = {str(cv): float(value) for cv, value in zip(cvs, values, strict=True)}

    def __format__(self, form: str) -> str:
        return f"oil {self.by_name[OIL]:{form}} and gas {self.by_name[GAS]:{form}}"


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """What the rows of one study are measured on."""

    data: xr.Dataset  # the finished runs of the study, loaded
    clock: Clock = None
    given: xr.Dataset | None = None  # from `studies.kpi.evaluate.key_figures`, if there already

    @classmethod
    def of(cls, data: xr.Dataset, clock: Clock = None, given: xr.Dataset | None = None) -> Evidence:
        """From results with at least one finished run."""
        return cls(completed(data).load(), clock, given)

    @functools.cached_property
    def key(self) -> xr.Dataset:
        """Key figures of the runs."""
        return key_figures(self.data) if self.given is None else self.given

    @functools.cached_property
    def roles(self) -> dict[str, str]:
        """Names of the runs by role (`ROLES`) and by name."""
        names = [str(name) for name in self.data.controller.values]
        out = dict(zip(names, names, strict=True))
        for name, kind, actuator in zip(names, self.data.kind.values, self.data.actuator.values, strict=True):
            out.setdefault(ROLES.get((str(kind), str(actuator)), name), name)
        return out

    def run(self, role: str) -> Run:
        """The results of one run."""
        return self.data.sel(controller=self.roles[role])

    @property
    def runs(self) -> list[Run]:
        """The results of every run."""
        return [self.data.isel(controller=i) for i in range(self.data.sizes["controller"])]

    def figure(self, name: str, run: Run) -> Any:
        """A key figure of one run: a number or an array; that of the choke, where it has one per MV."""
        found = self.key[name].sel(controller=name_of(run))
        return (found.sel(mv=CHOKE) if "mv" in found.dims else found).values[()]

    def rates(self, values: np.ndarray) -> Rates:
        """Numbers ``"cv"`` for the words of a row."""
        return Rates(values, self.data.cv.values)

    def starts(self, windows: np.ndarray | int) -> str:
        """Starts of some setpoint windows [s] in words, from a mask ``"window"`` or the number of one."""
        label = self.data.window.values
        which = [windows] if isinstance(windows, int) else np.flatnonzero(windows)
        first = [f"{float(self.data.time.values[label == w][0]):,.0f}" for w in which]
        return f"window{'s' if len(first) > 1 else ''} from {', '.join(first)} s"

    def times(self, run: Run) -> np.ndarray:
        """Times of the controller steps [s], ``"sample"``."""
        return run.solve_time.values if self.clock is None else self.clock(name_of(run))


def claim_of(row: Row, found: Finding) -> Claim:
    """The words of a row with the numbers of its measurement, and the verdict."""
    said = verdict(*found.conditions) if found.conditions else VERDICTS[3]
    numbers = vars(limits) | found.numbers
    reason = row.reason if isinstance(row.reason, str) else row.reason.get(found.why, "")
    return Claim(
        *(getattr(row, name) for name in Statement.__struct_fields__),
        value=found.instead or row.value.format_map(numbers),
        verdict=said,
        reason=reason.format_map(numbers) if said in VERDICTS[1:3] else "",
    )


def verdict(*conditions: Condition) -> str:
    """Holds if all conditions are met, in part if some are."""
    return VERDICTS[0 if all(conditions) else 1 if any(conditions) else 2]


def name_of(run: Run) -> str:
    """Of the controller of a run."""
    return str(run.controller.item())


def short(cv: str) -> str:
    """``gas`` or ``oil``."""
    return str(cv).removesuffix("_rate")


def index(run: Run, name: str) -> int:
    """Position of a CV or an MV on its axis."""
    axis = "mv" if name in (CHOKE, LIFT) else "cv"
    return [str(known) for known in run[axis].values].index(name)


def late(data: xr.Dataset) -> xr.Dataset:
    """The last `LATE` seconds of results."""
    return data.isel(time=np.flatnonzero(data.time.values > data.time.values[-1] - LATE))


def late_deviation(run: Run) -> np.ndarray:
    """Mean of measured minus setpoint over the last `LATE` seconds, ``"cv"`` [CV unit]."""
    end = late(run)
    return (end.measurement - end.setpoint).mean("time").values


def choke_travel(run: Run) -> float:
    """Travel of the actual choke position from the first sample on [%]."""
    return float(travel(choke_moves(run)))


def swing(values: np.ndarray, groups: list[np.ndarray]) -> np.ndarray:
    """Largest minus smallest value in groups of samples, ``"group channel"``."""
    return np.array([np.ptp(values[samples], axis=0) for samples in groups])
