"""Exact mixed-integer problems: our ways to finish beside SCIP, Gurobi and DAQP on the same samples."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmpc.controller.continuous import shift_plan
from jaxmpc.controller.mixed_integer import MixedIntegerController
from jaxmpc.controller.plan import Plan
from jaxmpc.relaxed.solve import shifted_start
from studies.bench import forms
from studies.bench.context import Context, absent, ask, asked
from studies.bench.instances import Instances, make_controller
from studies.bench.judge import Judge, ratio, time_each
from studies.bench.peers import Peer, piqp
from studies.bench.rows import RIGHT, Goal, Row, timed

GAP = 1e-6  # relative, as the controllers ask for
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
        context.say(f"exact MIQP, {mode}")
        instances = context.recordings.instances("mixed-integer", mode, context.size.exact)
        yield from _beside_peers(context, mode, instances)
        context.say(f"exact MIQP, {mode}: longest solves")
        hardest = context.recordings.instances("mixed-integer", mode, context.size.hardest, hardest=True)
        judge, name = (
            Judge([hardest.case(i) for i in range(len(hardest))]),
            f"exact MIQP, {mode}, longest solves",
        )
        found = {finish: _ours(mode, hardest, finish, judge) for finish in WAYS}
        for finish, seconds in found.items():
            yield timed(
                f"{name}: {WAYS[finish]}",
                "exact",
                seconds,
                judge.errors(finish),
                note=f"the {len(hardest)} samples of the run that took longest; the ways to finish check each other",
            )


def _beside_peers(context: Context, mode, instances: Instances) -> Iterator[Row]:
    name, cases = f"exact MIQP, {mode}", [instances.case(i) for i in range(len(instances))]
    judge = Judge(cases)
    ours = {}
    for finish in WAYS:
        context.say(f"{name}: {WAYS[finish]}")
        ours[finish] = _ours(mode, instances, finish, judge)
    theirs: dict[str, tuple[np.ndarray, np.ndarray, list[Any]]] = {}
    missing = {
        peer.name: absent(peer, context, "exact", f"{name}: {peer.name}") for peer in context.miqp_peers
    }
    for peer in context.miqp_peers:
        if missing[peer.name] is None:
            context.say(f"{name}: {peer.name}")
            at = asked(peer, context, len(cases))
            try:
                seconds, answers, plans = ask(peer, context, [cases[i] for i in at], 1e-7)
            except Exception as error:  # a licence that is too small shows only when it is used
                why = " ".join(str(error).split())
                missing[peer.name] = Row(
                    name=f"{name}: {peer.name}", section="exact", status="failed", note=why
                )
                continue
            judge.hear(peer.name, [_polished(cases[i], plan) for i, plan in zip(at, plans, strict=True)], at)
            theirs[peer.name] = at, seconds, answers
    reference = context.miqp_peers[0].name
    known = theirs.get(reference)
    for finish, seconds in ours.items():
        median, p99 = FLOORS[finish, mode]
        goals = [Goal("median_ms", median), Goal("p99_ms", p99)]
        row = timed(
            f"{name}: {WAYS[finish]}",
            "exact",
            seconds,
            judge.errors(finish),
            note="wall time of Planner.solve, started as in the loop, all programs compiled",
        )
        if known is not None:
            row.ratio, row.ratio_to = ratio(seconds, known[1], known[0]), reference
            row.ratio_is_lower_bound = any(answer.status == "limit" for answer in known[2])
        if finish == "auto":
            goals.append(Goal("ratio", 1000.0, 5000.0))
        row.goals = tuple(goals)
        yield row
    for peer in context.miqp_peers:
        yield missing[peer.name] or _peer_row(context, f"{name}: {peer.name}", peer, theirs[peer.name], judge)


def _peer_row(context: Context, name: str, peer: Peer, found, judge: Judge) -> Row:
    """A peer's row; problems that it did not finish in time are not solved, whatever it had by then."""
    _, seconds, answers = found
    finished = np.array([answer.status == "optimal" for answer in answers])
    row = timed(name, "exact", seconds, np.where(finished, judge.errors(peer.name), np.nan))
    row.counts = row.worst_error is None or row.worst_error <= RIGHT
    row.note = f"{peer.timed}; stopped after {min(peer.hopeless, context.size.cut_off):g} s"
    return row


def _ours(mode, instances: Instances, finish: str, judge: Judge) -> np.ndarray:
    """Seconds of our solves; their plans go to the judge under the name of the way to finish."""
    controller = make_controller("mixed-integer", mode, instances.model)
    problems = [_as_in_the_loop(controller, instances, i) for i in range(len(instances))]

    def solve(i: int) -> Plan:
        return controller.planner.solve(**problems[i], gap=GAP, finish=finish, time_limit=PATIENCE)

    for i in range(len(problems)):  # compiles every form that these problems meet
        solve(i)
    seconds, plans = time_each(solve, len(problems))
    judge.hear(finish, [plan.moves if plan.status == "optimal" else None for plan in plans])
    return seconds


def _as_in_the_loop(controller: MixedIntegerController, instances: Instances, i: int) -> dict[str, Any]:
    """Arguments of `Planner.solve`, with the plan and the prices of one sample earlier as the loop has them."""
    structure = controller.structure
    earlier = controller.planner.solve(**instances.before.at(i), recover=True, gap=GAP, time_limit=PATIENCE)
    start: dict[str, Any] = {}
    if earlier.moves is not None:
        start["previous_moves"] = np.asarray(shift_plan(structure, jnp.asarray(earlier.moves)))
    if earlier.warm is not None:
        start["warm"] = shifted_start(earlier.warm, structure.cv_count, structure.horizon_count)
    return {**instances.now.at(i), **start, "recover": True}


def _polished(case: dict, plan: np.ndarray | None) -> np.ndarray | None:
    """A peer's plan with its integer moves made whole and the others solved again, so that tolerances do not count."""
    if plan is None:
        return None
    form = forms.lifted(case)
    whole = np.round(plan[:, form.integer] / form.units[form.integer]).ravel()
    form.low[form.integers] = form.high[form.integers] = whole
    answer = piqp(1e-10, 10.0)(form)
    if answer.z is None:
        return plan
    moves = form.moves(answer.z)
    moves[:, form.integer] = whole.reshape(len(moves), -1) * form.units[form.integer]
    return moves
