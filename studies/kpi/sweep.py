"""Key figures of sweep scenarios: `studies.kpi.loop` and `studies.kpi.setpoint` on every lane of a chunk at once.

`run_kpis` is pure and has fixed shapes; `batch_kpis` compiles it once per number of lanes and samples. `KPIS`
names every figure with its unit and formula, in the notation of `kpi.loop`; docs/kpis.md explains them. Everything is a
float, so that a run whose numbers are not all finite can answer NaN instead of looking good.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmpc.controller.measurement import GOOD
from jaxmpc.errors import InputError
from jaxmpc.loop.trajectory import TrajectoryBatch
from jaxmpc.problem.tuning import Tuning
from jaxmpc.process.well.equations import CV_NAMES, MV_NAMES
from jaxmpc.status import OPTIMAL
from studies.kpi import loop as kpi
from studies.kpi import setpoint as kpi_setpoint

ROUNDING = 1e-6  # of a value at its limit, relative to the distance between the limits
RATE_UNIT = "m3/h"  # of what is integrated to a volume
_NUMBERS = ("cv", "mv", "mv_demand", "move", "objective", "gap", "solve_time")
RECORD = (*_NUMBERS, "status", "fallback", "quality", "off")  # fields of `Trajectory` that key figures need


@dataclasses.dataclass(frozen=True)
class Kpi:
    """What one key figure is.

    Attributes:
        name: key of the results of `run_kpis`, name of the stored variable.
        long_name: in words.
        unit: ``1`` without; ``cv_unit`` and ``mv_unit`` stand for the unit of the channel, see `unit_of`.
        formula: in the notation of `studies.kpi.loop`, for docs and attributes.
        dims: axes beside the scenario: none, ``("cv",)`` or ``("mv",)``.
    """

    name: str
    long_name: str
    unit: str
    formula: str
    dims: tuple[str, ...] = ()

    def unit_of(self, channel_unit: str) -> str:
        """The unit with that of the channel filled in; a fraction ``a/b`` is put in brackets before a product."""
        factor = f"({channel_unit})" if "/" in channel_unit and " " in self.unit else channel_unit
        return self.unit.replace("cv_unit", factor).replace("mv_unit", factor)


CV, MV = ("cv",), ("mv",)

KPIS: tuple[Kpi, ...] = (
    Kpi("iae", "integral of the absolute deviation", "cv_unit s", "dt sum_k e[k]", CV),
    Kpi("mean_absolute_deviation", "mean absolute deviation from the setpoint", "cv_unit", "mean_k e[k]", CV),
    Kpi(
        "time_outside_deadzone", "time with a deviation beyond the deadzone", "s", "dt count_k(e[k] > c)", CV
    ),
    Kpi(
        "setpoint_changes", "windows that begin with a change of the setpoint", "1", "count_w(d[w] != 0)", CV
    ),
    Kpi(
        "overshoot",
        "largest excursion beyond a new setpoint",
        "cv_unit",
        "max_w max_k max(sign(d[w]) (y[k] - r[k]), 0)",
        CV,
    ),
    Kpi("settling_time_mean", "mean settling time after setpoint changes", "s", "mean_w T[w]", CV),
    Kpi("settling_time_max", "longest settling time after a setpoint change", "s", "max_w T[w]", CV),
    Kpi(
        "unsettled_windows",
        "windows after a setpoint change that end unsettled",
        "1",
        "count_w(e[b] > tol)",
        CV,
    ),
    Kpi(
        "cv_violations",
        "samples with the CV outside its soft limits",
        "samples",
        "count_k(x[k] > 1e-6 width)",
        CV,
    ),
    Kpi("cv_largest_excess", "largest excess of the CV over its soft limits", "cv_unit", "max_k x[k]", CV),
    Kpi(
        "mv_violations", "samples with the MV outside its limits", "samples", "count_k(x[k] > 1e-6 width)", MV
    ),
    Kpi("mv_largest_excess", "largest excess of the MV over its limits", "mv_unit", "max_k x[k]", MV),
    Kpi("choke_travel", "sum of absolute choke moves, actual position", "%", "sum_k abs(m[k])"),
    Kpi("choke_moves", "choke moves", "1", "count_k(abs(m[k]) > 0.05 %)"),
    Kpi("choke_reversals", "choke moves against the move before", "1", "count_n(m[n] m[n-1] < 0)"),
    Kpi(
        "hunting_reversals",
        "choke reversals in the second halves of the setpoint windows",
        "1",
        "count_n(m[n] m[n-1] < 0, both late in one window)",
    ),
    Kpi("mean_dwell", "mean time between successive choke moves", "s", "mean_n(t[n] - t[n-1])"),
    Kpi("shortest_dwell", "shortest time between successive choke moves", "s", "min_n(t[n] - t[n-1])"),
    Kpi("lift_travel", "sum of absolute moves of the lift", "m3/h", "sum_k abs(m[k])"),
    Kpi("lift_volume", "lift gas asked for", "m3", "dt / 3600 sum_k u[k]"),
    Kpi("oil_produced", "oil produced", "m3", "dt / 3600 sum_k y[k]"),
    Kpi("gas_produced", "gas produced, lift gas included", "m3", "dt / 3600 sum_k y[k]"),
    Kpi("objective", "mean objective of the applied plans", "1", "mean_k J[k]"),
    Kpi(
        "closed_loop_cost",
        "tracking and move cost of the realised run, per sample",
        "1",
        "mean_k (sum_cv (Q e^2 + S h^2 + s h) + sum_mv P m^2)",
    ),
    Kpi("solve_time_median", "median time of one controller step", "s", "median_k tau[k]"),
    Kpi("solve_time_p99", "99th percentile of the time of one controller step", "s", "p99_k tau[k]"),
    Kpi("solve_time_max", "longest controller step", "s", "max_k tau[k]"),
    Kpi("largest_gap", "largest relative gap", "1", "max_k g[k]"),
    Kpi("not_optimal", "samples whose solve did not end optimal", "samples", "count_k(status[k] != 0)"),
    Kpi("fallbacks", "samples with the MVs held for want of a plan", "samples", "count_k(fallback[k])"),
    Kpi("bad_measurements", "measurements that were left out", "samples", "count_k(quality[k] != 0)", CV),
    Kpi(
        "switched_off",
        "samples with the CV switched off after bad measurements",
        "samples",
        "count_k(off[k])",
        CV,
    ),
    Kpi("finite", "1 if the run is complete: every CV and MV is finite", "1", "all_k finite(y, r, u, m)"),
)

# the last ones are about the steps and known also of a run whose numbers are not all finite, where all others are NaN
ALWAYS = tuple(item.name for item in KPIS[-9:])


class Run(NamedTuple):
    """One run as arrays, fields as in `jaxmpc.loop.trajectory.Trajectory`; `runs_of` gives many, lanes first."""

    cv: Any  # "sample cv"
    setpoint: Any  # "sample cv"
    mv: Any  # "sample mv", position of the actuators
    mv_demand: Any  # "sample mv"
    move: Any  # "sample mv", demand minus previous demand
    window: Any  # "sample", label of the setpoint window
    objective: Any  # "sample", of the applied plan, NaN where there was none
    gap: Any  # "sample", NaN where there was no plan
    solve_time: Any  # "sample" [s]
    optimal: Any  # "sample", whether the solve ended optimal
    fallback: Any  # "sample", whether the MVs were held
    left_out: Any  # "sample cv", whether the measurement was bad
    off: Any  # "sample cv", whether the CV was switched off


class Tuned(NamedTuple):
    """What key figures need of a tuning, fields as in `jaxmpc.problem.tuning.Tuning`: `PER_CV` ``"cv"``, others ``"mv"``."""

    cv_weight: Any
    soft_quadratic: Any
    soft_linear: Any
    deadzone: Any
    cv_low: Any
    cv_high: Any
    move_weight: Any
    mv_low: Any
    mv_high: Any
    move_low: Any
    move_high: Any
    mean_move_limit: Any


PER_CV = Tuned._fields[:6]
WEIGHTS = "cv_weight", "soft_quadratic", "soft_linear", "deadzone", "move_weight"  # of the closed-loop cost


class Channels(NamedTuple):
    """Positions of the well's MVs and CVs; static."""

    choke: int
    lift: int
    gas: int
    oil: int


def channels_of(batch: TrajectoryBatch) -> Channels:
    """Where the MVs and CVs of the well are in a batch, by name.

    Raises:
        InputError: if one is missing, or a rate is not in m3/h.
    """
    found = []
    for key, wanted in (("mv", MV_NAMES), ("cv", CV_NAMES)):
        names, units = getattr(batch, f"{key}_names"), getattr(batch, f"{key}_units")
        for name in wanted:
            if name not in names:
                expected = f"the well's {key.upper()} {name!r} among them"
                raise InputError(f"batch.{key}_names", list(names), expected)
            at = names.index(name)
            if name != MV_NAMES[0] and units[at] != RATE_UNIT:
                raise InputError(f"batch.{key}_units[{at}]", units[at], f"{RATE_UNIT!r}, the unit of {name}")
            found.append(at)
    return Channels(*found)


def runs_of(batch: TrajectoryBatch, window) -> Run:
    """The runs of a batch as NumPy arrays with the lane axis first.

    Args:
        batch: with at least the fields `RECORD`.
        window: labels of the setpoint windows, ``"sample"`` or ``"lane sample"``.

    Raises:
        InputError: for a field that was not recorded, or labels of another shape or type.
    """
    shape = (len(batch), len(batch.time))
    labels = np.asarray(window)
    if labels.shape not in (shape, shape[1:]) or not np.issubdtype(labels.dtype, np.integer):
        expected = f"whole numbers, one per sample [{shape[1]}] or per lane and sample {list(shape)}"
        raise InputError("window", f"{labels.dtype} of shape {list(labels.shape)}", expected)
    fields = {name: batch[name] for name in RECORD}
    return run_of(fields, batch.setpoint, np.broadcast_to(labels.astype(np.int32), shape))


def run_of(fields: Mapping[str, Any], setpoint, window) -> Run:
    """A run, or many with the lane axis first, from the fields `RECORD` of `Trajectory`."""
    return Run(
        **{key: np.asarray(fields[key], dtype=np.float64) for key in _NUMBERS},
        setpoint=np.asarray(setpoint, dtype=np.float64),
        window=window,
        optimal=np.asarray(fields["status"]) == OPTIMAL,
        fallback=np.asarray(fields["fallback"]) != 0,
        left_out=np.asarray(fields["quality"]) != GOOD,
        off=np.asarray(fields["off"]) != 0,
    )


def run_kpis(
    run: Run, tuning: Tuned, tolerance: Float[Array, " cv"], dt: float, channels: Channels
) -> dict[str, Array]:
    """Key figures of one run.

    Args:
        run: one lane.
        tuning: of its controller; what counts as outside the deadzone or a limit, and the weights of the cost.
        tolerance: half width around the setpoint in which a CV counts as settled [CV unit].
        dt: sampling interval [s].
        channels: from `channels_of`; static under `jax.jit`.

    Returns:
        Every name of `KPIS`, in that order, as floats of its dims. If a CV, setpoint or MV of any sample is not
        finite, all but `ALWAYS` are NaN.
    """
    y, r = run.cv, run.setpoint
    moves = jax.vmap(kpi.moves_of, in_axes=(1, 0), out_axes=1)(run.mv, run.mv_demand[0] - run.move[0])
    choke, lift = moves[:, channels.choke], moves[:, channels.lift]
    start, end = kpi_setpoint.window_bounds(run.window)
    change = kpi_setpoint.setpoint_change(y, r, tolerance, start)
    settled = kpi_setpoint.settling(y, r, change, tolerance, (start, end), dt)
    hunting = kpi.reversal_events(choke, segment=kpi_setpoint.late_segment(start, end))
    mean_dwell, shortest_dwell = kpi.dwell(choke, dt)
    cv_limits = y, tuning.cv_low, tuning.cv_high, rounding(tuning.cv_low, tuning.cv_high)
    mv_limits = run.mv, tuning.mv_low, tuning.mv_high, rounding(tuning.mv_low, tuning.mv_high)
    times = kpi.solve_time_statistics(run.solve_time)
    finite = jnp.stack([jnp.isfinite(part).all() for part in (y, r, run.mv, run.mv_demand, run.move)]).all()
    figures = {
        "iae": kpi.integral_absolute_error(y, r, dt),
        "mean_absolute_deviation": kpi.mean_absolute_deviation(y, r),
        "time_outside_deadzone": kpi.time_outside_deadzone(y, r, tuning.deadzone, dt),
        "setpoint_changes": settled.changes,
        "overshoot": kpi_setpoint.overshoot(y, r, change),
        "settling_time_mean": settled.mean,
        "settling_time_max": settled.longest,
        "unsettled_windows": settled.unsettled,
        "cv_violations": kpi.limit_violations(*cv_limits),
        "cv_largest_excess": kpi.largest_excess(*cv_limits),
        "mv_violations": kpi.limit_violations(*mv_limits),
        "mv_largest_excess": kpi.largest_excess(*mv_limits),
        "choke_travel": kpi.travel(choke),
        "choke_moves": kpi.move_count(choke),
        "choke_reversals": kpi.reversal_events(choke).sum(),
        "hunting_reversals": hunting.sum(),
        "mean_dwell": mean_dwell,
        "shortest_dwell": shortest_dwell,
        "lift_travel": kpi.travel(lift),
        "lift_volume": kpi.volume(run.mv[:, channels.lift], dt),
        "oil_produced": kpi.volume(y[:, channels.oil], dt),
        "gas_produced": kpi.volume(y[:, channels.gas], dt),
        "objective": run.objective.mean(),
        "closed_loop_cost": kpi.closed_loop_cost(
            y, r, moves, **{name: getattr(tuning, name) for name in WEIGHTS}
        ),
        "solve_time_median": times[0],
        "solve_time_p99": times[1],
        "solve_time_max": times[2],
        "largest_gap": kpi.largest_gap(run.gap),
        "not_optimal": (~run.optimal).sum(),
        "fallbacks": run.fallback.sum(),
        "bad_measurements": run.left_out.sum(axis=0),
        "switched_off": run.off.sum(axis=0),
        "finite": finite,
    }
    return {
        name: jnp.where(finite | (name in ALWAYS), jnp.asarray(value, dtype=jnp.float64), jnp.nan)
        for name, value in figures.items()
    }


def rounding(low, high):
    """How far beyond a limit is still at the limit."""
    width = high - low
    return ROUNDING * jnp.where(jnp.isfinite(width), width, 0.0)


def batch_kpis(batch: TrajectoryBatch, tunings: Tuning, window, *, tolerance=None) -> dict[str, np.ndarray]:
    """Key figures of every run of a batch; padding lanes are computed like the others, leaving them out is the caller's.

    Args:
        batch: with at least the fields `RECORD`, from the start of the runs, so that the position before the first
            sample is where the run began.
        tunings: one per lane of the batch (`jaxmpc.problem.tuning.stack_tunings`), or one for all.
        window: labels of the setpoint windows, ``"sample"`` or ``"lane sample"``, such as
            `jaxmpc.process.reference.Reference.window` gives.
        tolerance: half width around the setpoint in which a CV counts as settled, ``"cv"`` or ``"lane cv"``
            [CV unit]; the deadzone of each lane if not given. Give one where scenarios differ in their deadzone.

    Returns:
        Every name of `KPIS`, ``"lane"``, ``"lane cv"`` or ``"lane mv"``.

    Raises:
        InputError: for MVs or CVs that are not the well's, fields that were not recorded, or wrong shapes.
    """
    channels = channels_of(batch)
    runs = runs_of(batch, window)
    lanes, cvs, mvs = len(batch), len(batch.cv_names), len(batch.mv_names)
    sizes = {name: (cvs if name in PER_CV else mvs,) for name in Tuned._fields}
    each = Tuned(
        *(_per_lane(f"tunings.{name}", getattr(tunings, name), lanes, size) for name, size in sizes.items())
    )
    allowed = each.deadzone
    if tolerance is not None:
        allowed = _per_lane("tolerance", np.asarray(tolerance, dtype=np.float64), lanes, (cvs,))
        if not (allowed >= 0).all():
            raise InputError("tolerance", tolerance, "half widths, 0 or more [CV unit]")
    figures = _batched(runs, each, allowed, np.float64(batch.dt), channels)
    return {item.name: np.array(figures[item.name]) for item in KPIS}


def _per_lane(field: str, given, lanes: int, size: tuple[int, ...]) -> Any:
    """One value of the given size for each lane, from one per lane or one for all."""
    value = np.asarray(given)
    if value.shape not in (size, (lanes, *size)):
        expected = f"shape {[lanes, *size]}, one per lane, or {list(size)} for all"
        raise InputError(field, f"shape {list(value.shape)}", expected)
    return np.broadcast_to(value, (lanes, *size))


_batched = jax.jit(jax.vmap(run_kpis, in_axes=(0, 0, 0, None, None)), static_argnames="channels")
