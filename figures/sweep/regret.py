"""What move blocking costs: closed-loop cost lost against the time of one controller step, a point per blocking."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox

from figures import style
from figures.sweep import sheet
from figures.sweep.data import STRUCTURE, columns, figure_of, setting, thesis_setting
from studies.definition.fields import as_text

COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, style.ORANGE, style.PURPLE, style.SKY, style.GREY)
MODES = {"moves": "o", "inputs": "s", "none": "^"}
ROUND = ((1, 0.6), (1, -0.6), (-1, 0.6), (-1, -0.6), (0, 1), (0, -1), (1, 0), (-1, 0))
SHIFTS = [(r * dx, r * dy) for r in (7, 13, 20, 28, 38, 50, 65, 80) for dx, dy in ROUND]  # pt


@dataclasses.dataclass(frozen=True, eq=False)
class Blocking:
    """One blocking over all its runs.

    Attributes:
        mode: meaning of a block.
        blocks: how many.
        horizon: prediction horizon [samples].
        unknowns: moves that are decided at each sample, of all MVs.
        rows: positions of its scenarios.
        thesis: whether it is the blocking of the thesis.
    """

    mode: str
    blocks: int
    horizon: int
    unknowns: int
    rows: np.ndarray
    thesis: bool

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
    rows = list(zip(*(found[key].tolist() for key in keys), strict=True))
    out = []
    for one in dict.fromkeys(rows):
        given = dict(zip(keys, one, strict=True))
        full: dict[str, Any] = {
            key: given.get(key) or setting(data, key) or thesis_setting(key) for key in STRUCTURE
        }
        lengths = [int(v) for v in as_text(full["blocks"] if full["blocks"] is not None else "").split()]
        blocks = len(lengths)
        if full["blocking"] == "none":
            blocks = int(full["control_horizon"] or 0) or sum(lengths)
        same = all(as_text(full[key]) == as_text(thesis_setting(key)) for key in ("blocking", "blocks"))
        same = same and full["prediction_horizon"] == thesis_setting("prediction_horizon")
        inside = np.flatnonzero([row == one for row in rows])
        horizon = int(full["prediction_horizon"])
        out.append(
            Blocking(str(full["blocking"]), blocks, horizon, blocks * data.sizes.get("mv", 2), inside, same)
        )
    return out


def regret(data: xr.Dataset, variants: list[Blocking]) -> tuple[np.ndarray, str]:
    """Closed-loop cost above that of the reference in otherwise equal runs [%], ``"scenario"``, and what the reference is.

    The reference is the blocking of the thesis if it is among the variants, else the best of the equal runs. NaN where
    the reference run is missing.
    """
    cost = figure_of(data, "closed_loop_cost").values
    found = {key: values for key, values in columns(data).items() if key not in STRUCTURE}
    context = list(zip(*(values.tolist() for values in found.values()), strict=True)) or [()] * len(cost)
    thesis = [variant for variant in variants if variant.thesis]
    base: dict[tuple, float] = {}
    for row in thesis[0].rows if thesis else range(len(cost)):
        value = float(cost[row])
        if not np.isnan(value):
            base[context[row]] = value if thesis else min(value, base.get(context[row], np.inf))
    against = np.array([base.get(key, np.nan) for key in context])
    name = "the thesis blocking" if thesis else "the best blocking"
    return 100 * (cost / against - 1), name


def quartiles(values: np.ndarray) -> np.ndarray:
    """Lower quartile, median, upper quartile of the finite values; NaN without any."""
    values = values[np.isfinite(values)]
    return np.percentile(values, [25, 50, 75]) if len(values) else np.full(3, np.nan)


@contextlib.contextmanager
def draw(data: xr.Dataset) -> Iterator[Figure]:
    """Regret over median and 99th percentile of the solve time, and over the number of unknowns.

    Args:
        data: finished scenarios.
    """
    variants = blockings(data)
    lost, reference = regret(data, variants)
    runs = max(len(variant.rows) for variant in variants)
    kinds = list(dict.fromkeys(variant.label for variant in variants))
    panels_of = (
        ("median time of a controller step [ms]", 1e3 * figure_of(data, "solve_time_median").values),
        ("99th percentile of that time [ms]", 1e3 * figure_of(data, "solve_time_p99").values),
        ("moves to decide at each sample [1]", None),
    )
    with sheet.sheet(1, 3, 10.4, 4.6, sharey=True) as (drawn, panels):
        for ax, (title, values) in zip(panels[0], panels_of, strict=True):
            ax.axhline(0, color=style.BLACK, linewidth=0.8)
            names, places = [], []
            for variant in variants:
                y = quartiles(lost[variant.rows])
                x = np.full(3, float(variant.unknowns)) if values is None else quartiles(values[variant.rows])
                colour = COLOURS[kinds.index(variant.label) % len(COLOURS)]
                ax.errorbar(
                    x[1],
                    y[1],
                    xerr=[[x[1] - x[0]], [x[2] - x[1]]],
                    yerr=[[y[1] - y[0]], [y[2] - y[1]]],
                    marker=MODES.get(variant.mode, "D"),
                    color=colour,
                    markersize=7,
                    markeredgecolor="white",
                    markeredgewidth=0.6,
                    elinewidth=1.0,
                    ecolor=(colour, 0.4),
                    zorder=3,
                )
                if np.isfinite(x[1]) and np.isfinite(y[1]):
                    names.append((variant.label, colour))
                    places.append((x[1], y[1]))
                    if variant.thesis:
                        sheet.ring(ax, x[1], y[1], label=None, size=13)
            ax.margins(0.14)
            ax.set_xlabel(title)
            if values is None:
                ax.set_xlim(left=0)
                ax.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True))
            elif _magnitudes(values):
                ax.set_xscale("log")
            else:
                ax.xaxis.set_major_locator(MaxNLocator(nbins=4))  # numbers of four digits fit side by side
            ax.labels_to_place = (names, places)
        panels[0, 0].set_ylabel(f"closed-loop cost above that of\n{reference} [%]")
        modes = list(dict.fromkeys(variant.mode for variant in variants))
        grey: dict[str, Any] = {"linestyle": "none", "color": "#666666", "markeredgecolor": "white"}
        handles = [Line2D([], [], marker=MODES.get(m, "D"), markersize=7, **grey, label=m) for m in modes]
        if any(variant.thesis for variant in variants):
            look: dict[str, Any] = {**sheet.RING, "color": style.BLACK, "markersize": 10}
            handles.append(Line2D([], [], **look, label="thesis"))
        panels[0, 0].legend(
            handles=handles, loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, borderaxespad=0.1
        )
        sheet.write(
            drawn,
            data,
            [
                "Labels: number of blocks / prediction horizon [samples]. Points are medians, bars quartiles, over up to "
                f"{runs} runs that differ in {_further(data)}; each is compared with {reference} in an otherwise equal run."
            ],
        )
        drawn.canvas.draw()  # lays out, so that the labels know where the points are
        drawn.set_layout_engine("none")
        for ax in panels[0]:
            place_labels(ax, *ax.labels_to_place)
        yield drawn


def _further(data: xr.Dataset) -> str:
    names = [str(data[key].attrs.get("long_name", key)) for key in columns(data) if key not in STRUCTURE] or [
        "nothing"
    ]
    return " and ".join(names)


def _magnitudes(values: np.ndarray) -> bool:
    """Whether the values span more than one magnitude."""
    values = values[np.isfinite(values)]
    return len(values) > 0 and values.min() > 0 and values.max() > 10 * values.min()


def place_labels(
    ax: Axes, names: list[tuple[str, str]], places: list[tuple[float, float]], size: float = 8.0
) -> list[Bbox]:
    """Write labels beside points, where they cover neither a point nor each other as far as there is room.

    Args:
        ax: laid out already.
        names: text and colour of each label.
        places: of the points, in data units.
        size: of the text [pt].

    Returns:
        The boxes of the labels on the page [pixel].
    """
    canvas: Any = ax.figure.canvas
    renderer = canvas.get_renderer()
    pixel = ax.figure.dpi / 72
    frame = ax.get_window_extent(renderer)
    points = ax.transData.transform(places) if places else np.zeros((0, 2))
    radius = 5 * pixel
    taken = [Bbox([point - radius, point + radius]) for point in points]
    boxes: list[Bbox] = []
    order = np.argsort(-points[:, 1], kind="stable") if len(points) else []
    for i in order:
        (text, colour), point = names[i], points[i]
        note = ax.annotate(
            text, places[i], xytext=(0, 0), textcoords="offset points", fontsize=size, color=colour
        )
        extent = note.get_window_extent(renderer)
        best: tuple[float, Bbox, tuple[float, float]] | None = None
        for dx, dy in SHIFTS:
            left = point[0] + dx * pixel - (extent.width if dx < 0 else extent.width / 2 if dx == 0 else 0)
            low = point[1] + dy * pixel - extent.height / 2
            box = Bbox.from_bounds(left, low, extent.width, extent.height)
            covered = sum(_common(box, other) for k, other in enumerate([*taken, *boxes]) if k != i)
            covered += extent.width * extent.height - _common(box, frame)  # what hangs out
            if best is None or covered < best[0] - 1e-9:
                best = covered, box, (dx, dy)
            if covered == 0:
                break
        assert best is not None
        boxes.append(best[1])
        corner = (best[1].x0 - point[0]) / pixel, (best[1].y0 - point[1]) / pixel
        note.remove()
        line = {"arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 4}
        far = max(abs(best[2][0]), abs(best[2][1])) > 14
        ax.annotate(
            text,
            places[i],
            xytext=corner,
            textcoords="offset points",
            fontsize=size,
            color=colour,
            va="bottom",
            arrowprops=line if far else None,
            path_effects=[withStroke(linewidth=2, foreground="white")],
            zorder=4,
        )
    return boxes


def _common(one: Bbox, other: Bbox) -> float:
    """Area that two boxes share."""
    width = min(one.x1, other.x1) - max(one.x0, other.x0)
    height = min(one.y1, other.y1) - max(one.y0, other.y0)
    return max(width, 0.0) * max(height, 0.0)
