"""Runs many searches side by side: their relaxations share batched calls, their MILPs run in threads.

`integer.solve` builds the searches. Every round collects what all searches wait for, so that a batch of scenarios costs
few compiled calls; a scenario that is done drops out and costs nothing more.
"""

from __future__ import annotations

import concurrent.futures
import os

import jax
import numpy as np

from jaxmpc.integer.host_search import Offload, Request, Search, SearchResult, Steps
from jaxmpc.integer.relaxer import Relaxer
from jaxmpc.problem.instance import QpInstance
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.interrupts import being_left


class _Run:
    """One search under way: its generator, what it waits for, and where its result goes."""

    def __init__(self, number: int, search: Search, steps: Steps):
        self.number, self.search, self.steps = number, search, steps
        self.waits: Request | Offload | None = None
        self.future: concurrent.futures.Future | None = None
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
    for one in runs:
        one.send(None)
    pool = None
    try:
        while any(one.result is None for one in runs):
            for one in runs:
                if isinstance(one.waits, Offload) and one.future is None:
                    if pool is None:
                        pool = concurrent.futures.ThreadPoolExecutor(os.cpu_count())
                    one.future = pool.submit(_timed, one.waits.work)
            asking = [one for one in runs if isinstance(one.waits, Request)]
            if asking:
                _answer(relaxer, instances, asking)
            waiting = [one for one in runs if one.future is not None]
            if waiting and not asking:
                concurrent.futures.wait(
                    [one.future for one in waiting if one.future is not None],
                    return_when=concurrent.futures.FIRST_COMPLETED,
                )
            for one in waiting:
                if one.future is not None and one.future.done():
                    value, seconds = one.future.result()
                    one.future = None
                    one.search.spent += seconds
                    one.send(value)
    finally:
        if pool is not None:
            pool.shutdown(wait=not being_left(), cancel_futures=True)
    return [one.result for one in runs if one.result is not None]


def _timed(work):
    clock = Clock()
    return work(), clock.seconds


def _answer(relaxer: Relaxer, instances: QpInstance, asking: list[_Run]) -> None:
    """Solve what these searches wait for in shared batches, charge each for its lanes, and go on with them."""
    requests = [one.waits for one in asking if isinstance(one.waits, Request)]
    counts = [len(request.limits.lower) for request in requests]
    index = np.repeat([one.number for one in asking], counts)
    join = lambda *leaves: leaves[0] if len(leaves) == 1 else np.concatenate(leaves)  # noqa: E731
    clock = Clock()
    result = relaxer.solve(
        instances,
        index,
        jax.tree.map(join, *(request.limits for request in requests)),
        jax.tree.map(join, *(request.starts for request in requests)),
    )
    per_lane = clock.seconds / len(index)
    first = 0
    for one, count in zip(asking, counts, strict=True):
        one.search.spent += per_lane * count
        one.send(result.part(first, first + count))
        first += count
