"""The bar of a run: scenarios done, the rate so far, and the time left as the chunks of every group tell it."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from tqdm import tqdm

from jaxmpc.programs.clock import Clock
from studies.definition.estimate import Pace, Work, readable

LAYOUT = "{l_bar}{bar}| {n_fmt}/{total_fmt} scenarios [{elapsed}{postfix}]"


def looks(show: bool) -> dict[str, Any]:
    """What all bars have in common."""
    often = 0.5 if sys.stderr.isatty() else 10.0  # s; a log file needs no more
    return {"disable": not show, "dynamic_ncols": True, "mininterval": often}


class Progress:
    """A bar that is told of every chunk."""

    def __init__(self, bar: tqdm, work: Work, done: Mapping[int, Mapping[str, Any]]):
        """Use `progress_bar`."""
        self._bar, self._clock, self._scenarios = bar, Clock(), 0
        self._pace = Pace(work, done, lambda: self._clock.seconds)

    def add(self, chunk: int, facts: Mapping[str, Any], scenarios: int, more: str = "") -> None:
        """A chunk was computed.

        Args:
            more: to be shown beside rate and time left.
        """
        self._pace.add(chunk, facts)
        self._scenarios += scenarios
        words = [f"{self._scenarios / max(self._clock.seconds, 1e-9):.3g} per second", more]
        left = self._pace.left
        if not math.isnan(left) and left > 0:
            words.insert(0, f"about {readable(left)} left")
        self._bar.set_postfix_str(", ".join(filter(None, words)), refresh=False)
        self._bar.update(scenarios)


@contextlib.contextmanager
def progress_bar(
    name: str, total: int, stored: int, work: Work, done: Mapping[int, Mapping[str, Any]], show: bool
) -> Iterator[Progress]:
    """Show a bar while chunks are computed."""
    with tqdm(desc=name, total=total, initial=stored, bar_format=LAYOUT, **looks(show)) as bar:
        bar.set_postfix_str("compiles what is new to this machine; time left is known after the first chunk")
        yield Progress(bar, work, done)
