"""All controllers of a comparison in one figure: CVs and the MVs whose moves count, over time."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.comparison.tracking import STUDY
from figures.figure import FigureEntry
from studies.kpi.evaluate import completed


def draw(data: xr.Dataset) -> Figure:
    """A panel per CV and per stepped MV over time, a curve per controller, setpoints dashed."""
    data = completed(data)
    colours = panels.run_colours(data)
    labels = zip(data.controller.values, data.label.values, strict=True)
    curves = {str(name): {"label": str(label), "color": colours[str(name)]} for name, label in labels}
    channels = [*panels.cv_names(data), *panels.worn(data)]
    drawn, axes = style.figure(len(channels), width=9.6, row_height=1.5 if len(channels) > 5 else 1.9)
    seconds = panels.time_axis(axes[-1], *panels.span(data))
    for ax, channel in zip(axes, channels, strict=True):
        looks = {
            name: {**look, "zorder": order}
            for (name, look), order in zip(curves.items(), _orders(data, channel), strict=True)
        }
        panels.compared(ax, data, channel, looks, seconds)
        panels.changes(ax, data, seconds)
    panels.shared_legend(drawn, axes, columns=2)
    return drawn


def _orders(data: xr.Dataset, channel: str) -> np.ndarray:
    """Drawing order of the controllers: what moves most lies behind, so that a smooth curve is seen where they meet."""
    values = (
        data.measurement.sel(cv=channel) if panels.is_cv(data, channel) else data.position.sel(mv=channel)
    )
    moved = np.abs(values.diff("time")).sum("time").transpose("controller").values
    return 1.5 + 0.1 * np.argsort(np.argsort(-moved))


def _caption(data: xr.Dataset) -> str:
    shown = " and ".join(panels.words_of(data, mv) for mv in panels.worn(data))
    return f"Setpoints are dashed, thin lines mark where they change. Below the CVs: {shown}, where the actuators stand."


ENTRIES = (FigureEntry("overview", "all controllers over time", STUDY, draw, _caption),)
