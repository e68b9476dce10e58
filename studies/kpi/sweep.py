"""Key figures of sweep scenarios: `studies.kpi.loop` and `studies.kpi.setpoint` on every lane of a chunk at once.

`run_kpis` is pure and has fixed shapes; `batch_kpis` compiles it once per number of lanes and samples. `kpis_of` names every
figure with its unit and formula, in the notation of `kpi.loop`; docs/kpis.md explains them. Everything is a float, so
that a run whose numbers are not all finite can answer NaN instead of looking good.
"""

from __future__ import annotations

import dataclasses
import functools
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
from jaxmpc.process.process import Process
from jaxmpc.status import OPTIMAL
from studies.kpi import loop as kpi
from studies.kpi import setpoint as kpi_setpoint

ROUNDING = 1e-6  # of a value at its limit, relative to the distance between the limits
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
    Kpi("travel", "sum of absolute moves, actual position", "mv_unit", "sum_k abs(m[k])", MV),
    Kpi("moves", "moves", "1", "count_k(abs(m[k]) > smallest move)", MV),
    Kpi("reversals", "moves against the move before", "1", "count_n(m[n] m[n-1] < 0)", MV),
    Kpi(
        "hunting_reversals",
        "reversals in the second halves of the setpoint windows",
        "1",
        "count_n(m[n] m[n-1] < 0, both late in one window)",
        MV,
    ),
    Kpi("mean_dwell", "mean time between successive moves", "s", "mean_n(t[n] - t[n-1])", MV),
    Kpi("shortest_dwell", "shortest time between successive moves", "s", "min_n(t[n] - t[n-1])", MV),
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


class Integral(NamedTuple):
    """A key figure of a process: the integral of a CV or MV over the run; static."""

    name: str
    of: str  # cv or mv
    at: int  # position among them
    per: float  # seconds of the time unit in the unit of the rate


class Measures(NamedTuple):
    """What key figures need of a process."""

    smallest_move: Any  # "mv", what counts as a move is larger [MV unit]
    integrals: tuple[Integral, ...]  # static


def kpis_of(process: Process) -> tuple[Kpi, ...]:
    """Every key figure of a process: those of every process, and its own integrals before the ones of the steps."""
    own = [
        Kpi(figure.name, figure.label, figure.unit, f"dt / {figure.per:g} sum_k {figure.integral_of}[k]")
        for figure in process.key_figures
    ]
    at = [item.name for item in KPIS].index("objective")
    return (*KPIS[:at], *own, *KPIS[at:])


def measures_of(process: Process) -> Measures:
    """What key figures need of a process."""
    integrals = []
    for figure in process.key_figures:
        of = "cv" if figure.integral_of in process.cv_names else "mv"
        names = process.cv_names if of == "cv" else process.mv_names
        integrals.append(Integral(figure.name, of, names.index(figure.integral_of), figure.per))
    return Measures(np.array([mv.smallest_move for mv in process.mvs]), tuple(integrals))


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
    run: Run,
    tuning: Tuned,
    tolerance: Float[Array, " cv"],
    dt: float,
    smallest_move: Float[Array, " mv"],
    integrals: tuple[Integral, ...] = (),
) -> dict[str, Array]:
    """Key figures of one run.

    Args:
        run: one lane.
        tuning: of its controller; what counts as outside the deadzone or a limit, and the weights of the cost.
        tolerance: half width around the setpoint in which a CV counts as settled [CV unit].
        dt: sampling interval [s].
        smallest_move: what counts as a move is larger [MV unit].
        integrals: of `Measures`; static under `jax.jit`.

    Returns:
        Every name of `kpis_of`, in that order, as floats of its dims. If a CV, setpoint or MV of any sample is not
        finite, all but `ALWAYS` are NaN.
    """
    y, r = run.cv, run.setpoint
    moves = jax.vmap(kpi.moves_of, in_axes=(1, 0), out_axes=1)(run.mv, run.mv_demand[0] - run.move[0])
    start, end = kpi_setpoint.window_bounds(run.window)
    change = kpi_setpoint.setpoint_change(y, r, tolerance, start)
    settled = kpi_setpoint.settling(y, r, change, tolerance, (start, end), dt)
    late = kpi_setpoint.late_segment(start, end)

    def worn(move, smallest):
        mean_dwell, shortest_dwell = kpi.dwell(move, dt, smallest)
        return {
            "travel": kpi.travel(move),
            "moves": kpi.move_count(move, smallest),
            "reversals": kpi.reversal_events(move, smallest).sum(),
            "hunting_reversals": kpi.reversal_events(move, smallest, segment=late).sum(),
            "mean_dwell": mean_dwell,
            "shortest_dwell": shortest_dwell,
        }

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
        **jax.vmap(worn, in_axes=(1, 0))(moves, smallest_move),
        **{i.name: kpi.integral(getattr(run, i.of)[:, i.at], dt, i.per) for i in integrals},
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


def batch_kpis(
    batch: TrajectoryBatch, tunings: Tuning, window, measures: Measures, *, tolerance=None
) -> dict[str, np.ndarray]:
    """Key figures of every run of a batch; padding lanes are computed like the others, leaving them out is the caller's.

    Args:
        batch: with at least the fields `RECORD`, from the start of the runs, so that the position before the first
            sample is where the run began.
        tunings: one per lane of the batch (`jaxmpc.problem.tuning.stack_tunings`), or one for all.
        window: labels of the setpoint windows, ``"sample"`` or ``"lane sample"``, such as
            `jaxmpc.process.reference.Reference.window` gives.
        measures: from `measures_of`.
        tolerance: half width around the setpoint in which a CV counts as settled, ``"cv"`` or ``"lane cv"``
            [CV unit]; the deadzone of each lane if not given. Give one where scenarios differ in their deadzone.

    Returns:
        Every name of `kpis_of`, ``"lane"``, ``"lane cv"`` or ``"lane mv"``.

    Raises:
        InputError: for fields that were not recorded, or wrong shapes.
    """
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
    figures = _batched(runs, each, allowed, np.float64(batch.dt), measures.smallest_move, measures.integrals)
    names = [item.name for item in KPIS]
    order = [
        *names[: names.index("objective")],
        *(i.name for i in measures.integrals),
        *names[names.index("objective") :],
    ]
    return {name: np.array(figures[name]) for name in order}


def _per_lane(field: str, given, lanes: int, size: tuple[int, ...]) -> Any:
    """One value of the given size for each lane, from one per lane or one for all."""
    value = np.asarray(given)
    if value.shape not in (size, (lanes, *size)):
        expected = f"shape {[lanes, *size]}, one per lane, or {list(size)} for all"
        raise InputError(field, f"shape {list(value.shape)}", expected)
    return np.broadcast_to(value, (lanes, *size))


@functools.partial(jax.jit, static_argnames="integrals")
def _batched(runs, tunings, tolerance, dt, smallest_move, integrals):
    figures = functools.partial(run_kpis, integrals=integrals)
    return jax.vmap(figures, in_axes=(0, 0, 0, None, None))(runs, tunings, tolerance, dt, smallest_move)
