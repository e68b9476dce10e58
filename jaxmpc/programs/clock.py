"""Time of compiled calls and of bars, without what first calls take to compile."""

from __future__ import annotations

import threading
import time
from typing import Any

import jax


class _Compiling(threading.local):
    """Seconds that this thread has spent on compilation."""

    seconds = 0.0


_here = _Compiling()


def _heard(event: str, duration_secs: float, **_: Any) -> None:
    if event.startswith("/jax/core/compile"):
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
