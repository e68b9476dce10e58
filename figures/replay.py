"""A replay over time: what was measured and foreseen, what was done and advised, and the bias of the predictions."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from studies.plans import begins
from studies.replay import predicted, summary

STUDY = "replay"


def draw(data: xr.Dataset) -> Figure:
    """CVs with setpoint and prediction one sample ahead, MVs as they were moved and as was advised, and biases."""
    name = str(data.controller.values[0])
    data = broken(
        data.assign(predicted=(("controller", *data.setpoint.dims), predicted(data.isel(controller=0))[None]))
    )
    cvs, mvs = panels.cv_names(data), panels.mv_names(data)
    count = 2 * len(cvs) + len(mvs)
    drawn, axes = style.figure(count, width=9.6, row_height=1.5 if count > 5 else 1.9)
    seconds = panels.time_axis(axes[-1], *panels.span(data))
    times = data.time.values / seconds
    for ax, cv in zip(axes, cvs, strict=False):
        panels.controlled(ax, data, name, cv, seconds, legend=False)
        foreseen = data.predicted.sel(controller=name, cv=cv)
        look = {"color": style.PLAN, "linewidth": 0.9, "label": "predicted one sample ahead"}
        ax.plot(times, foreseen, **look)
    for ax, mv in zip(axes[len(cvs) :], mvs, strict=False):
        panels.step(
            ax, data, data.demand.sel(controller=name, mv=mv), seconds, color=style.PLAN, label="advised"
        )
        panels.manipulated(ax, data, name, mv, seconds, label="done", color=style.BLACK)
    for ax, cv in zip(axes[len(cvs) + len(mvs) :], cvs, strict=True):
        panels.bias(ax, data, name, cv, seconds)
        ax.set_ylabel(f"bias of the\n{panels.label_of(data, cv)}")
    panels.shared_legend(drawn, axes)
    return drawn


def broken(data: xr.Dataset) -> xr.Dataset:
    """The results with an empty sample behind every stretch of the log, so that no line bridges a gap."""
    times, dt = data.time.values, float(data.attrs["dt"])
    ends = times[np.flatnonzero(begins(data))[1:] - 1] + dt
    return data.reindex(time=np.union1d(times, ends)) if ends.size else data


def _caption(data: xr.Dataset) -> str:
    rows = dict(summary(data.isel(controller=0)))
    said = [f"{what}: {value}" for what, value in rows.items() if "agree" in what or "proven" in what]
    return f"An advice begins where the MV stands, whatever was advised before. {'; '.join(said)}."


ENTRIES = (FigureEntry("replay", "advice on logged data", STUDY, draw, _caption),)
