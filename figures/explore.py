"""Figures of the interactive app: one run beside a pinned one, the plan made at any time, the scenarios of a store.

Runs come as results of one controller (`studies.notebooks.loop.ExploreRun.data`, or `stored` for a scenario of a store). The
layout is fixed instead of computed, so that a figure is there a fraction of a second after its run.
"""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from figures import panels, style
from figures.facts import index_of
from figures.sweep.data import controller_of, deviation, figure_of, load, setting, sweep_axes
from figures.sweep.wear import front
from jaxmpc.errors import InputError
from studies.definition.presets import CHOKE, TUNINGS
from studies.kpi.evaluate import completed, key_figures
from studies.notebooks.loop import RUN
from studies.store.comparison import RESULTS, open_results
from studies.thesis.plans import StoredPlan, plan_at

BEFORE = 600.0  # s of the past beside a plan
MINUTE = 60.0
DPI = 150
PINNED = "#9A9A9A"
X, Y = "travel", "deviation"  # columns of `points`, [%] and [1]
TITLES = {X: "choke travel [%]", Y: "mean deviation / thesis deadzone [1]"}


def tracking(
    data: xr.Dataset, controller: str = RUN, pinned: xr.Dataset | None = None, wide: bool = False
) -> Figure:
    """CVs with setpoint and deadzone above, MVs below; a pinned run in grey behind.

    Args:
        data: results.
        controller: name of a run in them.
        pinned: results of one controller `RUN` to compare with; only times of `data` are drawn.
        wide: for the width of the page instead of two thirds of it.
    """
    cvs, mvs = panels.cv_names(data), [str(name) for name in data.mv.values]
    start, end = panels.span(data)
    with plt.rc_context(style.RC):
        figure, axes = _panels(2, max(len(cvs), len(mvs)), 9.6 if wide else 6.9, 4.2 if wide else 4.5)
        for ax, cv in zip(axes[0], cvs, strict=False):
            seconds = panels.time_axis(ax, start, end, bins=7)
            ax.set_xlabel("")
            _pinned(ax, pinned, "measurement", cv, seconds, end)
            panels.controlled(ax, data, controller, cv, seconds, legend=False)
        for ax, mv in zip(axes[1], mvs, strict=False):
            demand = mv == CHOKE and "demand" in data
            seconds = panels.time_axis(ax, start, end, bins=7)
            _pinned(ax, pinned, "position", mv, seconds, end)
            panels.manipulated(ax, data, controller, mv, seconds, demand=demand, legend=False)
        for ax in axes.flat:
            panels.changes(ax, data, seconds)
        _hide_unused(axes, (len(cvs), len(mvs)))
        _legend(figure, axes)
    return figure


def planned(data: xr.Dataset, time: float, controller: str = RUN) -> Figure:
    """The plan made at a time, as in figure 25: rates, inputs and moves; what came of it pale.

    Args:
        data: results with plans.
        time: of the plan [s].
        controller: name of a run in them.
    """
    plan = plan_at(data, controller, time)
    start, end = max(plan.time - BEFORE, 0.0), float(plan.cv_time[-1])
    past = data.isel(time=np.flatnonzero((data.time.values >= start) & (data.time.values <= plan.time)))
    later = data.isel(time=np.flatnonzero((data.time.values >= plan.time) & (data.time.values <= end)))
    colour = panels.run_colour(data, controller)
    with plt.rc_context(style.RC):
        figure, axes = _panels(3, 2, 9.6, 5.2)
        for ax in axes.flat:
            panels.time_axis(ax, start, end, bins=8)
            ax.set_xlabel("time [min]" if ax in axes[-1] else "")
            ax.set_xlim(start / MINUTE, end / MINUTE)
            ax.axvspan(plan.time / MINUTE, end / MINUTE, color=style.FUTURE, linewidth=0, zorder=0)
            panels.mark(ax, plan.time / MINUTE)
        shown = data.isel(time=np.flatnonzero((data.time.values >= start) & (data.time.values <= end)))
        for ax, cv in zip(axes[0], panels.cv_names(data), strict=False):
            panels.deadzone_lines(ax, shown, controller, cv, MINUTE)
            panels.setpoint(ax, shown, cv, MINUTE)
            ax.plot(later.time / MINUTE, _values(later, "measurement", cv), color=colour, alpha=0.4)
            panels.measured(ax, past, controller, cv, MINUTE, "actual")
            predicted = plan.cv[:, index_of(data.cv, cv)]
            ax.plot(plan.cv_time / MINUTE, predicted, color=style.PLAN, linewidth=1.6, label="plan")
        made = past.isel(time=slice(-1))  # the move of this time is part of the plan
        for ax, below, mv in zip(axes[1], axes[2], map(str, data.mv.values), strict=False):
            _moves(ax, below, plan, index_of(data.mv, mv))
            for panel, name in ((ax, "position"), (below, "move")):
                for part, strong in ((later, 0.4), (made, 1.0)):
                    if part.sizes["time"]:
                        t, values = _held(part, _values(part, name, mv))
                        label = "actual" if strong == 1.0 else None
                        panel.step(t, values, where="post", color=colour, alpha=strong, label=label)
            unit = style.unit(str(data.mv_unit.sel(mv=mv).item()))
            ax.set_ylabel(f"{style.NAMES.get(mv, mv)} [{unit}]")
            below.set_ylabel(f"{style.NAMES.get(mv, mv)} move [{unit}]")
        _legend(figure, axes)
    return figure


def points(store: str | Path) -> pd.DataFrame:
    """The runs of a study store, a row each, for `scatter`.

    Args:
        store: of a sweep (ending in ``.zarr``) or of a comparison (its folder or ``results.zarr``).

    Returns:
        A table with ``number`` (of the scenario; position of the controller in a comparison), ``run`` in words, `X` [%],
        `Y` [1], ``group`` for the colours (attribute ``group`` says what it is), ``best`` for runs that no other beats in
        both, and a text column for each thing that varies.

    Raises:
        InputError: if there is no store, or nothing of it is finished.
    """
    if is_comparison(store):
        data = completed(open_results(store))
        figures = key_figures(data)
        zones = np.array([TUNINGS["thesis"]["deadzone"][str(cv)] for cv in figures.cv.values])
        table = {
            "number": np.arange(data.sizes["controller"]),
            "run": [str(label) for label in data.label.values],
            X: figures.choke_travel.values.astype(float),
            Y: (figures.mean_absolute_deviation.values / zones).mean(axis=1),
            "group": [str(label) for label in data.label.values],
        }
        title = "controller"
    else:
        data = load(store)
        axes = sweep_axes(data)
        texts = {_plain(axis.label): [axis.text(v) for v in axis.values.tolist()] for axis in axes}
        names = [
            ", ".join(f"{name} {text[i]}" for name, text in texts.items())
            for i in range(data.sizes["scenario"])
        ]
        table = {
            "number": data.scenario.values,
            "run": names,
            X: figure_of(data, "choke_travel").values.astype(float),
            Y: deviation(data).values.astype(float),
            "group": next(iter(texts.values()), ["all"] * len(names)),
            **texts,
        }
        title = _plain(axes[0].title) if axes else ""
    table["best"] = np.where(front(table[X], table[Y]), "on the front", "beaten")
    out = pd.DataFrame(table)
    out.attrs["group"] = title
    return out


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
    missing = [name for name in ("measurement", "position", "setpoint") if name not in whole]
    if missing:
        raise InputError(
            "store.trajectories", missing, "stored cv, mv and setpoint", "Run the scenario again"
        )
    kinds, actuators = controller_of(whole)
    place = int(np.flatnonzero(whole.scenario.values == number)[0])
    one = whole[["measurement", "position", "setpoint"]].sel(scenario=number).load()
    last = np.flatnonzero(np.isfinite(one.measurement.values).all(axis=1))
    one = one.isel(time=slice(0, int(last[-1]) + 1 if last.size else 0))
    changed = np.any(np.diff(one.setpoint.values, axis=0) != 0, axis=1)
    zones = [_deadzone(whole, place, str(cv)) for cv in one.cv.values]
    soft = np.array([[1.0 if zone > 0 else 0.0 for zone in zones]])
    both = ("controller", "time")
    return xr.Dataset(
        {
            "measurement": ((*both, "cv"), one.measurement.values[None]),
            "position": ((*both, "mv"), one.position.values[None]),
            "setpoint": (("time", "cv"), one.setpoint.values),
            "window": ("time", np.concatenate([[0], np.cumsum(changed)])),
            "kind": ("controller", [str(kinds[place])]),
            "actuator": ("controller", [str(actuators[place])]),
            "tuning_deadzone": (("controller", "cv"), np.array([zones])),
            "tuning_soft_quadratic": (("controller", "cv"), soft),
            "tuning_soft_linear": (("controller", "cv"), soft),
        },
        {
            "controller": [RUN],
            **{name: one[name] for name in ("time", "cv", "mv", "cv_unit", "mv_unit")},
        },
        {"dt": float(np.diff(one.time.values[:2])[0]) if one.sizes["time"] > 1 else 1.0},
    )


def scatter(table: pd.DataFrame) -> Any:
    """The runs of `points` as an Altair chart to pick from; those on the front have a black ring."""
    import altair as alt

    varying = [str(name) for name in table.columns if name not in ("best", "group", "number", X, Y)]
    many = len(set(table["group"])) > len(_COLOURS)
    legend = alt.Legend(title=table.attrs.get("group"), titleLimit=400, orient="top")
    return (
        alt.Chart(table)
        .mark_point(filled=True, size=90, strokeWidth=1.6, opacity=0.9)
        .encode(
            x=alt.X(f"{X}:Q", title=TITLES[X], scale=alt.Scale(zero=False)),
            y=alt.Y(f"{Y}:Q", title=TITLES[Y], scale=alt.Scale(zero=False)),
            color=alt.value(style.BLUE)
            if many
            else alt.Color("group:N", scale=alt.Scale(range=_COLOURS), sort=None, legend=legend),
            stroke=alt.condition("datum.best == 'on the front'", alt.value("black"), alt.value("white")),
            tooltip=[*varying, *(alt.Tooltip(f"{k}:Q", title=TITLES[k], format=",.4g") for k in (X, Y))],
        )
        .properties(width="container", height=300, usermeta={"embedOptions": {"renderer": "svg"}})
    )


_COLOURS = [style.BLUE, style.VERMILLION, style.GREEN, style.ORANGE, style.PURPLE, style.SKY]
_COLOURS += ["#8C6D31", "#7F7F7F", "#A6761D", "#393B79"]


def png(figure: Figure) -> bytes:
    """A figure as PNG."""
    buffer = io.BytesIO()
    with plt.rc_context(style.RC):
        figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


def image(figure: Figure, name: str) -> str:
    """A figure as HTML that needs no further file.

    Args:
        figure: to show.
        name: what it shows, for screen readers.
    """
    content = base64.b64encode(png(figure)).decode()
    return f'<img alt="{html.escape(name)}" style="width:100%" src="data:image/png;base64,{content}">'


def _panels(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """A figure with a fixed layout, unknown to pyplot; axes ``"row column"``."""
    with plt.rc_context({"figure.constrained_layout.use": False}):
        figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    figure.subplots_adjust(
        left=0.78 / width,
        right=1 - 0.12 / width,
        bottom=0.5 / height,
        top=1 - 0.34 / height,
        wspace=0.3 if width < 8 else 0.2,
        hspace=0.12,
    )
    for ax in axes[:-1].flat:
        ax.tick_params(labelbottom=False)
    return figure, axes


def _pinned(ax: Axes, pinned: xr.Dataset | None, name: str, channel: str, seconds: float, end: float) -> None:
    if pinned is not None:
        inside = pinned.isel(time=np.flatnonzero(pinned.time.values < end))
        t, values = _held(inside, _values(inside, name, channel), seconds)
        look = {"color": PINNED, "linewidth": 1.8, "label": "pinned", "zorder": 1.5}
        ax.step(t, values, where="post", **look) if name == "position" else ax.plot(t, values, **look)


def _moves(ax: Axes, below: Axes, plan: StoredPlan, mv: int) -> None:
    """Planned values and moves of an MV, held to the end of the prediction horizon."""
    end = plan.cv_time[-1]
    t = np.append(plan.move_time, end) / MINUTE
    look = {"where": "post", "color": style.PLAN, "linewidth": 1.6}
    ax.step(t, np.append(plan.mv[:, mv], plan.mv[-1, mv]), **look, label="plan")
    t = np.append(plan.move_time, [plan.move_time[-1] + plan.dt, end]) / MINUTE
    below.step(t, np.append(plan.move[:, mv], [0.0, 0.0]), **look)


def _values(data: xr.Dataset, name: str, channel: str) -> np.ndarray:
    variable = data[name]
    return variable.isel(controller=0).sel({str(variable.dims[-1]): channel}).values


def _held(data: xr.Dataset, values: np.ndarray, seconds: float = MINUTE) -> tuple[np.ndarray, np.ndarray]:
    return np.append(data.time.values, panels.span(data)[1]) / seconds, np.append(values, values[-1])


def _hide_unused(axes: np.ndarray, used: tuple[int, ...]) -> None:
    for row, count in zip(axes, used, strict=True):
        for ax in row[count:]:
            ax.set_visible(False)


def _legend(figure: Figure, axes: np.ndarray) -> None:
    """One legend for all panels on top; the deadzone, which differs from CV to CV, without its width."""
    found: dict[str, Any] = {}
    for ax in axes.flat:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault("deadzone" if label.startswith("deadzone") else label, handle)
    if "demanded and actual" in found:  # of the MVs without a demand of their own
        found.pop("actual", None)
    figure.legend(list(found.values()), list(found), loc="upper center", ncols=len(found), borderaxespad=0.2)


def _deadzone(data: xr.Dataset, place: int, cv: str) -> float:
    """Half width of the deadzone of a scenario; 0 without Soft MPC."""

    def of(key: str) -> Any:
        return data[key].values[place] if key in data.coords else setting(data, key)

    hard = of("soft") in (False, "false") or str(of("preset")).startswith("no-soft")
    return 0.0 if hard else float(of(f"tuning.deadzone.{cv}"))


def _plain(name: str) -> str:
    """A column name without what the chart language reads as structure."""
    return name.replace(".", " ").replace("[", "(").replace("]", ")").replace(":", " ")
