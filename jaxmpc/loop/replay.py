"""A controller on logged data: at every sample what it would have advised, beside what was done.

The log is the plant, which does not listen: what was done enters the predictions as past moves, and every advice begins
where the actuators really stood (`Core.locate`). `studies.run.replay` reads logs and stores what `replay` gives.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.loop.host import REPORT, recorded, undisturbed
from jaxmpc.loop.trajectory import Trajectory

LEAST = 2  # rows of a stretch: one to begin with, and one that is decided


@dataclasses.dataclass(frozen=True)
class Done:
    """What a log tells a controller, row by row.

    Attributes:
        time: ``"row"`` [s].
        cv: ``"row cv"``, measured; not a number where nothing was [CV unit].
        setpoint: ``"row cv"`` [CV unit].
        mv: ``"row mv"``, held from this row to the next [MV unit].
        dv: ``"row dv"``, measured disturbances of the model; not a number where unchanged [DV unit].
        stretches: of rows one sampling interval apart; the controller begins anew at each.
    """

    time: Float[np.ndarray, " row"]
    cv: Float[np.ndarray, "row cv"]
    setpoint: Float[np.ndarray, "row cv"]
    mv: Float[np.ndarray, "row mv"]
    dv: Float[np.ndarray, "row dv"]
    stretches: Sequence[slice]

    @property
    def firsts(self) -> np.ndarray:
        """Rows at which stretches begin."""
        return np.array([own.start for own in self.stretches], dtype=int)

    @property
    def decided(self) -> np.ndarray:
        """Rows that are decided: all but the first of each stretch."""
        return np.concatenate([np.arange(own.start + 1, own.stop) for own in self.stretches])

    @property
    def begun(self) -> np.ndarray:
        """The first row of its stretch, for each row that is decided."""
        return np.concatenate([np.full(own.stop - own.start - 1, own.start) for own in self.stretches])


def replay(
    controller: Controller, done: Done, *, progress: Callable[[int, int], None] | None = None
) -> Trajectory:
    """What the controller would have advised at every sample, given what was done before.

    The first row of a stretch says where the plant stood, taken for a steady state. At each later row k the controller gets
    the CVs and disturbances of row k and the MVs of row k-1, where the actuators stand, and advises; row k then says what
    was done. Without a time limit the same rows give the same decisions, bit for bit.

    Args:
        controller: without a time limit.
        done: the log.
        progress: called with ``(done, total)`` samples.

    Returns:
        A sample per decided row: `mv` is what was done, `mv_demand` and `move` what was advised, from where the MVs stood;
        plans included.

    Raises:
        InputError: for a time limit, no stretch of two rows, values of MVs and setpoints that are not finite, and CVs that
            are not where a stretch begins.
    """
    if controller.time_limit is not None:
        raise InputError("time_limit", controller.time_limit, "None: decisions must not depend on a clock")
    if not done.stretches or min(own.stop - own.start for own in done.stretches) < LEAST:
        raise InputError("log", "no two rows in a row", f"stretches of {LEAST} rows or more")
    for name, values, names in (
        ("mv", done.mv, controller.structure.mv_names),
        ("cv", done.cv[done.firsts], controller.structure.cv_names),
    ):
        if not np.isfinite(values).all():
            raise InputError(f"log.{name}", "not a number", f"numbers for {', '.join(names)}")
    lanes, records, total = controller.lanes, [], len(done.decided)
    measured = bool(controller.model.dv_names)
    dv = lambda rows: rows[None] if measured else None  # noqa: E731
    with undisturbed():
        for own in done.stretches:
            first = own.start
            state = lanes.init(done.cv[first][None], done.mv[first][None], dv(np.nan_to_num(done.dv[first])))
            for k in range(first + 1, own.stop):
                told = done.cv[k][None], done.setpoint[k][None], done.mv[k - 1][None]
                if not records:
                    lanes.step(state, *told, dv=dv(done.dv[k]))  # compile before the clock starts
                state, info = lanes.step(state, *told, dv=dv(done.dv[k]))
                records.append({name: value[0] for name, value in recorded(told[0], state, info).items()})
                if progress is not None and (len(records) % REPORT == 0 or len(records) == total):
                    progress(len(records), total)
    fields = {name: np.stack([record[name] for record in records]) for name in records[0]}
    structure, rows = controller.structure, done.decided
    plan = fields.pop("plan")[:, : structure.block_count]
    return Trajectory(
        time=done.time[rows],
        setpoint=done.setpoint[rows],
        mv=done.mv[rows],
        **fields,
        plan=plan,
        cv_names=structure.cv_names,
        mv_names=structure.mv_names,
        cv_units=structure.cv_units,
        mv_units=structure.mv_units,
        dt=structure.dt,
    )
