"""Panels that several figures share: a CV with its setpoint, an MV, a bias; one run on one axes each."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from figures import style

HOUR = 3600.0
SAME = 1e-6  # MV units between a demand and a position that are one line


def run_of(data: xr.Dataset, controller: str) -> xr.Dataset:
    """One controller's part of the results."""
    return data.sel(controller=controller)


def run_colour(data: xr.Dataset, controller: str) -> str:
    """The controller's colour."""
    run = run_of(data, controller)
    names = [str(name) for name in data.controller.values]
    tuning = str(run.tuning_preset.item()) if "tuning_preset" in run else ""
    if tuning in style.TUNING_COLOURS:
        return style.TUNING_COLOURS[tuning]
    return style.colour(str(run.kind.item()), str(run.actuator.item()), names.index(controller))


def time_axis(axes: Axes, start: float, end: float, bins: int = 12) -> float:
    """Label the time axis in hours, or in minutes below four hours; returns the seconds in that unit."""
    seconds, name = time_unit(start, end)
    axes.set_xlabel(f"time [{name}]")
    axes.set_xlim(start / seconds, end / seconds)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=bins, steps=[1, 2, 5, 10], integer=True))
    return seconds


def time_unit(start: float, end: float) -> tuple[float, str]:
    """Unit of a time axis from `start` to `end` [s]: its seconds and its name."""
    return (60.0, "min") if end - start < 4 * HOUR else (HOUR, "h")


def controlled(
    axes: Axes, data: xr.Dataset, controller: str, cv: str, seconds: float, legend: bool = True
) -> None:
    """A measured CV, its setpoint dashed, and the deadzone of Soft MPC as a band where there is one."""
    run = run_of(data, controller).sel(cv=cv)
    half = soft_half_width(run)
    if half > 0:
        t, low = _ends(data) / seconds, _held(run.setpoint.values) - half
        label = _deadzone(run, half)
        axes.fill_between(t, low, low + 2 * half, step="post", color=style.BAND, linewidth=0, label=label)
    measured(axes, data, controller, cv, seconds)
    setpoint(axes, data, cv, seconds)
    if legend:
        legend_above(axes)


def measured(
    axes: Axes,
    data: xr.Dataset,
    controller: str,
    cv: str,
    seconds: float,
    label: str = "measured",
    colour: str | None = None,
) -> None:
    """A measured CV; in the controller's colour if none is given."""
    run = run_of(data, controller).sel(cv=cv)
    axes.plot(
        data.time.values / seconds,
        run.measurement.values,
        color=colour or run_colour(data, controller),
        linewidth=_width(data),
        label=label,
    )
    axes.set_ylabel(style.label(cv, str(run.cv_unit.item())))


def setpoint(axes: Axes, data: xr.Dataset, cv: str, seconds: float) -> None:
    """The setpoint of a CV, dashed."""
    values = _held(data.setpoint.sel(cv=cv).values)
    t = _ends(data) / seconds
    axes.step(t, values, where="post", color=style.BLACK, linestyle="--", linewidth=1.0, label="setpoint")


def deadzone_lines(axes: Axes, data: xr.Dataset, controller: str, cv: str, seconds: float) -> None:
    """The borders of the deadzone thin and dashed, for panels whose background already has a meaning."""
    run = run_of(data, controller).sel(cv=cv)
    half = soft_half_width(run)
    if half > 0:
        for side, label in ((-half, None), (half, _deadzone(run, half))):
            axes.step(
                _ends(data) / seconds,
                _held(run.setpoint.values) + side,
                where="post",
                color=style.GREY,
                linestyle=(0, (3, 3)),
                linewidth=0.8,
                label=label,
            )


def legend_above(axes: Axes, columns: int = 3) -> None:
    """A legend on top of the panel, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=columns, borderaxespad=0.1)


def mark(axes: Axes, at: float, label: str | None = None) -> None:
    """A dotted line where something happens; `at` in the unit of the time axis."""
    axes.axvline(at, color=style.BLACK, linestyle=":", linewidth=1.1, label=label)


def cv_names(data: xr.Dataset) -> list[str]:
    """CVs from the top panel down: oil above gas, as in the thesis."""
    return [str(name) for name in data.cv.values][::-1]


def span(data: xr.Dataset) -> tuple[float, float]:
    """Start of the first and end of the last sample [s]."""
    return float(data.time.values[0]), float(data.time.values[-1]) + float(data.attrs["dt"])


def _deadzone(run: xr.Dataset, half: float) -> str:
    return f"deadzone ±{half:g} {style.unit(str(run.cv_unit.item()))}"


def _ends(data: xr.Dataset) -> np.ndarray:
    """Starts of the samples and the end of the last one [s]."""
    return np.append(data.time.values, span(data)[1])


def choke(axes: Axes, data: xr.Dataset, controller: str, seconds: float, legend: bool = True) -> None:
    """Demanded and actual choke position."""
    manipulated(axes, data, controller, "choke", seconds, demand=True, legend=legend)


def manipulated(
    axes: Axes,
    data: xr.Dataset,
    controller: str,
    mv: str,
    seconds: float,
    demand: bool = False,
    legend: bool = True,
    label: str = "actual",
    colour: str | None = None,
) -> None:
    """An MV as the actuator holds it over each sample, with the controller's demand if asked for and not the same."""
    run = run_of(data, controller).sel(mv=mv)
    t = _ends(data) / seconds
    colour = colour or run_colour(data, controller)
    width = _width(data)
    apart = demand and bool(np.abs(run.demand.values - run.position.values).max() > SAME)
    if apart:
        axes.step(
            t,
            _held(run.demand.values),
            where="post",
            color=style.BLACK,
            linewidth=0.6 * width,
            label="demanded",
        )
    label = "demanded and actual" if demand and not apart else label
    axes.step(t, _held(run.position.values), where="post", color=colour, linewidth=width, label=label)
    axes.set_ylabel(style.label(mv, str(run.mv_unit.item())))
    if legend and demand:
        legend_above(axes)


def bias(axes: Axes, data: xr.Dataset, controller: str, cv: str, seconds: float) -> None:
    """Filtered output bias v(k|k) of a CV."""
    run = run_of(data, controller).sel(cv=cv)
    axes.axhline(0, color=style.BLACK, linewidth=0.8)
    t = data.time.values / seconds
    axes.plot(t, run.bias.values, color=run_colour(data, controller), linewidth=_width(data))
    axes.set_ylabel("bias of the " + style.label(cv, str(run.cv_unit.item())))


def soft_half_width(run: xr.Dataset) -> float:
    """Half width of the deadzone of one run and CV, 0 without Soft MPC."""
    soft = float(run.tuning_soft_quadratic) + float(run.tuning_soft_linear)
    return float(run.tuning_deadzone) if soft > 0 else 0.0


def _held(values: np.ndarray) -> np.ndarray:
    """Values held over their samples: the last one once more, for the end of the last sample."""
    return np.append(values, values[-1])


def limits(axes: Axes, *values: xr.DataArray, least: float = 0.0) -> None:
    """Vertical limits that hold all given values, so that figures of several controllers compare; `least` wide."""
    low = min(float(value.min()) for value in values)
    high = max(float(value.max()) for value in values)
    margin = max(0.05 * (high - low), (least - (high - low)) / 2) or 1.0
    axes.set_ylim(low - margin, high + margin)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 5, 10]))


def _width(data: xr.Dataset) -> float:
    """Line width: thinner where thousands of samples share the page."""
    return 0.9 if data.sizes["time"] > 2000 else 1.3


def changes(axes: Axes, data: xr.Dataset, seconds: float) -> None:
    """Thin lines where the setpoints change."""
    window = data.window.values
    for k in np.flatnonzero(np.diff(window)) + 1:
        axes.axvline(data.time.values[k] / seconds, color=style.GREY, linewidth=0.5, alpha=0.6)
