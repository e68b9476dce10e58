"""Plans of a stored run and what their controller expected of them, from stored variables alone (figures 25, 26, 36-38).

The prediction is the controller's own (2.30), (2.31): the CVs that the run started from, the bias, what past moves
will still do, and what the planned moves will do.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import xarray as xr

from jaxmpc.check import require
from studies.store.reading import provenance

BREAK = 1.5  # sampling intervals between two samples from which on there is a gap


@dataclasses.dataclass(frozen=True, eq=False)
class StoredPlan:
    """What a controller planned at one time."""

    time: float  # when the plan was made [s]
    move: np.ndarray  # "sample mv", planned moves of the Hu samples, row 0 the move made at `time` [MV unit]
    mv: np.ndarray  # "sample mv", the MVs after each of these moves [MV unit]
    cv: np.ndarray  # "horizon cv", predicted CVs at 1..Hp samples after `time` [CV unit]
    dt: float  # sampling interval [s]

    @property
    def move_time(self) -> np.ndarray:
        """Start of each sample of `move` and `mv`, ``"sample"`` [s]."""
        return self.time + self.dt * np.arange(len(self.move))

    @property
    def cv_time(self) -> np.ndarray:
        """When each row of `cv` is expected to be measured, ``"horizon"`` [s]."""
        return self.time + self.dt * np.arange(1, len(self.cv) + 1)


def begins(data: xr.Dataset) -> np.ndarray:
    """Whether a sample is the first of a stretch without gaps, ``"sample"``: of a run, or of a log that was replayed."""
    return np.diff(data.time.values, prepend=-np.inf) > BREAK * float(data.attrs["dt"])


def plan_at(data: xr.Dataset, controller: str, time: float) -> StoredPlan:
    """The plan that a controller made at a time, with its prediction.

    Args:
        data: results from `studies.store.reading.open_results`.
        controller: name of a finished run.
        time: of the plan [s]; that of the sample that holds it counts.

    Raises:
        InputError: for an unknown or unfinished controller, a time outside the run, or one at which no plan was made.
    """
    run = _finished(data, controller)
    written = provenance(data, "definition")["controllers"]
    own: dict = next((entry for entry in written if entry["name"] == controller), {})
    other = own.get("schedule") or own.get("model")
    expected = (
        "one with the model of the process; those of a gain schedule and of a controller are not stored"
    )
    require(not other, "controller", controller, expected)
    dt = float(data.attrs["dt"])
    times = data.time.values
    k = int(np.searchsorted(times, time + 1e-9 * dt, side="right")) - 1 if np.isfinite(time) else -1
    require(
        k >= 0 and time < times[-1] + dt, "time", time, f"a time of the run, {times[0]:g} to {times[-1]:g} s"
    )
    move = _sample_moves(run, run.plan.values[k])
    expected = "a time at which a plan was made, not one at which a plan is carried out"
    require(not np.isnan(move).any(), "time", time, expected)
    horizon = int(run.prediction_horizon)
    steps = data.model_coefficient.values  # "cv mv lag", S(1)..S(N)
    begin = int(np.flatnonzero(begins(data)[: k + 1])[-1])  # a replay begins anew behind a gap of its log
    run, k = run.isel(time=slice(begin, None)), k - begin
    base = run.base.values[k] if "base" in run else run.measurement.values[0]
    made = run.move.values[:k]
    if "base" in run or own.get("position_feedback"):  # predictions are from where the MVs stood
        made = run.position.values[:k] - run.demand.values[:k] + made
    cv = base + run.bias.values[k] + np.zeros((horizon, 1))
    for i in np.flatnonzero(made.any(axis=1)).tolist():
        cv += _response(steps, made[i], horizon, k - i)
    if "dv" in run:  # what measured disturbances did is fed forward
        changes = np.diff(run.dv.values[: k + 1], axis=0, prepend=0.0)
        for i in np.flatnonzero(changes.any(axis=1)).tolist():
            cv += _response(data.dv_coefficient.values, changes[i], horizon, k - i)
    for i in np.flatnonzero(move.any(axis=1)).tolist():
        cv[i:] += _response(steps, move[i], horizon - i, 0)
    before = run.demand.values[k] - run.move.values[k]
    return StoredPlan(float(run.time.values[k]), move, before + np.cumsum(move, axis=0), cv, dt)


def _finished(data: xr.Dataset, controller: str) -> xr.Dataset:
    names = list(data.controller.values)
    finished = [name for name, done in zip(names, data.complete.values, strict=True) if done == 1]
    expected = f"a finished run: {', '.join(finished) or 'there is none'}"
    require(controller in finished, "controller", controller, expected)
    return data.isel(controller=names.index(controller))


def _sample_moves(run: xr.Dataset, blocks: np.ndarray) -> np.ndarray:
    """Moves of the Hu samples, ``"sample mv"``, from block moves ``"block mv"``; MVs may have blocks of their own."""
    lengths = np.broadcast_to(run.block_length.values.reshape(len(blocks), -1), blocks.shape)
    out = np.zeros((int(lengths[:, 0].sum()), blocks.shape[1]))
    for i, own in enumerate(lengths.T):
        if str(run.blocking.values) == "inputs":
            out[(np.cumsum(own) - own)[own > 0], i] = blocks[own > 0, i]
        else:  # a move is made again in every sample of its block
            out[:, i] = np.repeat(blocks[:, i], own)
    return out


def _response(steps: np.ndarray, move: np.ndarray, horizon: int, age: int) -> np.ndarray:
    """Effect ``"horizon cv"`` of a move made `age` samples ago, at 1..`horizon` samples from now; S(N+1) = S(N)."""
    lag = np.minimum(np.arange(age, age + horizon), steps.shape[2] - 1)
    return np.einsum("cmh,m->hc", steps[:, :, lag], move)
