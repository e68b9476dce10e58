"""Monte Carlo studies: bands of the CVs and the choke over time, and how wear and deviation are distributed."""

from __future__ import annotations

import contextlib
import shlex
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from figures import panels, style
from figures.sweep import sheet
from figures.sweep.data import SweepAxis, Variant, deviation, figure_of, unit, variants

FEWEST = 8  # scenarios of a variant, for a distribution
MOST = 4  # variants in one figure
LEVELS = ((5, 95, 0.22, "90 %"), (25, 75, 0.42, "50 %"))
ROWS = 64  # scenarios whose trajectories are read at once


def monte_carlo(data: xr.Dataset, axes: list[SweepAxis]) -> list[Variant]:
    """The variants to draw: many wells or noises each, few variants, one with setpoints in common; empty otherwise."""
    if not any(axis.uncertain for axis in axes):
        return []
    found = variants(data, axes)
    few = len(found) <= MOST and min(len(variant.rows) for variant in found) >= FEWEST
    return found if few else []


def has_trajectories(data: xr.Dataset) -> bool:
    """Whether CVs and the choke are stored over time."""
    return all(name in data.data_vars for name in ("measurement", "position"))


def bands(values: np.ndarray) -> np.ndarray:
    """5th, 25th, 50th, 75th, 95th percentile over the scenarios, ``"5 time"``, without NaN.

    Args:
        values: ``"scenario time"``.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN", RuntimeWarning)  # times that no run reaches
        return np.nanpercentile(values, [5, 25, 50, 75, 95], axis=0)


@contextlib.contextmanager
def fan(data: xr.Dataset, found: list[Variant]) -> Iterator[Figure]:
    """Median and bands of each CV and of the choke over time, a column of panels per variant.

    Args:
        data: finished scenarios with trajectories.
        found: variants, setpoints in common within each.
    """
    rows = [*[("measurement", "cv", str(cv)) for cv in data.cv.values[::-1]], ("position", "mv", "choke")]
    width = 7.6 if len(found) < 3 else 3.4 * len(found)
    options = {"sharex": True, "sharey": "row"}
    with sheet.sheet(len(rows), len(found), width, 1.75 * len(rows) + 1.2, **options) as (drawn, grid):
        for j, variant in enumerate(found):
            part = data.isel(scenario=variant.rows)
            for i, (name, axis, channel) in enumerate(rows):
                _fan(grid[i, j], part, name, axis, channel, variant.colour)
                if j == 0:
                    units = str(data[f"{axis}_unit"].sel({axis: channel}).item())
                    grid[i, j].set_ylabel(style.label(channel, units))
            grid[0, j].set_title(f"{variant.label} ({len(variant.rows)} runs)", loc="left", fontsize=9)
        time = data.time.values
        step = float(time[1] - time[0]) if len(time) > 1 else 1.0
        for ax in grid[-1]:
            panels.time_axis(ax, float(time[0]), float(time[-1]) + step)
            ax.xaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 3, 6, 10], integer=True))
        legend: list = [
            Patch(facecolor=style.GREY, alpha=alpha + 0.1, label=style.printed(f"{label} of the runs"))
            for _, _, alpha, label in LEVELS
        ]
        legend.append(Line2D([], [], color=style.GREY, label="median"))
        legend.append(Line2D([], [], color=style.BLACK, linestyle="--", linewidth=1.0, label="setpoint"))
        words = f"Median and bands over the runs, every {step:g} s; setpoint dashed."
        sheet.write(drawn, data, [words], legend)
        yield drawn


def _fan(ax: Axes, part: xr.Dataset, name: str, axis: str, channel: str, colour: str) -> None:
    time = part.time.values
    seconds = 60.0 if time[-1] - time[0] < 4 * panels.HOUR else panels.HOUR
    one = part[name].sel({axis: channel})
    values = np.concatenate(
        [one.isel(scenario=slice(i, i + ROWS)).values for i in range(0, part.sizes["scenario"], ROWS)]
    )
    at = bands(values)
    held = axis == "mv"  # over the sample, and here over the samples that are not stored
    drawstyle = "steps-post" if held else "default"
    for low, high, alpha, label in LEVELS:
        i, j = [(5, 25, 50, 75, 95).index(level) for level in (low, high)]
        ax.fill_between(
            time / seconds,
            at[i],
            at[j],
            color=colour,
            alpha=alpha,
            step="post" if held else None,
            linewidth=0,
            label=style.printed(f"{label} of the runs"),
        )
    ax.plot(time / seconds, at[2], color=colour, linewidth=1.2, label="median", drawstyle=drawstyle)
    if axis == "cv" and "setpoint" in part.data_vars:
        setpoint = part.setpoint.sel(cv=channel).isel(scenario=0).values
        ax.step(
            time / seconds,
            setpoint,
            where="post",
            color=style.BLACK,
            linestyle="--",
            linewidth=1,
            label="setpoint",
        )


def worst(values: np.ndarray, scenarios: np.ndarray) -> int:
    """Number of the scenario with the largest value; of runs without a finite one, the first."""
    lost = np.flatnonzero(~np.isfinite(values))
    return int(scenarios[lost[0] if len(lost) else int(np.argmax(values))])


def shares(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finite values in increasing order, and the share of all runs [%] that each is not exceeded in."""
    kept = np.sort(values[np.isfinite(values)])
    return kept, 100 * np.arange(1, len(kept) + 1) / max(len(values), 1)


@contextlib.contextmanager
def distributions(data: xr.Dataset, found: list[Variant]) -> Iterator[Figure]:
    """Sorted choke travel and deviations, a line per variant; the worst run of each is named, with its command.

    Args:
        data: finished scenarios.
        found: variants.
    """
    quantities = [("choke travel [%]", figure_of(data, "choke_travel").values)]
    for cv in list(data.cv.values)[::-1]:
        name = style.NAMES.get(str(cv), str(cv))
        units = unit(str(data.cv_unit.sel(cv=cv).item()))
        quantities.append((f"mean deviation, {name} [{units}]", deviation(data, str(cv)).values))
    numbers = data.scenario.values
    with sheet.sheet(1, len(quantities), 3.1 * len(quantities), 3.9, sharey=True) as (drawn, grid):
        said = []
        for ax, (title, values) in zip(grid[0], quantities, strict=True):
            for i, variant in enumerate(found):
                kept, share = shares(values[variant.rows])
                ax.step(
                    np.append(kept[:1], kept),
                    np.append(0, share),
                    where="post",
                    color=variant.colour,
                    label=variant.label,
                )
                if not len(kept):
                    continue
                number = worst(values[variant.rows], numbers[variant.rows])
                ax.plot(kept[-1], share[-1], "o", markersize=4, color=variant.colour, clip_on=False, zorder=4)
                place = {"transform": ax.transAxes, "ha": "right", "fontsize": 8.5}
                ax.text(
                    0.98,
                    0.04 + 0.07 * (len(found) - 1 - i),
                    f"worst: #{number}",
                    color=variant.colour,
                    **place,
                )
                said.append(number)
            ax.set_xlabel(title)
            ax.set_ylim(0, 103)
            low, high = ax.get_xlim()
            if low > 0 and high > 30 * low:
                ax.set_xscale("log")
        grid[0, 0].set_ylabel(style.printed("share of the runs [%]"))
        legend = [Line2D([], [], color=v.colour, label=v.label) for v in found]
        command = ", ".join(f"#{number}" for number in dict.fromkeys(said))
        again = shlex.quote(f"{shown_store(data)}#{said[0] if said else 0}")
        words = f"Worst runs: {command}. One of them again: jaxmpc simulate {again}"
        sheet.write(drawn, data, ["Share of the runs that stay at or below a value.", words], legend)
        yield drawn


def shown_store(data: xr.Dataset) -> str:
    """The store as a command names it: below the working folder if it is there, its name if the path is long."""
    path = Path(str(data.attrs.get("store", "STORE.zarr")))
    if path.is_absolute() and path.is_relative_to(Path.cwd()):
        path = path.relative_to(Path.cwd())
    return str(path) if len(str(path)) <= 60 else path.name
