"""All figures of a sweep study from its store, and of one scenario that was run again; nothing here solves anything.

Which figures there are follows from what varies: ``pareto`` always, ``maps`` over two numeric axes, ``mismatch`` for models
and operating regions, ``blocking`` for blocks and horizons, ``fan`` and ``distributions`` for many wells or noises.
"""

from __future__ import annotations

import contextlib
import textwrap
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.sweep import fan, maps, regret, wear
from figures.sweep.data import load, sweep_axes
from figures.sweep.wear import pareto
from jaxmpc.loop.trajectory import Trajectory

__all__ = ["draw_run", "draw_sweep", "pages", "pareto"]

Page = Callable[[], AbstractContextManager[Figure]]


def pages(data: xr.Dataset) -> dict[str, Page]:
    """The figures that fit a study, by the name of their files.

    Args:
        data: of `figures.sweep.data.load`.
    """
    axes = sweep_axes(data)
    out: dict[str, Page] = {"pareto": lambda: wear.draw(data)}
    if maps.is_mismatch(axes):
        out["mismatch"] = lambda: maps.mismatch(data)
    else:
        for label, name, part in maps.controller_parts(data):
            found = maps.map_axes(part)
            if found is not None:
                shown = label if name else ""
                out[f"maps{name}"] = lambda part=part, found=found, shown=shown: maps.draw(part, found, shown)
    if regret.is_blocking(data):
        out["blocking"] = lambda: regret.draw(data)
    drawn = fan.monte_carlo(data, axes)
    if drawn:
        if fan.has_trajectories(data):
            out["fan"] = lambda: fan.fan(data, drawn)
        out["distributions"] = lambda: fan.distributions(data, drawn)
    return out


def draw_sweep(store: str | Path, folder: str | Path) -> list[Path]:
    """Draw every figure that fits the study, from the scenarios that are finished, as PNG and PDF.

    Args:
        store: of the study, ending in ``.zarr``.
        folder: for the files; made if it is missing.

    Returns:
        The files written.

    Raises:
        InputError: if there is no store, no scenario of it is finished, or a key figure is not in it.
    """
    paths: list[Path] = []
    for name, page in pages(load(store)).items():
        with page() as drawn:
            paths += style.save(drawn, folder, name)
    return paths


def draw_run(
    trajectory: Trajectory,
    deadzone: np.ndarray | tuple[float, ...],
    folder: str | Path,
    title: str,
    *,
    kind: str = "mixed-integer",
    actuator: str = "step",
    name: str = "run",
) -> list[Path]:
    """Draw one run: CVs with setpoint and deadzone, demanded and actual choke, lift.

    Args:
        trajectory: of the well.
        deadzone: half width per CV [CV unit]; 0 draws no band.
        folder: for the files.
        title: above the panels.
        kind: of the controller, for the colour.
        actuator: of the choke, for the colour.
        name: of the files.

    Returns:
        The PNG and the PDF.
    """
    data = run_results(trajectory, deadzone, kind, actuator)
    with run(data, title) as drawn:
        return style.save(drawn, folder, name)


@contextlib.contextmanager
def run(data: xr.Dataset, title: str) -> Iterator[Figure]:
    """The figure of `draw_run`, from results of one controller called ``run``."""
    cvs = panels.cv_names(data)
    with style.figure(len(cvs) + 2, row_height=1.8) as (drawn, axes):
        drawn.suptitle(textwrap.fill(title, 95), fontsize=10)
        seconds = panels.time_axis(
            axes[-1], float(data.time.values[0]), float(data.time.values[-1]) + data.attrs["dt"]
        )
        for ax, cv in zip(axes, cvs, strict=False):
            panels.controlled(ax, data, "run", cv, seconds)
        panels.choke(axes[-2], data, "run", seconds)
        panels.manipulated(axes[-1], data, "run", "gas_lift", seconds)
        for ax in axes:
            panels.changes(ax, data, seconds)
        yield drawn


def run_results(trajectory: Trajectory, deadzone, kind: str, actuator: str) -> xr.Dataset:
    """A trajectory as the panels of the comparison read it."""
    changed = np.any(np.diff(trajectory.setpoint, axis=0) != 0, axis=1)
    half = np.broadcast_to(np.asarray(deadzone, dtype=float), (1, len(trajectory.cv_names)))
    return xr.Dataset(
        {
            "measurement": (("controller", "time", "cv"), trajectory.cv[None]),
            "position": (("controller", "time", "mv"), trajectory.mv[None]),
            "demand": (("controller", "time", "mv"), trajectory.mv_demand[None]),
            "setpoint": (("time", "cv"), trajectory.setpoint),
            "window": ("time", np.concatenate([[0], np.cumsum(changed)])),
            "kind": ("controller", [kind]),
            "actuator": ("controller", [actuator]),
            "tuning_deadzone": (("controller", "cv"), half),
            "tuning_soft_quadratic": (("controller", "cv"), np.ones_like(half)),
            "tuning_soft_linear": (("controller", "cv"), np.ones_like(half)),
        },
        {
            "controller": ["run"],
            "time": trajectory.time,
            "cv": list(trajectory.cv_names),
            "mv": list(trajectory.mv_names),
            "cv_unit": ("cv", list(trajectory.cv_units)),
            "mv_unit": ("mv", list(trajectory.mv_units)),
        },
        {"dt": trajectory.dt},
    )
