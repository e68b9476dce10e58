"""Named comparisons: the thesis run (chapter 7) and the scenarios around it (figures 12 and 25 to 38), ready to run.

`run_named` computes one of `STUDIES` from nothing to stored results; figures and the command line ask for them by
name. Every study has a quick variant, shorter, with the same effects.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxmpc.errors import InputError
from studies.definition import references
from studies.definition.comparison import (
    PLANTS,
    ComparisonDefinition,
    ControllerDefinition,
    PlantKind,
    ReferenceDefinition,
    TuningChange,
)
from studies.definition.presets import GAS, OIL
from studies.thesis import extensions
from studies.thesis.comparison import run_definition, run_thesis, thesis_definition

Windows = tuple[tuple[float, float, float], ...]  # start [s], gas rate [m3/h], oil rate [m3/h]
WORKING_POINT = (11_013.0, 185.0)  # m3/h, 50 % choke and 7500 m3/h of lift
# m3/h, between 6 and 8 % choke with much lift: there a step of the choke does far more than the model says
HUNTING = (8300.0, 92.5)
STEP_AT = 600.0  # s, setpoint step whose plan is shown and carried out
PRESSURE_DROP = (1000.0, -3.0)  # s, bar
GAS_OFF_AT = 3000.0  # s


def _definition(
    name: str,
    title: str,
    quick: bool,
    plant: PlantKind,
    controllers: tuple[ControllerDefinition, ...],
    windows: Windows,
    duration: float,
    **more: Any,
) -> ComparisonDefinition:
    reference = ReferenceDefinition.of(references.from_windows(windows, duration))
    name, title = f"{name}-{'quick-' if quick else ''}{plant}", title + (", shortened" if quick else "")
    return ComparisonDefinition(name, title, plant, controllers, reference, **more)


def _mixed_integer(name: str, label: str, **more: Any) -> ControllerDefinition:
    return ControllerDefinition(name, label, kind="mixed-integer", actuator="step", **more)


SOFT = _mixed_integer("soft", "mixed-integer MPC with Soft MPC")


def soft(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """Nominal against Soft MPC while the choke closes to where its steps do most (6.4, figure 12)."""
    nominal = _mixed_integer("nominal", "mixed-integer MPC, nominal", tuning="no-soft")
    close, duration = (1800.0, 6000.0) if quick else (3600.0, 9600.0)
    windows = ((0.0, 9640.0, 152.0), (close, *HUNTING))
    return _definition("soft", "Nominal against Soft MPC", quick, plant, (nominal, SOFT), windows, duration)


def predictions(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """A step of the setpoints, and its first plan carried out without feedback (7.2.2, 7.2.3, figures 25 to 28)."""
    controllers = (
        _mixed_integer("closed-loop", "closed loop"),
        _mixed_integer("open-loop", "open loop: the plan of the step", open_loop_from=STEP_AT),
    )
    windows = ((0.0, *WORKING_POINT), (STEP_AT, 14_000.0, 205.0))
    duration = 3000.0 if quick else 5400.0
    return _definition("predictions", "Plan and evolution", quick, plant, controllers, windows, duration)


def fine_regulation(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """Setpoints out of reach together, then the gas rate counts no more (7.2.4, figures 29 and 30)."""
    free = {
        "cv_weight": {GAS: 0.0, OIL: 0.1},
        "soft_quadratic": {GAS: 0.0, OIL: 0.1},
        "soft_linear": {GAS: 0.0, OIL: 0.1},
    }
    controller = _mixed_integer(
        "mixed-integer", "mixed-integer MPC, step choke", then=(TuningChange(GAS_OFF_AT, free),)
    )
    duration = 4800.0 if quick else 12_000.0  # the last m3/h are slow
    return _definition(
        "fine-regulation",
        "Fine regulation of the oil rate",
        quick,
        plant,
        (controller,),
        ((0.0, 9000.0, 185.0),),
        duration,
    )


def disturbance(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """A drop of the reservoir pressure at constant setpoints (7.2.5, figures 31 to 33)."""
    controller = _mixed_integer("mixed-integer", "mixed-integer MPC, step choke")
    duration = 3000.0 if quick else 5000.0
    return _definition(
        "disturbance",
        "Drop of the reservoir pressure",
        quick,
        plant,
        (controller,),
        ((0.0, *WORKING_POINT),),
        duration,
        disturbance=(PRESSURE_DROP,),
    )


def without_soft(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """The thesis reference with and without Soft MPC (7.2.6, figures 34 to 38)."""
    controllers = (
        SOFT,
        _mixed_integer("no-soft", "mixed-integer MPC, one hard weight", tuning="no-soft"),
        _mixed_integer("no-soft-plain", "mixed-integer MPC, Soft MPC left out", tuning="no-soft-plain"),
    )
    windows, duration = references.THESIS_WINDOWS, references.THESIS_DURATION
    if quick:  # no window of the quick reference makes it hunt
        windows, duration = ((0.0, 9640.0, 152.0), (1800.0, 5870.0, 100.6), (3600.0, *HUNTING)), 6000.0
    return _definition("without-soft", "Without Soft MPC", quick, plant, controllers, windows, duration)


def unblocked(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """Moves in the 16 blocks of (6.3) against 200 single moves per MV (6.2), which take some hundred times as long.

    Whole moves without blocks take seconds each; the quick variant has none.
    """
    smooth: dict[str, Any] = {"kind": "continuous", "actuator": "continuous"}
    controllers = (
        ControllerDefinition("blocks", "continuous MPC, 16 blocks", **smooth),
        ControllerDefinition("no-blocks", "continuous MPC, 200 moves", **smooth, blocking="none"),
        _mixed_integer("mixed-integer-blocks", "mixed-integer MPC, 16 blocks"),
        _mixed_integer("mixed-integer-no-blocks", "mixed-integer MPC, 200 moves", blocking="none"),
    )
    controllers = controllers[:3] if quick else controllers
    step, duration = (50.0, 300.0) if quick else (300.0, 1800.0)
    windows = ((0.0, *WORKING_POINT), (step, 14_000.0, 205.0))
    return _definition(
        "unblocked", "With and without move blocking", quick, plant, controllers, windows, duration
    )


STUDIES: dict[str, Callable[[bool, PlantKind], ComparisonDefinition]] = {
    "thesis": thesis_definition,
    "soft": soft,
    "predictions": predictions,
    "fine-regulation": fine_regulation,
    "disturbance": disturbance,
    "without-soft": without_soft,
    "unblocked": unblocked,
    **extensions.STUDIES,
}


def run_named(
    name: str,
    out: str | Path = "results",
    quick: bool = False,
    plant: PlantKind = "fmu",
    *,
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> Path:
    """Compute and store a study of the catalogue; what is stored already with equal inputs is kept.

    Args:
        name: a key of `STUDIES`.
        out: folder of all results; each study gets its own folder in it, ``NAME-PLANT`` or ``NAME-quick-PLANT``.
        quick: the shortened variant.
        plant: ``fmu``, or ``jax`` for its JAX twin, which needs no C compiler.
        progress: whether to show bars with rate and time left.
        say: receives one line per event.

    Returns:
        The folder of the study, with ``results.zarr`` (see `studies.store.comparison.open_results`) and ``model.json``.

    Raises:
        InputError: for an unknown name or plant or a folder that cannot be written, before anything is computed.
        MissingToolError: if the FMU cannot be built.
    """
    if name not in STUDIES:
        raise InputError("study", name, f"one of {', '.join(STUDIES)}")
    if plant not in PLANTS:
        raise InputError("plant", plant, f"one of {', '.join(PLANTS)}")
    if name == "thesis":
        return run_thesis(out, quick, plant, progress=progress, say=say)
    return run_definition(STUDIES[name](quick, plant), out, progress=progress, say=say)
