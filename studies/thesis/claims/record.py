"""How a statement of the thesis becomes a measured row: what is said, how it is measured, when it holds, what came out.

The words of a row stand once, in its `Row`; `judge` adds the numbers and the verdict that follows from them by the rule of
the row. A statement that fails is shown as failing.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np
import xarray as xr

from studies.definition.presets import CHOKE, GAS, LIFT, OIL
from studies.kpi.evaluate import completed, key_figures

VERDICTS = ("holds", "holds in part", "does not hold", "not tested")
STATIONARY = 0.25  # deadzone half widths of mean deviation that count as arrived
LATE = 600.0  # s at the end of a stretch that stand for what it settles at
SETTLED = f"mean of y - r over the last {LATE:.0f} s"
ROLES = {  # by kind of controller and actuator, whatever the run is called
    ("continuous", "continuous"): "smooth",
    ("continuous", "step"): "rounded",
    ("mixed-integer", "step"): "integer",
}


class Claim(msgspec.Struct, frozen=True):
    """One statement of the thesis and what the results say.

    Attributes:
        id: short and unique.
        section: of the thesis that says it.
        statement: the thesis, in our words.
        definition: how it is measured.
        rule: when it counts as holding.
        value: the numbers, with units.
        verdict: one of `VERDICTS`.
        reason: what the data say about why it does not hold; empty if it does.
        figures: ids of the figures that show it.
        study: of `studies.thesis.catalogue.STUDIES`, whose results are measured.
    """

    id: str
    section: str
    statement: str
    definition: str
    rule: str
    value: str
    verdict: str
    reason: str
    figures: tuple[str, ...]
    study: str


class Finding(NamedTuple):
    """What a measurement gives.

    Attributes:
        value: the numbers, with units.
        conditions: those of the rule; none if it cannot be tested on these results.
        reason: shown unless all conditions are met.
    """

    value: str
    conditions: tuple[bool, ...]
    reason: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """What the rows of one study are measured on.

    Attributes:
        data: the finished runs of the study, loaded.
        clock: times of the controller steps of a run [s], ``"sample"``, by its name; the stored ones if None.
        given: from `studies.kpi.evaluate.key_figures`, if there already.
    """

    data: xr.Dataset
    clock: Callable[[str], np.ndarray] | None = None
    given: xr.Dataset | None = None

    @classmethod
    def of(cls, data: xr.Dataset, clock: Callable[[str], np.ndarray] | None = None) -> Evidence:
        """From results with at least one finished run."""
        return cls(completed(data).load(), clock)

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

    def run(self, role: str) -> xr.Dataset:
        """The results of one run."""
        return self.data.sel(controller=self.roles[role])

    def half(self, role: str) -> np.ndarray:
        """Half widths of the deadzone, ``"cv"`` [CV unit]."""
        return self.run(role).tuning_deadzone.values

    def starts(self, windows: np.ndarray) -> str:
        """Starts of some setpoint windows [s] in words, from a mask ``"window"``."""
        first = [
            float(self.data.time.values[self.data.window.values == w][0]) for w in np.flatnonzero(windows)
        ]
        return f"window{'s' if len(first) > 1 else ''} from {', '.join(f'{start:,.0f}' for start in first)} s"

    def times(self, role: str) -> np.ndarray:
        """Times of the controller steps [s], ``"sample"``."""
        name = self.roles[role]
        return self.run(role).solve_time.values if self.clock is None else self.clock(name)


@dataclasses.dataclass(frozen=True)
class Row:
    """A statement that can be measured.

    Attributes:
        id, section, statement, definition, rule, study, figures: as in `Claim`.
        needs: roles or names of the runs that the measurement uses.
        measure: numbers and conditions from the evidence.
    """

    id: str
    section: str
    statement: str
    definition: str
    rule: str
    study: str
    figures: tuple[str, ...]
    needs: tuple[str, ...]
    measure: Callable[[Evidence], Finding]


def judge(row: Row, evidence: Evidence | None) -> Claim:
    """Measure one row; without its runs it is not tested.

    Args:
        row: the statement.
        evidence: results of its study, None if there are none.
    """
    missing = [name for name in row.needs if evidence is None or name not in evidence.roles]
    if evidence is None or missing:
        found = Finding(f"no finished run of {', '.join(missing) or row.study}", ())
    else:
        found = row.measure(evidence)
    said = verdict(*found.conditions) if found.conditions else VERDICTS[3]
    words = {
        name: getattr(row, name)
        for name in ("id", "section", "statement", "definition", "rule", "figures", "study")
    }
    return Claim(**words, value=found.value, verdict=said, reason="" if said == VERDICTS[0] else found.reason)


def verdict(*conditions: bool) -> str:
    """Holds if all conditions are met, in part if some are."""
    if all(conditions):
        return VERDICTS[0]
    return VERDICTS[1] if any(conditions) else VERDICTS[2]


def short(cv: str) -> str:
    """``gas`` or ``oil``."""
    return str(cv).removesuffix("_rate")


def index(run: xr.Dataset, name: str) -> int:
    """Position of a CV or an MV on its axis."""
    axis = "mv" if name in (CHOKE, LIFT) else "cv"
    return [str(known) for known in run[axis].values].index(name)


def late(data: xr.Dataset) -> xr.Dataset:
    """The last `LATE` seconds of results."""
    return data.isel(time=np.flatnonzero(data.time.values > data.time.values[-1] - LATE))


def late_deviation(run: xr.Dataset) -> np.ndarray:
    """Mean of measured minus setpoint over the last `LATE` seconds, ``"cv"`` [CV unit]."""
    end = late(run)
    return (end.measurement - end.setpoint).mean("time").values


def quarters(window: np.ndarray) -> list[np.ndarray]:
    """Samples of the last quarter of every setpoint window."""
    out = []
    for w in range(int(window.max()) + 1):
        samples = np.flatnonzero(window == w)
        out.append(samples[(3 * len(samples)) // 4 :])
    return out


def both(values: np.ndarray, cvs: np.ndarray, form: str, unit: str = "m3/h") -> str:
    """``oil +1.2 and gas -30 m3/h``: one number per CV, oil first."""
    at = {str(cv): float(value) for cv, value in zip(cvs, values, strict=True)}
    return f"oil {at[OIL]:{form}} and gas {at[GAS]:{form}}{f' {unit}' if unit else ''}"
