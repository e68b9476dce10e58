"""What limited solve times cost the plans of stored runs, against the exact optimum of the very same steps.

`studies.thesis.report` writes it into the summary of the comparison ``time-limit``.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxmpc.controller.controller import Controller
from jaxmpc.controller.core import Core
from jaxmpc.controller.state import ControllerState
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.process import Process
from jaxmpc.status import LIMIT
from studies.definition.catalogue import Comparison
from studies.definition.comparison import ControllerDefinition


class LimitedSteps(NamedTuple):
    """The steps of a run that ended at their time limit."""

    label: str
    share: float  # of all steps, 0..1
    gap: float  # median of the relative gaps that were proven
    # relative to the exact optimum of the same step, the median, the 90th percentile and the most
    lost: tuple[float, float, float]


def limited_steps(data: xr.Dataset, comparison: Comparison, model: StepResponseModel) -> list[LimitedSteps]:
    """What the time limits of finished runs cost, one entry per controller with a limit; NaN where no step reached it."""
    out = []
    for definition in comparison.definition.controllers:
        if definition.time_limit is None:
            continue
        run = data.sel(controller=definition.name)
        at = run.status.values == LIMIT
        gap, lost = np.nan, (np.nan, np.nan, np.nan)
        if at.any():
            loss = objective_loss(data, definition, comparison.process, model)[at]
            gap = float(np.median(run.gap.values[at]))
            lost = tuple(np.nanpercentile(loss, (50, 90, 100)).tolist())
        out.append(LimitedSteps(definition.label, float(at.mean()), gap, lost))
    return out


def objective_loss(
    data: xr.Dataset, definition: ControllerDefinition, process: Process, model: StepResponseModel
) -> np.ndarray:
    """What a time limit cost every plan of a stored run, ``"sample"``: objective over the exact optimum, less one.

    The state of the controller is replayed from the stored measurements and plans, and the steps that ended at the limit
    are solved again without one. Zero for steps that were solved to the end, not a number for steps without a plan.
    """
    run = data.sel(controller=definition.name).load()
    exact = Controller(definition.structure(process), definition.build_tuning(process), model)
    cv, setpoint, move = run.measurement.values, run.setpoint.values, run.move.values
    blocks = exact.structure.block_count
    plan = np.zeros((len(cv), *exact.core.layout.length.shape, move.shape[1]))
    plan[:, :blocks] = run.plan.values[:, :blocks]
    plan[:, 0] = move
    status, objective = run.status.values, run.objective.values
    loss = np.where(np.isfinite(objective), 0.0, np.nan)
    state = exact.init(cv[0], run.demand.values[0] - move[0])
    for k in range(len(cv)):
        if status[k] == LIMIT and np.isfinite(objective[k]):
            best = float(exact.step(state, cv[k], setpoint[k])[1].objective)
            loss[k] = max(objective[k] / best - 1.0, 0.0)
        state = jax.tree.map(np.asarray, _replayed(exact.core, state, cv[k], plan[k]))
    return loss


@jax.jit
def _replayed(core: Core, state: ControllerState, cv, plan) -> ControllerState:
    """The state one sample later, for a plan whose first move was made."""
    state, _ = core.observe(state, jnp.asarray(cv), jnp.nan, False)
    return core.remember(state, plan, state.warm)
