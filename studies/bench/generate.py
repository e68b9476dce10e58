"""The shipped instances: one-step cases from published transfer functions (`foreign.toml`), one per seed.

Numbers are drawn by `random.Random`, whose sequence is fixed for a seed, and have seven digits, so that every machine makes
the same files. `foreign.json` has their certified optima; `jaxmpc bench --write` writes both.
"""

from __future__ import annotations

import math
import random
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.controller.case import Case
from jaxmpc.model.step_response import make_model
from jaxmpc.model.transfer_function import TransferFunction
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning, make_tuning

TABLE = Path(__file__).with_name("foreign.toml")
OPTIMA = TABLE.with_suffix(".json")


def shipped_cases() -> dict[str, Case]:
    """The cases of all families and seeds, by name: PROCESS_FAMILY_SEED."""
    processes = tomllib.loads(TABLE.read_text())
    families = ((name, process, family) for name, process in processes.items() for family in process["sets"])
    named = ((f"{name}_{family['name']}", process, family) for name, process, family in families)
    return {
        f"{name}_{seed}": _case(process, family, random.Random(f"{name}_{seed}"))
        for name, process, family in named
        for seed in range(family["seeds"])
    }


def step_response(row: list[float], times: np.ndarray) -> np.ndarray:
    """Of one transfer function: gain, dead time, and lags, of which infinite ones are integrators."""
    gain, dead, *lags = row
    return TransferFunction(gain, tuple(lags), dead).step_response(times)


def _case(process: dict, family: dict, rng: random.Random) -> Case:
    own: dict[str, Any] = {"blocks": (), **process["structure"], **family["structure"]}
    horizon, whole = own["prediction_horizon"], own.pop("whole")
    times = np.arange(1, 2 * horizon + 1) * process["dt"] / process["unit"]
    responses = _seven_digits([[step_response(row, times) for row in rows] for rows in process["responses"]])
    model = make_model(responses[:, :, :horizon], process["dt"], process["cv"], process["mv"])
    steps = tuple(whole.get(name) for name in process["mv"])
    names: dict[str, Any] = dict(cv_names=model.cv_names, mv_names=model.mv_names, dt=model.dt)
    structure = Structure(**names, **own, integer_step=steps)
    tuning = make_tuning(structure, **{**process["tuning"], **family.get("tuning", {})})
    drawn = _situation(process, responses, times[:horizon], tuning, steps, rng)
    return Case(model, structure, tuning, **{key: _seven_digits(value) for key, value in drawn.items()})


def _situation(
    process: dict, responses: np.ndarray, times: np.ndarray, tuning: Tuning, steps: tuple, rng: random.Random
) -> dict[str, Any]:
    """Where the MVs are, and what the CVs do from where they are after a disturbance and past moves."""
    draws, horizon = process["draws"], len(times)
    low, high = np.asarray(tuning.mv_low), np.asarray(tuning.mv_high)
    around = lambda spans: np.array([rng.uniform(-span, span) for span in spans])  # noqa: E731
    now, last = np.zeros(len(low)), np.zeros(len(low))
    for m, step in enumerate(steps):
        now[m] = rng.uniform(low[m], high[m])
        if step:  # on a whole step, each as likely
            now[m] = low[m] + step * int(rng.random() * (round((high[m] - low[m]) / step) + 1))
    free = np.tile(around(draws["cv"])[:, None], horizon)
    amount = rng.uniform(*draws["disturbance"])
    free += amount * np.array([step_response(row, times) for row in process["disturbance"]])
    if draws["past"] == 0:  # nothing is at rest: the MVs act from now on
        free += np.tensordot(responses[:, :, :horizon], now, ((1,), (0,)))
    for age in range(1, draws["past"] + 1):  # [samples]
        m = int(rng.random() * len(now))
        move = (steps[m] or rng.uniform(0.1, 0.5) * float(tuning.move_high[m])) * math.copysign(
            1.0, rng.random() - 0.5
        )
        last[m] += move * (age == 1)
        free += move * (responses[:, m, age : age + horizon] - responses[:, m, age - 1 : age])
    setpoint = np.tile(around(draws["setpoint"]), (horizon, 1))
    return {"mv_now": now, "last_move": last, "free_response": free.T, "setpoint": setpoint}


_seven_digits = partial(np.vectorize(lambda value: float(f"{value:.7g}"), otypes=[float]))
