"""Panels that several figures share: a CV with its setpoint, an MV, a bias, several runs; on one axes each.

`data` are results as `studies.store.reading.open_results` gives them, or `figures.closed_loop.results` of one run.
`seconds` is the unit of the time axis, as `time_axis` returns it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from figures import style
from studies.store.process import process_in

HOUR, MINUTE = 3600.0, 60.0
SAME = 1e-6  # MV units between a demand and a position that are one line
THIN: dict[str, Any] = {"color": style.GREY, "linestyle": (0, (3, 3)), "linewidth": 0.8}

Curves = Mapping[str, Mapping[str, Any]]  # label, perhaps colour, of the curve of each controller


def run_colour(data: xr.Dataset, controller: str) -> str:
    """The controller's colour."""
    return run_colours(data)[controller]


def run_colours(data: xr.Dataset) -> dict[str, str]:
    """A colour of its own for each controller: that of its kind and actuators where no other has it before.

    Controllers with the first preset of the process come first: those with another one are compared with them.
    """
    names = [str(name) for name in data.controller.values]
    kinds = zip(data.kind.values.tolist(), data.actuator.values.tolist(), strict=True)
    wanted = {
        name: style.CONTROLLER_COLOURS.get((kind, actuator))
        for name, (kind, actuator) in zip(names, kinds, strict=True)
    }
    if "tuning_preset" in data:
        first = process_in(data).default_preset
        other = {
            name
            for name, preset in zip(names, data.tuning_preset.values.tolist(), strict=True)
            if preset != first
        }
        wanted |= dict.fromkeys(other)
    out: dict[str, str] = {}
    for name, colour in wanted.items():
        if colour is not None and colour not in out.values():
            out[name] = colour
    for i, name in enumerate(name for name in names if name not in out):
        out[name] = style.SPARE_COLOURS[i % len(style.SPARE_COLOURS)]
    return {name: out[name] for name in names}


def cv_names(data: xr.Dataset) -> list[str]:
    """CVs from the top panel down."""
    return [str(name) for name in data.cv.values]


def mv_names(data: xr.Dataset) -> list[str]:
    """MVs from the top panel down."""
    return [str(name) for name in data.mv.values]


def stepped(data: xr.Dataset) -> list[str]:
    """MVs whose actuators do not take every value."""
    process = process_in(data)
    known = {process.mv_names[i] for i in process.stepped}
    return [name for name in mv_names(data) if name in known]


def worn(data: xr.Dataset) -> list[str]:
    """MVs whose moves count: those with stepped actuators, all where there are none."""
    return stepped(data) or mv_names(data)


def is_cv(data: xr.Dataset, channel: str) -> bool:
    """Whether a channel is a CV rather than an MV."""
    return channel in data.cv.values


def unit_of(data: xr.Dataset, channel: str) -> str:
    """Unit of a CV or MV as it is printed."""
    axis = "cv" if is_cv(data, channel) else "mv"
    return style.unit(str(data[f"{axis}_unit"].sel({axis: channel}).item()))


def words_of(data: xr.Dataset, channel: str) -> str:
    """A CV or MV in words, as its process calls it."""
    return process_in(data).labels.get(channel) or style.name_of(channel)


def label_of(data: xr.Dataset, channel: str, what: str = "") -> str:
    """Label of an axis with a CV or MV, `what` of it, and the unit."""
    return style.label(words_of(data, channel) + what, unit_of(data, channel))


def span(data: xr.Dataset) -> tuple[float, float]:
    """Start of the first and end of the last sample [s]."""
    return float(data.time.values[0]), float(data.time.values[-1]) + float(data.attrs["dt"])


def between(data: xr.Dataset, start: float, end: float = np.inf, closed: bool = True) -> xr.Dataset:
    """Samples from one time to another [s], that of the end included if `closed`."""
    before = data.time.values <= end if closed else data.time.values < end
    return data.isel(time=np.flatnonzero((data.time.values >= start) & before))


def time_unit(start: float, end: float) -> tuple[float, str]:
    """Seconds and name of the unit of a time axis from `start` to `end` [s]: the largest of which it has four."""
    units = ((HOUR, "h"), (MINUTE, "min"))
    return next(((size, name) for size, name in units if end - start >= 4 * size), (1.0, "s"))


def time_axis(
    axes: Axes, start: float, end: float, bins: int = 12, steps: Sequence[int] = (1, 2, 5, 10)
) -> float:
    """Label the time axis, with `bins` numbers at most, multiples of `steps`; returns the seconds in its unit."""
    seconds, name = time_unit(start, end)
    axes.set_xlabel(f"time [{name}]")
    axes.set_xlim(start / seconds, end / seconds)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=bins, steps=steps, integer=True))
    return seconds


def held(data: xr.Dataset, values: Any, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and values that are held over their samples: the last one once more, for the end of the last sample."""
    values = np.asarray(values)
    return np.append(data.time.values, span(data)[1]) / seconds, np.append(values, values[-1])


def step(axes: Axes, data: xr.Dataset, values: Any, seconds: float, **look: Any) -> None:
    """Values ``"time"`` that are held over their samples."""
    axes.step(*held(data, values, seconds), where="post", **look)


def dashed(
    axes: Axes, data: xr.Dataset, values: Any, seconds: float, label: str, colour: str = style.BLACK
) -> None:
    """A setpoint, demand or target ``"time"``."""
    step(axes, data, values, seconds, color=colour, linestyle="--", linewidth=1.0, label=label)


def setpoint(axes: Axes, data: xr.Dataset, cv: str, seconds: float) -> None:
    """The setpoint of a CV."""
    dashed(axes, data, data.setpoint.sel(cv=cv), seconds, "setpoint")


def soft_half_width(run: xr.Dataset) -> float:
    """Half width of the deadzone of one run and CV, 0 without Soft MPC."""
    soft = float(run.tuning_soft_quadratic) + float(run.tuning_soft_linear)
    return float(run.tuning_deadzone) if soft > 0 else 0.0


def band(axes: Axes, data: xr.Dataset, centre: Any, half: float, seconds: float, label: str | None) -> None:
    """The deadzone around a setpoint ``"time"``."""
    t, low = held(data, np.asarray(centre) - half, seconds)
    axes.fill_between(t, low, low + 2 * half, step="post", color=style.BAND, linewidth=0, label=label)


def deadzone_lines(axes: Axes, data: xr.Dataset, controller: str, cv: str, seconds: float) -> None:
    """The borders of the deadzone thin and dashed, for panels whose background already has a meaning."""
    run = data.sel(controller=controller, cv=cv)
    half = soft_half_width(run)
    if half > 0:
        for side, label in ((-half, None), (half, f"deadzone ±{half:g} {unit_of(data, cv)}")):
            step(axes, data, run.setpoint + side, seconds, **THIN, label=label)


def controlled(
    axes: Axes, data: xr.Dataset, controller: str, cv: str, seconds: float, legend: bool = True
) -> None:
    """A measured CV, its setpoint dashed, and the deadzone of Soft MPC as a band where there is one."""
    run = data.sel(controller=controller, cv=cv)
    half = soft_half_width(run)
    if half > 0:
        band(axes, data, run.setpoint, half, seconds, f"deadzone ±{half:g} {unit_of(data, cv)}")
    measured(axes, data, controller, cv, seconds)
    setpoint(axes, data, cv, seconds)
    if legend:
        legend_above(axes)


def measured(axes: Axes, data: xr.Dataset, controller: str, cv: str, seconds: float, **look: Any) -> None:
    """A measured CV, in the controller's colour if `look` names none."""
    values = data.measurement.sel(controller=controller, cv=cv).values
    look = {"color": run_colour(data, controller), "linewidth": _width(data), "label": "measured", **look}
    axes.plot(data.time.values / seconds, values, **look)
    axes.set_ylabel(label_of(data, cv))


def manipulated(
    axes: Axes, data: xr.Dataset, controller: str, mv: str, seconds: float, demand: bool = False, **look: Any
) -> None:
    """An MV as the actuator holds it over each sample, with the controller's demand if asked for and not the same."""
    run = data.sel(controller=controller, mv=mv)
    demand = demand and "demand" in run
    look = {"color": run_colour(data, controller), "linewidth": _width(data), "label": "actual", **look}
    if demand and np.abs(run.demand.values - run.position.values).max() > SAME:
        thin = 0.6 * look["linewidth"]
        step(axes, data, run.demand, seconds, color=style.BLACK, linewidth=thin, label="demanded")
    elif demand:
        look["label"] = "demanded and actual"
    step(axes, data, run.position, seconds, **look)
    axes.set_ylabel(label_of(data, mv))


def bias(axes: Axes, data: xr.Dataset, controller: str, cv: str, seconds: float) -> None:
    """Filtered output bias v(k|k) of a CV."""
    run = data.sel(controller=controller, cv=cv)
    axes.axhline(0, color=style.BLACK, linewidth=0.8)
    look = {"color": run_colour(data, controller), "linewidth": _width(data)}
    axes.plot(data.time.values / seconds, run.bias.values, **look)
    axes.set_ylabel(f"bias of the {label_of(data, cv)}")


def compared(
    axes: Axes, data: xr.Dataset, channel: str, curves: Curves, seconds: float, zone: str | None = None
) -> None:
    """Several runs of a CV with its setpoint, and if `zone` is given the deadzone of that controller; or of an MV."""
    cv = is_cv(data, channel)
    if cv and zone is not None:
        deadzone_lines(axes, data, zone, channel, seconds)
    for name, look in curves.items():
        (measured if cv else manipulated)(axes, data, name, channel, seconds, **look)
    if cv:
        setpoint(axes, data, channel, seconds)


def changes(axes: Axes, data: xr.Dataset, seconds: float) -> None:
    """Thin lines where the setpoints change."""
    for k in np.flatnonzero(np.diff(data.window.values)) + 1:
        axes.axvline(data.time.values[k] / seconds, color=style.GREY, linewidth=0.5, alpha=0.6)


def mark(axes: Axes, at: float, label: str | None = None) -> None:
    """A dotted line where something happens; `at` in the unit of the time axis."""
    axes.axvline(at, color=style.BLACK, linestyle=":", linewidth=1.1, label=label)


def limits(axes: Axes, *values: xr.DataArray, least: float = 0.0) -> None:
    """Vertical limits that hold all given values, so that figures of several controllers compare; `least` wide."""
    low = min(float(value.min()) for value in values)
    high = max(float(value.max()) for value in values)
    margin = max(0.05 * (high - low), (least - (high - low)) / 2) or 1.0
    axes.set_ylim(low - margin, high + margin)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 5, 10]))


def legend_above(axes: Axes, columns: int = 3, **options: Any) -> None:
    """A legend on top of the panel, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=columns, borderaxespad=0.1, **options)


def shared_legend(
    drawn: Figure,
    axes: Iterable[Axes],
    loc: Any = "outside upper center",
    columns: int | None = None,
    **options: Any,
) -> None:
    """One legend for all panels, in a row or some columns; the deadzone, which differs from CV to CV, without its width."""
    found: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault("deadzone" if label.startswith("deadzone") else label, handle)
    if "demanded and actual" in found:  # of the MVs without a demand of their own
        found.pop("actual", None)
    drawn.legend(list(found.values()), list(found), loc=loc, ncols=columns or len(found), **options)


def _width(data: xr.Dataset) -> float:
    """Line width: thinner where thousands of samples share the page."""
    return 0.9 if data.sizes["time"] > 2000 else 1.3
