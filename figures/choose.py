"""The runs of a store to choose from in the interactive app: the plane of travel and deviation, and what decides both.

`points` reads a store as one table. `scatter` shows its plane, `parallel` every axis beside the two to drag ranges on, which
`within` applies, and `importance` what the axes explain of the two.
"""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from figures import closed_loop, style
from figures.closed_loop import RUN
from figures.explore import COLOURS, Spec, coded, described
from figures.sweep.data import (
    SETTLED,
    SweepAxis,
    controller_of,
    deviation,
    figure_of,
    load,
    setting,
    shown_mv,
    sweep_axes,
    travel_title,
)
from figures.sweep.wear import front
from jaxmpc.errors import InputError
from studies.kpi.evaluate import completed, key_figures
from studies.store.files import RESULTS
from studies.store.process import process_in
from studies.store.reading import open_results

X, Y = "travel", "deviation"  # columns of `Runs.table`, [MV unit] and [1]
BRUSH = "brush"  # name of the selection of `parallel`
GROUPS = 6  # of an axis with more numbers


@dataclasses.dataclass(frozen=True, eq=False)
class Runs:
    """The runs of a store.

    Attributes:
        table: a row each: ``number`` (of the scenario; position of the controller in a comparison), ``run`` in words, `X` of
            `figures.sweep.data.shown_mv`, `Y` [1], ``group`` for the colours, ``best`` for runs that no other beats in
            both, and a text column for each thing that varies.
        axes: what varies, columns of the table by name.
        group: what the groups are.
        titles: of `X` and `Y`.
    """

    table: pd.DataFrame
    axes: dict[str, SweepAxis]
    group: str
    titles: dict[str, str]


def points(store: str | Path) -> Runs:
    """The runs of a study store.

    Args:
        store: of a sweep (ending in ``.zarr``) or of a comparison (its folder or ``results.zarr``).

    Raises:
        InputError: if there is no store, or nothing of it is finished.
    """
    axes: dict[str, SweepAxis] = {}
    if is_comparison(store):
        data = completed(open_results(store))
        figures = key_figures(data).load().assign_attrs(data.attrs)  # which process they are of
        title, numbers, names = "controller", np.arange(data.sizes["controller"]), data.label.values.tolist()
        groups = names
    else:
        data = figures = load(store)
        axes = {_plain(axis.label): axis for axis in sweep_axes(data)}
        texts = [[axis.text(v) for v in axis.values.tolist()] for axis in axes.values()]
        title, numbers = next((_plain(axis.title) for axis in axes.values()), ""), data.scenario.values
        rows = zip(*texts, strict=True) if texts else [()] * len(numbers)
        names = [", ".join(map(" ".join, zip(axes, row, strict=True))) for row in rows]
        groups = texts[0] if texts else ["all"] * len(names)
    travel, away = (
        values.values.astype(float) for values in (figure_of(figures, "travel"), deviation(figures))
    )
    columns = {"number": numbers, "run": names, X: travel, Y: away, "group": groups}
    columns |= {name: [axis.text(v) for v in axis.values.tolist()] for name, axis in axes.items()}
    columns["best"] = np.where(front(travel, away), "on the front", "beaten")
    titles = {X: travel_title(shown_mv(process_in(data))), Y: f"mean deviation / {SETTLED} [1]"}
    return Runs(pd.DataFrame(columns), axes, title, titles)


def is_comparison(store: str | Path) -> bool:
    """Whether a store is that of a comparison of controllers rather than of a sweep."""
    path = Path(store)
    return path.name == RESULTS or (path / RESULTS).is_dir()


def stored(store: str | Path, number: int) -> xr.Dataset:
    """The stored run of a row of `points`, as `tracking` reads it: one controller `RUN`.

    Raises:
        InputError: for a store without trajectories, or a number that is not in it.
    """
    if is_comparison(store):
        data = completed(open_results(store))
        if not 0 <= number < data.sizes["controller"]:
            raise InputError("number", number, f"0 to {data.sizes['controller'] - 1}")
        return data.isel(controller=[number]).assign_coords(controller=[RUN]).load()
    whole = load(store)
    if number not in whole.scenario.values:
        raise InputError("number", number, "a finished scenario of the store")
    stored_as = ["measurement", "position", "setpoint"]
    missing = [name for name in stored_as if name not in whole]
    if missing:
        expected = "stored cv, mv and setpoint"
        raise InputError("store.trajectories", missing, expected, "Run the scenario again")
    kinds, actuators = controller_of(whole)
    place = int(np.flatnonzero(whole.scenario.values == number)[0])
    one = whole[stored_as].sel(scenario=number).load()
    one = one.drop_vars([str(name) for name, coord in one.coords.items() if coord.ndim == 0])
    last = np.flatnonzero(np.isfinite(one.measurement.values).all(axis=1))
    one = one.isel(time=slice(0, int(last[-1]) + 1 if last.size else 0))
    dt = float(np.diff(one.time.values[:2])[0]) if one.sizes["time"] > 1 else 1.0
    zones = [_deadzone(whole, place, str(cv)) for cv in one.cv.values]
    return closed_loop.results(one, dt, zones, str(kinds[place]), str(actuators[place]), process_in(whole))


def scatter(runs: Runs, kept: np.ndarray | None = None) -> Any:
    """The plane of `X` and `Y` as an Altair chart to pick from; those on the front have a black ring.

    Args:
        kept: ``"run"``, those that are not pale; all if not given.
    """
    import altair as alt

    table = runs.table.assign(kept=1 if kept is None else kept.astype(int))
    many = len(set(table["group"])) > len(COLOURS)
    legend = alt.Legend(title=runs.group, titleLimit=400, orient="top")
    scale, titles = alt.Scale(range=COLOURS), runs.titles
    colour = alt.value(style.BLUE) if many else alt.Color("group:N", scale=scale, sort=None, legend=legend)
    kept_or = lambda *values: alt.condition("datum.kept == 1", *map(alt.value, values))  # noqa: E731
    return (
        alt.Chart(table)
        .mark_point(filled=True, size=90, strokeWidth=1.6)
        .encode(
            x=alt.X(f"{X}:Q", title=titles[X], scale=alt.Scale(zero=False)),
            y=alt.Y(f"{Y}:Q", title=titles[Y], scale=alt.Scale(zero=False)),
            color=colour,
            fillOpacity=kept_or(0.9, 0.12),  # opacity itself is for what is picked
            strokeOpacity=kept_or(1.0, 0.12),
            stroke=alt.condition("datum.best == 'on the front'", alt.value("black"), alt.value("white")),
            tooltip=[
                *("run", *runs.axes),
                *(alt.Tooltip(f"{k}:Q", title=titles[k], format=",.4g") for k in (X, Y)),
            ],
        )
        .properties(width="container", height=300, usermeta={"embedOptions": {"renderer": "svg"}})
    )


def parallel(runs: Runs, kept: np.ndarray, width: int = 820, height: int = 220) -> Spec:
    """A line per run across its axes, `X` and `Y`, to drag ranges on; the selection is called `BRUSH`.

    Args:
        kept: ``"run"``, those that are not pale.
    """
    scales, names = _scales(runs), runs.table["run"]
    numbers = {"n": runs.table["number"], "kept": kept}
    table = pd.concat(
        pd.DataFrame({"axis": name, "position": scale.positions, "run": names, **numbers})
        for name, scale in scales.items()
    )
    table["best"] = np.tile(runs.table["best"] == "on the front", len(scales))
    ends = [
        {"axis": name, "position": place, "text": text}
        for name, scale in scales.items()
        for place, text in zip((0.0, 1.0), scale.ends, strict=True)
    ]
    wrapped = ", ".join(f"{textwrap.wrap(name, 18)!r}" for name in scales)
    labels = {"title": None, "labelAngle": 0, "labelExpr": f"[{wrapped}][indexof(domain('x'), datum.value)]"}
    labels |= {"orient": "bottom", "grid": True, "gridColor": "#999999"}
    x = coded("axis", "nominal", sort=list(scales), scale={"type": "point", "padding": 0.4}, axis=labels)
    y = coded("position", "quantitative", axis=None, scale={"domain": [-0.1, 1.1]})
    best = {"test": "datum.kept && datum.best", "value": style.VERMILLION}
    strong = {"test": "datum.kept", "value": 0.75 if kept.sum() < 200 else 0.3}
    shades = {
        "color": {"condition": best, "value": style.BLUE},
        "opacity": {"condition": strong, "value": 0.06},
    }
    lines = {
        "data": {"values": table.to_dict("records")},
        "params": [{"name": BRUSH, "select": {"type": "interval", "encodings": ["x", "y"]}}],
        "mark": {"type": "line", "strokeWidth": 1.2},
        "encoding": {"x": x, "y": y, "detail": {"field": "n"}, **shades, "tooltip": coded("run", "nominal")},
    }
    offset = {"yOffset": {"expr": "datum.position > 0 ? -8 : 9"}}
    words = {
        "data": {"values": ends},
        "mark": {"type": "text", "fontSize": 10, "color": "#444444", **offset},
        "encoding": {"x": x, "y": y, "text": {"field": "text"}},
    }
    renderer = "svg" if len(runs.table) < 500 else "canvas"
    return described(renderer, width=width, height=height, layer=[lines, words])


@dataclasses.dataclass(frozen=True)
class Condition:
    """A range on an axis of `parallel`, as positions between its ends."""

    axis: str
    low: float
    high: float


def conditions(selected: Any) -> list[Condition]:
    """What was dragged on `parallel`, as the browser tells it: a range on one axis or on several beside each other."""
    selected = selected or {}
    axes, ends = selected.get("axis") or [], selected.get("position") or []
    return [Condition(str(axis), min(ends), max(ends)) for axis in axes] if len(ends) == 2 else []


def within(runs: Runs, given: Iterable[Condition]) -> np.ndarray:
    """Which runs are within all ranges, ``"run"``."""
    scales, kept = _scales(runs), np.ones(len(runs.table), dtype=bool)
    for one in given:
        if one.axis in scales:
            kept &= (scales[one.axis].positions >= one.low) & (scales[one.axis].positions <= one.high)
    return kept


def in_words(runs: Runs, one: Condition) -> str:
    """A range as its axis says it."""
    positions, texts = _scales(runs)[one.axis].positions, _scales(runs)[one.axis].texts
    inside = np.flatnonzero((positions >= one.low) & (positions <= one.high))
    if not len(inside):
        return f"{one.axis}: none"
    ends = [texts[inside[k]] for k in (np.argmin(positions[inside]), np.argmax(positions[inside]))]
    return f"{one.axis}: {' to '.join(dict.fromkeys(ends))}"


def importance(runs: Runs) -> pd.DataFrame:
    """What each axis alone explains of `X` and of `Y`: columns ``axis``, ``figure``, ``share`` [1].

    The share of the variance between the means over the values of the axis, corrected for what as many random groups would
    explain (epsilon squared, of one-way analysis of variance); 0 at least. Numbers with many values are taken in six groups
    of equal size. What axes do together is not in it.
    """
    rows = []
    for name, axis in runs.axes.items():
        values = axis.values
        if axis.numeric and len(axis.unique) > GROUPS:
            edges = np.quantile(values.astype(float), np.linspace(0, 1, GROUPS + 1)[1:-1])
            values = np.searchsorted(edges, values.astype(float), side="right")
        for figure in (X, Y):
            rows.append(
                {
                    "axis": name,
                    "figure": runs.titles[figure],
                    "share": _explained(runs.table[figure].to_numpy(dtype=float), values),
                }
            )
    return pd.DataFrame(rows, columns=["axis", "figure", "share"])


def importance_chart(runs: Runs, width: int = 300) -> Spec:
    """`importance` as bars."""
    bar = {"axis": {"format": "%", "tickCount": 5}, "scale": {"domain": [0, 1]}}
    scale = {"domain": list(runs.titles.values()), "range": [style.BLUE, style.ORANGE]}
    legend = {"orient": "top", "title": None, "labelLimit": 300}
    encoding = {
        "x": coded("share", "quantitative", **bar, title="share of the variance"),
        "y": coded("axis", "nominal", sort=list(runs.axes), title=None, axis={"labelLimit": 240}),
        "yOffset": {"field": "figure", "sort": scale["domain"]},
        "color": coded("figure", "nominal", scale=scale, legend=legend),
    }
    return described(
        width=width,
        height={"step": 12},
        title="What each axis alone decides",
        data={"values": importance(runs).to_dict("records")},
        mark={"type": "bar"},
        encoding=encoding,
    )


def _explained(y: np.ndarray, groups: np.ndarray) -> float:
    """Epsilon squared; not a number where there is nothing to explain."""
    there = np.isfinite(y)
    y, groups = y[there], np.asarray(groups)[there]
    total, names = np.sum((y - y.mean()) ** 2) if len(y) else 0.0, set(groups.tolist())
    if total == 0 or len(y) <= len(names):
        return float("nan") if total == 0 else 1.0
    means = {name: y[groups == name].mean() for name in names}
    left = np.sum((y - np.array([means[name] for name in groups.tolist()])) ** 2)
    return float(max(0.0, 1 - (left / (len(y) - len(names))) / (total / (len(y) - 1))))


@dataclasses.dataclass(frozen=True, eq=False)
class _Scale:
    """Where the runs are on an axis of `parallel`, from 0 to 1, and what is written there."""

    positions: np.ndarray
    texts: list[str]
    ends: tuple[str, str]


def _scales(runs: Runs) -> dict[str, _Scale]:
    out = {}
    for name, axis in runs.axes.items():
        unique = axis.unique
        if axis.numeric and axis.scale != "equal":
            values = axis.values.astype(float)
            values = np.log(values) if axis.scale == "log" else values
        else:
            order = {value: k for k, value in enumerate(unique)}
            values = np.array([float(order[value]) for value in axis.values.tolist()])
        ends = axis.text(unique[0]), axis.text(unique[-1])
        out[name] = _Scale(_unit(values), [axis.text(v) for v in axis.values.tolist()], ends)
    for column, title in runs.titles.items():
        values = runs.table[column].to_numpy(dtype=float)
        low, high = np.nanmin(values), np.nanmax(values)
        out[title] = _Scale(_unit(values), [f"{v:.4g}" for v in values], (f"{low:.4g}", f"{high:.4g}"))
    return out


def _unit(values: np.ndarray) -> np.ndarray:
    """Values between their least and largest as 0 to 1; in the middle where all are equal."""
    low, high = np.nanmin(values), np.nanmax(values)
    return (values - low) / (high - low) if high > low else np.full(len(values), 0.5)


def _deadzone(data: xr.Dataset, place: int, cv: str) -> float:
    """Half width of the deadzone of a scenario; 0 without Soft MPC."""
    one = data.isel(scenario=[place])  # an axis of one value is a setting
    soft = sum(float(setting(one, f"tuning.{key}.{cv}")) for key in ("soft_quadratic", "soft_linear"))
    hard = setting(one, "soft") in (False, "false") or soft == 0
    return 0.0 if hard else float(setting(one, f"tuning.deadzone.{cv}"))


def _plain(name: str) -> str:
    """A column name without what the chart language reads as structure."""
    return name.replace(".", " ").replace("[", "(").replace("]", ")").replace(":", " ")
