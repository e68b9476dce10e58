"""The mean-move limit (thesis 6.6): reactive, as in the thesis, against predictive."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from studies.kpi import loop as kpi
from studies.kpi.evaluate import key_figures
from studies.thesis.well import CHOKE

KINDS = ("continuous", "mixed-integer")
MODES = {"reactive": style.VERMILLION, "predictive": style.BLUE}
OPENING = 2400.0  # s to show of the window in which the choke opens


def draw(data: xr.Dataset) -> Figure:
    """Two columns, continuous and mixed-integer MPC: choke position above the windowed mean of its moves."""
    zoom = opening(data)
    at = np.isin(data.time.values, zoom.time.values)
    drawn, axes = style.grid(2, 2, 9.6, 5.1, sharex=True)
    for kind, (choke, mean) in zip(KINDS, axes.T, strict=True):
        seconds = panels.time_axis(mean, *panels.span(zoom), bins=6)
        curves = {f"{kind}-{mode}": {"label": mode, "color": colour} for mode, colour in MODES.items()}
        panels.compared(choke, zoom, CHOKE, curves, seconds)
        for name, curve in curves.items():
            values = _means(data, name)[at]
            mean.step(zoom.time.values / seconds, values, where="post", **curve)
        limit = float(data.tuning_mean_move_limit.sel(mv=CHOKE).values[0])
        mean.axhline(limit, color=style.BLACK, linestyle="--", linewidth=1.0, label=f"limit {limit:g} %")
        choke.set_title(f"{kind} MPC")
        choke.legend(loc="best")
        panels.legend_above(mean)
    axes[0, 1].set_ylabel("")
    axes[1, 0].set_ylabel("mean of 25 moves [%/sample]")
    return drawn


def _means(data: xr.Dataset, name: str) -> np.ndarray:
    """Windowed mean of the choke moves of a run, ``"time"`` [%/sample]."""
    run = data.sel(controller=name)
    return np.asarray(kpi.windowed_mean(run.move.sel(mv=CHOKE).values, int(run.mean_move_window.item())))


def opening(data: xr.Dataset) -> xr.Dataset:
    """The first minutes of the setpoint window in which the choke of every controller opens fast."""
    length = int(OPENING / float(data.attrs["dt"]))
    starts = np.flatnonzero(np.diff(data.window.values, prepend=-1))
    means = np.stack([_means(data, str(name)) for name in data.controller.values])
    start = int(max(starts, key=lambda k: means[:, k : k + length].max(axis=1).min()))
    return data.isel(time=slice(start, start + length))


def _caption(data: xr.Dataset) -> str:
    largest = key_figures(data).largest_mean_rise.sel(mv=CHOKE)
    kinds = "; ".join(
        f"{kind} MPC {float(largest.sel(controller=f'{kind}-reactive')):.3f} and "
        f"{float(largest.sel(controller=f'{kind}-predictive')):.3f}"
        for kind in KINDS
    )
    return (
        "The reactive limit stops the choke once the mean of its moves is above the limit; the predictive limit plans with "
        f"the windows. Largest mean of the run, reactive and predictive: {kinds} %/sample."
    )


ENTRIES = (
    FigureEntry(
        "mean-move",
        "the mean-move limit: reactive against predictive",
        "mean-move",
        draw,
        _caption,
        needs=tuple(f"{kind}-{mode}" for kind in KINDS for mode in MODES),
    ),
)
