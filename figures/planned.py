"""A plan with its prediction, and what came of it: rows of panels that thesis figures and the app share.

The past is white and what lies ahead grey. Plans come from `studies.plans`, which rebuilds them from what is stored.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from figures import panels, style
from studies.plans import StoredPlan

BEFORE = 60  # samples of the past to show


def draw_plan(
    rows: np.ndarray,
    data: xr.Dataset,
    controller: str,
    plan: StoredPlan,
    shown: tuple[float, float],
    *,
    known: float,
    pale: bool = False,
    grey: bool = True,
    line: str = "-",
) -> None:
    """A plan with its prediction, and what happened.

    Args:
        rows: axes ``"row column"``: CVs, MVs, and in a third row, if there is one, the moves of the MVs.
        data: results of `controller` among others.
        controller: whose plan it is.
        plan: to draw.
        shown: start and end of the time axis [s].
        known: time until which what happened is drawn [s].
        pale: whether what happened later is drawn too, pale.
        grey: whether what lies after the plan is grey.
        line: of the plan.
    """
    whole, colour = panels.between(data, *shown), panels.run_colour(data, controller)
    # the CVs of the time `known` are measured, the moves are not made yet
    parts = [
        (panels.between(whole, 0.0, known), panels.between(whole, 0.0, known, closed=False), "actual", 1.0)
    ]
    if pale:
        parts.insert(0, (panels.between(whole, known), panels.between(whole, known), "_later", 0.4))
    seconds = panels.time_unit(*shown)[0]
    for ax in rows.flat:
        panels.time_axis(ax, *shown, bins=8)
        if ax not in rows[-1]:
            ax.set_xlabel("")
        panels.mark(ax, plan.time / seconds)
        if grey:
            ax.axvspan(plan.time / seconds, shown[1] / seconds, color=style.FUTURE, linewidth=0, zorder=0)
    look: dict[str, Any] = {"linestyle": line, "color": style.PLAN, "linewidth": 1.6, "label": "plan"}
    inside = plan.cv_time <= shown[1]
    for ax, cv in zip(rows[0], panels.cv_names(data), strict=False):
        panels.deadzone_lines(ax, whole, controller, cv, seconds)
        panels.setpoint(ax, whole, cv, seconds)
        ax.plot(plan.cv_time[inside] / seconds, plan.cv[inside, index_of(data.cv, cv)], **look)
        for seen, _, label, strength in parts:
            panels.measured(ax, seen, controller, cv, seconds, label=label, alpha=strength)
    t = np.append(plan.move_time, [plan.move_time[-1] + plan.dt, plan.cv_time[-1]]) / seconds
    for column, mv in zip(rows[1:].T, panels.mv_names(data), strict=False):
        i = index_of(data.mv, mv)
        kinds = (("position", "", plan.mv, plan.mv[-1, i]), ("move", " move", plan.move, 0.0))
        for ax, (name, words, values, after) in zip(column, kinds, strict=False):
            ax.step(t, np.append(values[:, i], [after, after]), where="post", **look)
            for _, made, label, strength in parts:
                if made.sizes["time"]:
                    done = made[name].sel(controller=controller, mv=mv)
                    panels.step(ax, made, done, seconds, color=colour, alpha=strength, label=label)
            ax.set_ylabel(panels.label_of(data, mv, words))


def index_of(names: xr.DataArray, name: str) -> int:
    """Position of a name in a coordinate."""
    return [str(known) for known in names.values].index(name)
