"""Time of compiled calls and of bars, without what first calls take to compile; and what keeps a short time short."""

from __future__ import annotations

import contextlib
import gc
import threading
import time
from collections.abc import Iterator
from typing import Any

import jax


class _Compiling(threading.local):
    """Seconds that this thread has spent on compilation; begin of every part of it, and the seconds before."""

    def __init__(self):
        self.seconds, self.parts = 0.0, list[tuple[float, float]]()


_here = _Compiling()


def _heard(event: str, duration_secs: float, **_: Any) -> None:
    if event.startswith("/jax/core/compile"):
        begin = time.perf_counter() - duration_secs
        while _here.parts and _here.parts[-1][0] >= begin:  # a part of this one, which ends later
            _here.seconds = _here.parts.pop()[1]
        _here.parts.append((begin, _here.seconds))
        _here.seconds += duration_secs


jax.monitoring.register_event_duration_secs_listener(_heard)


class Clock:
    """Wall time since it was made, compilation by the same thread left out."""

    def __init__(self):
        self.begin, self.compiled = time.perf_counter(), _here.seconds

    @property
    def seconds(self) -> float:
        """Since the start [s]."""
        return max(time.perf_counter() - self.begin - (_here.seconds - self.compiled), 0.0)


@contextlib.contextmanager
def in_time(limit: float | None) -> Iterator[None]:
    """With a time limit nothing waits for a search for garbage, which takes a fifth of a second among compiled programs."""
    if limit is None or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
