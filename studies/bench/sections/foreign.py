"""The shipped instances from other processes: our ways to finish beside SCIP and Gurobi, all on one core."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator

import numpy as np

from jaxmpc.controller.case import case_to_dict
from studies.bench.beside import Contest, polished
from studies.bench.context import Context
from studies.bench.folder import shipped, solve
from studies.bench.rows import Row
from studies.bench.sections.exact import WAYS


def foreign(context: Context) -> Iterator[Row]:
    """Rows ``foreign MIQP: SOLVER``; the ratio is to SCIP. Leaves the times of all solvers for performance profiles."""
    cases, known = shipped(context.size.foreign)
    bodies = [case_to_dict(case) for case in cases.values()]
    optima = [known[name].optimum for name in cases]
    limit = context.size.cut_off
    peers = tuple(
        dataclasses.replace(peer, limit=10_000, hopeless=limit) for peer in context.miqp_peers if peer.bounds
    )
    contest = Contest(context, "foreign MIQP", bodies, peers, 1e-7, polished, in_time=True, optima=optima)
    with one_core():
        for finish, label in WAYS.items():
            context.say(f"{contest.name}: {label}")
            found = [solve(case, limit, finish) for case in cases.values()]
            plans = [plan.moves if plan.status == "optimal" else None for _, plan in found]
            contest.enter(finish, np.array([seconds for seconds, _ in found]), plans)
        contest.ask_peers()
    note = (
        f"Planner.solve, nothing kept from before, compilation left out; stopped after {limit:g} s; one core"
    )
    for finish, label in WAYS.items():
        row = contest.row(finish, label, note=note)
        row.counts = row.worst_error is None or row.counts  # not solved in time is not wrong
        yield row
    yield from contest.peer_rows()
    context.series["foreign"] = {WAYS.get(who, who): seconds for who, seconds in contest.solved().items()}


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Keep all threads of this process on one core, where the system can."""
    if not os.path.isdir("/proc/self/task"):
        yield
        return
    before = os.sched_getaffinity(0)

    def keep(cores: set[int]) -> None:
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError):  # it has ended
                os.sched_setaffinity(int(thread), cores)

    keep({min(before)})
    try:
        yield
    finally:
        keep(before)
