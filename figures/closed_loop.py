"""One closed loop as the panels read it, and its figure: CVs with setpoints above, MVs below.

`jaxmpc simulate` draws a scenario that was run again with `draw_run`; `figures.show` and the app read one run as `results`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import panels, style
from jaxmpc.files import strict_json
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.process.process import Process

RUN = "run"  # name of the one controller in results of one run


@style.house_style
def draw_run(
    trajectory: Trajectory,
    deadzone: np.ndarray | tuple[float, ...],
    folder: str | Path,
    title: str,
    *,
    kind: str = "mixed-integer",
    actuator: str = "step",
    name: str = "run",
    process: Process | None = None,
) -> list[Path]:
    """Draw one run: CVs with setpoint and deadzone, then MVs with what was demanded of stepped actuators.

    Args:
        trajectory: of the run.
        deadzone: half width per CV [CV unit]; 0 draws no band.
        folder: for the files.
        title: above the panels.
        kind: of the controller, for the colour.
        actuator: of the MVs, ``step`` or ``continuous``, for the colour.
        name: of the files.
        process: that was controlled, for labels and stepped MVs.

    Returns:
        The PNG and the PDF.
    """
    return style.save(run(of_trajectory(trajectory, deadzone, kind, actuator, process), title), folder, name)


def run(data: xr.Dataset, title: str) -> Figure:
    """The figure of `draw_run`, from results of one controller called ``run``."""
    drawn, axes = style.figure(data.sizes["cv"] + data.sizes["mv"], row_height=1.8)
    drawn.suptitle(textwrap.fill(title, 95), fontsize=10)
    tracking(axes, data, RUN)
    return drawn


def tracking(axes: Iterable[Axes], data: xr.Dataset, controller: str, legend: bool = True) -> None:
    """CVs with setpoint and deadzone, MVs, stepped ones with what was demanded, a panel each."""
    start, end = panels.span(data)
    cvs, stepped = panels.cv_names(data), panels.stepped(data)
    for ax, channel in zip(axes, [*cvs, *panels.mv_names(data)], strict=True):
        seconds = panels.time_axis(ax, start, end)
        spec = ax.get_subplotspec()
        if spec is not None and not spec.is_last_row():
            ax.set_xlabel("")
        if channel in cvs:
            panels.controlled(ax, data, controller, channel, seconds, legend=legend)
        else:
            demand = channel in stepped
            panels.manipulated(ax, data, controller, channel, seconds, demand=demand)
            if legend and demand:
                panels.legend_above(ax)
        panels.changes(ax, data, seconds)


def of_trajectory(
    trajectory: Trajectory, deadzone: Any, kind: str, actuator: str, process: Process | None = None
) -> xr.Dataset:
    """A trajectory as `results`; its other arguments."""
    run = xr.Dataset(
        {
            "measurement": (("time", "cv"), trajectory.cv),
            "position": (("time", "mv"), trajectory.mv),
            "demand": (("time", "mv"), trajectory.mv_demand),
            "move": (("time", "mv"), trajectory.move),
            "bias": (("time", "cv"), trajectory.bias),
            "setpoint": (("time", "cv"), trajectory.setpoint),
        },
        {
            "time": trajectory.time,
            "cv": list(trajectory.cv_names),
            "mv": list(trajectory.mv_names),
            "cv_unit": ("cv", list(trajectory.cv_units)),
            "mv_unit": ("mv", list(trajectory.mv_units)),
        },
    )
    return results(run, trajectory.dt, deadzone, kind, actuator, process)


def results(
    run: xr.Dataset, dt: float, deadzone: Any, kind: str, actuator: str, process: Process | None = None
) -> xr.Dataset:
    """One run as panels read the results of a comparison: its controller is called `RUN`.

    Args:
        run: ``measurement`` and ``setpoint`` ``"time cv"``, ``position`` and perhaps ``demand`` ``"time mv"``, with units.
        dt: sampling interval [s].
        deadzone: half width for all CVs or per CV [CV unit]; 0 without Soft MPC.
        kind: of the controller.
        actuator: of the MVs.
        process: that was controlled, if it is known.
    """
    changed = np.any(np.diff(run.setpoint.values, axis=0) != 0, axis=1)
    half = np.broadcast_to(np.asarray(deadzone, dtype=float), (1, run.sizes["cv"]))
    variables: dict[str, Any] = {
        "setpoint": run.setpoint,
        "window": ("time", np.concatenate([[0], np.cumsum(changed)])),
        "kind": ("controller", [kind]),
        "actuator": ("controller", [actuator]),
        "tuning_deadzone": (("controller", "cv"), half),
    }
    for name in ("tuning_soft_quadratic", "tuning_soft_linear"):
        variables[name] = (("controller", "cv"), 1.0 * (half > 0))
    known = {} if process is None else {"process": strict_json(process.body)}
    return run.expand_dims(controller=[RUN]).assign(variables).assign_attrs(dt=dt, **known)
