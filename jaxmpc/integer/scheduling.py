"""Runs many searches side by side: their relaxations share batched calls, their MILPs run in threads.

`integer.solve` builds the searches. Every round collects what all searches wait for, so that a batch of scenarios costs
few compiled calls; a scenario that is done drops out and costs nothing more.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import os

import jax
import numpy as np

from jaxmpc.integer.host_search import Offload, Request, Search, SearchResult, Steps
from jaxmpc.integer.relaxer import LANES, Relaxations, Relaxer
from jaxmpc.problem.instance import QpInstance
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.interrupts import being_left
from jaxmpc.programs.progress import Seen, watched
from jaxmpc.relaxed.newton import MOST_STEPS
from jaxmpc.status import OPTIMAL


class _Run:
    """One search under way: its generator, what it waits for, and where its result goes."""

    def __init__(self, number: int, search: Search, steps: Steps):
        self.number, self.search, self.steps = number, search, steps
        self.waits: Request | Offload | None = None
        self.future: concurrent.futures.Future | None = None
        self.left: float | None = None  # seconds to the time limit when the work in the thread began,
        self.began = Clock()  # and what has passed since
        self.result: SearchResult | None = None

    def send(self, value) -> None:
        """Go on with an answer, up to the next question or the end."""
        clock = self.search.clock = Clock()
        try:
            self.waits = self.steps.send(value)
        except StopIteration as end:
            self.waits, self.result = None, end.value
        self.search.spent += clock.seconds
        self.search.clock = None

    def submit(self, pool: concurrent.futures.Executor) -> None:
        """Begin the work that it waits for."""
        assert isinstance(self.waits, Offload)
        self.future = pool.submit(_timed, self.waits.work)
        self.left, self.began = self.search.seconds_left(), Clock()

    @property
    def patience(self) -> float | None:
        """Seconds that it still waits for the work in the thread, None for any time."""
        return None if self.left is None else max(self.left - self.began.seconds, 0.0)

    def collect(self) -> bool:
        """Go on if the work in the thread has ended, or without it if its time has; whether work was left to itself."""
        assert self.future is not None
        late = not self.future.done() and self.patience == 0.0
        if self.future.done():
            value, seconds = self.future.result()
        elif late:
            value, seconds, self.search.stopped = None, self.began.seconds, True
        else:
            return False
        self.future = None
        self.search.spent += seconds
        self.send(value)
        return late


def run(
    relaxer: Relaxer, instances: QpInstance, searches: list[tuple[int, Search, Steps]]
) -> list[SearchResult]:
    """Run searches to their ends.

    Args:
        relaxer: compiled relaxations of the scenarios.
        instances: problems of all scenarios, first axis ``"scenario"``.
        searches: scenario number, state and generator of each.

    Returns:
        Their results, in the same order.
    """
    runs = [_Run(*entry) for entry in searches]
    if any(search.time_limit is not None for _, search, _ in searches):
        return _run(relaxer, instances, runs)
    before = [search.spent for _, search, _ in searches]

    def seen(seconds: float) -> Seen:
        k = next((k for k, one in enumerate(runs) if one.result is None), len(runs) - 1)
        return runs[k].search.seen_after(before[k] + seconds)

    with watched(seen) if runs else contextlib.nullcontext():
        return _run(relaxer, instances, runs)


def _run(relaxer: Relaxer, instances: QpInstance, runs: list[_Run]) -> list[SearchResult]:
    """Run searches to their ends."""
    for one in runs:
        one.send(None)
    pool, left_alone = None, False
    try:
        while any(one.result is None for one in runs):
            clock, active = Clock(), [one for one in runs if one.result is None]
            charged = sum(one.search.spent for one in active)
            for one in runs:
                if isinstance(one.waits, Offload) and one.future is None:
                    if pool is None:
                        pool = concurrent.futures.ThreadPoolExecutor(os.cpu_count())
                    one.submit(pool)
            asking = [one for one in runs if isinstance(one.waits, Request)]
            if asking:
                _answer(relaxer, instances, asking)
            waiting = [one for one in runs if one.future is not None]
            if waiting and not asking:
                concurrent.futures.wait(
                    [one.future for one in waiting if one.future is not None],
                    min((one.patience for one in waiting if one.patience is not None), default=None),
                    return_when=concurrent.futures.FIRST_COMPLETED,
                )
            for one in waiting:
                left_alone |= one.collect()
            # what was charged to nobody is what it takes to serve them
            served = clock.seconds - (sum(one.search.spent for one in active) - charged)
            for one in active:
                one.search.spent += max(served, 0.0) / len(active)
    finally:
        if pool is not None:
            pool.shutdown(wait=not (being_left() or left_alone), cancel_futures=True)
    return [one.result for one in runs if one.result is not None]


def _timed(work):
    clock = Clock()
    return work(), clock.seconds


def _answer(relaxer: Relaxer, instances: QpInstance, asking: list[_Run]) -> None:
    """Solve what these searches wait for, and go on with them; those whose time limit is far share batches."""
    together = []
    for one in asking:
        request, left = one.waits, one.search.seconds_left()
        assert isinstance(request, Request)
        count = len(request.limits.lower)
        if left is None or relaxer.pace.steps_within(left / count) >= MOST_STEPS:
            together.append((one, request))
        else:
            one.send(_solved_in_time(relaxer, instances, one, request))
    if together:
        _solve_together(relaxer, instances, together)


def _solve_together(relaxer: Relaxer, instances: QpInstance, some: list[tuple[_Run, Request]]) -> None:
    """Requests of searches in shared batches, each charged for its lanes."""
    counts = [len(request.limits.lower) for _, request in some]
    index = np.repeat([one.number for one, _ in some], counts)
    join = lambda *leaves: leaves[0] if len(leaves) == 1 else np.concatenate(leaves)  # noqa: E731
    clock = Clock()
    result = relaxer.solve(
        instances,
        index,
        jax.tree.map(join, *(request.limits for _, request in some)),
        jax.tree.map(join, *(request.starts for _, request in some)),
        join(*(request.most for _, request in some)),
    )
    per_lane = clock.seconds / len(index)
    first = 0
    for (one, _), count in zip(some, counts, strict=True):
        one.search.spent += per_lane * count
        one.send(result.part(first, first + count))
        first += count


def _solved_in_time(
    relaxer: Relaxer, instances: QpInstance, one: _Run, request: Request
) -> Relaxations | None:
    """As many of the lanes, the first ones, as are solved before the time limit of their search."""
    search, count, done = one.search, len(request.limits.lower), 0
    all_of = request.limits, request.starts, request.most
    some = lambda begin, end: jax.tree.map(lambda leaf: leaf[begin:end], all_of)  # noqa: E731
    parts = []
    while done < count:
        left = search.seconds_left()
        assert left is not None
        lanes = min(count - done, LANES)
        if request.most.any():
            lanes = min(lanes, relaxer.pace.lanes_within(left))
        if not lanes:
            break
        in_time = relaxer.pace.steps_within(left / lanes)
        *given, most = some(done, done + lanes)
        clock = Clock()
        result = relaxer.solve(instances, np.full(lanes, one.number), *given, np.minimum(most, in_time))
        search.spent += clock.seconds
        # a lane that the clock has stopped proves little, but its moves may be good
        stopped = (result.steps >= in_time) & (result.status != OPTIMAL) & (most > 0.0)
        good = int(np.argmax(stopped)) if stopped.any() else lanes
        for lane in range(good, lanes):
            search.offer(result, lane)
        parts.append(result.part(0, good))
        done += good
        if stopped.any() and lanes == 1:
            break
    return Relaxations.joined(parts) if parts else None
