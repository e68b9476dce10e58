"""`plot(thing)` and `pareto(study)`: a quick look at a model, tuning, plan, run or study, for notebooks.

What is drawn is recognised by its type. The axes that come back show themselves as a PNG.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from figures import panels, style
from figures.explore import is_comparison
from figures.sweep import wear
from figures.sweep.data import load
from figures.sweep.draw import run_results
from jaxmpc.errors import InputError
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.problem.tuning import Tuning
from studies.kpi.evaluate import completed
from studies.store.comparison import open_results


class Panels(np.ndarray):
    """Axes ``"row column"`` of one figure; the figure is what a notebook shows of them."""

    @property
    def figure(self) -> Figure:
        """That the axes belong to."""
        return np.asarray(self).flat[0].figure

    def _repr_png_(self) -> bytes:
        return _png(self.figure)


def plot(
    thing: Any,
    *,
    tuning: Tuning | None = None,
    structure: Any = None,
) -> Panels:
    """Draw something; numbers as they are, units where they are known.

    Args:
        thing: `StepResponseModel` (each step response), `Tuning` (cost of a deviation per CV), `Plan` (predicted CVs,
            planned MVs), `Trajectory`, or a study: the path of its store or what `open_study` or
            `open_results` gave (sweeps: choke wear against deviation).
        tuning: of a trajectory, for its deadzones.
        structure: of a tuning or a plan, for names and units.

    Returns:
        The axes, ``"row column"``.

    Raises:
        InputError: for anything else, or a tuning of many scenarios.
    """
    with plt.rc_context(style.RC):
        if isinstance(thing, Trajectory):
            return _trajectory(thing, tuning)
        if isinstance(thing, str | Path | xr.Dataset):
            return _study(thing)
        draw = _DRAW.get(type(thing).__name__)  # figures import nothing that predicts or solves
        if draw is None:
            raise InputError(
                "thing",
                type(thing).__name__,
                f"{', '.join(_DRAW)}, Trajectory, the path of a study store or an opened one",
            )
        return draw(thing, structure)


def pareto(study: str | Path | xr.Dataset, x: str = "choke_travel", **options: Any) -> Axes:
    """The runs of a sweep study, and the front of those that no other beats.

    Args:
        study: path of the store, or what `open_study` gave.
        x: key figure along the horizontal axis.
        **options: of `figures.sweep.wear.pareto`.

    Raises:
        InputError: if there is no store, or for a key figure that is not there.
    """
    return wear.pareto(load(study) if isinstance(study, str | Path) else study, x, **options)


def _model(model: Any, _: Any) -> Panels:
    steps = np.asarray(model.coefficients)
    if steps.ndim != 3:
        raise InputError("model.coefficients", f"shape {list(steps.shape)}", "those of one model")
    axes = _axes(len(model.cv_names), len(model.mv_names), sharex=True)
    t = model.dt * np.arange(model.samples + 1)
    for c, cv in enumerate(model.cv_names):
        for m, mv in enumerate(model.mv_names):
            ax = axes[c, m]
            ax.axhline(0, color=style.BLACK, linewidth=0.6)
            ax.plot(t, np.append(0.0, steps[c, m]), color=style.BLUE)
            per = f"{_of(model.cv_units, c)} per {_of(model.mv_units, m)}"
            ax.set_ylabel(f"{style.NAMES.get(cv, cv)} [{per}]")
            if c == 0:
                ax.set_title(f"unit step of {style.NAMES.get(mv, mv)}")
    for ax in axes[-1]:
        ax.set_xlabel("time after the step [s]")
    return axes


def _tuning(tuning: Tuning, structure: Any) -> Panels:
    weight, square, linear, zone = (
        np.asarray(getattr(tuning, name))
        for name in ("cv_weight", "soft_quadratic", "soft_linear", "deadzone")
    )
    if weight.ndim != 1:
        raise InputError("tuning", f"shape {list(weight.shape)}", "the tuning of one controller")
    axes = _axes(1, len(weight))
    for c, ax in enumerate(axes[0]):
        soft = square[c] + linear[c] > 0
        reach = 2.5 * zone[c] if soft and zone[c] > 0 else 1.0
        e = np.linspace(-reach, reach, 401)
        beyond = np.maximum(np.abs(e) - zone[c], 0.0)
        if soft and zone[c] > 0:
            ax.axvspan(-zone[c], zone[c], color=style.BAND, linewidth=0, label=f"deadzone ±{zone[c]:g}")
        cost = weight[c] * e**2
        ax.plot(e, cost, "--", color=style.BLACK, linewidth=1.0, label="without Soft MPC")
        ax.plot(e, cost + square[c] * beyond**2 + linear[c] * beyond, color=style.BLUE, label="cost")
        name = _name(structure, "cv", c)
        ax.set_xlabel(f"deviation of the {name} [{_of(getattr(structure, 'cv_units', ()), c, 'CV unit')}]")
        ax.set_ylabel("cost of one sample [1]")
        ax.legend(loc="upper center")
    return axes


def _plan(plan: Any, structure: Any) -> Panels:
    if plan.moves is None:
        raise InputError("plan", plan.status, "a plan with moves")
    cv, mv = np.asarray(plan.cv), np.asarray(plan.mv)
    axes = _axes(2, max(cv.shape[1], mv.shape[1]), sharex=True)
    dt = getattr(structure, "dt", None)
    for row, values, kind in ((axes[0], cv, "cv"), (axes[1], mv, "mv")):
        for i, ax in enumerate(row):
            if i >= values.shape[1]:
                ax.set_visible(False)
                continue
            t = np.arange(len(values) + (kind == "mv")) + (kind == "cv")
            t = t * (dt or 1.0)
            if kind == "cv":
                ax.plot(t, values[:, i], color=style.PLAN)
            else:
                ax.step(t, np.append(values[:, i], values[-1, i]), where="post", color=style.PLAN)
            unit = _of(getattr(structure, f"{kind}_units", ()), i, f"{kind.upper()} unit")
            ax.set_ylabel(f"{_name(structure, kind, i)} [{unit}]")
            ax.set_xlabel("time from now [s]" if dt else "samples from now")
    return axes


def _trajectory(run: Trajectory, tuning: Tuning | None) -> Panels:
    zones = np.zeros(len(run.cv_names))
    if tuning is not None:
        soft = np.asarray(tuning.soft_quadratic) + np.asarray(tuning.soft_linear) > 0
        zones = np.where(soft, np.asarray(tuning.deadzone), 0.0)
    return _runs(run_results(run, zones, "continuous", "continuous"), ["run"])


def _study(study: str | Path | xr.Dataset) -> Panels:
    comparison = "controller" in study.dims if isinstance(study, xr.Dataset) else is_comparison(study)
    if comparison:
        data = completed(study if isinstance(study, xr.Dataset) else open_results(study)).load()
        return _runs(data, [str(name) for name in data.controller.values])
    axes = _axes(1, 1, width=7.6, height=5.0)
    wear.pareto(study if isinstance(study, xr.Dataset) else load(study), axes=axes[0, 0])
    return axes


def _runs(data: xr.Dataset, controllers: Sequence[str]) -> Panels:
    """CVs with setpoint, then MVs; every controller in its colour."""
    cvs, mvs = panels.cv_names(data), [str(name) for name in data.mv.values]
    axes = _axes(len(cvs) + len(mvs), 1, width=7.6, height=1.7, sharex=True)
    seconds = panels.time_axis(axes[-1, 0], *panels.span(data))
    for name in controllers:
        label = str(data.label.sel(controller=name).item()) if "label" in data.coords else name
        for ax, cv in zip(axes[:, 0], cvs, strict=False):
            if len(controllers) == 1:
                panels.controlled(ax, data, name, cv, seconds)
            else:
                panels.measured(ax, data, name, cv, seconds, label)
        for ax, mv in zip(axes[len(cvs) :, 0], mvs, strict=True):
            panels.manipulated(ax, data, name, mv, seconds, label=label, legend=False)
    if len(controllers) > 1:
        for ax, cv in zip(axes[:, 0], cvs, strict=False):
            panels.setpoint(ax, data, cv, seconds)
        panels.legend_above(axes[0, 0])
    return axes


_DRAW: dict[str, Callable[[Any, Any], Panels]] = {
    "StepResponseModel": _model,
    "Tuning": _tuning,
    "Plan": _plan,
}


def _axes(rows: int, columns: int, width: float = 0.0, height: float = 0.0, **options: Any) -> Panels:
    """Empty panels of a figure that pyplot does not know; sizes in inches, of the figure and of a row."""
    size = (width or max(4.0 * columns, 5.0), (height or 2.4) * rows + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure.subplots(rows, columns, squeeze=False, **options).view(Panels)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    with plt.rc_context(style.RC):
        figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _of(units: Sequence[str], k: int, unknown: str = "unit") -> str:
    return style.unit(units[k]) if k < len(units) and units[k] else unknown


def _name(structure: Any, kind: str, k: int) -> str:
    names = getattr(structure, f"{kind}_names", ())
    name = str(names[k]) if k < len(names) else f"{kind.upper()} {k + 1}"
    return style.NAMES.get(name, name)
