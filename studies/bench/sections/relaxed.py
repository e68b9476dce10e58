"""Relaxed QPs: one at a time beside every peer, and in batches over batch size."""

from __future__ import annotations

import time
from collections.abc import Iterator

import jax
import numpy as np

from studies.bench.context import Context, absent, ask, asked
from studies.bench.judge import Judge, ratio, time_each
from studies.bench.lanes import Lanes
from studies.bench.rows import Goal, Row, timed

TOLERANCE = 1e-8  # that the peers are asked for
FLOOR_BATCH = 512


def one_at_a_time(context: Context) -> Iterator[Row]:
    """Rows ``relaxed QP, MODE: SOLVER``; the ratio is to PIQP."""
    for mode in context.size.modes:
        context.say(f"relaxed QP, {mode}")
        instances = context.recordings.instances("continuous", mode, context.size.relaxed)
        cases = [instances.case(i) for i in range(len(instances))]
        judge, lanes, name = Judge(cases), Lanes(instances), f"relaxed QP, {mode}"
        ours = {}
        for start in ("warm", "cold"):
            singles = lanes.singles(getattr(lanes, start))
            lanes.solve_single(singles[0])  # compiles
            seconds, found = time_each(lambda i, s=singles, own=lanes: own.solve_single(s[i]), len(singles))
            judge.hear(start, lanes.plans(np.stack([solution.x for solution in found])))
            ours[start] = seconds
        theirs: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        missing = {
            peer.name: absent(peer, context, "relaxed", f"{name}: {peer.name}") for peer in context.qp_peers
        }
        for peer in context.qp_peers:
            if missing[peer.name] is None:
                context.say(f"relaxed QP, {mode}: {peer.name}")
                at = asked(peer, context, len(cases))
                seconds, _, plans = ask(peer, context, [cases[i] for i in at], TOLERANCE)
                judge.hear(peer.name, plans, at)
                theirs[peer.name] = at, seconds
        reference = context.qp_peers[0].name
        for start, seconds in ours.items():
            known = theirs.get(reference)
            goals = (Goal("ratio", 10.0, 50.0),) if start == "warm" else ()
            yield timed(
                f"{name}: jaxmpc {start}",
                "relaxed",
                seconds,
                judge.errors(start),
                ratio=None if known is None else ratio(seconds, known[1], known[0]),
                ratio_to=reference,
                goals=goals,
                note="one call from the host; "
                + ("starts at the shifted solution one sample earlier" if start == "warm" else "no start"),
            )
        for peer in context.qp_peers:
            row = missing[peer.name]
            if row is not None:
                yield row
                continue
            at, seconds = theirs[peer.name]
            known = theirs.get(reference)
            own = np.full(len(cases), np.nan)
            own[at] = seconds
            common = np.intersect1d(at, known[0]) if known else np.zeros(0, dtype=int)
            yield timed(
                f"{name}: {peer.name}",
                "relaxed",
                seconds,
                judge.errors(peer.name),
                ratio=ratio(own, known[1][np.isin(known[0], common)], common) if known else None,
                ratio_to=reference,
                note=peer.timed,
            )


def batches(context: Context) -> Iterator[Row]:
    """Rows ``batch of N, MODE, warm or cold``; rates, and the ratio to the rate of PIQP on one core."""
    peer = context.qp_peers[0]
    for mode in context.size.modes:
        instances = context.recordings.instances("continuous", mode, context.size.lanes)
        cases = [instances.case(i) for i in range(len(instances))]
        judge, lanes = Judge(cases), Lanes(instances)
        rate_of_peer = None
        if peer.missing() is None:
            context.say(f"batch, {mode}: {peer.name}")
            seconds, _, plans = ask(peer, context, cases, TOLERANCE)
            judge.hear(peer.name, plans)
            rate_of_peer = 1.0 / float(np.median(seconds))
        rates: dict[str, list[float]] = {"batch": [], "warm": [], "cold": []}
        for count in context.size.batches:
            context.say(f"batch of {count}, {mode}")
            rates["batch"].append(count)
            for start in ("warm", "cold"):
                batch = lanes.batch(getattr(lanes, start), count)
                solution = lanes.solve_batch(batch)  # compiles
                repeats = 1 if count > 1000 else 5 if count >= 64 else 20
                seconds = float(np.median([clock(lanes, batch) for _ in range(repeats)]))
                distinct = min(count, len(cases))
                who = f"{count} {start}"
                judge.hear(who, lanes.plans(solution.x[:distinct]))
                repeated = np.asarray(solution.status[distinct:])
                errors = judge.errors(who)
                if repeated.any():  # a repeated lane that is not solved
                    errors[0] = np.inf
                rates[start].append(count / seconds)
                times = None if rate_of_peer is None else count / seconds / rate_of_peer
                goals = (Goal("ratio", 60.0, 150.0),) if count == FLOOR_BATCH else ()
                row = timed(f"batch of {count}, {mode}, {start}", "batch", np.full(1, seconds), errors)
                row.median_ms, row.p99_ms = seconds / count * 1e3, None
                row.rate, row.seconds = count / seconds, seconds
                row.ratio, row.ratio_to, row.goals = times, f"{peer.name} (one core)", goals
                row.note = "median of several calls; time per QP; float64"
                yield row
        if rate_of_peer is not None:
            rates[peer.name] = [rate_of_peer] * len(rates["batch"])
        context.series[f"batch {mode}"] = rates


def clock(lanes: Lanes, batch) -> float:
    """Seconds of one call for a batch."""
    begin = time.perf_counter()
    lanes.solve_batch(batch)
    return time.perf_counter() - begin


def devices(context: Context) -> Iterator[Row]:
    """The batch of 4096 on an accelerator and on the CPU of the same machine; one line where there is none."""
    count, mode = 4096, context.size.modes[0]
    if jax.default_backend() == "cpu":
        yield Row(
            name=f"GPU against CPU, batch of {count}",
            section="gpu",
            status="not measured",
            note="JAX sees no accelerator on this machine",
        )
        return
    instances = context.recordings.instances("continuous", mode, context.size.lanes)
    judge = Judge([instances.case(i) for i in range(len(instances))])
    seconds: dict[str, float] = {}
    for device in (jax.devices("cpu")[0], jax.devices()[0]):
        context.say(f"batch of {count} on {device}")
        with jax.default_device(device):
            lanes = Lanes(instances)
            batch = lanes.batch(lanes.cold, count)
            solution = lanes.solve_batch(batch)
            judge.hear(device.platform, lanes.plans(solution.x[: len(instances)]))
            seconds[device.platform] = min(clock(lanes, batch) for _ in range(5))
    for platform, taken in seconds.items():
        row = timed(
            f"batch of {count}, {mode}, cold, on {platform}", "gpu", np.full(1, taken), judge.errors(platform)
        )
        row.median_ms, row.p99_ms = taken / count * 1e3, None
        row.rate, row.seconds = count / taken, taken
        row.ratio, row.ratio_to = seconds["cpu"] / taken, "the CPU"
        yield row
