"""Model predictive control with discrete actuators, from a step-response model.

Importing the package switches JAX to float64: pruning integer decisions needs bounds that are right to
1e-6, and float32 bounds are not. It also turns on JAX's persistent compilation cache, so that a second
process starts without compiling; set ``JAX_COMPILATION_CACHE_DIR`` to move it or ``JAXMPC_NO_JIT_CACHE=1``
to leave it off. The public names of its modules can be taken from the package itself.
"""

from jaxmpc import interrupts as _interrupts

if _interrupts.is_command():  # before everything else, as JAX takes a while
    _interrupts.install()

import os as _os
from importlib import import_module as _import_module

import jax as _jax

from jaxmpc.cache import keep_programs as _keep_programs

_jax.config.update("jax_enable_x64", True)
if not _os.environ.get("JAXMPC_NO_JIT_CACHE"):
    _keep_programs()

_HOME_OF = {
    "ContinuousController": "controller",
    "InputError": "errors",
    "MixedIntegerController": "mixed_integer",
    "MixedIntegerControllers": "mixed_integer",
    "Reference": "reference",
    "SensorFault": "measurement",
    "SteadyMap": "steady_map",
    "StepResponseModel": "step_response",
    "Structure": "structure",
    "TargetController": "targets",
    "Trajectory": "trajectory",
    "WellPlant": "plant",
    "controller_batch": "batch",
    "fault_errors": "measurement",
    "load_controller": "checkpoint",
    "make_model": "step_response",
    "make_tuning": "tuning",
    "optimise": "rto",
    "save_controller": "checkpoint",
    "simulate": "closed_loop",
    "simulate_batch": "closed_loop",
    "simulate_batches": "closed_loop",
    "solve_plan": "plan",
    "stack_tunings": "tuning",
}


def __getattr__(name: str):
    """Public names, loaded when first used, so that importing the package stays quick."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(_import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
