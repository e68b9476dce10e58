"""Monte Carlo studies: bands of the CVs and an MV over time, and how travel and deviation are distributed."""

from __future__ import annotations

import shlex
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from figures import panels, style
from figures.sweep import sheet
from figures.sweep.data import SweepAxis, Variant, quantities, shown_mv, variants
from figures.sweep.wear import SPREAD
from studies.store.process import process_in

FEWEST = 8  # scenarios of a variant, for a distribution
MOST = 4  # variants in one figure
LEVELS = ((0, 4, 0.22, "90 %"), (1, 3, 0.42, "50 %"))  # of `bands`: from, to, strength, in words
ROWS = 64  # scenarios whose trajectories are read at once


def monte_carlo(data: xr.Dataset, axes: list[SweepAxis]) -> list[Variant]:
    """The variants to draw: many plants or noises each, few variants, one with setpoints in common; empty otherwise."""
    if not any(axis.uncertain for axis in axes):
        return []
    found = variants(data, axes)
    few = len(found) <= MOST and min(len(variant.rows) for variant in found) >= FEWEST
    return found if few else []


def has_trajectories(data: xr.Dataset) -> bool:
    """Whether CVs and MVs are stored over time."""
    return all(name in data.data_vars for name in ("measurement", "position"))


def bands(values: np.ndarray) -> np.ndarray:
    """5th, 25th, 50th, 75th, 95th percentile ``"5 time"`` of values ``"scenario time"``, without NaN."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN", RuntimeWarning)  # times that no run reaches
        return np.nanpercentile(values, [5, 25, 50, 75, 95], axis=0)


def fan(data: xr.Dataset, found: list[Variant]) -> Figure:
    """Median and bands of each CV and of `shown_mv` over time, a column of panels per variant."""
    channels = [*panels.cv_names(data), shown_mv(process_in(data)).name]
    width = 7.6 if len(found) < 3 else 3.4 * len(found)
    height = 1.75 * len(channels) + 1.2
    drawn, grid = style.grid(len(channels), len(found), width, height, sharex=True, sharey="row")
    time = data.time.values
    step = float(time[1] - time[0]) if len(time) > 1 else 1.0
    data = data.assign_attrs(dt=step)  # held over the samples that are not stored too
    for column, variant in zip(grid.T, found, strict=True):
        part = data.isel(scenario=variant.rows)
        seconds = panels.time_axis(column[-1], *panels.span(data), bins=6, steps=[1, 2, 3, 6, 10])
        for ax, channel in zip(column, channels, strict=True):
            _fan(ax, part, channel, seconds, variant.colour)
        column[0].set_title(f"{variant.label} ({len(variant.rows)} runs)", loc="left", fontsize=9)
    for ax, channel in zip(grid[:, 0], channels, strict=True):
        ax.set_ylabel(panels.label_of(data, channel))
    legend: list = [
        Patch(facecolor=style.GREY, alpha=alpha + 0.1, label=style.printed(f"{label} of the runs"))
        for _, _, alpha, label in LEVELS
    ]
    legend.append(Line2D([], [], color=style.GREY, label="median"))
    legend.append(Line2D([], [], color=style.BLACK, linestyle="--", linewidth=1.0, label="setpoint"))
    words = f"Median and bands over the runs, every {step:g} s; setpoint dashed."
    sheet.write(drawn, data, [words], legend)
    return drawn


def _fan(ax: Axes, part: xr.Dataset, channel: str, seconds: float, colour: str) -> None:
    cv = panels.is_cv(part, channel)
    one = part.measurement.sel(cv=channel) if cv else part.position.sel(mv=channel)
    starts = range(0, part.sizes["scenario"], ROWS)
    at = bands(np.concatenate([one.isel(scenario=slice(i, i + ROWS)).values for i in starts]))
    t = part.time.values / seconds
    for low, high, alpha, label in LEVELS:
        look: dict[str, Any] = {"color": colour, "alpha": alpha, "step": None if cv else "post"}
        ax.fill_between(
            t, at[low], at[high], linewidth=0, label=style.printed(f"{label} of the runs"), **look
        )
    drawstyle = "default" if cv else "steps-post"
    ax.plot(t, at[2], color=colour, linewidth=1.2, label="median", drawstyle=drawstyle)
    if cv and "setpoint" in part.data_vars:
        wanted = part.setpoint.sel(cv=channel).isel(scenario=0).values
        ax.step(t, wanted, where="post", color=style.BLACK, linestyle="--", linewidth=1, label="setpoint")


def worst(values: np.ndarray, scenarios: np.ndarray) -> int:
    """Number of the scenario with the largest value; of runs without a finite one, the first."""
    lost = np.flatnonzero(~np.isfinite(values))
    return int(scenarios[lost[0] if len(lost) else int(np.argmax(values))])


def shares(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finite values in increasing order, and the share of all runs [%] that each is not exceeded in."""
    kept = np.sort(values[np.isfinite(values)])
    return kept, 100 * np.arange(1, len(kept) + 1) / max(len(values), 1)


def distributions(data: xr.Dataset, found: list[Variant]) -> Figure:
    """Sorted travel and deviations, a line per variant; the worst run of each is named, with its command."""
    shown = quantities(data)
    drawn, grid = style.grid(1, len(shown), 3.1 * len(shown), 3.9, sharey=True)
    said = []
    for ax, (title, values) in zip(grid[0], shown, strict=True):
        for i, variant in enumerate(found):
            kept, share = shares(values[variant.rows])
            t, upto = np.append(kept[:1], kept), np.append(0, share)
            ax.step(t, upto, where="post", color=variant.colour, label=variant.label)
            if len(kept):
                number = worst(values[variant.rows], data.scenario.values[variant.rows])
                ax.plot(kept[-1], share[-1], "o", markersize=4, color=variant.colour, clip_on=False, zorder=4)
                look: dict[str, Any] = {"transform": ax.transAxes, "ha": "right", "fontsize": 8.5}
                height = 0.04 + 0.07 * (len(found) - 1 - i)
                ax.text(0.98, height, f"worst: #{number}", color=variant.colour, **look)
                said.append(number)
        ax.set_xlabel(title)
        ax.set_ylim(0, 103)
        if style.spans(np.array(ax.get_xlim()), SPREAD):
            ax.set_xscale("log")
    grid[0, 0].set_ylabel(style.printed("share of the runs [%]"))
    legend = [Line2D([], [], color=v.colour, label=v.label) for v in found]
    command = ", ".join(f"#{number}" for number in dict.fromkeys(said))
    again = shlex.quote(f"{shown_store(data)}#{said[0] if said else 0}")
    words = f"Worst runs: {command}. One of them again: jaxmpc simulate {again}"
    sheet.write(drawn, data, ["Share of the runs that stay at or below a value.", words], legend)
    return drawn


def shown_store(data: xr.Dataset) -> str:
    """The store as a command names it: below the working folder if it is there, its name if the path is long."""
    path = Path(str(data.attrs.get("store", "STORE.zarr")))
    if path.is_absolute() and path.is_relative_to(Path.cwd()):
        path = path.relative_to(Path.cwd())
    return str(path) if len(str(path)) <= 60 else path.name
