"""Thesis figures 25, 26 (a plan, and what came of it) and 36 to 38 (prediction against response in an oscillation).

The past is white and what lies ahead grey. Plans come from `studies.thesis.plans`, which rebuilds them from what is stored.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.facts import index_of
from jaxmpc.errors import InputError
from studies.kpi import loop as kpi
from studies.kpi.evaluate import NEAR_CLOSED
from studies.thesis.plans import StoredPlan, plan_at

BEFORE = 600.0  # s of the past to show
MINUTE = 60.0
SWING = (300.0, 600.0)  # s, at least, to show before and after the moves of an oscillation


@contextlib.contextmanager
def planned(data: xr.Dataset, controller: str) -> Iterator[Figure]:
    """Figure 25: the plan made when the setpoints first change: rates, inputs and moves over the horizon.

    Args:
        data: results of the study ``predictions``.
        controller: name of a run whose plans are stored.
    """
    at = first_change(data)
    plan = plan_at(data, controller, at)
    with _six_panels(data, controller, at, plan) as (drawn, rows):
        past = _between(data, at - BEFORE, at)  # the CV of that time is known, the move is not made yet
        for ax in rows.flat:
            ax.axvspan(at / MINUTE, ax.get_xlim()[1], color=style.FUTURE, linewidth=0, zorder=0)
            panels.mark(ax, at / MINUTE)
        _evolution(rows, past, past.isel(time=slice(-1)), controller)
        _plan(rows, data, plan, "-")
        _legend(drawn, rows)
        yield drawn


@contextlib.contextmanager
def evolved(data: xr.Dataset, controller: str) -> Iterator[Figure]:
    """Figure 26: what the controller did after that change, and the first plan beside it; arguments of `planned`."""
    at = first_change(data)
    plan = plan_at(data, controller, at)
    with _six_panels(data, controller, at, plan) as (drawn, rows):
        whole = _between(data, at - BEFORE, at + _horizon(plan))
        for ax in rows.flat:
            panels.mark(ax, at / MINUTE)
        _plan(rows, data, plan, "--")
        _evolution(rows, whole, whole, controller)
        _legend(drawn, rows)
        yield drawn


@contextlib.contextmanager
def swing(data: xr.Dataset, controller: str, which: int) -> Iterator[Figure]:
    """Figures 36, 37, 38: what a move of an oscillation was to bring, and what it brought.

    Args:
        data: results of the study ``without-soft``.
        controller: name of a run that oscillates.
        which: 0, 1 or 2: the first, second or third move.
    """
    moves = swing_moves(data, controller)
    at = float(moves[which])
    plan = plan_at(data, controller, at)
    length = moves[2] - moves[0]
    start = max(moves[0] - max(SWING[0], length / 2), panels.span(data)[0])
    end = min(moves[2] + max(SWING[1], length), panels.span(data)[1])
    shown = _between(data, start, end)
    with style.grid(2, 2, sharex=True) as (drawn, rows):
        for ax in rows.flat:
            ax.axvspan(at / MINUTE, end / MINUTE, color=style.FUTURE, linewidth=0, zorder=0)
            panels.mark(ax, at / MINUTE)
        for ax, cv in zip(rows[0], panels.cv_names(data), strict=True):
            panels.deadzone_lines(ax, shown, controller, cv, MINUTE)
            values = plan.cv[:, index_of(data.cv, cv)]
            inside = plan.cv_time <= end
            t = plan.cv_time[inside] / MINUTE
            ax.plot(t, values[inside], color=style.PLAN, linewidth=1.8, label="plan")
            panels.measured(ax, shown, controller, cv, MINUTE, "actual")
            panels.setpoint(ax, shown, cv, MINUTE)
        for ax, mv in zip(rows[1], ("choke", "gas_lift"), strict=True):
            t, values = _held_plan(data, plan, mv)
            ax.step(t / MINUTE, values, where="post", color=style.PLAN, linewidth=1.8, label="plan")
            panels.manipulated(ax, shown, controller, mv, MINUTE, legend=False)
            panels.time_axis(ax, start, end, bins=8)
        word = ("first", "second", "third")[which]
        size = f"{plan.move[0, index_of(data.mv, 'choke')]:+g}".replace("-", "−")
        _legend(drawn, rows, f"{word} turn: choke {size} % at {at:,.0f} s")
        yield drawn


def swing_moves(data: xr.Dataset, controller: str) -> tuple[float, float, float]:
    """Times [s] of three successive moves that turn the choke back, the quickest three of the busiest window.

    The window is the one in which the choke turns back most often, below half open if it does so there.

    Raises:
        InputError: if the choke turns back fewer than three times in every window.
    """
    position = data.position.sel(controller=controller, mv="choke").values
    window = data.window.values
    turn = np.asarray(kpi.reversal_events(np.diff(position, prepend=position[:1]), segment=window))
    near = turn & (position < NEAR_CLOSED)
    turn = near if np.bincount(window, weights=near).max() >= 3 else turn
    at = np.flatnonzero(turn & (window == np.bincount(window, weights=turn).argmax()))
    if len(at) < 3:
        raise InputError("controller", controller, "a run whose choke turns back three times at one setpoint")
    first = int(np.argmin(at[2:] - at[:-2]))
    one, two, three = data.time.values[at[first : first + 3]].tolist()
    return one, two, three


def first_change(data: xr.Dataset) -> float:
    """When the setpoints change for the first time [s]."""
    return float(data.time.values[int(np.flatnonzero(data.window.values > 0)[0])])


def _between(data: xr.Dataset, start: float, end: float) -> xr.Dataset:
    inside = np.flatnonzero((data.time.values >= start) & (data.time.values <= end))
    return data.isel(time=inside)


def _horizon(plan: StoredPlan) -> float:
    return len(plan.cv) * plan.dt


def _held_plan(data: xr.Dataset, plan: StoredPlan, mv: str) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and planned values of an MV, held to the end of the prediction horizon."""
    return (
        np.append(plan.move_time, plan.cv_time[-1]),
        np.append(plan.mv[:, index_of(data.mv, mv)], plan.mv[-1, index_of(data.mv, mv)]),
    )


def _plan(rows: np.ndarray, data: xr.Dataset, plan: StoredPlan, line: str) -> None:
    for ax, cv in zip(rows[0], panels.cv_names(data), strict=True):
        values = plan.cv[:, index_of(data.cv, cv)]
        ax.plot(plan.cv_time / MINUTE, values, line, color=style.PLAN, linewidth=1.6, label="plan")
    for ax, below, mv in zip(rows[1], rows[2], ("choke", "gas_lift"), strict=True):
        t, values = _held_plan(data, plan, mv)
        ax.step(t / MINUTE, values, line, where="post", color=style.PLAN, linewidth=1.6, label="plan")
        moves = np.append(plan.move[:, index_of(data.mv, mv)], [0.0, 0.0])
        t = np.append(plan.move_time, [plan.move_time[-1] + plan.dt, plan.cv_time[-1]])
        below.step(t / MINUTE, moves, line, where="post", color=style.PLAN, linewidth=1.6)


def _evolution(rows: np.ndarray, measured: xr.Dataset, moved: xr.Dataset, controller: str) -> None:
    """CVs of the one, MVs and moves of the other stretch of time."""
    colour = panels.run_colour(measured, controller)
    for ax, cv in zip(rows[0], panels.cv_names(measured), strict=True):
        panels.measured(ax, measured, controller, cv, MINUTE, "actual")
    for ax, below, mv in zip(rows[1], rows[2], ("choke", "gas_lift"), strict=True):
        panels.manipulated(ax, moved, controller, mv, MINUTE, legend=False)
        move = moved.move.sel(controller=controller, mv=mv).values
        t = np.append(moved.time.values, panels.span(moved)[1])
        below.step(t / MINUTE, np.append(move, move[-1]), where="post", color=colour)


@contextlib.contextmanager
def _six_panels(
    data: xr.Dataset, controller: str, at: float, plan: StoredPlan
) -> Iterator[tuple[Figure, np.ndarray]]:
    """Rates, inputs and moves, oil and choke on the left; setpoints and deadzones drawn."""
    start, end = max(at - BEFORE, float(data.time.values[0])), at + _horizon(plan)
    end = min(end, panels.span(data)[1])
    shown = _between(data, start, end)
    with style.grid(3, 2) as (drawn, rows):
        for ax, cv in zip(rows[0], panels.cv_names(data), strict=True):
            panels.deadzone_lines(ax, shown, controller, cv, MINUTE)
            panels.setpoint(ax, shown, cv, MINUTE)
        for ax, mv in zip(rows[2], ("choke", "gas_lift"), strict=True):
            unit = style.unit(str(data.mv_unit.sel(mv=mv).item()))
            ax.set_ylabel(f"{style.NAMES[mv]} move [{unit}]")
            panels.time_axis(ax, start, end, bins=8)
        for ax, mv in zip(rows[1], ("choke", "gas_lift"), strict=True):
            ax.set_ylabel(style.label(mv, str(data.mv_unit.sel(mv=mv).item())))
        yield drawn, rows


def _legend(drawn: Figure, rows: np.ndarray, title: str | None = None) -> None:
    """One legend for all panels, on top of the figure."""
    found = {}
    for ax in rows.flat:
        found |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    # the deadzone differs from CV to CV: said without its width
    zones = [label for label in found if label.startswith("deadzone")]
    shown = {label: found[label] for label in found if label not in zones}
    if zones:
        shown["deadzone"] = found[zones[0]]
    drawn.legend(list(shown.values()), list(shown), loc="outside upper center", ncols=len(shown), title=title)
