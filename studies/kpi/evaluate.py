"""Key figures of stored results: `studies.kpi.loop` applied to every finished run of a comparison."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Array

from jaxmpc.errors import InputError
from studies.kpi import loop as kpi
from studies.kpi.sweep import RECORD, Integral, Run, Tuned, kpis_of, measures_of, rounding, run_kpis, run_of
from studies.store.process import process_in

STORED = {
    "cv": "measurement",
    "mv": "position",
    "mv_demand": "demand",
}  # what fields of runs are called in results


def completed(data: xr.Dataset) -> xr.Dataset:
    """The controllers whose runs are stored whole.

    Raises:
        InputError: if there is none.
    """
    rows = np.flatnonzero(data.complete.values == 1)
    if rows.size == 0:
        raise InputError("results", "no finished run", "one or more finished runs", "Run the study first")
    return data.isel(controller=rows)


# beyond those of `studies.kpi.sweep`: (axes beside the controller, unit, what it is)
_OWN: dict[str, tuple[tuple[str, ...], str, str]] = {
    "late_reversals": (("window", "mv"), "1", "reversals in the second half of each setpoint window"),
    "move_violations": (("mv",), "samples", "samples with a move outside its limits"),
    "largest_mean_rise": (("mv",), "mv_unit/sample", "largest windowed mean of the demanded moves"),
    "mean_move_stops": (("mv",), "1", "pauses of a rise under the mean-move limit"),
    "rises_above_limit": (("mv",), "1", "moves up although the windowed mean was above its limit"),
    "wall_time": ((), "s", "time of the whole run"),
}


def key_figures(data: xr.Dataset) -> xr.Dataset:
    """Key figures of every finished run, with units; formulas in `studies.kpi.loop`.

    Args:
        data: results from `studies.store.reading.open_results`.

    Returns:
        The variables of `studies.kpi.sweep.kpis_of`, in which a CV counts as settled within its own deadzone, and of `_OWN`
        over ``controller`` and some over ``cv``, ``mv`` or ``window``.
    """
    data = completed(data).load()
    window = data.window.values
    windows = int(window.max()) + 1
    late = kpi.second_halves(window)
    process = process_in(data)
    measures = measures_of(process)
    rows = []
    for i in range(data.sizes["controller"]):
        run = data.isel(controller=i)
        tuned = Tuned(*(run[f"tuning_{name}"].values for name in Tuned._fields))
        span = run.mean_move_window.item()
        fields = {name: run[STORED.get(name, name)].values for name in RECORD}
        # what a replayed log does not have stays as it was measured last
        fields["cv"] = pd.DataFrame(fields["cv"]).ffill().bfill().to_numpy()
        arrays = run_of(fields, run.setpoint.values, window)
        row = _figures(
            arrays,
            tuned,
            late,
            float(data.attrs["dt"]),
            measures.smallest_move,
            windows,
            span,
            measures.integrals,
        )
        rows.append(row | {"wall_time": run.wall_time.values})
    out = {}
    for key, (axes, unit, meaning) in (
        {k.name: (k.dims, k.unit, k.long_name) for k in kpis_of(process)} | _OWN
    ).items():
        values = np.stack([np.asarray(row[key]) for row in rows])
        attrs = {"units": unit, "long_name": meaning}
        out[key] = xr.DataArray(values, dims=("controller", *axes), attrs=attrs)
    coords: dict = {name: data[name] for name in ("controller", "label", "cv", "mv", "cv_unit", "mv_unit")}
    starts = np.array([data.time.values[samples[0]] for samples in windows_of(data)])
    coords["window"] = ("window", starts, {"long_name": "start of the setpoint window", "units": "s"})
    return xr.Dataset(out, coords)


@functools.partial(jax.jit, static_argnames=("windows", "span", "integrals"))
def _figures(
    run: Run,
    tuned: Tuned,
    late,
    dt: float,
    smallest_move,
    windows: int,
    span: int,
    integrals: tuple[Integral, ...],
) -> dict[str, Array]:
    """The key figures of one run as arrays."""

    def of_mv(position, demand, move, smallest, limit):
        actual = kpi.moves_of(position, demand[0] - move[0])
        return {
            "late_reversals": kpi.count_by_segment(
                kpi.reversal_events(actual, smallest, segment=late), late, windows
            ),
            "largest_mean_rise": kpi.windowed_mean(move, span).max(),
            "mean_move_stops": kpi.mean_move_stops(move, span, limit, smallest),
            "rises_above_limit": kpi.rises_above_limit(move, span, limit),
        }

    own = jax.vmap(of_mv, in_axes=(1, 1, 1, 0, 0))(
        run.mv, run.mv_demand, run.move, smallest_move, tuned.mean_move_limit
    )
    own["late_reversals"] = own["late_reversals"].T
    low, high = tuned.move_low, tuned.move_high
    own["move_violations"] = kpi.limit_violations(run.move, low, high, rounding(low, high))
    return run_kpis(run, tuned, tuned.deadzone, dt, smallest_move, integrals) | own


def windows_of(data: xr.Dataset) -> list[np.ndarray]:
    """Positions of the samples of each setpoint window."""
    window = data.window.values
    return [np.flatnonzero(window == w) for w in range(int(window.max()) + 1)]


def quarters(data: xr.Dataset) -> list[np.ndarray]:
    """Positions of the samples of the last quarter of each setpoint window."""
    return [samples[3 * len(samples) // 4 :] for samples in windows_of(data)]


def window_deviation(data: xr.Dataset, controller: str) -> np.ndarray:
    """Mean absolute deviation of a finished run from the setpoint in every window, ``"window cv"`` [CV unit]."""
    run = data.sel(controller=controller)
    away = np.abs(run.measurement.values - run.setpoint.values)
    return np.array([away[samples].mean(axis=0) for samples in windows_of(data)])


def final_deviation(data: xr.Dataset, controller: str) -> np.ndarray:
    """Mean deviation of a finished run over the last quarter of every window, in deadzone half widths.

    Returns:
        ``"window cv"``: signed, measured minus setpoint over deadzone; a swing around the setpoint cancels.
    """
    run = data.sel(controller=controller)
    scaled = (run.measurement.values - run.setpoint.values) / run.tuning_deadzone.values
    return np.array([scaled[samples].mean(axis=0) for samples in quarters(data)])
