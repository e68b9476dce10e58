"""Heat maps of a sweep study: key figures over two numeric axes, or over working points of the model and regions."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from figures import style
from figures.sweep import sheet
from figures.sweep.data import (
    SweepAxis,
    controller_of,
    deviation,
    figure_of,
    sweep_axes,
    thesis_tuning,
    unit,
)
from figures.sweep.wear import MAP, linked_sentences

LONGEST = 40  # values along an axis
FILLED = 0.5  # of the cells, else the two axes are no grid
NUMBERS = 130  # cells of a map that still have their number printed


def map_axes(data: xr.Dataset) -> tuple[SweepAxis, SweepAxis] | None:
    """The first two numeric axes that form a grid; None without."""
    numeric = [
        axis
        for axis in sweep_axes(data)
        if axis.numeric and axis.key != "seed" and len(axis.unique) <= LONGEST
    ]
    for i, first in enumerate(numeric):
        for second in numeric[i + 1 :]:
            cells = len(set(zip(first.values.tolist(), second.values.tolist(), strict=True)))
            if cells >= FILLED * len(first.unique) * len(second.unique) and cells > len(first.unique):
                return first, second
    return None


def controller_parts(data: xr.Dataset) -> list[tuple[str, str, xr.Dataset]]:
    """Label, short name for files ("" if there is one controller only), and the scenarios of each controller."""
    kind, actuator = controller_of(data)
    both = list(zip(kind.tolist(), actuator.tolist(), strict=True))
    out = []
    for one in dict.fromkeys(both):
        rows = np.flatnonzero([other == one for other in both])
        name = f"_{one[0]}_{one[1]}_choke".replace("-", "_") if len(set(both)) > 1 else ""
        out.append((f"{one[0]} MPC, {one[1]} choke", name, data.isel(scenario=rows)))
    return out


def cells(values: np.ndarray, at: list[tuple[np.ndarray, list]]) -> np.ndarray:
    """Median of the values in each cell, ``"row column"``; NaN in an empty one.

    Args:
        values: ``"scenario"``.
        at: rows, then columns: where each scenario is, and the distinct places.
    """
    (rows, row_places), (columns, column_places) = at
    out = np.full((len(row_places), len(column_places)), np.nan)
    for i, row in enumerate(row_places):
        for j, column in enumerate(column_places):
            inside = values[(rows == row) & (columns == column)]
            inside = inside[~np.isnan(inside)]
            if len(inside):
                out[i, j] = np.median(inside)
    return out


@contextlib.contextmanager
def draw(data: xr.Dataset, axes: tuple[SweepAxis, SweepAxis], label: str = "") -> Iterator[Figure]:
    """Choke travel, reversals, and the mean deviation of each CV over two axes.

    Args:
        data: finished scenarios, of one controller.
        axes: the horizontal and the vertical one, of these scenarios.
        label: of the controller.
    """
    across, up = axes
    quantities = [
        ("choke travel [%]", figure_of(data, "choke_travel").values),
        ("choke reversals [1]", figure_of(data, "choke_reversals").values),
    ]
    for cv in data.cv.values:
        name = style.NAMES.get(str(cv), str(cv))
        title = f"mean deviation, {name} [{unit(str(data.cv_unit.sel(cv=cv).item()))}]"
        quantities.append((title, deviation(data, str(cv)).values))
    mark = thesis_tuning(data)
    rows = (len(quantities) + 1) // 2
    with sheet.sheet(rows, 2, 9.0, 3.05 * rows + 0.7) as (drawn, panels):
        for i, (title, values) in enumerate(quantities):
            ax = panels[i // 2, i % 2]
            table = cells(values, [(up.values, up.unique), (across.values, across.unique)])
            x, y = _place(ax, across, "x"), _place(ax, up, "y")
            mesh = heat(ax, table, edges(x, across.scale), edges(y, up.scale), centres=(x, y))
            sheet.colour_bar(mesh, ax, pad=0.02, aspect=25)
            ax.set_title(title, loc="left")
            if i // 2 == rows - 1:
                ax.set_xlabel(across.title)
            if i % 2 == 0:
                ax.set_ylabel(up.title)
            if mark.any():
                at = np.flatnonzero(mark)[0]
                place = across.unique.index(across.values[at]), up.unique.index(up.values[at])
                outline(ax, edges(x, across.scale), edges(y, up.scale), place)
        for spare in panels.ravel()[len(quantities) :]:
            spare.set_visible(False)
        framed = "Framed: the tuning of the thesis." if mark.any() else ""
        sheet.write(drawn, data, [_caption(data, axes, label), framed, *linked_sentences(data)])
        yield drawn


def _caption(data: xr.Dataset, axes: tuple[SweepAxis, SweepAxis], label: str) -> str:
    """What the cells are a median of, and where distances are not to scale."""
    further = [a.label for a in sweep_axes(data) if a.key not in {axis.key for axis in axes}]
    median = f"median over {', '.join(further)}" if further else "one scenario per cell"
    equal = [axis.label for axis in axes if axis.scale == "equal"]
    scale = f"; {' and '.join(equal)} at equal distances, not to scale" if equal else ""
    return f"{label + ': ' + median if label else median.capitalize()}{scale}."


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
    x_edges: np.ndarray,
    y_edges: np.ndarray,
    *,
    centres: tuple[np.ndarray, np.ndarray],
    norm: Normalize | None = None,
    numbers: bool | None = None,
    size: float | None = None,
) -> QuadMesh:
    """One map; logarithmic colours for values of several magnitudes, numbers printed where they fit."""
    finite = table[np.isfinite(table)]
    norm = norm or colours(finite)
    size = size or (8.0 if table.size <= 50 else 6.3)
    mesh = ax.pcolormesh(x_edges, y_edges, np.ma.masked_invalid(table), cmap=MAP, norm=norm)
    ax.set_facecolor("#F2F2F2")
    ax.grid(False)
    if numbers if numbers is not None else table.size <= NUMBERS:
        middle = 0.62
        for i, j in zip(*np.nonzero(np.isfinite(table)), strict=True):
            place, value = (float(centres[0][j]), float(centres[1][i])), float(table[i, j])
            shade = style.BLACK if float(norm(value)) > middle else "white"
            ax.text(
                *place,
                short(value, 3 if size > 7 else 2),
                ha="center",
                va="center",
                fontsize=size,
                color=shade,
                clip_on=True,
            )
    return mesh


def short(value: float, digits: int) -> str:
    """A number in as few characters as a cell has room for."""
    if abs(value) >= 9999.5:
        return f"{value / 1000:.0f}k"
    return f"{value:.0f}" if abs(value) >= 10**digits - 0.5 else f"{value:.{digits}g}"


def outline(ax: Axes, x: np.ndarray, y: np.ndarray, cell: tuple[int, int]) -> None:
    """Frame a cell, column and row given, dark on light and light on dark."""
    i, j = cell
    for colour, width in (("white", 3.6), (style.BLACK, 1.6)):
        size = x[i + 1] - x[i], y[j + 1] - y[j]
        frame = Rectangle((x[i], y[j]), *size, edgecolor=colour, linewidth=width, fill=False, clip_on=False)
        frame.set_zorder(5)
        ax.add_patch(frame)


def colours(finite: np.ndarray) -> Normalize:
    """The colour scale of some values."""
    if not len(finite):
        return Normalize(0, 1)
    low, high = float(finite.min()), float(finite.max())
    if low > 0 and high > 10 * low:
        return LogNorm(low, high)
    return Normalize(low, high if high > low else low + 1)


def is_mismatch(axes: list[SweepAxis]) -> bool:
    """Whether the working point of the model and the operating region vary."""
    keys = {axis.key for axis in axes}
    return "reference" in keys and bool(keys & {"model.choke", "model.lift"})


@contextlib.contextmanager
def mismatch(data: xr.Dataset) -> Iterator[Figure]:
    """Deviation and choke travel by working point of the model and operating region, a row of panels per controller.

    Args:
        data: finished scenarios with the columns ``reference`` and ``model.choke`` or ``model.lift``.
    """
    parts = controller_parts(data)
    found = {axis.key: axis for axis in sweep_axes(data)}
    regions = found["reference"].unique
    key = "model.choke" if "model.choke" in found else "model.lift"
    points = found[key].unique
    lifts = found["model.lift"].unique if key == "model.choke" and "model.lift" in found else [None]
    values: tuple[tuple[str, Callable[[xr.Dataset], np.ndarray]], ...] = (
        ("deviation / thesis deadzone, mean of the CVs [1]", lambda part: deviation(part).values),
        ("choke travel [%]", lambda part: figure_of(part, "choke_travel").values),
    )
    steps = len(lifts)
    height = max(len(parts) * (0.21 * steps * len(regions) + 0.55), 2.0)
    options = {"sharex": True, "sharey": True}
    with sheet.sheet(len(parts), 2, 9.0, height + 1.5, **options) as (drawn, panels):
        y = np.arange(steps * len(regions), dtype=float)
        x = np.arange(len(points), dtype=float)
        for column, (title, quantity) in enumerate(values):
            norm = colours(_finite(quantity(data)))
            mesh: Any = None
            for ax, (label, _, part) in zip(panels[:, column], parts, strict=True):
                where = [
                    regions.index(region) * steps + (lifts.index(lift) if lifts != [None] else 0)
                    for region, lift in zip(
                        part.reference.values,
                        part["model.lift"].values if lifts != [None] else [None] * part.sizes["scenario"],
                        strict=True,
                    )
                ]
                table = cells(quantity(part), [(np.array(where), y.tolist()), (part[key].values, points)])
                mesh = heat(
                    ax, table, edges(x, "equal"), edges(y, "equal"), centres=(x, y), norm=norm, size=6
                )
                for border in range(1, len(regions)):
                    ax.axhline(border * steps - 0.5, color="white", linewidth=2.5)
                ax.set_title(label if column == 0 else " ", loc="left", fontsize=9)
                ax.set_xticks(x, [f"{v:g}" for v in points])
                ax.tick_params(length=0)
            panels[-1, column].set_xlabel(f"{found[key].label} [{unit(found[key].unit)}]")
            sheet.colour_bar(mesh, panels[:, column], title, location="top", aspect=40, pad=0.02)
        for ax in panels[:, 0]:
            ax.set_yticks(y, [f"{lifts[int(k) % steps] or 0:g}" if lifts != [None] else "" for k in y])
            for i, region in enumerate(regions):
                middle = i * steps + (steps - 1) / 2
                ax.annotate(
                    str(region),
                    (-0.13 if lifts != [None] else -0.02, middle),
                    xycoords=("axes fraction", "data"),
                    ha="right",
                    va="center",
                    fontsize=8.5,
                )
        holes = not np.isfinite(np.concatenate([quantity(data) for _, quantity in values])).all()
        words = f"Rows: operating region{', in it the gas lift of the working point [m3/h]' * (steps > 1)}."
        known = {"controller", "reference", key, "model.lift"}
        further = [axis.label for axis in sweep_axes(data) if axis.key not in known]
        median = f" Median over {', '.join(further)}." if further else ""
        sheet.write(
            drawn,
            data,
            [
                words
                + " One colour scale for all controllers." * (len(parts) > 1)
                + median
                + " Empty: no finite figure." * (holes or bool(data.attrs.get("missing")))
            ],
        )
        yield drawn


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]
