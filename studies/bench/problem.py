"""One controller step as plain numbers, and what a plan of it costs, straight from the equations (thesis 5.1-6.5).

Nothing here is shared with the library: a case is read as the plain content of its JSON file and predictions are
superposed sample by sample. The benchmark and the tests judge every solver's plan with `objective` and `violation`.
"""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import numpy as np

WEIGHTS = dict(
    Q="cv_weight", P="move_weight", S2="soft_quadratic", S1="soft_linear", c="deadzone", rho="slack_weight"
)
OPTIONAL = dict(ideal="ideal", W="ideal_weight")  # what a case may leave out
LIMITS = dict(ylo="cv_low", yhi="cv_high", ulo="mv_low", uhi="mv_high", dlo="move_low", dhi="move_high")
STEP_ROUNDING = 1e-6  # [steps]: a limit so close to a whole number of steps counts as that number


def read(case: dict) -> SimpleNamespace:
    """The numbers of a case file: arrays instead of lists, infinities instead of None, S continued to Hp.

    A recorded sample may carry ``first_move_low`` and ``first_move_high`` beside the fields of a case file: limits of
    the move applied now alone, which the mean-move limit (6.6) sets.
    """
    model, structure, tuning = case["model"], case["structure"], case["tuning"]
    n = SimpleNamespace(cvs=len(model["cv"]), mvs=len(model["mv"]))
    n.hp, n.hu, n.hw = (
        structure[key] for key in ("prediction_horizon", "control_horizon", "first_penalised")
    )
    given = structure.get("blocks")
    own = given if isinstance(given, dict) else dict.fromkeys(model["mv"], given)
    n.lists = [list(own[name] or [1] * n.hu) for name in model["mv"]]  # lengths of the blocks of every MV
    n.begins = [[0, *itertools.accumulate(blocks)][:-1] for blocks in n.lists]
    n.blocking = structure["blocking"]
    n.step = [structure.get("integer_step", {}).get(name) for name in model["mv"]]
    horizon = structure.get("integer_horizon", {})
    horizon = horizon if isinstance(horizon, dict) else dict.fromkeys(model["mv"], horizon)
    # how many blocks have whole moves, and how many samples these are
    n.whole = [
        sum(begin < horizon.get(name, n.hu) for begin in begins) if step else 0
        for name, begins, step in zip(model["mv"], n.begins, n.step, strict=True)
    ]
    n.until = [sum(blocks[:whole]) for blocks, whole in zip(n.lists, n.whole, strict=True)]
    if not isinstance(given, dict):  # those of all MVs
        n.blocks, n.starts = n.lists[0], n.begins[0]
    n.oscillation = [bool(tuning.get("oscillation_rows", {}).get(name)) for name in model["mv"]]
    n.S = np.zeros((n.cvs, n.mvs, n.hp))
    for c, m in np.ndindex(n.cvs, n.mvs):
        response = np.asarray(model["coefficients"][c][m], dtype=float)
        n.S[c, m] = response[np.minimum(np.arange(n.hp), len(response) - 1)]
    for name, key in WEIGHTS.items():
        setattr(n, name, np.array(tuning[key], dtype=float))
    for name, key in LIMITS.items():
        missing = -np.inf if key.endswith("low") else np.inf
        setattr(n, name, np.array([missing if v is None else v for v in tuning[key]], dtype=float))
    for name, key in OPTIONAL.items():
        setattr(n, name, np.array(tuning.get(key, [0.0] * n.mvs), dtype=float))
    n.u0, n.last = np.array(case["mv_now"], dtype=float), np.array(case["last_move"], dtype=float)
    n.free, n.r = np.array(case["free_response"], dtype=float), np.array(case["setpoint"], dtype=float)
    n.first_low = np.array(case.get("first_move_low", [-np.inf] * n.mvs), dtype=float)
    n.first_high = np.array(case.get("first_move_high", [np.inf] * n.mvs), dtype=float)
    return n


def sample_moves(case: dict, moves) -> np.ndarray:
    """The move of every sample, "sample mv", of a plan "block mv"."""
    n, moves = read(case), np.asarray(moves, dtype=float)
    du = np.zeros((n.hu, n.mvs))
    for m in range(n.mvs):
        for b, (start, length) in enumerate(zip(n.begins[m], n.lists[m], strict=True)):
            du[start : start + (length if n.blocking == "moves" else 1), m] = moves[b, m]
    return du


def predict(case: dict, moves) -> np.ndarray:
    """The CVs at j = 1..Hp, "horizon cv": the free response plus one step response per move, (2.30)."""
    n, du = read(case), sample_moves(case, moves)
    y = n.free.copy()
    for k in range(min(n.hu, n.hp)):
        y[k:] += np.einsum("cmj,m->jc", n.S[:, :, : n.hp - k], du[k])
    return y


def objective(case: dict, moves) -> float:
    """The cost (6.6) and (6.20) of a plan, constants included, with the slacks at their smallest values."""
    n, y = read(case), predict(case, moves)
    e = (y - n.r)[n.hw - 1 :]
    eta = np.maximum(0.0, np.abs(e) - n.c)
    above = np.maximum(0.0, (y - n.yhi)[n.hw - 1 :].max(axis=0))
    below = np.maximum(0.0, (n.ylo - y)[n.hw - 1 :].max(axis=0))
    du = sample_moves(case, moves)
    u = (n.u0 + np.cumsum(du, axis=0))[np.minimum(np.arange(n.hw - 1, n.hp), n.hu - 1)]  # held after Hu
    return float(
        (n.Q * e**2).sum()
        + (n.W * (u - n.ideal) ** 2).sum()
        + (n.P * du**2).sum()
        + (n.S2 * eta**2 + n.S1 * eta).sum()
        + (n.rho * (above + below)).sum()
    )


def violation(case: dict, moves) -> float:
    """The largest violation of the hard constraints of a plan, 0 when there is none.

    Limits of moves and MVs count relative to max(1, |limit|), integrality and oscillation in steps. An MV
    that starts outside its limit by rounding widens the limit to where it is.
    """
    n, moves = read(case), np.asarray(moves, dtype=float)
    if not np.isfinite(moves).all():
        return math.inf
    du = sample_moves(case, moves)
    u = n.u0 + np.cumsum(du, axis=0)
    worst = 0.0
    for m in range(n.mvs):
        low, high = min(n.ulo[m], n.u0[m]), max(n.uhi[m], n.u0[m])
        for values, limit, sign in (
            (du[:1, m], n.first_high[m], 1),
            (du[:1, m], n.first_low[m], -1),
            (du[:, m], n.dhi[m], 1),
            (du[:, m], n.dlo[m], -1),
            (u[:, m], high, 1),
            (u[:, m], low, -1),
        ):
            if math.isfinite(limit):
                worst = max(worst, (sign * (values - limit)).max() / max(1.0, abs(limit)))
        if n.step[m]:
            d = du[: n.until[m], m] / n.step[m]
            worst = max(worst, np.abs(d - np.round(d)).max())
            if n.oscillation[m]:  # (6.16), the past move rounded to whole steps
                past = round(n.last[m] / n.step[m])
                worst = max(worst, np.abs(np.diff(d, prepend=past)).max() - 1.0)
    return float(worst)


def step_limits(n: SimpleNamespace, m: int) -> tuple[float, float, float, float]:
    """Move and position limits of an integer MV in whole steps from where it is."""
    step, up, down = n.step[m], math.floor, math.ceil

    def whole(x, rounding, slack):
        return rounding(x + slack) if math.isfinite(x) else x

    return (
        whole(n.dlo[m] / step, down, -STEP_ROUNDING),
        whole(n.dhi[m] / step, up, STEP_ROUNDING),
        min(0, whole((n.ulo[m] - n.u0[m]) / step, down, -STEP_ROUNDING)),
        max(0, whole((n.uhi[m] - n.u0[m]) / step, up, STEP_ROUNDING)),
    )
