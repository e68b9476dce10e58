"""Compiled programs side by side on the cores of a CPU.

A CPU solves the lanes of a batch one after the other on one core, and compiled programs run without Python's lock. Work on
many lanes is therefore cut into parts of a size that does not depend on the machine, so that results do not
either, and a few threads take one part after the other.
"""

from __future__ import annotations

import concurrent.futures
import os
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

from jaxmpc.programs.interrupts import being_left

T = TypeVar("T")
THREADS = "JAXMPC_THREADS"  # environment variable with the number of threads


def cores() -> int:
    """Threads to use: ``JAXMPC_THREADS`` if set, else the cores that this process may run on; 1 on an accelerator."""
    if jax.default_backend() != "cpu":
        return 1
    given = os.environ.get(THREADS, "")
    return max(int(given), 1) if given.isdecimal() else len(os.sched_getaffinity(0))


def parts_of(count: int, most: int, *, cut: bool = False) -> list[np.ndarray]:
    """Positions 0..count - 1 in parts of equal size, the last filled up with the last position.

    On an accelerator it is one part, unless it has to be `cut`.
    """
    if jax.default_backend() != "cpu" and not cut:
        most = count
    number = -(-count // most)
    size = -(-count // number)
    return [np.minimum(np.arange(size) + k * size, count - 1) for k in range(number)]


def side_by_side(work: Callable[[T, Callable[[], bool]], Any], parts: Sequence[T]) -> list[Any]:
    """Results of work on every part, in order.

    Args:
        work: of a part and of a function that says whether to give up, because another part failed or the user interrupts.
    """
    stopped = threading.Event()
    if len(parts) == 1 or cores() == 1:
        return [work(part, stopped.is_set) for part in parts]
    pool = concurrent.futures.ThreadPoolExecutor(min(cores(), len(parts)))
    try:
        futures = [pool.submit(work, part, stopped.is_set) for part in parts]
        for future in concurrent.futures.as_completed(futures):
            future.result()
        return [future.result() for future in futures]
    finally:
        stopped.set()
        pool.shutdown(wait=not being_left(), cancel_futures=True)
