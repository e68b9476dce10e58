"""Thesis figures 12 and 13: the nominal mixed-integer MPC against Soft MPC, and what each charges for a deviation (6.4)."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from figures.show import cost
from figures.thesis.facts import reversals, times
from studies.thesis.well import CHOKE, GAS, OIL, WELL

NOMINAL, SOFT = "nominal", "soft"
PENALTIES = (  # preset, label, line, colour
    ("no-soft", "nominal", "-", style.PURPLE),
    ("no-soft-plain", "Soft MPC left out, weight unchanged", "-.", style.SKY),
    ("thesis", "Soft MPC", "-", style.GREEN),
)
REACH = 4.0  # deadzone half widths to show


def compared(data: xr.Dataset) -> Figure:
    """Oil rate with setpoint and deadzone above the choke position, each with a curve per controller."""
    drawn, axes = style.figure(2, row_height=2.5)
    seconds = panels.time_axis(axes[1], *panels.span(data))
    for ax, channel in zip(axes, (OIL, CHOKE), strict=True):
        curves = {NOMINAL: {"label": "nominal"}, SOFT: {"label": "Soft MPC"}}
        panels.compared(ax, data, channel, curves, seconds, zone=SOFT)
    panels.legend_above(axes[0], 4)
    return drawn


def _compared_caption(data: xr.Dataset) -> str:
    return (
        f"Without the deadzone the choke reverses {times(reversals(data, NOMINAL))} over the run, with Soft MPC "
        f"{times(reversals(data, SOFT))}: a small constant deviation of the oil rate is cheap, another move is not."
    )


def penalties(_results=None) -> Figure:
    """Two plots, oil above gas: three parabola-like penalties over the deviation, the deadzone shaded."""
    drawn, axes = style.figure(2, row_height=2.6, sharex=False)
    for ax, cv in zip(axes, (OIL, GAS), strict=True):
        unit = style.unit(WELL.units[cv])
        half = WELL.presets["thesis"]["deadzone"][cv]
        deviation = np.linspace(-REACH * half, REACH * half, 401)
        for preset, label, line, colour in PENALTIES:
            ax.plot(deviation, penalty(preset, cv, deviation), line, color=colour, label=label)
        ax.axvspan(-half, half, color=style.BAND, linewidth=0, label=f"deadzone ±{half:g} {unit}")
        ax.set_xlim(deviation[0], deviation[-1])
        ax.set_ylim(bottom=0)
        ax.set_xlabel(f"{WELL.labels[cv]}: deviation from the setpoint [{unit}]")
        ax.set_ylabel("penalty of a sample [1]")
        ax.legend(loc="upper center")
    return drawn


def penalty(preset: str, cv: str, deviation: np.ndarray) -> np.ndarray:
    """What one sample costs with a preset of the well; deviation in CV units."""
    fields = ("cv_weight", "soft_quadratic", "soft_linear", "deadzone")
    return cost(deviation, *(WELL.presets[preset][field][cv] for field in fields))


def _penalties_caption(_results=None) -> str:
    half = WELL.presets["thesis"]["deadzone"][OIL]
    at = np.array([half, 10 * half])
    inside, outside = 100 * penalty("thesis", OIL, at) / penalty("no-soft", OIL, at)
    return (
        f"The penalty of one sample with the weights of our presets: inside the deadzone Soft MPC charges {inside:.0f} % of "
        f"the nominal controller, at ten times its half width {outside:.0f} %."
    )


ENTRIES = (
    FigureEntry(
        "12",
        "nominal and Soft mixed-integer MPC",
        "soft",
        compared,
        _compared_caption,
        "nominal_and_soft",
        (NOMINAL, SOFT),
    ),
    FigureEntry(
        "13", "penalty of a deviation: Soft MPC and nominal", None, penalties, _penalties_caption, "penalties"
    ),
)
