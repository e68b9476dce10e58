"""`plot(thing)`: a quick look at a model, tuning, plan, run or study, for notebooks.

What is drawn is recognised by its type. The axes that come back show themselves as a PNG.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import closed_loop, panels, style
from figures.choose import is_comparison
from figures.sweep import wear
from jaxmpc.errors import InputError
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.problem.tuning import Tuning
from studies.kpi.evaluate import completed
from studies.store.reading import open_results


class Panels(np.ndarray):
    """Axes ``"row column"`` of one figure; the figure is what a notebook shows of them."""

    @property
    def figure(self) -> Figure:
        """That the axes belong to."""
        return np.asarray(self).flat[0].figure

    def _repr_png_(self) -> bytes:
        return style.png(self.figure, dpi=110)


@style.house_style
def plot(thing: Any, *, tuning: Tuning | None = None, structure: Any = None) -> Panels:
    """Draw something; numbers as they are, units where they are known.

    Args:
        thing: `StepResponseModel` (each step response), `Tuning` (cost of a deviation per CV), `Plan` (predicted CVs,
            planned MVs), `Trajectory`, or a study: the path of its store or what `open_study` or
            `open_results` gave (sweeps: travel of an MV against deviation).
        tuning: of a trajectory, for its deadzones.
        structure: of a tuning or a plan, for names and units.

    Returns:
        The axes, ``"row column"``.

    Raises:
        InputError: for anything else, or a tuning of many scenarios.
    """
    if isinstance(thing, Trajectory):
        return _trajectory(thing, tuning)
    if isinstance(thing, str | Path | xr.Dataset):
        return _study(thing)
    draw = _DRAW.get(type(thing).__name__)  # figures import nothing that predicts or solves
    if draw is None:
        expected = f"{', '.join(_DRAW)}, Trajectory, the path of a study store or an opened one"
        raise InputError("thing", type(thing).__name__, expected)
    return draw(thing, structure)


def _model(model: Any, _: Any) -> Panels:
    steps = np.asarray(model.coefficients)
    if steps.ndim != 3:
        raise InputError("model.coefficients", f"shape {list(steps.shape)}", "those of one model")
    axes = _axes(len(model.cv_names), len(model.mv_names), sharex=True)
    t = model.dt * np.arange(model.samples + 1)
    for (c, m), ax in np.ndenumerate(np.asarray(axes)):
        ax.axhline(0, color=style.BLACK, linewidth=0.6)
        ax.plot(t, np.append(0.0, steps[c, m]), color=style.BLUE)
        per = f"{_unit(model, 'cv', c, 'unit')} per {_unit(model, 'mv', m, 'unit')}"
        ax.set_ylabel(f"{_name(model, 'cv', c)} [{per}]")
        if c == 0:
            ax.set_title(f"unit step of {_name(model, 'mv', m)}")
    for ax in axes[-1]:
        ax.set_xlabel("time after the step [s]")
    return axes


def _tuning(tuning: Tuning, structure: Any) -> Panels:
    fields = ("cv_weight", "soft_quadratic", "soft_linear", "deadzone")
    values = [np.asarray(getattr(tuning, name)) for name in fields]
    if values[0].ndim != 1:
        raise InputError("tuning", f"shape {list(values[0].shape)}", "the tuning of one controller")
    axes = _axes(1, len(values[0]))
    for c, (ax, weight, square, linear, zone) in enumerate(zip(axes[0], *values, strict=True)):
        banded = square + linear > 0 and zone > 0
        e = np.linspace(-1.0, 1.0, 401) * (2.5 * zone if banded else 1.0)
        if banded:
            ax.axvspan(-zone, zone, color=style.BAND, linewidth=0, label=f"deadzone ±{zone:g}")
        ax.plot(e, weight * e**2, "--", color=style.BLACK, linewidth=1.0, label="without Soft MPC")
        ax.plot(e, cost(e, weight, square, linear, zone), color=style.BLUE, label="cost")
        ax.set_xlabel(f"deviation of the {_name(structure, 'cv', c)} [{_unit(structure, 'cv', c)}]")
        ax.set_ylabel("cost of one sample [1]")
        ax.legend(loc="upper center")
    return axes


def cost(
    deviation: np.ndarray, weight: float, quadratic: float, linear: float, deadzone: float
) -> np.ndarray:
    """What the deviation of one sample costs in (6.6): Q d^2 + S eta^2 + s eta with eta = max(|d| - c, 0)."""
    eta = np.maximum(np.abs(deviation) - deadzone, 0.0)
    return weight * deviation**2 + quadratic * eta**2 + linear * eta


def _plan(plan: Any, structure: Any) -> Panels:
    if plan.moves is None:
        raise InputError("plan", plan.status, "a plan with moves")
    cv, mv = np.asarray(plan.cv), np.asarray(plan.mv)
    axes = _axes(2, max(cv.shape[1], mv.shape[1]), sharex=True)
    dt = getattr(structure, "dt", None)
    for row, kind, values in ((axes[0], "cv", cv), (axes[1], "mv", np.vstack([mv, mv[-1:]]))):
        t = (np.arange(len(values)) + (kind == "cv")) * (dt or 1.0)
        for i, ax in enumerate(row[: values.shape[1]]):
            ax.plot(t, values[:, i], color=style.PLAN, drawstyle="steps-post" if kind == "mv" else "default")
            ax.set_ylabel(f"{_name(structure, kind, i)} [{_unit(structure, kind, i)}]")
            ax.set_xlabel("time from now [s]" if dt else "samples from now")
        for ax in row[values.shape[1] :]:
            ax.set_visible(False)
    return axes


def _trajectory(trajectory: Trajectory, tuning: Tuning | None) -> Panels:
    zones = np.zeros(len(trajectory.cv_names))
    if tuning is not None:
        soft = np.asarray(tuning.soft_quadratic) + np.asarray(tuning.soft_linear) > 0
        zones = np.where(soft, np.asarray(tuning.deadzone), 0.0)
    return _runs(closed_loop.of_trajectory(trajectory, zones, "continuous", "continuous"))


def _study(study: str | Path | xr.Dataset) -> Panels:
    comparison = "controller" in study.dims if isinstance(study, xr.Dataset) else is_comparison(study)
    if comparison:
        return _runs(completed(study if isinstance(study, xr.Dataset) else open_results(study)).load())
    axes = _axes(1, 1, width=7.6, height=5.0)
    wear.pareto(study, axes=axes[0, 0])
    return axes


def _runs(data: xr.Dataset) -> Panels:
    """CVs with setpoint, then MVs; several controllers each in its colour."""
    channels = [*panels.cv_names(data), *panels.mv_names(data)]
    axes = _axes(len(channels), 1, width=7.6, height=1.7, sharex=True)
    if data.sizes["controller"] == 1:
        closed_loop.tracking(axes[:, 0], data, str(data.controller.values[0]))
        return axes
    seconds = panels.time_axis(axes[-1, 0], *panels.span(data))
    labels = data.label if "label" in data.coords else data.controller
    curves = {
        name: {"label": label} for name, label in zip(data.controller.values, labels.values, strict=True)
    }
    for ax, channel in zip(axes[:, 0], channels, strict=True):
        panels.compared(ax, data, channel, curves, seconds)
    panels.legend_above(axes[0, 0])
    return axes


_DRAW: dict[str, Callable[[Any, Any], Panels]] = {
    "StepResponseModel": _model,
    "Tuning": _tuning,
    "Plan": _plan,
}


def _axes(rows: int, columns: int, width: float = 0.0, height: float = 2.4, **options: Any) -> Panels:
    """Empty panels; sizes in inches, of the figure and of a row."""
    width = width or max(4.0 * columns, 5.0)
    return style.grid(rows, columns, width, height * rows + 0.4, **options)[1].view(Panels)


def _unit(known: Any, kind: str, k: int, unknown: str = "") -> str:
    """Unit of a CV or MV of a model or structure."""
    units: Sequence[str] = getattr(known, f"{kind}_units", ())
    return style.unit(units[k]) if k < len(units) and units[k] else unknown or f"{kind.upper()} unit"


def _name(known: Any, kind: str, k: int) -> str:
    names = getattr(known, f"{kind}_names", ())
    return style.name_of(str(names[k])) if k < len(names) else f"{kind.upper()} {k + 1}"
