"""Key figures of stored results: `studies.kpi` applied to every finished run of a comparison."""

from __future__ import annotations

import numpy as np
import xarray as xr

from jaxmpc.errors import InputError
from studies import kpi
from studies.presets import CHOKE, LIFT

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


def key_figures(data: xr.Dataset) -> xr.Dataset:
    """Key figures of every finished run, with units; definitions in `studies.kpi`.

    Args:
        data: results from `studies.store.open_results`.

    Returns:
        Variables over ``controller`` and, where they have one, ``cv``, ``mv`` or ``window``.
    """
    data = completed(data).load()
    dt = sampling_interval(data)
    window = data.window.values
    windows = int(window.max()) + 1
    late = kpi.second_halves(window)
    rows = []
    for name in data.controller.values:
        run = data.sel(controller=name)
        choke = run.position.sel(mv=CHOKE).values
        first = run.demand.sel(mv=CHOKE).values[0] - run.move.sel(mv=CHOKE).values[0]
        choke_move = kpi.moves_of(choke, first)
        demand_move = run.move.sel(mv=CHOKE).values
        y, r = run.measurement.values, run.setpoint.values
        reversal = kpi.reversal_events(choke_move)
        hunting = kpi.reversal_events(choke_move, segment=late)
        mean_dwell, shortest_dwell = kpi.dwell(choke_move, dt)
        times = kpi.solve_time_statistics(run.solve_time.values)
        span = run.mean_move_window.item()
        tolerance = {kind: ROUNDING * _span(run, kind) for kind in ("cv", "mv", "move")}
        rows.append(
            {
                "choke_travel": ((), kpi.travel(choke_move), "%"),
                "choke_moves": ((), kpi.move_count(choke_move), "1"),
                "choke_reversals": ((), reversal.sum(), "1"),
                "late_reversals": (("window",), kpi.count_by_segment(hunting, late, windows), "1"),
                "late_reversals_near_closed": ((), (hunting & (choke < NEAR_CLOSED)).sum(), "1"),
                "mean_dwell": ((), mean_dwell, "s"),
                "shortest_dwell": ((), shortest_dwell, "s"),
                "lift_travel": ((), kpi.travel(run.move.sel(mv=LIFT).values), "m3/h"),
                "mean_absolute_deviation": (("cv",), kpi.mean_absolute_deviation(y, r), "cv_unit"),
                "integral_absolute_error": (("cv",), kpi.integral_absolute_error(y, r, dt), "cv_unit s"),
                "time_outside_deadzone": (
                    ("cv",),
                    kpi.time_outside_deadzone(y, r, run.tuning_deadzone.values, dt),
                    "s",
                ),
                "cv_violations": (
                    ("cv",),
                    kpi.limit_violations(
                        y, run.tuning_cv_low.values, run.tuning_cv_high.values, tolerance["cv"]
                    ),
                    "samples",
                ),
                "mv_violations": (
                    ("mv",),
                    kpi.limit_violations(
                        run.position.values,
                        run.tuning_mv_low.values,
                        run.tuning_mv_high.values,
                        tolerance["mv"],
                    ),
                    "samples",
                ),
                "move_violations": (
                    ("mv",),
                    kpi.limit_violations(
                        run.move.values,
                        run.tuning_move_low.values,
                        run.tuning_move_high.values,
                        tolerance["move"],
                    ),
                    "samples",
                ),
                "largest_mean_opening": ((), kpi.windowed_mean(demand_move, span).max(), "%/sample"),
                "mean_move_stops": (
                    (),
                    kpi.mean_move_stops(demand_move, span, run.tuning_mean_move_limit.sel(mv=CHOKE).item()),
                    "1",
                ),
                "openings_above_limit": (
                    (),
                    kpi.opening_above_limit(
                        demand_move, span, run.tuning_mean_move_limit.sel(mv=CHOKE).item()
                    ),
                    "1",
                ),
                "solve_time_median": ((), times[0], "s"),
                "solve_time_p99": ((), times[1], "s"),
                "solve_time_max": ((), times[2], "s"),
                "largest_gap": ((), kpi.largest_gap(run.gap.values), "1"),
                "not_optimal": ((), (run.status.values != 0).sum(), "samples"),
                "fallbacks": ((), (run.fallback.values != 0).sum(), "samples"),
                "wall_time": ((), run.wall_time.item(), "s"),
            }
        )
    out = {}
    for key, (dims, _, unit) in rows[0].items():
        values = np.stack([np.asarray(row[key][1]) for row in rows])
        out[key] = xr.DataArray(values, dims=("controller", *dims), attrs={"units": unit})
    coords = {name: data[name] for name in ("controller", "label", "cv", "mv", "cv_unit", "mv_unit")}
    starts = np.array([data.time.values[window == w][0] for w in range(windows)])
    coords["window"] = ("window", starts, {"long_name": "start of the setpoint window", "units": "s"})
    return xr.Dataset(out, coords)


def sampling_interval(data: xr.Dataset) -> float:
    """Sampling interval of the results [s]."""
    return float(data.attrs["dt"])


def _span(run: xr.Dataset, kind: str) -> np.ndarray:
    """Distance between the limits of a kind, 0 where one is infinite."""
    span = run[f"tuning_{kind}_high"].values - run[f"tuning_{kind}_low"].values
    return np.where(np.isfinite(span), span, 0.0)


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
