"""Key figures of stored results: `studies.kpi.loop` applied to every finished run of a comparison."""

from __future__ import annotations

import functools

import jax
import numpy as np
import xarray as xr
from jaxtyping import Array

from jaxmpc.errors import InputError
from studies.definition.presets import CHOKE, GAS, LIFT, OIL
from studies.kpi import loop as kpi
from studies.kpi.sweep import KPIS, RECORD, Channels, Run, Tuned, rounding, run_kpis, run_of

NEAR_CLOSED = 50.0  # % choke, the border in the thesis's statement on oscillation
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
    "late_reversals": (("window",), "1", "choke reversals in the second half of each setpoint window"),
    "late_reversals_near_closed": ((), "1", "those of them below 50 % choke, all windows"),
    "move_violations": (("mv",), "samples", "samples with a move outside its limits"),
    "largest_mean_opening": ((), "%/sample", "largest windowed mean of the demanded choke moves"),
    "mean_move_stops": ((), "1", "pauses of the opening under the mean-move limit"),
    "openings_above_limit": ((), "1", "openings although the windowed mean was above its limit"),
    "wall_time": ((), "s", "time of the whole run"),
}


def key_figures(data: xr.Dataset) -> xr.Dataset:
    """Key figures of every finished run, with units; formulas in `studies.kpi.loop`.

    Args:
        data: results from `studies.store.reading.open_results`.

    Returns:
        The variables of `studies.kpi.sweep.KPIS`, in which a CV counts as settled within its own deadzone, and of `_OWN`
        over ``controller`` and some over ``cv``, ``mv`` or ``window``.
    """
    data = completed(data).load()
    window = data.window.values
    windows = int(window.max()) + 1
    late = kpi.second_halves(window)
    mvs, cvs = list(data.mv.values), list(data.cv.values)
    channels = Channels(mvs.index(CHOKE), mvs.index(LIFT), cvs.index(GAS), cvs.index(OIL))
    rows = []
    for i in range(data.sizes["controller"]):
        run = data.isel(controller=i)
        tuned = Tuned(*(run[f"tuning_{name}"].values for name in Tuned._fields))
        span = run.mean_move_window.item()
        fields = {name: run[STORED.get(name, name)].values for name in RECORD}
        arrays = run_of(fields, run.setpoint.values, window)
        row = _figures(arrays, tuned, late, float(data.attrs["dt"]), windows, span, channels)
        rows.append(row | {"wall_time": run.wall_time.values})
    out = {}
    for key, (axes, unit, meaning) in ({k.name: (k.dims, k.unit, k.long_name) for k in KPIS} | _OWN).items():
        values = np.stack([np.asarray(row[key]) for row in rows])
        attrs = {"units": unit, "long_name": meaning}
        out[key] = xr.DataArray(values, dims=("controller", *axes), attrs=attrs)
    coords: dict = {name: data[name] for name in ("controller", "label", "cv", "mv", "cv_unit", "mv_unit")}
    starts = np.array([data.time.values[samples[0]] for samples in _windows(data)])
    coords["window"] = ("window", starts, {"long_name": "start of the setpoint window", "units": "s"})
    return xr.Dataset(out, coords)


@functools.partial(jax.jit, static_argnames=("windows", "span", "channels"))
def _figures(
    run: Run, tuned: Tuned, late, dt: float, windows: int, span: int, channels: Channels
) -> dict[str, Array]:
    """The key figures of one run as arrays."""
    position, demanded = run.mv[:, channels.choke], run.move[:, channels.choke]
    actual = kpi.moves_of(position, run.mv_demand[0, channels.choke] - demanded[0])
    hunting = kpi.reversal_events(actual, segment=late)
    low, high, limit = tuned.move_low, tuned.move_high, tuned.mean_move_limit[channels.choke]
    return run_kpis(run, tuned, tuned.deadzone, dt, channels) | {
        "late_reversals": kpi.count_by_segment(hunting, late, windows),
        "late_reversals_near_closed": (hunting & (position < NEAR_CLOSED)).sum(),
        "move_violations": kpi.limit_violations(run.move, low, high, rounding(low, high)),
        "largest_mean_opening": kpi.windowed_mean(demanded, span).max(),
        "mean_move_stops": kpi.mean_move_stops(demanded, span, limit),
        "openings_above_limit": kpi.opening_above_limit(demanded, span, limit),
    }


def _windows(data: xr.Dataset) -> list[np.ndarray]:
    """Positions of the samples of each setpoint window."""
    window = data.window.values
    return [np.flatnonzero(window == w) for w in range(int(window.max()) + 1)]


def window_deviation(data: xr.Dataset, controller: str) -> np.ndarray:
    """Mean absolute deviation of a finished run from the setpoint in every window, ``"window cv"`` [CV unit]."""
    run = data.sel(controller=controller)
    away = np.abs(run.measurement.values - run.setpoint.values)
    return np.array([away[samples].mean(axis=0) for samples in _windows(data)])


def final_deviation(data: xr.Dataset, controller: str) -> np.ndarray:
    """Mean deviation of a finished run over the last quarter of every window, in deadzone half widths.

    Returns:
        ``"window cv"``: signed, measured minus setpoint over deadzone; a swing around the setpoint cancels.
    """
    run = data.sel(controller=controller)
    scaled = (run.measurement.values - run.setpoint.values) / run.tuning_deadzone.values
    return np.array([scaled[samples[3 * len(samples) // 4 :]].mean(axis=0) for samples in _windows(data)])


def distance_to_reach(data: xr.Dataset, refine: int = 8) -> np.ndarray:
    """How far each setpoint pair is from the steady states of the plant, in deadzone half widths.

    The smallest over the stored steady-state map (interpolated linearly, `refine` points per cell) of the
    largest |rate - setpoint| / c over the CVs, c the half width of the deadzone.

    Returns:
        ``"window"``.
    """
    rate = data.map_rate.transpose("map_choke", "map_lift", "cv").values
    for axis in (0, 1):
        n = rate.shape[axis]
        at = np.arange((n - 1) * refine + 1) / refine
        low = np.minimum(at.astype(int), n - 2)
        share = (at - low).reshape([-1 if a == axis else 1 for a in range(3)])
        rate = np.take(rate, low, axis) * (1 - share) + np.take(rate, low + 1, axis) * share
    half = data.tuning_deadzone.isel(controller=0).values
    setpoints = data.setpoint.values[[samples[0] for samples in _windows(data)]]
    away = np.abs(rate[None] - setpoints[:, None, None, :]) / half
    return np.nanmin(away.max(axis=-1), axis=(1, 2))
