"""Thesis figures 12 and 13: the nominal mixed-integer MPC against Soft MPC, and what each charges for a deviation."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from jaxmpc.process.well.equations import CV_NAMES, CV_UNITS
from studies.definition.presets import GAS, OIL, TUNINGS

CV_UNIT = dict(zip(CV_NAMES, CV_UNITS, strict=True))
NOMINAL, SOFT = "nominal", "soft"
CURVES = (  # preset, label, line
    ("no-soft", "nominal", "-"),
    ("no-soft-plain", "Soft MPC left out, weight unchanged", "-."),
    ("thesis", "Soft MPC", "-"),
)
REACH = 4.0  # deadzone half widths to show


@contextlib.contextmanager
def compared(data: xr.Dataset) -> Iterator[Figure]:
    """Figure 12: oil rate with setpoint and deadzone, and choke position, of both controllers.

    Args:
        data: results of the study ``soft``.
    """
    with style.figure(2, row_height=2.5) as (drawn, (rate, choke)):
        seconds = panels.time_axis(choke, *panels.span(data))
        for name in (NOMINAL, SOFT):
            label = "nominal" if name == NOMINAL else "Soft MPC"
            panels.measured(rate, data, name, OIL, seconds, label)
            panels.manipulated(choke, data, name, "choke", seconds, label=label)
        panels.deadzone_lines(rate, data, SOFT, OIL, seconds)
        panels.setpoint(rate, data, OIL, seconds)
        panels.legend_above(rate, 4)
        yield drawn


@contextlib.contextmanager
def penalties(_results=None) -> Iterator[Figure]:
    """Figure 13: penalty of one sample over the deviation, with the weights of the presets."""
    with style.figure(2, row_height=2.6, sharex=False) as (drawn, axes):
        for ax, cv in zip(axes, (OIL, GAS), strict=True):
            half = TUNINGS["thesis"]["deadzone"][cv]
            deviation = np.linspace(-REACH * half, REACH * half, 401)
            for preset, label, line in CURVES:
                colour = style.TUNING_COLOURS.get(preset, style.CONTROLLER_COLOURS["mixed-integer", "step"])
                ax.plot(deviation, penalty(preset, cv, deviation), line, color=colour, label=label)
            zone = f"deadzone ±{half:g} {style.unit(CV_UNIT[cv])}"
            ax.axvspan(-half, half, color=style.BAND, linewidth=0, label=zone)
            ax.set_xlim(deviation[0], deviation[-1])
            ax.set_ylim(bottom=0)
            name = style.NAMES[cv]
            ax.set_xlabel(f"{name}: deviation from the setpoint [{style.unit(CV_UNIT[cv])}]")
            ax.set_ylabel("penalty of a sample [1]")
        axes[0].legend(loc="upper center", ncols=1)
        axes[1].legend(loc="upper center", ncols=1)
        yield drawn


def penalty(preset: str, cv: str, deviation: np.ndarray) -> np.ndarray:
    """What one sample costs in (6.6): Q d^2 + S eta^2 + s eta with eta = max(|d| - c, 0).

    Args:
        preset: a key of `studies.definition.presets.TUNINGS`.
        cv: name of the CV.
        deviation: predicted CV minus setpoint [CV unit].
    """
    tuning = TUNINGS[preset]
    eta = np.maximum(np.abs(deviation) - tuning["deadzone"][cv], 0.0)
    return (
        tuning["cv_weight"][cv] * deviation**2
        + tuning["soft_quadratic"][cv] * eta**2
        + tuning["soft_linear"][cv] * eta
    )
