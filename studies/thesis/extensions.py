"""Comparisons beyond the thesis: gain scheduling (its chapter 8), a mean-move limit that looks ahead, limited solve times.

`STUDIES` has the same form as that of `catalogue`. `limited_steps` measures what time limits cost the plans of
stored runs, against the exact optimum of the very same steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxmpc.controller.continuous import ControllerState, Memory
from jaxmpc.controller.mixed_integer import MixedIntegerController
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.status import LIMIT
from studies.definition import references
from studies.definition.comparison import (
    ComparisonDefinition,
    ControllerDefinition,
    PlantKind,
    ReferenceDefinition,
)

# Closes to 21 %, then to the two targets of the thesis run at 9 and 7 %, where a step of the choke does most.
NEAR_CLOSED_WINDOWS = ((0.0, 9640.0, 152.0), (2400.0, 5870.0, 100.6), (6000.0, 5445.0, 88.0))
NEAR_CLOSED_DURATION = 9600.0  # s
LONGEST = 1.0  # s, of a step with window rows: a few of them would take minutes to prove
TIME_LIMITS = (0.005, 0.01, 0.05)  # s


def _windows(quick: bool) -> ReferenceDefinition:
    return ReferenceDefinition.of(references.quick() if quick else references.thesis())


def _named(name: str, title: str, quick: bool, plant: PlantKind) -> dict:
    short = ", shortened reference" if quick else ""
    return {"name": f"{name}-{'quick-' if quick else ''}{plant}", "title": title + short, "plant": plant}


def gain_scheduling(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """One model against models that follow the choke, with and without Soft MPC (thesis chapter 8)."""
    controllers = []
    for tuning, soft in (("thesis", "Soft MPC"), ("no-soft", "no Soft MPC")):
        suffix = "" if tuning == "thesis" else "-no-soft"
        for schedule, model in ((False, "one model"), (True, "scheduled")):
            controllers.append(
                ControllerDefinition(
                    ("scheduled" if schedule else "single") + suffix,
                    f"mixed-integer MPC, {model}, {soft}",
                    kind="mixed-integer",
                    actuator="step",
                    tuning=tuning,
                    schedule=schedule,
                )
            )
    for schedule, model in ((False, "one model"), (True, "scheduled")):
        controllers.append(
            ControllerDefinition(
                "rounded-scheduled" if schedule else "rounded",
                f"continuous MPC, step choke, {model}, Soft MPC",
                kind="continuous",
                actuator="step",
                schedule=schedule,
            )
        )
    reference = (
        ReferenceDefinition.of(references.from_windows(NEAR_CLOSED_WINDOWS, NEAR_CLOSED_DURATION))
        if quick
        else _windows(False)
    )
    named = _named("gain-scheduling", "Gain scheduling", quick, plant)
    return ComparisonDefinition(**named, controllers=tuple(controllers), reference=reference)


def mean_move(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """The mean-move limit as a stop after the fact (6.6) against rows on the windows of the whole plan."""
    controllers = []
    kinds: tuple[tuple[Literal["continuous", "mixed-integer"], Literal["continuous", "step"]], ...] = (
        ("continuous", "continuous"),
        ("mixed-integer", "step"),
    )
    modes: tuple[Literal["reactive", "predictive"], ...] = ("reactive", "predictive")
    for kind, actuator in kinds:
        for mode in modes:
            controllers.append(
                ControllerDefinition(
                    f"{kind}-{mode}",
                    f"{kind} MPC, {mode} mean-move limit",
                    kind=kind,
                    actuator=actuator,
                    mean_move_mode=mode,
                    time_limit=LONGEST if (kind, mode) == ("mixed-integer", "predictive") else None,
                )
            )
    named = _named("mean-move", "Mean-move limit, reactive and predictive", quick, plant)
    return ComparisonDefinition(**named, controllers=tuple(controllers), reference=_windows(quick))


def time_limit(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """Mixed-integer MPC that has to decide within some milliseconds, against one that solves every step exactly."""
    controllers = [
        ControllerDefinition("exact", "mixed-integer MPC, exact", kind="mixed-integer", actuator="step")
    ]
    for seconds in TIME_LIMITS:
        controllers.append(
            ControllerDefinition(
                f"limit-{1e3 * seconds:g}-ms",
                f"mixed-integer MPC, at most {1e3 * seconds:g} ms",
                kind="mixed-integer",
                actuator="step",
                time_limit=seconds,
            )
        )
    named = _named("time-limit", "Limited solve times", quick, plant)
    return ComparisonDefinition(**named, controllers=tuple(controllers), reference=_windows(quick))


STUDIES: dict[str, Callable[[bool, PlantKind], ComparisonDefinition]] = {
    "gain-scheduling": gain_scheduling,
    "mean-move": mean_move,
    "time-limit": time_limit,
}


class LimitedSteps(NamedTuple):
    """The steps of a run that ended at their time limit.

    Attributes:
        label: of the controller.
        share: of all steps, 0..1.
        gap: median of the relative gaps that were proven.
        lost: relative to the exact optimum of the same step, the median, the 90th percentile and the most.
    """

    label: str
    share: float
    gap: float
    lost: tuple[float, float, float]


def limited_steps(
    data: xr.Dataset, definitions: Iterable[ControllerDefinition], model: StepResponseModel
) -> list[LimitedSteps]:
    """What the time limits of stored runs cost, one entry per controller with a limit; NaN where no step reached it.

    Args:
        data: results from `studies.store.comparison.open_results`, every run finished.
        definitions: of the controllers that ran.
        model: their prediction model, ``model.json`` in the folder of the study.
    """
    out = []
    for definition in definitions:
        if definition.time_limit is None:
            continue
        run = data.sel(controller=definition.name)
        at = run.status.values == LIMIT
        gap, lost = np.nan, (np.nan, np.nan, np.nan)
        if at.any():
            loss = objective_loss(data, definition, model)[at]
            gap = float(np.median(run.gap.values[at]))
            lost = float(np.nanmedian(loss)), float(np.nanpercentile(loss, 90)), float(np.nanmax(loss))
        out.append(LimitedSteps(definition.label, float(at.mean()), gap, lost))
    return out


def objective_loss(
    data: xr.Dataset, definition: ControllerDefinition, model: StepResponseModel
) -> np.ndarray:
    """What a time limit cost every plan of a stored run, ``"sample"``: objective over the exact optimum, less one.

    The state of the controller is replayed from the stored measurements and plans, and the steps that ended at the limit
    are solved again without one. Zero for steps that were solved to the end, not a number for steps without a plan.

    Args:
        data: results from `studies.store.comparison.open_results`.
        definition: of the controller that ran.
        model: its prediction model, ``model.json`` in the folder of the study.
    """
    run = data.sel(controller=definition.name).load()
    exact = MixedIntegerController(definition.structure(), definition.build_tuning(), model)
    cv, setpoint, move = run.measurement.values, run.setpoint.values, run.move.values
    plan = run.plan.values[:, : definition.structure().block_count]
    status, objective = run.status.values, run.objective.values
    loss = np.where(np.isfinite(objective), 0.0, np.nan)
    state, memory = exact.init(cv[0], run.demand.values[0] - move[0]), exact.memory
    for k in range(len(cv)):
        if status[k] == LIMIT and np.isfinite(objective[k]):
            best = float(exact.step(state, cv[k], setpoint[k])[1].objective)
            loss[k] = max(objective[k] / best - 1.0, 0.0)
        state = _replayed(memory, state, cv[k], move[k], plan[k])
    return loss


@jax.jit
def _replayed(memory: Memory, state: ControllerState, cv, move, plan) -> ControllerState:
    """The state one sample later, for a move that was made."""
    state, _ = memory.observe(state, jnp.asarray(cv))
    return memory.remember(state, move, plan, state.warm)
