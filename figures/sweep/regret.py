"""What move blocking costs: closed-loop cost lost against the time of one controller step, a point per blocking."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from figures import panels, style
from figures.sweep import sheet
from figures.sweep.data import STRUCTURE, columns, default_setting, figure_of, rows_by, setting
from studies.definition.fields import as_text
from studies.store.process import process_in

COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, style.ORANGE, style.PURPLE, style.SKY, style.GREY)
MODES = {"moves": "o", "inputs": "s", "none": "^"}
POINT = {"markersize": 7, "markeredgecolor": "white"}
ROUND = ((1, 0.6), (1, -0.6), (-1, 0.6), (-1, -0.6), (0, 1), (0, -1), (1, 0), (-1, 0))
SHIFTS = np.array([(r * dx, r * dy) for r in (7, 13, 20, 28, 38, 50, 65, 80) for dx, dy in ROUND])  # pt


@dataclasses.dataclass(frozen=True, eq=False)
class Blocking:
    """One blocking over all its runs."""

    mode: str  # meaning of a block
    blocks: int
    horizon: int  # of the prediction [samples]
    unknowns: int  # moves that are decided at each sample, of all MVs
    rows: np.ndarray  # positions of its scenarios
    default: bool  # whether it is the blocking of the process

    @property
    def label(self) -> str:
        """Blocks and horizon."""
        return f"{self.blocks} / {self.horizon}"


def is_blocking(data: xr.Dataset) -> bool:
    """Whether blocking or horizons vary, and what the figure needs is stored."""
    needed = ("closed_loop_cost", "solve_time_median", "solve_time_p99")
    return bool(set(columns(data)) & set(STRUCTURE)) and all(name in data for name in needed)


def blockings(data: xr.Dataset) -> list[Blocking]:
    """Every combination of mode, blocks and horizons in the study."""
    found = columns(data)
    keys = [key for key in STRUCTURE if key in found]
    process = process_in(data)
    usual = {key: default_setting(process, key) for key in STRUCTURE}
    out = []
    for one, rows in rows_by(*(found[key].tolist() for key in keys)).items():
        given = dict(zip(keys, one, strict=True))
        full: dict[str, Any] = {key: given.get(key) or setting(data, key) or usual[key] for key in STRUCTURE}
        written = as_text(full["blocks"] if full["blocks"] is not None else "").split(";")
        lengths, mvs = [[int(v) for v in own.split()] for own in written], len(process.mvs)
        blocks, horizon = max(map(len, lengths)), int(full["prediction_horizon"])
        unknowns = sum(map(len, lengths)) * (mvs if len(lengths) == 1 else 1)
        if full["blocking"] == "none":
            blocks = int(full["control_horizon"] or 0) or sum(lengths[0])
            unknowns = blocks * mvs
        same = all(as_text(full[key]) == as_text(usual[key]) for key in ("blocking", "blocks"))
        same = same and horizon == usual["prediction_horizon"]
        out.append(Blocking(str(full["blocking"]), blocks, horizon, unknowns, rows, same))
    return out


def regret(data: xr.Dataset, variants: list[Blocking]) -> tuple[np.ndarray, str]:
    """Closed-loop cost above that of the reference in otherwise equal runs [%], ``"scenario"``, and what the reference is.

    The reference is the blocking of the process if it is among the variants, else the best of the equal runs. NaN where
    the reference run is missing.
    """
    cost = figure_of(data, "closed_loop_cost").values
    context = [values.tolist() for key, values in columns(data).items() if key not in STRUCTURE]
    usual = next((variant.rows for variant in variants if variant.default), None)
    against = np.full(len(cost), np.nan)
    for rows in rows_by(*context).values() if context else [np.arange(len(cost))]:
        base = cost[rows if usual is None else np.intersect1d(rows, usual)]
        base = base[~np.isnan(base)]
        if len(base):
            against[rows] = base.min() if usual is None else base[-1]
    return 100 * (cost / against - 1), "the best blocking" if usual is None else "the default blocking"


def quartiles(values: np.ndarray) -> np.ndarray:
    """Lower quartile, median, upper quartile of the finite values; NaN without any."""
    values = values[np.isfinite(values)]
    return np.percentile(values, [25, 50, 75]) if len(values) else np.full(3, np.nan)


def draw(data: xr.Dataset) -> Figure:
    """Regret over median and 99th percentile of the solve time, and over the number of unknowns, of finished scenarios."""
    variants = blockings(data)
    lost, reference = regret(data, variants)
    kinds = list(dict.fromkeys(variant.label for variant in variants))
    colours = {kind: COLOURS[i % len(COLOURS)] for i, kind in enumerate(kinds)}
    unknowns = np.full(len(lost), np.nan)
    for variant in variants:
        unknowns[variant.rows] = variant.unknowns
    drawn, ((first, second, third),) = style.grid(1, 3, 10.4, 4.6, sharey=True)
    to_place = []
    for ax, values, title in (
        (first, 1e3 * figure_of(data, "solve_time_median").values, "median time of a controller step [ms]"),
        (second, 1e3 * figure_of(data, "solve_time_p99").values, "99th percentile of that time [ms]"),
        (third, unknowns, "moves to decide at each sample [1]"),
    ):
        ax.axhline(0, color=style.BLACK, linewidth=0.8)
        places = [_point(ax, variant, values, lost, colours[variant.label]) for variant in variants]
        shown = [i for i, place in enumerate(places) if np.isfinite(place).all()]
        names = [(variants[i].label, colours[variants[i].label]) for i in shown]
        to_place.append((ax, names, [places[i] for i in shown]))
        ax.margins(0.14)
        ax.set_xlabel(title)
        if ax is third:
            ax.set_xlim(left=0)
            ax.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True))
        elif style.spans(values, 10):
            ax.set_xscale("log")
        else:
            ax.xaxis.set_major_locator(MaxNLocator(nbins=4))  # numbers of four digits fit side by side
    first.set_ylabel(f"closed-loop cost above that of\n{reference} [%]")
    modes = list(dict.fromkeys(variant.mode for variant in variants))
    grey: dict[str, Any] = {"linestyle": "none", "color": "#666666", **POINT}
    handles = [Line2D([], [], marker=MODES.get(mode, "D"), **grey, label=mode) for mode in modes]
    if any(variant.default for variant in variants):
        look: dict[str, Any] = {**sheet.RING, "color": style.BLACK, "markersize": 10}
        handles.append(Line2D([], [], **look, label="default"))
    panels.legend_above(first, 4, handles=handles)
    differ = [str(data[k].attrs.get("long_name", k)) for k in columns(data) if k not in STRUCTURE]
    words = (
        "Labels: number of blocks / prediction horizon [samples]. Points are medians, bars quartiles, over up to "
        f"{max(len(variant.rows) for variant in variants)} runs that differ in {' and '.join(differ or ['nothing'])}; "
        f"each is compared with {reference} in an otherwise equal run."
    )
    sheet.write(drawn, data, [words])
    drawn.canvas.draw()  # lays out, so that the labels know where the points are
    drawn.set_layout_engine("none")
    for ax, names, places in to_place:
        place_labels(ax, names, places)
    return drawn


def _point(ax: Axes, variant: Blocking, values, lost, colour: str) -> tuple[float, float]:
    """Median of a variant with its quartiles; where it is."""
    x, y = quartiles(values[variant.rows]), quartiles(lost[variant.rows])
    look: dict[str, Any] = {"marker": MODES.get(variant.mode, "D"), "color": colour, "markeredgewidth": 0.6}
    look |= {"elinewidth": 1.0, "ecolor": (colour, 0.4), "zorder": 3, **POINT}
    apart = [np.diff(at)[:, None] for at in (x, y)]
    ax.errorbar(x[1], y[1], xerr=apart[0], yerr=apart[1], **look)
    if variant.default and np.isfinite((x[1], y[1])).all():
        sheet.ring(ax, x[1], y[1], label=None, size=13)
    return x[1], y[1]


def place_labels(
    ax: Axes, names: list[tuple[str, str]], places: list[tuple[float, float]], size: float = 8.0
) -> None:
    """Write labels beside points, where they cover neither a point nor each other as far as there is room.

    `ax` is laid out already, `names` are text and colour of each label, `places` those of the points in data units, and
    `size` is that of the text [pt].
    """
    canvas: Any = ax.figure.canvas
    pixel = ax.figure.dpi / 72
    points = ax.transData.transform(places) if places else np.zeros((0, 2))
    taken = np.hstack([points - 5 * pixel, points + 5 * pixel])  # left, bottom, right, top of each
    frame = np.array([ax.get_window_extent(canvas.get_renderer()).extents])
    for i in np.argsort(-points[:, 1], kind="stable"):
        (text, colour), point = names[i], points[i]
        look: dict[str, Any] = {"textcoords": "offset points", "fontsize": size, "color": colour}
        note = ax.annotate(text, places[i], (0, 0), **look)
        extent = np.array(note.get_window_extent(canvas.get_renderer()).size)
        note.remove()
        corners = point + SHIFTS * pixel - extent * (0.5 - 0.5 * np.sign(SHIFTS) * (1, 0))
        boxes = np.hstack([corners, corners + extent])
        covered = _common(boxes, np.delete(taken, i, axis=0)).sum(axis=1)
        covered += extent.prod() - _common(boxes, frame)[:, 0]  # what hangs out
        best = int(np.argmin(covered.round(9)))
        taken = np.vstack([taken, boxes[best]])
        line = {"arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 4}
        look |= {"va": "bottom", "zorder": 4, "path_effects": [withStroke(linewidth=2, foreground="white")]}
        look["arrowprops"] = line if np.abs(SHIFTS[best]).max() > 14 else None
        ax.annotate(text, places[i], (corners[best] - point) / pixel, **look)


def _common(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Areas ``"one other"`` that boxes share."""
    one = one[:, None]
    sides = np.minimum(one[..., 2:], other[:, 2:]) - np.maximum(one[..., :2], other[:, :2])
    return np.maximum(sides, 0.0).prod(axis=2)
