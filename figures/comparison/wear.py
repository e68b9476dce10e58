"""What the controllers of a comparison ask of the actuators, and how far off the setpoints they stay: bars."""

from __future__ import annotations

import textwrap

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.comparison.tracking import STUDY
from figures.figure import FigureEntry
from figures.sweep.data import SETTLED
from studies.kpi.evaluate import completed, key_figures
from studies.store.process import process_in

COLUMNS = 3
WIDE = 26  # characters of a label


def draw(data: xr.Dataset) -> Figure:
    """Horizontal bars by controller: travel and reversals of each stepped MV, and the mean deviation of the CVs."""
    data = completed(data)
    figures, colours = key_figures(data), panels.run_colours(data)
    shown = [*_of_actuators(data, figures), _off(data, figures)]
    count = figures.sizes["controller"]
    columns = min(COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    drawn, grid = style.grid(rows, columns, 9.6, rows * (0.42 * count + 0.75) + 0.1, sharey=True)
    places = np.arange(count)
    paint = [colours[str(name)] for name in figures.controller.values]
    for ax, (title, values) in zip(grid.flat, shown, strict=False):
        bars = ax.barh(places, values, 0.62, color=paint)
        ax.bar_label(
            bars,
            [f"{value:,.0f}" if value >= 100 else f"{value:.3g}" for value in values],
            padding=3,
            fontsize=8,
        )
        ax.set_title(title, loc="left", fontsize=9)
        ax.margins(x=0.22)
        ax.set_xlim(left=0)
        ax.locator_params(axis="x", nbins=5)
        ax.grid(axis="y", visible=False)
        ax.set_yticks(places, [textwrap.fill(str(label), WIDE) for label in figures.label.values])
        ax.tick_params(axis="y", length=0)
    grid[0, 0].invert_yaxis()  # the first controller on top
    for spare in grid.flat[len(shown) :]:
        spare.set_visible(False)
    return drawn


def _of_actuators(data: xr.Dataset, figures: xr.Dataset) -> list[tuple[str, np.ndarray]]:
    """Title and value per controller: travel of MVs, reversals of stepped ones."""
    out = []
    stepped = panels.stepped(data)
    for mv in panels.worn(data):
        words = panels.words_of(data, mv)
        out.append((panels.label_of(data, mv, " travel"), figures.travel.sel(mv=mv).values))
        if mv in stepped:
            out.append((f"{words} reversals [1]", figures.reversals.sel(mv=mv).values))
    return out


def _off(data: xr.Dataset, figures: xr.Dataset) -> tuple[str, np.ndarray]:
    scaled = figures.mean_absolute_deviation.values / process_in(data).settled
    return f"mean deviation / {SETTLED} [1]", scaled.mean(axis=1)


def _caption(data: xr.Dataset) -> str:
    cvs = process_in(data).cvs
    widths = ", ".join(f"{cv.label} {cv.settled:g} {style.unit(cv.unit)}".removesuffix(" 1") for cv in cvs)
    return (
        "Travel is the sum of absolute moves of the actual position; a reversal is a move against the move before. Each "
        f"deviation is divided by the half width in which its CV counts as settled ({widths}), then averaged."
    )


ENTRIES = (FigureEntry("wear", "moves of the actuators and deviations", STUDY, draw, _caption),)
