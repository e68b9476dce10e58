"""What a search weighs: objectives by name, their values per scenario, and which scenarios none beats.

An objective is a key figure of `studies.kpi.sweep`, with the name of a channel behind it where it has one (``travel.NAME``
of an MV), or ``deviation``: the mean over the CVs of the mean absolute deviation, each divided by the half width in which it
counts as settled. The front is never stored: `front` computes it from the stored key figures, so that
it always agrees with them, also in a store that is not complete yet.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET

from jaxmpc.errors import InputError, near
from jaxmpc.process.process import Process
from studies.definition.sections import Search
from studies.kpi.sweep import kpis_of
from studies.store.layout import FLAG
from studies.store.process import process_in
from studies.store.reading import open_study, provenance

DEVIATION = "deviation"
CLOCK = "solve_time"  # figures of the clock differ from run to run
DIRECTIONS = ("minimize", "maximize")


@dataclasses.dataclass(frozen=True)
class Objective:
    """One objective, its name and direction as in the definition."""

    name: str
    direction: str  # ``minimize`` or ``maximize``
    figure: str  # key figure that it is made of
    channel: int | None = None  # position of its CV or MV; None without, and for the combined deviation
    scale: tuple[float, ...] = ()  # of the combined deviation, by CV [CV unit]

    def values(self, fields: Mapping[str, Any]) -> np.ndarray:
        """Per scenario, from the stored variables ``"scenario ..."`` by name; NaN for a run that is not complete."""
        figure = np.asarray(fields[self.figure], dtype=float)
        if self.name == DEVIATION:
            figure = (figure / np.array(self.scale)).mean(axis=1)
        elif self.channel is not None:
            figure = figure[:, self.channel]
        return np.where(np.asarray(fields[FLAG]) > 0, figure, np.nan)


def objective(process: Process, path: str, name: str, direction: str = "minimize") -> Objective:
    """The objective of a name; `path` is where the name stands.

    Raises:
        InputError: for an unknown name, a figure with channels without one, and figures of the clock.
    """
    if name == DEVIATION:
        return Objective(name, direction, "mean_absolute_deviation", scale=tuple(process.settled))
    figures = {kpi.name: kpi for kpi in kpis_of(process)}
    figure, _, channel = name.partition(".")
    if figure not in figures:
        known = [DEVIATION, *figures]
        raise InputError(path, name, "a key figure of docs/kpis.md, or deviation", near(figure, known))
    if figure.startswith(CLOCK):
        advice = "It depends on the machine and would make the search another one every time"
        raise InputError(path, name, "a key figure that does not depend on the clock", advice)
    channels = {(): (), ("cv",): process.cv_names, ("mv",): process.mv_names}
    names = channels[figures[figure].dims]
    if not names:
        if channel:
            raise InputError(path, name, f"{figure} alone: it has no channels")
        return Objective(name, direction, figure)
    if channel not in names:
        expected = " or ".join(f"{figure}.{known}" for known in names)
        raise InputError(path, name, expected, near(channel, names))
    return Objective(name, direction, figure, names.index(channel))


def objectives_of(search: Search, process: Process) -> tuple[Objective, ...]:
    """The objectives of a definition, checked.

    Raises:
        InputError: naming the path in the definition.
    """
    names = search.objectives
    directions = (DIRECTIONS[0],) * len(names) if search.directions is UNSET else search.directions
    if len(directions) != len(names):
        expected = f"{len(names)} directions, one per objective"
        raise InputError("search.directions", list(directions), expected)
    out = []
    for i, (name, direction) in enumerate(zip(names, directions, strict=True)):
        if name in names[:i]:
            raise InputError(f"search.objectives[{i}]", name, "each objective once")
        out.append(objective(process, f"search.objectives[{i}]", name, direction))
    return tuple(out)


def values_of(objectives: Sequence[Objective], fields: Mapping[str, Any]) -> np.ndarray:
    """Objectives ``"scenario objective"`` from stored variables by name; NaN for a run that is not complete."""
    return np.stack([o.values(fields) for o in objectives], axis=1)


def costs(objectives: Sequence[Objective], values: np.ndarray) -> np.ndarray:
    """Objectives ``"scenario objective"`` with signs that make smaller better."""
    return values * [1.0 if o.direction == DIRECTIONS[0] else -1.0 for o in objectives]


def unbeaten(values: np.ndarray) -> np.ndarray:
    """Which points no other point beats: as good in everything and better in something, smaller being better.

    Equal points do not beat each other; points with a value that is not finite are never among them and beat nothing.
    Values are ``"point objective"``.
    """
    on, rivals = np.zeros(len(values), dtype=bool), values[:0]
    for i in np.lexsort(values.T[::-1]):  # whoever beats a point comes before it
        beaten = (rivals <= values[i]).all(axis=1) & (rivals < values[i]).any(axis=1)
        if np.isfinite(values[i]).all() and not beaten.any():
            on[i], rivals = True, np.vstack([rivals, values[i]])
    return on


def front(store: str | Path) -> np.ndarray:
    """Numbers of the scenarios that no other beats in the store of a search, the best in the first objective first.

    Raises:
        InputError: if there is no store, or it is not that of a search.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Damaged in")  # such scenarios read as not complete
        data = open_study(store)
    with data:
        names = provenance(data, "objectives")
        if not isinstance(names, dict):
            raise InputError("store", str(store), "the store of a search, which has objectives")
        process = process_in(data)
        objectives = [objective(process, "objectives", name, direction) for name, direction in names.items()]
        values = costs(objectives, values_of(objectives, data.data_vars))  # type: ignore[arg-type]
        best = np.flatnonzero(unbeaten(values))
        order = np.lexsort(values[best].T[::-1])
        return data.scenario.values[best[order]]
