"""Travel of an MV against deviation from the setpoints: every scenario of a sweep study, and the front of the best ones."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from figures import style
from figures.sweep import sheet
from figures.sweep.data import (
    SETTLED,
    SweepAxis,
    axis_of,
    default_tuning,
    deviation,
    figure_of,
    load,
    shown_mv,
    sweep_axes,
)
from jaxmpc.check import among
from jaxmpc.errors import InputError
from studies.kpi.objectives import unbeaten
from studies.store.process import process_in

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h", "d")
COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, *style.SPARE_COLOURS)
MAP = "viridis"
MANY = 300  # points, from which on they are drawn smaller
SPREAD = 30.0  # largest over smallest value of an axis that is drawn logarithmically


def front(x, y) -> np.ndarray:
    """Which points no other point beats: as good in both and better in one, smaller being better.

    Equal points do not beat each other. Points that are not finite are never on the front and beat nothing.

    Args:
        x: ``"point"``.
        y: ``"point"``.
    """
    return unbeaten(np.column_stack([x, y]).astype(float))


@style.house_style
def pareto(
    data: str | Path | xr.Dataset,
    x: str = "travel",
    y: str = "mean_absolute_deviation",
    color: str | None = None,
    *,
    marker: str | None = None,
    cv: str | None = None,
    axes: Axes | None = None,
) -> Axes:
    """Scenarios as points, the front of those that none beats as a line, the first preset with a ring.

    Args:
        data: path of a store, what `studies.store.reading.open_study` gave, or finished scenarios of it.
        x: key figure along the horizontal axis, ``NAME.CHANNEL`` for that of one CV or MV. One per MV is drawn for the
            first MV with a stepped actuator, or the first where there is none.
        y: key figure along the vertical axis. One per CV is drawn for `cv`, or as the mean over the CVs; where it has the
            unit of the CV, each is divided by the half width in which its CV counts as settled before.
        color: column of the colours; the first one of numbers if not given.
        marker: column of the markers; the controller, another column of text, or the second one of numbers if not given.
        cv: name of a CV.
        axes: to draw on; a figure of its own otherwise.

    Returns:
        The axes; `axes.figure` is the figure.

    Raises:
        InputError: if there is no store, or for a key figure or column that is not there.
    """
    data = data if isinstance(data, xr.Dataset) else load(data)
    axes = axes or style.figure(1, row_height=4.5)[1][0]
    (across, x_title), (up, y_title) = _figure(data, x, cv), _figure(data, y, cv)
    known = sweep_axes(data)
    coloured = _pick(data, known, color) if color else next((a for a in known if a.numeric), None)
    shaped = _pick(data, known, marker) if marker else _marker_axis(known, coloured)
    best = np.flatnonzero(front(across, up))
    best = best[np.lexsort((-up[best], across[best]))]
    axes.plot(across[best], up[best], color=style.BLACK, linewidth=1.0, zorder=2, label="front")
    _points(axes, across, up, coloured, shaped)
    mark = default_tuning(data) & np.isfinite(across) & np.isfinite(up)
    if mark.any():
        sheet.ring(axes, across[mark], up[mark], f"{process_in(data).default_preset} tuning")
    for values, set_scale in ((across, axes.set_xscale), (up, axes.set_yscale)):
        if style.spans(values, SPREAD):
            set_scale("log")
    axes.set_xlabel(x_title)
    axes.set_ylabel(y_title)
    return axes


def draw(data: xr.Dataset) -> Figure:
    """The figure of a study, from its finished scenarios."""
    drawn, ((axes,),) = style.grid(1, 1, 7.6, 5.3)
    pareto(data, axes=axes)
    finite = np.isfinite(figure_of(data, "travel").values) & np.isfinite(deviation(data).values)
    lost, process = int((~finite).sum()), process_in(data)
    widths = ", ".join(f"{cv.label} {cv.settled:g} {cv.unit}".removesuffix(" 1") for cv in process.cvs)
    lines = [
        "One point per scenario; the line joins those that no other beats in both. The deviation of each CV is "
        f"divided by the half width in which it counts as settled ({widths}), then averaged.",
        *linked_sentences(data),
        f"Not drawn, without finite figures: {lost} of the finished scenarios." if lost else "",
    ]
    sheet.write(drawn, data, lines)
    label = shown_mv(process).label
    axes.set_title(f"{label[0].upper()}{label[1:]} travel against deviation", loc="left")
    return drawn


def linked_sentences(data: xr.Dataset) -> list[str]:
    """Which columns are a fixed multiple of another one that is drawn."""
    out = []
    for axis in sweep_axes(data):
        for key in axis.linked if axis.numeric else ():
            top = int(np.argmax(np.abs(axis.values)))
            ratio = data[key].values[top] / axis.values[top]
            if np.allclose(data[key].values, ratio * axis.values, rtol=1e-9):
                out.append(f"The {data[key].attrs.get('long_name', key)} is {ratio:g} of the {axis.label}.")
    return out


def _figure(data: xr.Dataset, name: str, cv: str | None) -> tuple[np.ndarray, str]:
    """Values per scenario and the title of their axis."""
    values = figure_of(data, name)
    bare = name.partition(".")[0]
    words, units = str(values.attrs.get("long_name", bare)), str(values.attrs.get("units", "1"))
    if values.dims == ("scenario",):
        for axis in ("cv", "mv"):
            if axis in values.coords:
                channel = str(values[axis].item())
                words = f"{process_in(data).labels[channel]} {_TITLES.get(bare, words)}"
                units = units.replace(f"{axis}_unit", str(data[f"{axis}_unit"].sel({axis: channel}).item()))
        return values.values.astype(float), style.label(words, units)
    if values.dims != ("scenario", "cv"):
        raise InputError(name, list(values.dims), "a key figure of the scenario, or one per CV")
    if cv is None:
        if "cv_unit" not in units:
            return values.mean("cv", skipna=False).values, f"{words}, mean of the CVs [{style.unit(units)}]"
        rest = style.unit(units.replace("cv_unit", "").strip() or "1")
        return deviation(data, name=name).values, f"{_TITLES.get(name, words)} / {SETTLED} [{rest}]"
    among("cv", cv, map(str, data.cv.values))
    shown = units.replace("cv_unit", str(data.cv_unit.sel(cv=cv).item()))
    return values.sel(cv=cv).values, f"{words}, {process_in(data).labels[cv]} [{style.unit(shown)}]"


_TITLES = {"travel": "travel", "mean_absolute_deviation": "mean deviation"}


def _pick(data: xr.Dataset, known: list[SweepAxis], key: str) -> SweepAxis:
    for axis in known:
        if key == axis.key:
            return axis
    if key not in data.coords or data[key].dims != ("scenario",):
        raise InputError("color or marker", key, f"a column of the study: {', '.join(a.key for a in known)}")
    return axis_of(data, key)


def _marker_axis(known: list[SweepAxis], coloured: SweepAxis | None) -> SweepAxis | None:
    """The controller, then text, then numbers; as many values as there are markers, never the seed."""
    rest = [a for a in known if a is not coloured and len(a.unique) <= len(MARKERS) and a.key != "seed"]
    return min(rest, key=lambda a: (a.key != "controller", a.numeric), default=None)


def _points(axes: Axes, x, y, coloured: SweepAxis | None, shaped: SweepAxis | None) -> None:
    small = len(x) > MANY
    look: dict[str, Any] = {"s": 14 if small else 34, "linewidth": 0.25 if small else 0.4}
    look |= {"edgecolor": "white", "zorder": 3}
    paints = np.full(len(x), style.BLUE, dtype=object)
    handles, titles = [], []
    grey: dict[str, Any] = {"linestyle": "none", "markersize": 6, "markeredgecolor": "white"}
    if coloured is not None and coloured.numeric:
        paints = coloured.values.astype(float)
        log = coloured.scale == "log" and paints.max() > 10 * paints.min()
        look |= {"norm": (LogNorm if log else Normalize)(paints.min(), paints.max()), "cmap": MAP}
    elif coloured is not None:
        shades = dict(zip(coloured.unique, itertools.cycle(COLOURS)))
        paints = np.array([shades[value] for value in coloured.values])
        titles.append(coloured.title)
        handles += [Line2D([], [], marker="o", **grey, color=s, label=str(v)) for v, s in shades.items()]
    if shaped is None:
        drawn = axes.scatter(x, y, marker=MARKERS[0], c=paints, **look)
    else:
        titles += [shaped.title] if shaped.key != "controller" else []
        for mark, value in zip(itertools.cycle(MARKERS), shaped.unique):
            rows = shaped.values == value
            drawn = axes.scatter(x[rows], y[rows], marker=mark, c=paints[rows], **look)
            words = f"{value:g}" if shaped.numeric else str(value)
            handles.append(Line2D([], [], marker=mark, **grey, color="#666666", label=words))
    if coloured is not None and coloured.numeric:
        bar = sheet.colour_bar(drawn, axes, coloured.title, pad=0.015, aspect=30)
        if log and len(coloured.unique) <= 10:
            bar.set_ticks(coloured.unique, labels=[f"{v:g}" for v in coloured.unique])
    handles.append(Line2D([], [], color=style.BLACK, linewidth=1.0, label="front"))
    axes.legend(
        handles=handles,
        title=", ".join(titles) or None,
        loc="best" if not small else "upper right",  # searching takes long among many points
        fontsize=8,
        title_fontsize=8,
        ncols=1 + (len(handles) > 6),
    )
