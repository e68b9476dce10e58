"""Model predictive control with discrete actuators, from a step-response model.

Importing the package switches JAX to float64: pruning integer decisions needs bounds that are right to
1e-6, and float32 bounds are not. It also turns on JAX's persistent compilation cache, so that a second
process starts without compiling; set ``JAX_COMPILATION_CACHE_DIR`` to move it or ``JAXMPC_NO_JIT_CACHE=1``
to leave it off. What compiles for more than a moment says so on standard error, unless ``JAXMPC_QUIET=1``.
The public names of its modules can be taken from the package itself.
"""

from jaxmpc.programs import interrupts as _interrupts

if _interrupts.is_command():  # before everything else, as JAX takes a while
    _interrupts.install()

import os as _os
from importlib import import_module as _import_module

import jax as _jax

from jaxmpc.programs.cache import compile_quickly as _compile_quickly
from jaxmpc.programs.cache import keep_programs as _keep_programs
from jaxmpc.programs.compilation import watch as _watch

_jax.config.update("jax_enable_x64", True)
_compile_quickly()
if not _os.environ.get("JAXMPC_NO_JIT_CACHE"):
    _keep_programs()
_watch()

_HOME_OF = {
    "Actuator": "process.actuator",
    "Controller": "controller.controller",
    "Controllers": "controller.batch",
    "Event": "loop.events",
    "FunctionPlant": "process.function_plant",
    "InputError": "errors",
    "Reference": "process.reference",
    "ModelPlant": "process.model_plant",
    "Parameter": "process.plant",
    "Process": "process.process",
    "SensorFault": "controller.measurement",
    "SteadyMap": "steady.map",
    "StepResponseModel": "model.step_response",
    "Structure": "problem.structure",
    "Trajectory": "loop.trajectory",
    "WellPlant": "process.well.plant",
    "fault_errors": "controller.measurement",
    "load_process": "process.file",
    "load_controller": "controller.checkpoint",
    "make_model": "model.step_response",
    "make_tuning": "problem.tuning",
    "optimise": "steady.optimise",
    "save_controller": "controller.checkpoint",
    "simulate": "loop.simulate",
    "simulate_batch": "loop.simulate",
    "simulate_batches": "loop.simulate",
    "solve_plan": "controller.plan",
    "stack_tunings": "problem.tuning",
}


def __getattr__(name: str):
    """Public names, loaded when first used, so that importing the package stays quick."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(_import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
