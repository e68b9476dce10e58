"""Instances as a folder that any solver can read: case files of `jaxmpc plan`, and ``truth.json`` with their optima.

`write` fills a folder and `read` takes any such folder in; `found` holds our answers against what is known, and `certified`
finds out what is known. docs/instances.md describes the format.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from jaxmpc.check import located, require
from jaxmpc.controller.case import Case, case_to_dict, load_case
from jaxmpc.controller.plan import Plan, Planner
from jaxmpc.errors import InputError
from jaxmpc.files import json_by_field, read_json, write_atomically
from studies.bench.beside import ask, polished
from studies.bench.context import Context
from studies.bench.generate import OPTIMA, shipped_cases
from studies.bench.judge import FEASIBLE, repeated, tolerated
from studies.bench.problem import objective, violation
from studies.bench.rows import Found, Row

TRUTH = "truth.json"
PATIENCE = 60.0  # s that each solver has to certify an instance
GIVEN = ("mv_now", "last_move", "free_response", "setpoint", "previous_moves")


class Known(msgspec.Struct, kw_only=True, omit_defaults=True):
    """What is known of the optimum of one instance."""

    objective: float | None = None  # of the best plan, the optimum unless `open`; None where there is no plan
    bound: float | None = None  # no plan is below
    moves: list[list[float]] | None = None  # of the best plan, ``"block mv"`` [MV unit]
    certified: list[str] = []  # the independent ways that found the optimum and proved it
    open: bool = False  # whether fewer than two did
    infeasible: bool = False  # whether no plan meets the hard constraints

    @property
    def optimum(self) -> float | None:
        """The certified optimum, None where there is none."""
        return None if self.open or self.infeasible else self.objective


def shipped(processes: tuple[str, ...] = ()) -> tuple[dict[str, Case], dict[str, Known]]:
    """The shipped instances and what is known of them; of some processes alone the first of every family."""
    cases = shipped_cases()
    first = [name for name in cases if name.split("_")[0] in processes and name.endswith("_0")]
    known = msgspec.json.decode(OPTIMA.read_bytes(), type=dict[str, Known])
    return {name: cases[name] for name in first or cases}, known


def write(folder: Path, cases: dict[str, dict], known: dict[str, Known]) -> None:
    """Write ``cases/NAME.json``, and ``truth.json`` with what is known."""
    files = {Path("cases", f"{name}.json"): case for name, case in cases.items()}
    for name, body in (files | {Path(TRUTH): msgspec.to_builtins(known)}).items():
        write_atomically(folder / name, json_by_field(body))


def read(folder: Path) -> tuple[dict[str, Case], dict[str, Known]]:
    """The cases of a folder, or of ``cases`` in it, by name, and what ``truth.json`` there or above knows of them.

    Raises:
        InputError: naming the file, for a folder without cases and for what a case file or ``truth.json`` must not have.
    """
    inner = folder / "cases" if (folder / "cases").is_dir() else folder
    paths = sorted(path for path in inner.glob("*.json") if path.name != TRUTH)
    require(paths, "--read", str(folder), "a folder with case files NAME.json, or with such a folder `cases`")
    cases = {}
    for path in paths:
        with located(lambda field, path=path: f"{path}: {field}"):
            cases[path.stem] = load_case(path)
    truth = next((path for path in (inner / TRUTH, inner.parent / TRUTH) if path.exists()), None)
    try:
        known = {} if truth is None else msgspec.convert(read_json("--read", truth), dict[str, Known])
    except msgspec.ValidationError as error:
        raise InputError("--read", str(truth), f"optima by the name of their instance ({error})") from None
    return cases, known


def solve(case: Case, limit: float, finish: str = "auto") -> tuple[float, Plan]:
    """Seconds of a solve, compilation left out, and its plan; nothing is kept from one repetition to the next.

    Args:
        limit: seconds that it may take, where the case itself says nothing.
    """
    given: dict[str, Any] = {key: getattr(case, key) for key in GIVEN}
    seconds = limit if case.time_limit is None else case.time_limit

    def once() -> tuple[float, Plan]:
        planner = Planner(case.structure, case.tuning, case.model)
        plan = planner.solve(**given, time_limit=seconds, gap=case.gap, finish=finish)
        return plan.solve_time_s, plan

    return repeated(once)


def found(
    context: Context, cases: dict[str, Case], known: dict[str, Known], folder: Path | None
) -> Iterator[Row]:
    """A row per instance: our answer beside the optimum, which does not count where it claims what does not hold.

    Args:
        folder: that gets a ``truth.json`` by all solvers, before our answers are judged; None for none.
    """
    if folder is not None:
        known = {}
        for name, case in cases.items():
            context.say(f"{name}: all solvers")
            known[name] = certified(context, case)
        write(folder, {}, known)
    for name, case in cases.items():
        context.say(name)
        entry, body = known.get(name, Known(open=True)), case_to_dict(case)
        seconds, plan = solve(case, context.size.cut_off)
        wrong = faults(body, entry, plan)
        answer = {key: getattr(plan, key) for key in ("status", "objective", "gap", "finished_by")}
        best = Found(**answer, best=entry.objective, certified=entry.optimum is not None)
        yield Row(name=name, seconds=seconds, counts=not wrong, note="; ".join(wrong), found=best)


def faults(case: dict, known: Known, plan: Plan) -> list[str]:
    """What a plan claims and does not hold, judged by (6.6) apart from the library."""
    best, proven = known.objective, plan.status == "optimal"
    if plan.moves is None or plan.objective is None:
        return ["infeasible, but there is a plan"] * (plan.status == "infeasible" and best is not None)
    value, broken = objective(case, plan.moves), violation(case, plan.moves)
    beyond = lambda one, other: one is not None and other is not None and one - other > tolerated(other)  # noqa: E731
    claims = {
        f"hard constraints are broken by {broken:.1e}": broken > FEASIBLE,
        f"the plan costs {value:.9g}": abs(value - plan.objective) > tolerated(value),
        "there is no plan": known.infeasible,
        "the best plan known is better": proven and beyond(value, best),
        "the bound is above the best plan known": beyond(plan.bound, best),
        "it is better than the certified optimum": beyond(known.optimum, value),
    }
    return [words for words, holds in claims.items() if holds]


def certified(context: Context, case: Case) -> Known:
    """Solve an instance with all solvers that are there; its optimum is certified where two prove the same."""
    body, size = case_to_dict(case), dataclasses.replace(context.size, cut_off=PATIENCE)
    context = dataclasses.replace(context, size=size)
    _, plan = solve(case, PATIENCE)
    ways = {"jaxmpc": (plan.status, plan.moves, plan.bound)}
    for peer in context.miqp_peers:
        if peer.bounds and peer.missing() is None:
            try:
                _, (answer,), (moves,) = ask(
                    dataclasses.replace(peer, hopeless=PATIENCE), context, [body], 1e-8
                )
            except Exception as error:  # what a licence does not cover, or tolerances break
                context.say(f"{peer.name}: {error}")
                continue
            ways[f"{peer.name} ({peer.package} {peer.version()})"] = (
                answer.status,
                polished(body, moves),
                answer.bound,
            )
    costs = {who: objective(body, moves) for who, (_, moves, _) in ways.items() if moves is not None}
    costs = {who: cost for who, cost in costs.items() if violation(body, ways[who][1]) <= FEASIBLE}
    if not costs:
        agree = [who for who, (status, _, _) in ways.items() if status == "infeasible"]
        return Known(infeasible=len(agree) > 1, open=len(agree) < 2, certified=agree)
    winner = min(costs, key=lambda who: costs[who])
    best = costs[winner]
    close = lambda low: low is not None and best - low <= 100.0 * tolerated(best)  # noqa: E731  # their tolerances
    agree = [
        who
        for who, cost in costs.items()
        if ways[who][0] == "optimal" and cost - best <= tolerated(best) and close(ways[who][2])
    ]
    bound = max(min(best, -math.inf if low is None else float(low)) for _, _, low in ways.values())
    moves = np.asarray(ways[winner][1]).tolist()
    return Known(objective=best, bound=bound, moves=moves, certified=agree, open=len(agree) < 2)
