"""A long step is seen: what is known of it, on standard error, every two seconds from the second on.

`jaxmpc plan` and `jaxmpc simulate` enter `shown`; the searches on the host say with `watched` what there is to be seen. A
step that ends earlier says nothing, nor does one with a time limit, whose end is known. Quiet where compilation is.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from jaxmpc.programs.compilation import is_quiet, say
from jaxmpc.programs.interrupts import being_left

EVERY = 2.0  # s between two lines, and before the first


class Seen(NamedTuple):
    """Of a search under way: seconds so far, objective of the best plan (infinite without one), bound, relative gap."""

    seconds: float
    objective: float
    bound: float
    gap: float

    def __str__(self) -> str:
        bound = f"bound {self.bound:.6g}" if self.bound > -float("inf") else "no bound yet"
        if self.objective == float("inf"):
            return f"{self.seconds:.0f} s: no plan yet, {bound}"
        return f"{self.seconds:.0f} s: objective {self.objective:.6g}, {bound}, gap {self.gap:.1e}"


class _Shown:
    """Whether steps are shown; a command enters it, and all its threads are seen."""

    def __init__(self):
        self.commands = 0

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        self.commands += 1
        try:
            yield
        finally:
            self.commands -= 1


_shown = _Shown()


def shown() -> contextlib.AbstractContextManager[None]:
    """Long steps are seen as long as this is entered."""
    return _shown.entered()


@contextlib.contextmanager
def watched(seen: Callable[[float], object]) -> Iterator[None]:
    """Show a search, or other long work, as long as this is entered.

    Args:
        seen: what is known of it as text or `Seen`, so many seconds after this was entered; called in a thread of its own.
    """
    if not _shown.commands or is_quiet():
        yield
        return
    ended, begin = threading.Event(), time.monotonic()

    def tell() -> None:
        while not ended.wait(EVERY) and not being_left():
            say(str(seen(time.monotonic() - begin)))

    teller = threading.Thread(target=tell, daemon=True)
    with contextlib.suppress(RuntimeError):  # no thread can be started
        teller.start()
    try:
        yield
    finally:
        ended.set()
        with contextlib.suppress(RuntimeError):
            teller.join()
