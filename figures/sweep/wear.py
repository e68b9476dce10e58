"""Choke wear against deviation from the setpoints: every scenario of a sweep study, and the front of the best ones."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from figures import style
from figures.sweep import sheet
from figures.sweep.data import SweepAxis, deviation, figure_of, sweep_axes, thesis_tuning, unit
from jaxmpc.errors import InputError

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h", "d")
MAP = "viridis"
MANY = 300  # points, from which on they are drawn smaller
SPREAD = 30.0  # largest over smallest value of an axis that is drawn logarithmically


def front(x, y) -> np.ndarray:
    """Which points no other point beats: as good in both and better in one, smaller being better.

    Equal points do not beat each other. Points with NaN are never on the front and beat nothing.

    Args:
        x: ``"point"``.
        y: ``"point"``.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    on = np.zeros(len(x), dtype=bool)
    best_y, best_x = np.inf, np.nan
    for i in np.lexsort((y, x)):  # by x, then by y; NaN last
        if np.isnan(x[i]) or np.isnan(y[i]):
            continue
        if y[i] < best_y or (y[i] == best_y and x[i] == best_x):
            on[i], best_y, best_x = True, y[i], x[i]
    return on


def pareto(
    data: xr.Dataset,
    x: str = "choke_travel",
    y: str = "mean_absolute_deviation",
    color: str | None = None,
    *,
    marker: str | None = None,
    cv: str | None = None,
    axes: Axes | None = None,
) -> Axes:
    """Scenarios as points, the front of those that none beats as a line, the thesis tuning with a ring.

    Args:
        data: of `studies.store.reading.open_study`, or finished scenarios of it.
        x: key figure along the horizontal axis.
        y: key figure along the vertical axis. One per CV is drawn for `cv`, or as the mean over the CVs; where
            it has the unit of the CV, each is divided by its deadzone in the thesis (1000 and 5 m3/h) before.
        color: column of the colours; the first one of numbers if not given.
        marker: column of the markers; the controller, another column of text, or the second one of numbers if not given.
        cv: name of a CV.
        axes: to draw on; a figure of its own otherwise.

    Returns:
        The axes; `axes.figure` is the figure, unknown to pyplot unless `axes` was given.

    Raises:
        InputError: for a key figure or column that is not there.
    """
    if axes is None:
        with plt.rc_context(style.RC):
            own = Figure(figsize=(7.6, 5.0), layout="constrained")
            FigureCanvasAgg(own)
            return pareto(data, x, y, color, marker=marker, cv=cv, axes=own.add_subplot())
    (across, x_title), (up, y_title) = _figure(data, x, cv), _figure(data, y, cv)
    known = sweep_axes(data)
    coloured = _pick(data, known, color) if color else next((a for a in known if a.numeric), None)
    shaped = _pick(data, known, marker) if marker else _marker_axis(known, coloured)
    best = np.flatnonzero(front(across, up))
    best = best[np.lexsort((-up[best], across[best]))]
    axes.plot(across[best], up[best], color=style.BLACK, linewidth=1.0, zorder=2, label="front")
    _points(axes, across, up, coloured, shaped)
    mark = thesis_tuning(data) & np.isfinite(across) & np.isfinite(up)
    if mark.any():
        sheet.ring(axes, across[mark], up[mark])
    for values, set_scale in ((across, axes.set_xscale), (up, axes.set_yscale)):
        finite = values[np.isfinite(values)]
        if len(finite) and finite.min() > 0 and finite.max() > SPREAD * finite.min():
            set_scale("log")
    axes.set_xlabel(x_title)
    axes.set_ylabel(y_title)
    return axes


@contextlib.contextmanager
def draw(data: xr.Dataset) -> Iterator[Figure]:
    """The figure of a study.

    Args:
        data: finished scenarios.
    """
    with sheet.sheet(1, 1, 7.6, 5.3) as (drawn, panels):
        axes = pareto(data, axes=panels[0, 0])
        across, up = figure_of(data, "choke_travel").values, deviation(data).values
        lost = int((~(np.isfinite(across) & np.isfinite(up))).sum())
        lines = [
            "One point per scenario; the line joins those that no other beats in both. The deviation of each CV is "
            "divided by its deadzone in the thesis (1000 and 5 m3/h), then averaged.",
            *linked_sentences(data),
            f"Not drawn, without finite figures: {lost} of the finished scenarios." if lost else "",
        ]
        sheet.write(drawn, data, lines)
        axes.set_title("Choke wear against deviation", loc="left")
        yield drawn


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
    words, units = str(values.attrs.get("long_name", name)), str(values.attrs.get("units", "1"))
    if values.dims == ("scenario",):
        return values.values.astype(float), f"{_TITLES.get(name, words)} [{unit(units)}]"
    if values.dims != ("scenario", "cv"):
        raise InputError(name, list(values.dims), "a key figure of the scenario, or one per CV")
    if cv is None:
        if "cv_unit" not in units:
            return values.mean("cv", skipna=False).values, f"{words}, mean of the CVs [{unit(units)}]"
        rest = unit(units.replace("cv_unit", "").strip() or "1")
        return deviation(data, name=name).values, f"{_TITLES.get(name, words)} / thesis deadzone [{rest}]"
    if cv not in data.cv.values:
        raise InputError("cv", cv, f"one of {', '.join(map(str, data.cv.values))}")
    shown = units.replace("cv_unit", str(data.cv_unit.sel(cv=cv).item()))
    return values.sel(cv=cv).values, f"{words}, {style.NAMES.get(cv, cv)} [{unit(shown)}]"


_TITLES = {"choke_travel": "choke travel", "mean_absolute_deviation": "mean absolute deviation"}


def _pick(data: xr.Dataset, known: list[SweepAxis], key: str) -> SweepAxis:
    for axis in known:
        if key == axis.key:
            return axis
    if key not in data.coords or data[key].dims != ("scenario",):
        raise InputError("color or marker", key, f"a column of the study: {', '.join(a.key for a in known)}")
    attrs = data[key].attrs
    return SweepAxis(key, attrs.get("long_name", key), attrs.get("units", ""), data[key].values)


def _marker_axis(known: list[SweepAxis], coloured: SweepAxis | None) -> SweepAxis | None:
    """The controller, then text, then numbers; as many values as there are markers, never the seed."""
    rest = [a for a in known if a is not coloured and len(a.unique) <= len(MARKERS) and a.key != "seed"]
    return min(rest, key=lambda a: (a.key != "controller", a.numeric), default=None)


def _points(
    axes: Axes, x: np.ndarray, y: np.ndarray, coloured: SweepAxis | None, shaped: SweepAxis | None
) -> None:
    look: dict = {"s": 34, "linewidth": 0.4, "edgecolor": "white", "zorder": 3}
    if len(x) > MANY:
        look |= {"s": 14, "linewidth": 0.25}
    if coloured is not None and coloured.numeric:
        numbers = coloured.values.astype(float)
        log = coloured.scale == "log" and numbers.max() > 10 * numbers.min()
        look["norm"] = (LogNorm if log else Normalize)(numbers.min(), numbers.max())
        look["cmap"] = MAP
    marks = shaped.unique if shaped is not None else [None]
    for i, value in enumerate(marks):
        rows = np.flatnonzero(shaped.values == value) if shaped is not None else np.arange(len(x))
        paint: dict = {"color": style.BLUE}
        if coloured is not None:
            paint = {"c": coloured.values[rows]} if coloured.numeric else {"color": _texts(coloured, rows)}
        drawn = axes.scatter(x[rows], y[rows], marker=MARKERS[i % len(MARKERS)], **paint, **look)
        if i == 0 and "norm" in look and coloured is not None:
            bar = sheet.colour_bar(drawn, axes, coloured.title, pad=0.015, aspect=30)
            if isinstance(look["norm"], LogNorm) and len(coloured.unique) <= 10:
                bar.set_ticks(coloured.unique, labels=[f"{v:g}" for v in coloured.unique])
    grey: dict = {"linestyle": "none", "markersize": 6, "markeredgecolor": "white"}
    handles, titles = [], []
    if coloured is not None and not coloured.numeric:
        titles.append(coloured.title)
        firsts = [int(np.flatnonzero(coloured.values == v)[0]) for v in coloured.unique]
        for value, shade in zip(coloured.unique, _texts(coloured, np.array(firsts)), strict=True):
            handles.append(Line2D([], [], marker="o", **grey, color=shade, label=str(value)))
    if shaped is not None:
        titles += [shaped.title] if shaped.key != "controller" else []
        for mark, value in zip(MARKERS, marks, strict=False):
            handles.append(Line2D([], [], marker=mark, **grey, color="#666666", label=_short(shaped, value)))
    handles.append(Line2D([], [], color=style.BLACK, linewidth=1.0, label="front"))
    axes.legend(
        handles=handles,
        title=", ".join(titles) or None,
        loc="best" if len(x) <= MANY else "upper right",  # searching takes long among many points
        fontsize=8,
        title_fontsize=8,
        ncols=1 + (len(handles) > 6),
    )


def _short(axis: SweepAxis, value) -> str:
    return f"{value:g}" if axis.numeric else str(value)


def _texts(axis: SweepAxis, rows: np.ndarray) -> list[str]:
    colours = (style.BLUE, style.VERMILLION, style.GREEN, *style.SPARE_COLOURS)
    places = {value: i for i, value in enumerate(axis.unique)}
    return [colours[places[axis.values[row]] % len(colours)] for row in rows]
