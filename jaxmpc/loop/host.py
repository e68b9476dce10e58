"""A closed loop that asks the host at every sample: for plants outside JAX, and plans that are carried out.

`loop.simulate` is the only caller.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from jaxmpc.controller.core import ControllerState, StepInfo
from jaxmpc.controller.measurement import received
from jaxmpc.controller.sample import Sample
from jaxmpc.loop.compiled import Inputs
from jaxmpc.loop.events import Stage
from jaxmpc.loop.interventions import CarriedOut

REPORT = 20  # samples between two progress reports


def simulate_on_host(
    controllers: Any,
    plant: Any,
    inputs: Inputs,
    stages: Sequence[Stage],
    blind: int | None,
    progress: Callable[[int, int], None] | None,
) -> dict[str, np.ndarray]:
    """One closed loop; fields of `Trajectory`.

    Args:
        controllers: a single one that steps like `Batch`, in the first stage.
        stages: what holds from which sample on, where there are events.
        blind: sample whose plan is carried out without feedback; None for none.
        progress: called with ``(done, total)`` samples.
    """
    setpoints, offsets, errors, faults = (v[0] for v in inputs[:4])
    told, total, named = bool(inputs.told[0]), len(setpoints), hasattr(plant, "disturbance_names")
    future = controllers.size.future if inputs.preview else 1
    beyond = lambda v: np.concatenate([v, np.repeat(v[-1:], future, axis=0)])  # noqa: E731
    references, dvs = beyond(setpoints), beyond(inputs.dv[0])
    ahead = int(inputs.preview)  # the setpoint of the sample itself where no other is told
    outputs = plant.init()
    now, mv = np.asarray(outputs.cv), np.asarray(outputs.mv)
    unknown, manual = np.full_like(mv, np.nan), np.zeros(len(mv), dtype=bool)
    state = controllers.init(now[None], mv[None])
    first = _sample(now, now[None], unknown, manual, dvs[:future])
    controllers.decide(state, first)  # compile before the clock starts
    entered = {stage.first: stage for stage in stages}
    tuning = stages[0].tuning if stages else None
    records: list[dict[str, Any]] = []
    carried = None
    with _undisturbed():
        for k in range(total):
            cv = np.asarray(outputs.cv) + errors[k]
            if k in entered:
                stage = entered[k]
                if stage.tuning is not tuning:
                    controllers = controllers.of(controllers.scenarios.with_tunings([stage.tuning]))
                tuning, manual = stage.tuning, stage.manual
            if carried is None or blind is None:
                arrived = received(cv, faults[k], np.asarray(state.sensors.value)[0])
                stands = np.asarray(outputs.mv) if told else unknown
                wanted = references[k + ahead : k + ahead + future]
                sample = _sample(arrived, wanted, stands, manual, dvs[k : k + future])
                state, info = controllers.decide(state, sample)
                record = _record(cv, state, info)
                carried = CarriedOut(controllers.structure, record) if k == blind else None
            else:
                record = carried.record(k - blind, cv)
            outputs = plant.step(record["mv_demand"], offsets[k] if named else float(offsets[k, 0]))
            records.append(record | {"mv": np.asarray(outputs.mv)})
            if progress is not None and ((k + 1) % REPORT == 0 or k + 1 == total):
                progress(k + 1, total)
    return {name: np.stack([record[name] for record in records]) for name in records[0]}


def _sample(
    cv: np.ndarray, setpoint: np.ndarray, mv: np.ndarray, manual: np.ndarray, dv: np.ndarray
) -> Sample:
    """Of one lane, with its axis."""
    return Sample(cv[None], setpoint[None], mv[None], manual[None], dv[None] if dv.size else None)


def _record(cv: np.ndarray, state: ControllerState, info: StepInfo) -> dict[str, Any]:
    """What a sample leaves behind, by the names of `Trajectory`."""
    found = {f.name: getattr(info, f.name) for f in dataclasses.fields(info) if f.name != "recovering"}
    found |= dict(
        mv_demand=found.pop("mv"), plan=found.pop("moves"), bias=state.bias, bias_raw=state.bias_raw
    )
    return {"cv": cv} | {name: np.asarray(value)[0] for name, value in found.items()}


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """No search for garbage among what is there already: compiled programs would keep it busy for a fifth of a second."""
    if gc.get_freeze_count():  # the caller's business
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
