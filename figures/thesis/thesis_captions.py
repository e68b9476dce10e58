"""Captions of the thesis comparison: what to see on our well, with numbers from the results that are drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import xarray as xr

from figures import style
from figures.facts import choke_moves, deviation, reversals, times
from figures.thesis import closeup
from studies.definition.presets import CHOKE, GAS, LIFT, OIL

WORKING_CHOKE = 50.0  # %, where the model is identified


def coefficients(cv: str) -> Callable[[xr.Dataset], str]:
    """Figures 10 and 11."""

    def text(data: xr.Dataset) -> str:
        curves = data.sweep_coefficient.sel(cv=cv)
        largest = curves.where(curves == curves.max(), drop=True)
        at = float(largest.sweep_choke.values[0])
        lift = largest.sweep_lift.values[0]
        working = float(curves.sel(sweep_lift=lift).interp(sweep_choke=WORKING_CHOKE).item())
        ratio = float(curves.max()) / working
        return (
            f"The gain of the choke on the {style.NAMES[cv]} depends on where it stands: at a lift of {lift:.0f} m³/h a "
            f"step at {at:.0f} % does {ratio:.1f} times as much as one at {WORKING_CHOKE:.0f} %, where the prediction "
            "model is identified."
        )

    return text


def tracking(controller: str) -> Callable[[xr.Dataset], str]:
    """Figures 14, 17 and 22."""

    def text(data: xr.Dataset) -> str:
        off = {cv: deviation(data, controller, cv) for cv in (GAS, OIL)}
        others = ", ".join(
            f"{data.label.sel(controller=name).item()} {times(reversals(data, name))}"
            for name in data.controller.values
            if name != controller and data.complete.sel(controller=name) == 1
        )
        return (
            f"Mean absolute deviation from the setpoints: gas {off[GAS]:.0f} m³/h, oil {off[OIL]:.1f} m³/h, targets out "
            f"of reach included. The choke reverses {times(reversals(data, controller))}"
            f"{f' ({others})' if others else ''}."
        )

    return text


def inputs(controller: str) -> Callable[[xr.Dataset], str]:
    """Figures 15, 18, 23 and 35."""

    def text(data: xr.Dataset) -> str:
        run = data.sel(controller=controller)
        move = choke_moves(data, controller)
        low, high = float(run.position.sel(mv=CHOKE).min()), float(run.position.sel(mv=CHOKE).max())
        return (
            f"The choke travels {np.abs(move).sum():.0f} % between {low:.0f} and {high:.0f} % and reverses "
            f"{times(reversals(data, controller))}; the lift travels "
            f"{np.abs(run.move.sel(mv=LIFT)).sum().item():,.0f} m³/h."
        )

    return text


def bias(controller: str) -> Callable[[xr.Dataset], str]:
    """Figures 16, 19 and 24."""

    def text(data: xr.Dataset) -> str:
        size = np.abs(data.bias.sel(controller=controller)).max("time")
        return (
            "What the linear model leaves unexplained of the measurements, filtered: up to "
            f"{size.sel(cv=GAS).item():.0f} m³/h of gas and {size.sel(cv=OIL).item():.0f} m³/h of oil. Every prediction "
            "is corrected by that much."
        )

    return text


def oscillating_rates(controller: str) -> Callable[[xr.Dataset], str]:
    """Figure 20."""

    def text(data: xr.Dataset) -> str:
        part = closeup.stretch(data, controller)
        swing = part.measurement.sel(controller=controller)
        gas, oil = (float(swing.sel(cv=cv).max() - swing.sel(cv=cv).min()) for cv in (GAS, OIL))
        choke = part.position.sel(controller=controller, mv=CHOKE)
        return (
            f"With the choke between {choke.min().item():.0f} and {choke.max().item():.0f} % gas swings over {gas:.0f} m³/h "
            f"and oil over {oil:.1f} m³/h."
        )

    return text


def oscillating_inputs(controller: str) -> Callable[[xr.Dataset], str]:
    """Figure 21."""

    def text(data: xr.Dataset) -> str:
        part = closeup.stretch(data, controller)
        minutes = (part.time.values[-1] - part.time.values[0]) / 60
        return (
            f"In these {minutes:.0f} minutes the choke reverses {times(reversals(part, controller))}: the controller asks "
            "for positions between two steps and gets the one or the other, once its demand is far enough away."
        )

    return text


def compiled_note(data: xr.Dataset, controllers: Iterable[str]) -> str:
    """What to know of times per sample where compiled loops have none of their own; empty otherwise."""
    compiled = any(
        len(np.unique(data.solve_time.sel(controller=name).values)) < data.sizes["time"] / 10
        for name in controllers
    )
    return (
        " On the JAX well samples run compiled, many at once; each has their mean time." if compiled else ""
    )


def solve_time(controllers: tuple[str, ...]) -> Callable[[xr.Dataset], str]:
    """Figure 39."""

    def text(data: xr.Dataset) -> str:
        parts = []
        for name in controllers:
            ms = 1e3 * data.solve_time.sel(controller=name).values
            kind = str(data.kind.sel(controller=name).item())
            parts.append(f"{kind} MPC {np.median(ms):.1f} / {ms.max():.0f} ms")
        return (
            f"Median and longest time of one step: {', '.join(parts)}; the sampling interval is "
            f"{float(data.attrs['dt']):.0f} s.{compiled_note(data, controllers)}"
        )

    return text


def summary(data: xr.Dataset) -> str:
    """The summary page."""
    return (
        f"Key figures of the {data.sizes['controller']} runs, and statements of the thesis about this comparison with "
        "what our well shows and a verdict by a stated rule."
    )
