"""How long a sweep study takes: from one table before the first run, from the chunks themselves as soon as there are any.

A dry run (`scenarios.Study.describe`) has only the table. The bar of a run and `study status` measure: chunks of a group
have one shape and cost about the same, whereas groups differ by factors, so every group is judged by its own chunks.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

# The table: measured on 2 CPU cores with chunks of 64 scenarios and the thesis tuning. Smaller chunks are slower per
# scenario, and tunings that move stepped MVs readily take several times as long.
SAMPLES_PER_SECOND = {"continuous": 4000.0, "mixed-integer": 800.0}  # samples of one scenario
MODEL_SECONDS = 1.0  # identification of one model


def chunk_seconds(kind: str, samples: int, lanes: int) -> float:
    """What the table expects of one chunk [s], compilation never counted; `lanes` has its padding too."""
    return lanes * samples / SAMPLES_PER_SECOND[kind]


@dataclasses.dataclass(frozen=True)
class Work:
    """The chunks of a study and what the table expects of them."""

    groups: Sequence[int]  # index of the group of every chunk
    kinds: Sequence[str]  # kind of controller of every group
    seconds: Sequence[float]  # `chunk_seconds` of every group [s]

    def costs(self, done: Mapping[int, Mapping[str, Any]]) -> list[float]:
        """Seconds that one worker needs for a chunk of each group.

        A group with stored chunks has their mean. A group without any has what the table expects, times measured over
        expected of groups with its kind of controller (of all groups, where none of its kind is measured).

        Args:
            done: facts of stored chunks, as `chunk.ChunkResult` has them; those without ``wall_time`` were not computed.
        """
        times: dict[int, list[float]] = {}
        for chunk in sorted(done):
            if "wall_time" in done[chunk]:
                times.setdefault(self.groups[chunk], []).append(float(done[chunk]["wall_time"]))
        measured = {group: statistics.fmean(seconds) for group, seconds in times.items()}
        pace = {group: seconds / self.seconds[group] for group, seconds in measured.items()}
        costs = []
        for group, (kind, expected) in enumerate(zip(self.kinds, self.seconds, strict=True)):
            alike = [value for other, value in pace.items() if self.kinds[other] == kind]
            factor = statistics.fmean(alike or pace.values() or [1.0])
            costs.append(measured.get(group, factor * expected))
        return costs

    def rest(self, done: Mapping[int, Mapping[str, Any]]) -> float:
        """Seconds that one worker needs for all chunks that are not in `done`, as for `costs`."""
        costs = self.costs(done)
        return sum(costs[group] for chunk, group in enumerate(self.groups) if chunk not in done)


@dataclasses.dataclass(frozen=True)
class Description:
    """What a run would do; see `scenarios.Study.describe`."""

    name: str
    scenarios: int
    group_sizes: tuple[int, ...]  # scenarios of every group
    chunks: int
    compilations: int  # compiled programs; groups of one size share theirs
    models: int  # step-response models to identify
    samples: int  # samples of all scenarios together
    stored_bytes: int  # key figures and trajectories before compression [B]
    seconds: float  # rough time on 2 CPU cores [s]: identification, and what the table says of the chunks
    searched: bool = False  # whether each chunk is a batch that is asked for after the one before

    def __str__(self) -> str:
        sizes, minutes = self.group_sizes, f"{self.seconds / 60:.1f} minutes"
        listed = ", ".join(map(str, sizes[:12])) + (", ..." if len(sizes) > 12 else "")
        batches = f"{self.chunks} batches of {self.scenarios // self.chunks} scenarios"
        lines = {
            "study": self.name,
            "scenarios": f"{self.scenarios} ({self.samples} samples in all)",
            "search": f"{batches}, each asked after the one before",
            "groups": f"{len(sizes)} of equal structure and length, of {listed} scenarios",
            "chunks": self.chunks,
            "to compile": self.compilations,
            "models": f"{self.models} to identify" if self.models else "given by the process",
            "stored": f"{megabytes(self.stored_bytes)} before compression",
            "time": f"about {minutes} on 2 CPU cores; the run measures it by its own chunks",
        }
        del lines["groups" if self.searched else "search"]
        return "\n".join(f"{what:<12}{said}" for what, said in lines.items())


class Pace:
    """The time left of a run, from the chunks that it has computed and from the time that has passed meanwhile.

    With several workers, chunks overlap: the rest of the work is divided by what was computed per second that passed.
    """

    def __init__(
        self, work: Work, done: Mapping[int, Mapping[str, Any]], clock: Callable[[], float] = time.monotonic
    ):
        """Start the clock; `done` are the facts of the chunks that are stored already."""
        self._work, self._done, self._clock = work, dict(done), clock
        self._begin, self._computed = clock(), 0.0

    def add(self, chunk: int, facts: Mapping[str, Any]) -> None:
        """A chunk has arrived."""
        self._done[chunk] = facts
        self._computed += float(facts["wall_time"])

    @property
    def left(self) -> float:
        """Time left [s]; NaN before the first chunk has arrived."""
        if not self._computed:
            return float("nan")
        return self._work.rest(self._done) * (self._clock() - self._begin) / self._computed


def megabytes(size: float) -> str:
    """A size [B] that a person reads."""
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e6:.2g} MB"


def readable(seconds: float) -> str:
    """A time that a person reads."""
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"
