"""Closed-loop tracking of each run of a comparison: CVs with setpoint and deadzone, MVs with what was demanded."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import closed_loop, panels, style
from figures.figure import FigureEntry
from figures.sweep.sheet import LEGEND_AT
from studies.kpi.evaluate import completed

STUDY = "comparison"


def draw(data: xr.Dataset, controller: str) -> Figure:
    """One run over time, a panel per CV with setpoint and deadzone, then per MV with demand and position."""
    rows = data.sizes["cv"] + data.sizes["mv"]
    drawn, axes = style.figure(rows, width=9.0, row_height=1.5 if rows > 5 else 1.8)
    title = f"{data.label.sel(controller=controller).item()}\n "  # the second line is the legend's
    drawn.suptitle(title, fontsize=10.5, x=0.01, ha="left")
    closed_loop.tracking(axes, data, controller, legend=False)
    for ax, channel in zip(axes, [*panels.cv_names(data), *panels.mv_names(data)], strict=True):
        if panels.is_cv(data, channel):
            panels.limits(ax, data.measurement.sel(cv=channel), data.setpoint.sel(cv=channel))
        else:
            panels.limits(ax, data.position.sel(mv=channel))
    place = (0.005, 1 - LEGEND_AT / drawn.get_size_inches()[1])
    panels.shared_legend(drawn, axes, "upper left", bbox_to_anchor=place, borderaxespad=0.1)
    return drawn


def _caption(data: xr.Dataset, controller: str) -> str:
    run = data.sel(controller=controller)
    off = np.abs(run.measurement - run.setpoint).mean("time")
    parts = ", ".join(
        f"{panels.words_of(data, cv)} {float(off.sel(cv=cv)):.3g} {panels.unit_of(data, cv)}".removesuffix(
            " 1"
        )
        for cv in panels.cv_names(data)
    )
    return f"Mean absolute deviation from the setpoints, targets out of reach included: {parts}."


def entries(data: xr.Dataset) -> tuple[FigureEntry, ...]:
    """A figure of every finished run; vertical limits hold all of them."""
    return tuple(
        FigureEntry(
            f"run-{name}",
            f"closed loop: {label}",
            STUDY,
            draw,
            _caption,
            arguments={"controller": str(name)},
        )
        for name, label in zip(completed(data).controller.values, completed(data).label.values, strict=True)
    )
