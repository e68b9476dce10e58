"""Relaxed QPs: one at a time beside every peer, and in batches over batch size."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np

from studies.bench.beside import Contest, ask
from studies.bench.context import Context
from studies.bench.judge import Judge, taken, time_each
from studies.bench.lanes import Lanes
from studies.bench.rows import Goal, Row, whole

TOLERANCE = 1e-8  # that the peers are asked for
FLOOR_BATCH = 512
STARTS = {"warm": "starts at the shifted solution one sample earlier", "cold": "no start"}


def one_at_a_time(context: Context) -> Iterator[Row]:
    """Rows ``relaxed QP, MODE: SOLVER``; the ratio is to PIQP."""
    for mode in context.size.modes:
        name = f"relaxed QP, {mode}"
        context.say(name)
        instances = context.recordings.instances("continuous", mode, context.size.relaxed)
        contest = Contest(context, name, instances.cases(), context.qp_peers, TOLERANCE)
        lanes = Lanes(instances)
        for start in STARTS:
            singles = lanes.singles(getattr(lanes, start))
            lanes.solve_single(singles[0])  # compiles
            seconds, found = time_each(lanes.solve_single, singles)
            contest.enter(start, seconds, lanes.plans(np.stack([solution.x for solution in found])))
        contest.ask_peers()
        for start, words in STARTS.items():
            goals = (Goal("ratio", 10.0, 50.0),) if start == "warm" else ()
            yield contest.row(start, f"jaxmpc {start}", goals=goals, note=f"one call from the host; {words}")
        yield from contest.peer_rows()


def batches(context: Context) -> Iterator[Row]:
    """Rows ``batch of N, MODE, warm or cold``; rates, and the ratio to the rate of PIQP on one core."""
    peer = context.qp_peers[0]
    for mode in context.size.modes:
        instances = context.recordings.instances("continuous", mode, context.size.lanes)
        judge, lanes = Judge(instances.cases()), Lanes(instances)
        rate_of_peer = None
        if peer.missing() is None:
            context.say(f"batch, {mode}: {peer.name}")
            seconds, _, plans = ask(peer, context, judge.cases, TOLERANCE)
            judge.hear(peer.name, plans)
            rate_of_peer = 1.0 / float(np.median(seconds))
        rates: dict[str, list[float]] = {"batch": [], "warm": [], "cold": []}
        for count in context.size.batches:
            context.say(f"batch of {count}, {mode}")
            rates["batch"].append(count)
            repeats = 1 if count > 1000 else 5 if count >= 64 else 20
            for start in STARTS:
                times, errors = batch_times(lanes, judge, f"{count} {start}", start, count, repeats)
                seconds = float(np.median(times))
                rates[start].append(count / seconds)
                yield whole(
                    f"batch of {count}, {mode}, {start}",
                    seconds,
                    errors,
                    count,
                    ratio=None if rate_of_peer is None else count / seconds / rate_of_peer,
                    ratio_to=f"{peer.name} (one core)",
                    goals=(Goal("ratio", 60.0, 150.0),) if count == FLOOR_BATCH else (),
                    note="median of several calls; time per QP; float64",
                )
        if rate_of_peer is not None:
            rates[peer.name] = [rate_of_peer] * len(rates["batch"])
        context.series[f"batch {mode}"] = rates


def batch_times(
    lanes: Lanes, judge: Judge, who: str, start: str, count: int, repeats: int
) -> tuple[list[float], np.ndarray]:
    """Seconds of every repeated call for a batch, and the errors of its distinct problems, whose plans the judge hears."""
    batch = lanes.batch(getattr(lanes, start), count)
    solution = lanes.solve_batch(batch)  # compiles
    times = [taken(lambda: lanes.solve_batch(batch))[0] for _ in range(repeats)]
    distinct = min(count, len(judge.cases))
    judge.hear(who, lanes.plans(solution.x[:distinct]))
    errors = judge.errors(who)
    if np.asarray(solution.status[distinct:]).any():  # a repeated lane that is not solved
        errors[0] = np.inf
    return times, errors


def devices(context: Context) -> Iterator[Row]:
    """The batch of 4096 on an accelerator and on the CPU of the same machine; one line where there is none."""
    count, mode = 4096, context.size.modes[0]
    if jax.default_backend() == "cpu":
        name, note = f"GPU against CPU, batch of {count}", "JAX sees no accelerator on this machine"
        yield Row(name=name, status="not measured", note=note)
        return
    instances = context.recordings.instances("continuous", mode, context.size.lanes)
    judge = Judge(instances.cases())
    seconds: dict[str, float] = {}
    for device in (jax.devices("cpu")[0], jax.devices()[0]):
        context.say(f"batch of {count} on {device}")
        with jax.default_device(device):
            times, _ = batch_times(Lanes(instances), judge, device.platform, "cold", count, 5)
        seconds[device.platform] = min(times)
    for platform, own in seconds.items():
        name, errors = f"batch of {count}, {mode}, cold, on {platform}", judge.errors(platform)
        yield whole(name, own, errors, count, ratio=seconds["cpu"] / own, ratio_to="the CPU")
