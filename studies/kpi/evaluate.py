"""Key figures of stored results: `studies.kpi.loop` applied to every finished run of a comparison."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxmpc.errors import InputError
from studies.definition.presets import CHOKE, LIFT
from studies.kpi import loop as kpi

NEAR_CLOSED = 50.0  # % choke, the border in the thesis's statement on oscillation
ROUNDING = 1e-6  # of a value at its limit, relative to the distance between the limits


def completed(data: xr.Dataset) -> xr.Dataset:
    """The controllers whose runs are stored whole.

    Raises:
        InputError: if there is none.
    """
    rows = np.flatnonzero(data.complete.values == 1)
    if rows.size == 0:
        raise InputError("results", "no finished run", "one or more finished runs", "Run the study first")
    return data.isel(controller=rows)


# key figure: (its axes beside the controller, unit, what it is)
MEANINGS: dict[str, tuple[tuple[str, ...], str, str]] = {
    "choke_travel": ((), "%", "sum of absolute choke moves, actual position"),
    "choke_moves": ((), "1", "choke moves"),
    "choke_reversals": ((), "1", "choke reversals over the whole run"),
    "late_reversals": (("window",), "1", "choke reversals in the second half of each setpoint window"),
    "late_reversals_near_closed": ((), "1", "those of them below 50 % choke, all windows"),
    "mean_dwell": ((), "s", "mean time between successive choke moves"),
    "shortest_dwell": ((), "s", "shortest time between successive choke moves"),
    "lift_travel": ((), "m3/h", "sum of absolute moves of the lift"),
    "mean_absolute_deviation": (("cv",), "cv_unit", "mean of the absolute deviation from the setpoint"),
    "integral_absolute_error": (("cv",), "cv_unit s", "integral of the absolute deviation"),
    "time_outside_deadzone": (("cv",), "s", "time with a deviation beyond the deadzone"),
    "cv_violations": (("cv",), "samples", "samples with the CV outside its soft limits"),
    "mv_violations": (("mv",), "samples", "samples with the MV outside its limits"),
    "move_violations": (("mv",), "samples", "samples with a move outside its limits"),
    "largest_mean_opening": ((), "%/sample", "largest windowed mean of the demanded choke moves"),
    "mean_move_stops": ((), "1", "pauses of the opening under the mean-move limit"),
    "openings_above_limit": ((), "1", "openings although the windowed mean was above its limit"),
    "solve_time_median": ((), "s", "median time of one controller step"),
    "solve_time_p99": ((), "s", "99th percentile of the time of one controller step"),
    "solve_time_max": ((), "s", "longest controller step"),
    "largest_gap": ((), "1", "largest relative gap"),
    "not_optimal": ((), "samples", "samples whose solve did not end optimal"),
    "fallbacks": ((), "samples", "samples with the MVs held for want of a plan"),
    "bad_measurements": (("cv",), "samples", "measurements that were left out"),
    "wall_time": ((), "s", "time of the whole run"),
}


def key_figures(data: xr.Dataset) -> xr.Dataset:
    """Key figures of every finished run, with units; formulas in `studies.kpi.loop`.

    Args:
        data: results from `studies.store.comparison.open_results`.

    Returns:
        The variables of `MEANINGS` over ``controller`` and some over ``cv``, ``mv`` or ``window``.
    """
    data = completed(data).load()
    window = data.window.values
    windows = int(window.max()) + 1
    late = kpi.second_halves(window)
    choke, lift = (list(data.mv.values).index(name) for name in (CHOKE, LIFT))
    rows = []
    for i in range(data.sizes["controller"]):
        run = data.isel(controller=i)
        arrays = {name: run[name].values for name in INPUTS}
        row = _figures(
            arrays, late, sampling_interval(data), windows, run.mean_move_window.item(), choke, lift
        )
        rows.append(row | {"wall_time": run.wall_time.values})
    out = {}
    for key, (axes, unit, meaning) in MEANINGS.items():
        values = np.stack([np.asarray(row[key]) for row in rows])
        out[key] = xr.DataArray(
            values, dims=("controller", *axes), attrs={"units": unit, "long_name": meaning}
        )
    coords: dict = {name: data[name] for name in ("controller", "label", "cv", "mv", "cv_unit", "mv_unit")}
    starts = np.array([data.time.values[window == w][0] for w in range(windows)])
    coords["window"] = ("window", starts, {"long_name": "start of the setpoint window", "units": "s"})
    return xr.Dataset(out, coords)


INPUTS = (
    "measurement",
    "setpoint",
    "position",
    "demand",
    "move",
    "solve_time",
    "gap",
    "status",
    "fallback",
    "quality",
    "tuning_deadzone",
    "tuning_cv_low",
    "tuning_cv_high",
    "tuning_mv_low",
    "tuning_mv_high",
    "tuning_move_low",
    "tuning_move_high",
    "tuning_mean_move_limit",
)


@functools.partial(jax.jit, static_argnames=("windows", "span", "choke", "lift"))
def _figures(run: dict, late, dt: float, windows: int, span: int, choke: int, lift: int) -> dict:
    """The key figures of one run as arrays; `jax.vmap` over `run` does many."""
    position, y, r = run["position"][:, choke], run["measurement"], run["setpoint"]
    actual = kpi.moves_of(position, run["demand"][0, choke] - run["move"][0, choke])
    demanded = run["move"][:, choke]
    hunting = kpi.reversal_events(actual, segment=late)
    mean_dwell, shortest_dwell = kpi.dwell(actual, dt)
    times = kpi.solve_time_statistics(run["solve_time"])
    limit = run["tuning_mean_move_limit"][choke]

    def violations(value, kind):
        low, high = run[f"tuning_{kind}_low"], run[f"tuning_{kind}_high"]
        width = jnp.where(jnp.isfinite(high - low), high - low, 0.0)
        return kpi.limit_violations(value, low, high, ROUNDING * width)

    return {
        "choke_travel": kpi.travel(actual),
        "choke_moves": kpi.move_count(actual),
        "choke_reversals": kpi.reversal_events(actual).sum(),
        "late_reversals": kpi.count_by_segment(hunting, late, windows),
        "late_reversals_near_closed": (hunting & (position < NEAR_CLOSED)).sum(),
        "mean_dwell": mean_dwell,
        "shortest_dwell": shortest_dwell,
        "lift_travel": kpi.travel(run["move"][:, lift]),
        "mean_absolute_deviation": kpi.mean_absolute_deviation(y, r),
        "integral_absolute_error": kpi.integral_absolute_error(y, r, dt),
        "time_outside_deadzone": kpi.time_outside_deadzone(y, r, run["tuning_deadzone"], dt),
        "cv_violations": violations(y, "cv"),
        "mv_violations": violations(run["position"], "mv"),
        "move_violations": violations(run["move"], "move"),
        "largest_mean_opening": kpi.windowed_mean(demanded, span).max(),
        "mean_move_stops": kpi.mean_move_stops(demanded, span, limit),
        "openings_above_limit": kpi.opening_above_limit(demanded, span, limit),
        "solve_time_median": times[0],
        "solve_time_p99": times[1],
        "solve_time_max": times[2],
        "largest_gap": kpi.largest_gap(run["gap"]),
        "not_optimal": (run["status"] != 0).sum(),
        "fallbacks": (run["fallback"] != 0).sum(),
        "bad_measurements": (run["quality"] != 0).sum(axis=0),
    }


def sampling_interval(data: xr.Dataset) -> float:
    """Sampling interval of the results [s]."""
    return float(data.attrs["dt"])


def window_deviation(data: xr.Dataset, controller: str) -> np.ndarray:
    """Mean absolute deviation from the setpoint in every window, ``"window cv"`` [CV unit].

    Args:
        data: results.
        controller: name of a finished run.
    """
    run = data.sel(controller=controller)
    away = np.abs(run.measurement.values - run.setpoint.values)
    window = data.window.values
    return np.array([away[window == w].mean(axis=0) for w in range(int(window.max()) + 1)])


def final_deviation(data: xr.Dataset, controller: str) -> np.ndarray:
    """Mean deviation over the last quarter of every window, in deadzone half widths.

    Args:
        data: results.
        controller: name of a finished run.

    Returns:
        ``"window cv"``: signed, measured minus setpoint over deadzone; a swing around the setpoint cancels.
    """
    run = data.sel(controller=controller)
    window = data.window.values
    scaled = (run.measurement.values - run.setpoint.values) / run.tuning_deadzone.values
    out = []
    for w in range(int(window.max()) + 1):
        samples = np.flatnonzero(window == w)
        out.append(scaled[samples[(3 * len(samples)) // 4 :]].mean(axis=0))
    return np.array(out)


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
    first = [
        int(np.flatnonzero(data.window.values == w)[0]) for w in range(int(data.window.values.max()) + 1)
    ]
    setpoints = data.setpoint.values[first]
    away = np.abs(rate[None] - setpoints[:, None, None, :]) / half
    return np.nanmin(away.max(axis=-1), axis=(1, 2))
