"""All figures of a sweep study from its store; nothing here solves anything.

Which figures there are follows from what varies: ``pareto`` always, ``maps`` over two numeric axes, ``mismatch`` for models
and references, ``blocking`` for blocks and horizons, ``fan`` and ``distributions`` for many plants or noises.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from figures import style
from figures.sweep import fan, maps, regret, wear
from figures.sweep.data import load, sweep_axes


def pages(data: xr.Dataset) -> dict[str, Callable[[], Figure]]:
    """What draws the figures that fit a study, from `figures.sweep.data.load`, by the name of their files."""
    axes = sweep_axes(data)
    out: dict[str, Callable[[], Figure]] = {"pareto": functools.partial(wear.draw, data)}
    if maps.is_mismatch(axes):
        out["mismatch"] = functools.partial(maps.mismatch, data)
    else:
        for label, name, part in maps.controller_parts(data):
            found = maps.map_axes(part)
            if found is not None:
                out[f"maps{name}"] = functools.partial(maps.draw, part, found, label if name else "")
    if regret.is_blocking(data):
        out["blocking"] = functools.partial(regret.draw, data)
    drawn = fan.monte_carlo(data, axes)
    if drawn:
        if fan.has_trajectories(data):
            out["fan"] = functools.partial(fan.fan, data, drawn)
        out["distributions"] = functools.partial(fan.distributions, data, drawn)
    return {name: style.house_style(page) for name, page in out.items()}


def draw_sweep(store: str | Path, folder: str | Path) -> list[Path]:
    """Draw every figure that fits the study, from the scenarios that are finished, as PNG and PDF.

    Args:
        store: of the study, ending in ``.zarr``.
        folder: for the files; made if it is missing.

    Returns:
        The files written.

    Raises:
        InputError: if there is no store, no scenario of it is finished, or a key figure is not in it.
    """
    return [path for name, page in pages(load(store)).items() for path in style.save(page(), folder, name)]
