"""How the fields of a `Trajectory` are stored, in sweeps and in comparisons."""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxmpc.loop.trajectory import Trajectory
from studies.store.layout import FLAG, Variable

_CV, _MV, _TIME = ("time", "cv"), ("time", "mv"), ("time",)

# by field of `Trajectory`; codes are -1 before they are computed
TRAJECTORIES: dict[str, Variable] = {
    "cv": Variable("measurement", "measured CV at the start of the sample", "cv_unit", _CV),
    "setpoint": Variable("setpoint", "setpoint", "cv_unit", _CV),
    "mv_demand": Variable("demand", "MV demanded by the controller", "mv_unit", _MV),
    "mv": Variable("position", "MV after the actuator", "mv_unit", _MV),
    "move": Variable("move", "move of the demand", "mv_unit", _MV),
    "bias": Variable("bias", "filtered output bias v(k|k)", "cv_unit", _CV),
    "bias_raw": Variable("bias_raw", "measured minus predicted CV", "cv_unit", _CV),
    "quality": Variable("quality", "measurement: 0 good, 1 missing, 2 outside, 3 frozen", "1", _CV, "i1", -1),
    "off": Variable("off", "CV switched off after bad measurements", "1", _CV, "i1", -1),
    "status": Variable("status", "status of the solve", "1", _TIME, "i1", -1),
    "fallback": Variable("fallback", "MVs held because the solve gave no plan", "1", _TIME, "i1", -1),
    "objective": Variable("objective", "objective (6.6) of the applied plan", "1", _TIME),
    "bound": Variable("bound", "proven lower bound of the objective", "1", _TIME),
    "gap": Variable("gap", "relative gap between objective and bound", "1", _TIME),
    "nodes": Variable("nodes", "relaxations solved in a search", "1", _TIME, "i4", -1),
    "solve_time": Variable("solve_time", "time of one controller step", "s", _TIME),
    "finished_by": Variable("finished_by", "what proved the integer optimum", "1", _TIME, "i1", -1),
}
PLAN = Variable(
    "plan", "move planned at this time for every sample of a block", "mv_unit", ("time", "block", "mv")
)
_TIMED = Variable("wall_time", "time of the whole run", "s")
_DONE = Variable(FLAG, "1 once every sample of the controller is stored", "1", (), "i1", 0)

# what a comparison keeps of a run; its setpoints belong to all runs
RUN_VARIABLES = (*(v for f, v in TRAJECTORIES.items() if f != "setpoint"), PLAN, _TIMED, _DONE)


def swept(field: str) -> Variable:
    """The stored trajectory of a sweep, where a key figure has the name ``objective`` already."""
    variable = TRAJECTORIES[field]
    return dataclasses.replace(variable, name="plan_objective") if field == "objective" else variable


def run_fields(trajectory: Trajectory, wall_time: float, blocks: int) -> dict[str, np.ndarray]:
    """A run of a comparison as the values of `RUN_VARIABLES`, one lane.

    Args:
        blocks: of the store; the plan is not a number in those that the controller does not have.
    """
    fields = {
        variable.name: np.asarray(getattr(trajectory, field)).astype(variable.dtype)[None]
        for field, variable in TRAJECTORIES.items()
        if field != "setpoint"
    }
    plan = np.full((1, trajectory.samples, blocks, len(trajectory.mv_names)), np.nan)
    if trajectory.plan is not None:
        plan[0, :, : trajectory.plan.shape[1]] = trajectory.plan
    return {**fields, "plan": plan, "wall_time": np.array([wall_time]), FLAG: np.ones(1, dtype="i1")}
