"""Heat maps of a sweep study: key figures over two numeric axes, or over working points of the model and references."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from figures import style
from figures.sweep import sheet
from figures.sweep.data import (
    ACTUATORS,
    SETTLED,
    SweepAxis,
    controller_of,
    controller_words,
    default_tuning,
    deviation,
    figure_of,
    quantities,
    rows_by,
    shown_mv,
    sweep_axes,
    travel_title,
)
from figures.sweep.wear import MAP, linked_sentences
from studies.store.process import process_in

LONGEST = 40  # values along an axis
FILLED = 0.5  # of the cells, else the two axes are no grid
NUMBERS = 130  # cells of a map that still have their number printed
DARK = 0.62  # of the colour scale, beyond it numbers are dark


def map_axes(data: xr.Dataset) -> tuple[SweepAxis, SweepAxis] | None:
    """The first two numeric axes that form a grid; None without."""
    known = sweep_axes(data)
    numeric = [a for a in known if a.numeric and a.key != "seed" and len(a.unique) <= LONGEST]
    for i, first in enumerate(numeric):
        for second in numeric[i + 1 :]:
            count = len(set(zip(first.values.tolist(), second.values.tolist(), strict=True)))
            if count >= FILLED * len(first.unique) * len(second.unique) and count > len(first.unique):
                return first, second
    return None


def controller_parts(data: xr.Dataset) -> list[tuple[str, str, xr.Dataset]]:
    """Label, short name for files ("" if there is one controller only), and the scenarios of each controller."""
    parts = rows_by(*controller_of(data))
    out = []
    for (kind, actuator), rows in parts.items():
        name = f"_{kind}_{ACTUATORS.get(actuator, actuator)}".replace("-", "_") if len(parts) > 1 else ""
        out.append((controller_words(kind, actuator), name, data.isel(scenario=rows)))
    return out


def cells(values: np.ndarray, at: list[tuple[np.ndarray, list]]) -> np.ndarray:
    """Median of the values ``"scenario"`` in each cell, ``"row column"``; NaN in an empty one.

    `at` says for rows, then columns, where each scenario is, and the distinct places.
    """
    (rows, row_places), (columns, column_places) = at
    medians = pd.Series(values).groupby([rows, columns]).median().unstack()
    return medians.reindex(index=row_places, columns=column_places).to_numpy(dtype=float)


def draw(data: xr.Dataset, axes: tuple[SweepAxis, SweepAxis], label: str = "") -> Figure:
    """Travel and reversals of `shown_mv` and the mean deviation of each CV over two axes; one controller."""
    across, up = axes
    process = process_in(data)
    shown, mv = quantities(data), shown_mv(process)
    shown.insert(1, (f"{mv.label} reversals [1]", figure_of(data, f"reversals.{mv.name}").values))
    mark = np.flatnonzero(default_tuning(data))
    rows = (len(shown) + 1) // 2
    drawn, grid = style.grid(rows, 2, 9.0, 3.05 * rows + 0.7)
    for i, (ax, (title, values)) in enumerate(zip(grid.flat, shown, strict=False)):
        table = cells(values, [(up.values, up.unique), (across.values, across.unique)])
        x, y = _place(ax, across, "x"), _place(ax, up, "y")
        borders = edges(x, across.scale), edges(y, up.scale)
        sheet.colour_bar(heat(ax, table, borders, (x, y)), ax, pad=0.02, aspect=25)
        ax.set_title(title, loc="left")
        if i // 2 == rows - 1:
            ax.set_xlabel(textwrap.fill(across.title, 48))
        if i % 2 == 0:
            ax.set_ylabel(textwrap.fill(up.title, 32))
        if len(mark):
            outline(ax, *borders, [axis.unique.index(axis.values[mark[0]]) for axis in axes])
    for spare in grid.flat[len(shown) :]:
        spare.set_visible(False)
    framed = f"Framed: {process.default_preset} tuning." if len(mark) else ""
    sheet.write(drawn, data, [_caption(data, axes, label), framed, *linked_sentences(data)])
    return drawn


def _caption(data: xr.Dataset, axes: tuple[SweepAxis, SweepAxis], label: str) -> str:
    """What the cells are a median of, and where distances are not to scale."""
    median = _median(data, {axis.key for axis in axes}) or "one scenario per cell"
    equal = [axis.label for axis in axes if axis.scale == "equal"]
    scale = f"; {' and '.join(equal)} at equal distances, not to scale" if equal else ""
    return f"{label + ': ' + median if label else median[0].upper() + median[1:]}{scale}."


def _median(data: xr.Dataset, shown: set[str]) -> str:
    """What else varies in a cell."""
    further = [axis.label for axis in sweep_axes(data) if axis.key not in shown]
    return f"median over {', '.join(further)}" if further else ""


def _place(ax: Axes, axis: SweepAxis, which: str) -> np.ndarray:
    """Scale and ticks of one axis of a map; where its values are."""
    values = np.array(axis.unique, dtype=float)
    places = values if axis.scale != "equal" else np.arange(len(values), dtype=float)
    if axis.scale == "log":
        getattr(ax, f"set_{which}scale")("log")
    set_ticks = getattr(ax, f"set_{which}ticks")
    set_ticks(places, [f"{v:.5g}" for v in values])
    set_ticks([], minor=True)
    if which == "x":
        ax.tick_params(axis="x", rotation=45 if len(values) > 7 else 0)
    return places


def edges(places: np.ndarray, scale: str) -> np.ndarray:
    """Borders of the cells around increasing places, half way between them on the scale."""
    at = np.log(places) if scale == "log" else np.asarray(places, dtype=float)
    middle = (at[1:] + at[:-1]) / 2
    out = np.concatenate([[2 * at[0] - middle[0]], middle, [2 * at[-1] - middle[-1]]])
    return np.exp(out) if scale == "log" else out


def heat(
    ax: Axes,
    table: np.ndarray,
    borders: tuple[np.ndarray, np.ndarray],
    centres: tuple[np.ndarray, np.ndarray],
    norm: Normalize | None = None,
    size: float | None = None,
) -> QuadMesh:
    """One map of a table ``"row column"``, columns and rows between their borders, numbers [pt] printed where they fit.

    Colours are logarithmic for values of several magnitudes, if no scale is given.
    """
    norm = norm or colours(table)
    size = size or (8.0 if table.size <= 50 else 6.3)
    mesh = ax.pcolormesh(*borders, np.ma.masked_invalid(table), cmap=MAP, norm=norm)
    ax.set_facecolor("#F2F2F2")
    ax.grid(False)
    look: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": size, "clip_on": True}
    for i, j in np.argwhere(np.isfinite(table)) if table.size <= NUMBERS else ():
        shade = style.BLACK if float(norm(table[i, j])) > DARK else "white"
        text = short(float(table[i, j]), 3 if size > 7 else 2)
        ax.text(float(centres[0][j]), float(centres[1][i]), text, color=shade, **look)
    return mesh


def short(value: float, digits: int) -> str:
    """A number in as few characters as a cell has room for."""
    if abs(value) >= 9999.5:
        return f"{value / 1000:.0f}k"
    return f"{value:.0f}" if abs(value) >= 10**digits - 0.5 else f"{value:.{digits}g}"


def outline(ax: Axes, x: np.ndarray, y: np.ndarray, cell: list[int]) -> None:
    """Frame a cell, column and row given, dark on light and light on dark."""
    i, j = cell
    size = x[i + 1] - x[i], y[j + 1] - y[j]
    for colour, width in (("white", 3.6), (style.BLACK, 1.6)):
        look: dict[str, Any] = {"edgecolor": colour, "linewidth": width, "fill": False, "clip_on": False}
        ax.add_patch(Rectangle((x[i], y[j]), *size, zorder=5, **look))


def colours(values: np.ndarray) -> Normalize:
    """The colour scale of some values."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return Normalize(0, 1)
    low, high = float(finite.min()), float(finite.max())
    if style.spans(values, 10):
        return LogNorm(low, high)
    return Normalize(low, high if high > low else low + 1)


def model_axes(axes: list[SweepAxis]) -> list[SweepAxis]:
    """The first two coordinates of the working point of the model that vary: for columns, then for rows of a reference."""
    return [axis for axis in axes if axis.key.startswith("model.")][:2]


def is_mismatch(axes: list[SweepAxis]) -> bool:
    """Whether the working point of the model and the reference vary."""
    return "reference" in [axis.key for axis in axes] and bool(model_axes(axes))


def mismatch(data: xr.Dataset) -> Figure:
    """Deviation and travel by working point of the model and reference, a row of panels per controller."""
    parts, known = controller_parts(data), sweep_axes(data)
    mv = shown_mv(process_in(data))
    reference = next(axis for axis in known if axis.key == "reference")
    column, *inner = model_axes(known)
    regions, points = reference.unique, column.unique
    within = inner[0].unique if inner else []
    steps = max(len(within), 1)  # rows of a reference
    height = max(len(parts) * (0.21 * steps * len(regions) + 0.55), 2.0)
    drawn, grid = style.grid(len(parts), 2, 9.0, height + 1.5, sharex=True, sharey=True)
    y, x = (np.arange(count, dtype=float) for count in (steps * len(regions), len(points)))
    holes = bool(data.attrs.get("missing"))
    shown = (
        (f"deviation / {SETTLED}, mean of the CVs [1]", deviation(data)),
        (
            travel_title(mv),
            figure_of(data, f"travel.{mv.name}"),
        ),
    )
    for i, (title, quantity) in enumerate(shown):
        norm = colours(quantity.values)
        holes = holes or not np.isfinite(quantity.values).all()
        mesh: Any = None
        for ax, (label, _, part) in zip(grid[:, i], parts, strict=True):
            where = steps * np.array([regions.index(region) for region in part.reference.values])
            if inner:
                where = where + np.searchsorted(within, part[inner[0].key].values)
            values = quantity.sel(scenario=part.scenario).values
            table = cells(values, [(where, y.tolist()), (part[column.key].values, points)])
            mesh = heat(ax, table, (edges(x, "equal"), edges(y, "equal")), (x, y), norm, size=6)
            for border in range(1, len(regions)):
                ax.axhline(border * steps - 0.5, color="white", linewidth=2.5)
            ax.set_title(label if i == 0 else " ", loc="left", fontsize=9)
            ax.set_xticks(x, [f"{v:g}" for v in points])
            ax.tick_params(length=0)
        grid[-1, i].set_xlabel(column.title)
        sheet.colour_bar(mesh, grid[:, i], title, location="top", aspect=40, pad=0.02)
    for ax in grid[:, 0]:
        ax.set_yticks(y, [f"{value:g}" for value in within] * len(regions) if inner else [""] * len(y))
        for i, region in enumerate(regions):
            place = (-0.13 if inner else -0.02, i * steps + (steps - 1) / 2)
            look: dict[str, Any] = {"ha": "right", "va": "center", "fontsize": 8.5}
            ax.annotate(str(region), place, xycoords=("axes fraction", "data"), **look)
    median = _median(data, {"controller", "reference", column.key, *(axis.key for axis in inner)})
    words = [
        f"Rows: {reference.label}{f', in it {inner[0].label} [{inner[0].unit}]' if inner else ''}.",
        "One colour scale for all controllers." * (len(parts) > 1),
        f"M{median[1:]}." if median else "",
        "Empty: no finite figure." * holes,
    ]
    sheet.write(drawn, data, [" ".join(filter(None, words))])
    return drawn
