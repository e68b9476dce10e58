"""The runs of a store to choose from in the interactive app: the plane of wear and deviation, and what decides both.

The charts are descriptions that the browser draws, as those of `figures.explore`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from figures import closed_loop, style
from figures.closed_loop import RUN
from figures.explore import COLOURS
from figures.sweep.data import (
    SETTLED,
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

X, Y = "travel", "deviation"  # columns of `points`, [MV unit] and [1]


def points(store: str | Path) -> pd.DataFrame:
    """The runs of a study store, a row each, for `scatter`.

    Args:
        store: of a sweep (ending in ``.zarr``) or of a comparison (its folder or ``results.zarr``).

    Returns:
        A table with ``number`` (of the scenario; position of the controller in a comparison), ``run`` in words, `X` of
        `figures.sweep.data.shown_mv`, `Y` [1], ``group`` for the colours, ``best`` for runs that no other beats in both, and
        a text column for each thing that varies. Attribute ``group`` says what the groups are, ``titles`` what `X` and `Y`.

    Raises:
        InputError: if there is no store, or nothing of it is finished.
    """
    if is_comparison(store):
        data = completed(open_results(store))
        figures = key_figures(data).load()
        texts = {}
        title, numbers, names = "controller", np.arange(data.sizes["controller"]), data.label.values.tolist()
        groups = names
    else:
        data = figures = load(store)
        axes = sweep_axes(data)
        texts = {_plain(axis.label): [axis.text(v) for v in axis.values.tolist()] for axis in axes}
        title, numbers = _plain(axes[0].title) if axes else "", data.scenario.values
        rows = zip(*texts.values(), strict=True) if texts else [()] * len(numbers)
        names = [", ".join(map(" ".join, zip(texts, row, strict=True))) for row in rows]
        groups = next(iter(texts.values()), ["all"] * len(names))
    travel, away = (
        values.values.astype(float) for values in (figure_of(figures, "travel"), deviation(figures))
    )
    best = np.where(front(travel, away), "on the front", "beaten")
    out = pd.DataFrame(
        {"number": numbers, "run": names, X: travel, Y: away, "group": groups, **texts, "best": best}
    )
    out.attrs["group"] = title
    out.attrs["titles"] = {X: travel_title(shown_mv(process_in(data))), Y: f"mean deviation / {SETTLED} [1]"}
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


def scatter(table: pd.DataFrame) -> Any:
    """The runs of `points` as an Altair chart to pick from; those on the front have a black ring."""
    import altair as alt

    varying = [str(name) for name in table.columns if name not in ("best", "group", "number", X, Y)]
    many = len(set(table["group"])) > len(COLOURS)
    legend = alt.Legend(title=table.attrs.get("group"), titleLimit=400, orient="top")
    scale, titles = alt.Scale(range=COLOURS), table.attrs.get("titles", {X: X, Y: Y})
    colour = alt.value(style.BLUE) if many else alt.Color("group:N", scale=scale, sort=None, legend=legend)
    return (
        alt.Chart(table)
        .mark_point(filled=True, size=90, strokeWidth=1.6, opacity=0.9)
        .encode(
            x=alt.X(f"{X}:Q", title=titles[X], scale=alt.Scale(zero=False)),
            y=alt.Y(f"{Y}:Q", title=titles[Y], scale=alt.Scale(zero=False)),
            color=colour,
            stroke=alt.condition("datum.best == 'on the front'", alt.value("black"), alt.value("white")),
            tooltip=[*varying, *(alt.Tooltip(f"{k}:Q", title=titles[k], format=",.4g") for k in (X, Y))],
        )
        .properties(width="container", height=300, usermeta={"embedOptions": {"renderer": "svg"}})
    )


def _deadzone(data: xr.Dataset, place: int, cv: str) -> float:
    """Half width of the deadzone of a scenario; 0 without Soft MPC."""
    one = data.isel(scenario=[place])  # an axis of one value is a setting
    soft = sum(float(setting(one, f"tuning.{key}.{cv}")) for key in ("soft_quadratic", "soft_linear"))
    hard = setting(one, "soft") in (False, "false") or soft == 0
    return 0.0 if hard else float(setting(one, f"tuning.deadzone.{cv}"))


def _plain(name: str) -> str:
    """A column name without what the chart language reads as structure."""
    return name.replace(".", " ").replace("[", "(").replace("]", ")").replace(":", " ")
