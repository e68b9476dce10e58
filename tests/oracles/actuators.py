"""Lists of allowed values and minimum dwell, straight from their words: every sample is looked at.

A case with them is a case without (`plain`: a grid and the limits that hold the list) of which plans are left out (`kept`).
"""

from __future__ import annotations

import copy
import math
from fractions import Fraction

import numpy as np

from tests.oracles import steps as oracles


def common_step(values) -> float:
    """The largest number of which all differences of decimals are multiples."""
    exact = [Fraction(str(v)) for v in values]
    over = math.lcm(*(v.denominator for v in exact))
    apart = [int((v - exact[0]) * over) for v in exact[1:]]
    return float(Fraction(math.gcd(*apart), over))


def plain(case: dict) -> dict:
    """The case with a grid in place of every list, and without dwell."""
    body = copy.deepcopy(case)
    structure, tuning = body["structure"], body["tuning"]
    for name, values in structure.pop("integer_values", {}).items():
        m = body["model"]["mv"].index(name)
        structure["integer_step"][name] = common_step(values)
        for key, end, tighter in (("mv_low", values[0], max), ("mv_high", values[-1], min)):
            limit = tuning[key][m]
            tuning[key][m] = end if limit is None else tighter(limit, end)
    structure.pop("dwell", None)
    body.pop("samples_since_move", None)
    return body


def kept(case: dict, m: int, plan) -> bool:
    """Whether whole moves per block of one MV keep its list and its dwell, sample by sample."""
    structure, name = case["structure"], case["model"]["mv"][m]
    values, dwell = structure.get("integer_values", {}).get(name), structure.get("dwell", {}).get(name, 1)
    step = common_step(values) if values else structure["integer_step"][name]
    moves = []
    for move, length in zip(plan, structure["blocks"], strict=True):
        moves += [move] * length if structure["blocking"] == "moves" else [move] + [0] * (length - 1)
    if values:
        at = case["mv_now"][m] + step * np.cumsum(moves)
        if np.abs(at[:, None] - np.array(values)).min(axis=1).max() > 1e-6 * step:
            return False
    since = (case.get("samples_since_move") or [None] * (m + 1))[m]
    last = -since if since else -(10**6)
    if abs(case["last_move"][m]) >= 0.5 * step:
        last = -1
    for k, move in enumerate(moves):
        if move and k - last < dwell:
            return False
        last = k if move else last
    return True


def brute_force(case: dict, **options) -> oracles.Answer:
    """The best of all plans that keep lists and dwell."""
    return oracles.brute_force(plain(case), keep=lambda m, plan: kept(case, m, plan), **options)


def complaints(case: dict, plan, reference: oracles.Answer) -> list[str]:
    """What is wrong with a plan of the library, in words; empty if nothing is."""
    body = plain(case)
    found = oracles.complaints(body, plan, reference)
    if plan.moves is not None:
        for m, step in enumerate(oracles.read(body).step):
            if step and not kept(case, m, np.round(np.asarray(plan.moves)[:, m] / step).astype(int)):
                found.append(f"the plan of MV {m} breaks its list or its dwell")
    return found
