"""Shared fixtures. Importing the package switches JAX to float64 and turns on the compilation cache."""

import gc
import os
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxmpc  # noqa: F401
from jaxmpc.model.step_response import make_model
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning

os.environ["JAXMPC_QUIET"] = (
    "1"  # what a test compiles depends on the tests before it; `test_compilation` listens
)
# for the workers and all that tests start, which share the cores: threads that wait for each other in NumPy keep them busy
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
MAPS = Path("/proc/self/maps")
MOST_MAPS = 20_000  # of the 65,530 that a process may have, so that the largest modules still fit

# programs are traced by the thousand, and what they are traced to lives on: looking for garbage in it takes a twentieth
gc.set_threshold(20_000, 20, 20)


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_programs():
    """Before memory maps run out, of which a program holds hundreds; until then the next module may use the same."""
    yield
    if not MAPS.exists() or MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()


def second_order(gain, slow, fast, zero, samples, dt=10.0):
    """Unit-step response of gain (zero s + 1) / ((slow s + 1)(fast s + 1)) at dt, 2 dt, ..."""
    t = dt * np.arange(1, samples + 1)
    a, b = (slow - zero) / (slow - fast), (fast - zero) / (fast - slow)
    return gain * (1 - a * np.exp(-t / slow) - b * np.exp(-t / fast))


@pytest.fixture(scope="session")
def well_like_model():
    """A synthetic 2 x 2 model that resembles the well, with 60 samples."""
    responses = [
        [(30.0, 120.0, 15.0, 400.0), (1.1, 90.0, 60.0, 0.0)],
        [(0.7, 150.0, 12.0, 350.0), (0.006, 200.0, 60.0, 300.0)],
    ]
    coefficients = [[second_order(*entry, samples=60) for entry in row] for row in responses]
    return make_model(coefficients, 10.0, ["gas", "oil"], ["choke", "lift"])


@pytest.fixture(scope="session")
def small_structure():
    """Six blocks over 20 samples, whole choke moves of 2 %."""
    return Structure(
        cv_names=("gas", "oil"),
        mv_names=("choke", "lift"),
        prediction_horizon=40,
        control_horizon=20,
        blocks=(1, 1, 2, 4, 4, 8),
        integer_step=(2.0, None),
    )


@pytest.fixture(scope="session")
def thesis_fields():
    """Fields of a tuning like Table 1 of the thesis."""
    return dict(
        cv_weight=[1e-4, 0.1],
        move_weight=[250.0, 0.2],
        soft_quadratic=[1e-4, 0.1],
        soft_linear=[1e-4, 0.1],
        deadzone=[1000.0, 5.0],
        cv_low=[0.0, 0.0],
        cv_high=[20000.0, 400.0],
        slack_weight=1000.0,
        mv_low=[0.0, 0.0],
        mv_high=[100.0, 10000.0],
        move_low=[-2.0, -200.0],
        move_high=[2.0, 200.0],
        bias_cutoff=1 / 20,
    )


@pytest.fixture(scope="session")
def small_tuning(small_structure, thesis_fields):
    """The thesis-like tuning for `small_structure`, with oscillation rows."""
    return make_tuning(small_structure, **thesis_fields, oscillation_rows={"choke": True})


@pytest.fixture(scope="module")
def made(well_like_model, small_structure, thesis_fields):
    """Controllers by kind (`five_controllers`) and changed tuning fields, each made once."""
    from tests.five_controllers import controller_of

    known = {}

    def get(kind, **more):
        key = kind, repr(sorted(more.items()))
        if key not in known:
            known[key] = controller_of(kind, well_like_model, small_structure, thesis_fields, **more)
        return known[key]

    return get
