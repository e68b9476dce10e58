"""Exact mixed-integer problems: our ways to finish beside SCIP, Gurobi and DAQP on the same samples."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxmpc.controller.plan import Plan, Planner
from jaxmpc.relaxed.solve import shifted_start
from studies.bench.beside import Contest, polished
from studies.bench.context import Context
from studies.bench.instances import Instances, Mode, make_controller
from studies.bench.judge import time_each
from studies.bench.rows import Goal, Row

GAP = 1e-6  # relative, as the controllers ask for
LIMITS = (0.003, 0.006, 0.02)  # s; of steps whose lateness is measured
PATIENCE = 30.0  # s; most that one of our solves may take
FLOORS = {
    ("auto", "moves"): (2.0, 40.0),
    ("auto", "inputs"): (2.0, 100.0),
    ("highs", "moves"): (10.0, 500.0),
    ("highs", "inputs"): (10.0, 500.0),
}
WAYS = {"auto": "jaxmpc", "highs": "jaxmpc, HiGHS finish"}


def exact(context: Context) -> Iterator[Row]:
    """Rows ``exact MIQP, MODE: SOLVER``; the ratio is to SCIP."""
    for mode in context.size.modes:
        name = f"exact MIQP, {mode}"
        context.say(name)
        instances = context.recordings.instances("mixed-integer", mode, context.size.exact)
        contest = Contest(context, name, instances.cases(), context.miqp_peers, 1e-7, polished, in_time=True)
        _enter_ours(contest, mode, instances)
        contest.ask_peers()
        for finish, label in WAYS.items():
            median, p99 = FLOORS[finish, mode]
            goals = (Goal("median_ms", median), Goal("p99_ms", p99))
            goals += (Goal("ratio", 1000.0, 5000.0),) if finish == "auto" else ()
            note = "wall time of Planner.solve, started as in the loop, all programs compiled"
            yield contest.row(finish, label, goals=goals, note=note)
        yield from contest.peer_rows()
        context.say(f"{name}: lateness")
        yield _lateness(f"{name}: jaxmpc, late under a limit", mode, instances)


def _enter_ours(contest: Contest, mode: Mode, instances: Instances) -> None:
    """Solve all problems in each of our ways to finish."""
    for finish, label in WAYS.items():
        contest.context.say(f"{contest.name}: {label}")
        controller = make_controller("mixed-integer", mode, instances.model)
        planner = Planner(controller.structure, controller.tuning, controller.model)
        problems = [_as_in_the_loop(planner, instances, i) for i in range(len(instances))]
        limits = {"gap": GAP, "finish": finish, "time_limit": PATIENCE}

        def solve(problem: dict[str, Any], planner=planner, limits=limits) -> Plan:
            return planner.solve(**problem, **limits)

        for problem in problems:  # compiles every form that these problems meet
            solve(problem)
        seconds, plans = time_each(solve, problems)
        contest.enter(finish, seconds, [plan.moves if plan.status == "optimal" else None for plan in plans])


def _lateness(name: str, mode: Mode, instances: Instances) -> Row:
    """How long after its time limit a step ends, over limits that stop some steps and limits that stop most."""
    controller = make_controller("mixed-integer", mode, instances.model)
    planner = Planner(controller.structure, controller.tuning, controller.model)
    problems = [instances.now.at(i) for i in range(len(instances))]
    late = []
    for limit in (LIMITS[-1], *LIMITS):  # the first time compiles
        late.append(
            [
                max(
                    planner.solve(**problem, recover=True, gap=GAP, time_limit=limit).solve_time_s - limit,
                    0.0,
                )
                for problem in problems
            ]
        )
    times = 1e3 * np.array(late[1:]).reshape(-1)
    return Row(
        name=name,
        instances=len(times),
        median_ms=float(np.median(times)),
        p99_ms=float(np.percentile(times, 99)),
        goals=(Goal("p99_ms", 10.0, 2.0),),
        note=f"limits of {', '.join(f'{1e3 * limit:g}' for limit in LIMITS)} ms, cold starts; 0 for what ends in time",
    )


def _as_in_the_loop(planner: Planner, instances: Instances, i: int) -> dict[str, Any]:
    """Arguments of `Planner.solve`, with the plan and the prices of one sample earlier as the loop has them."""
    structure = planner.structure
    earlier = planner.solve(**instances.before.at(i), recover=True, gap=GAP, time_limit=PATIENCE)
    start: dict[str, Any] = {}
    if earlier.moves is not None:
        shift = np.asarray(planner.controllers.cores.shared.layout.shift)
        start["previous_moves"] = shift[: structure.block_count, : structure.block_count] @ earlier.moves
    if earlier.warm is not None:
        start["warm"] = shifted_start(earlier.warm, structure.cv_count)
    return {**instances.now.at(i), **start, "recover": True}
