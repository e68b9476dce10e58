"""How far a study is: what its store holds, what is damaged, how fast it went, and what to do next."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from jaxmpc.errors import InputError
from studies.definition.estimate import Work, megabytes, readable
from studies.store.files import Survey, open_manifest, survey
from studies.store.layout import FLAG
from studies.store.reading import read_small
from studies.store.writing import held


@dataclass(frozen=True)
class StudyStatus:
    """The state of a store at one moment; printed, it reads as a few lines.

    Attributes:
        failed: scenarios in stored chunks that did not run to their end (``complete`` 0).
        bytes: size of the files of the study [B].
        damaged: damaged files with what is wrong; their chunks are not among the stored ones.
        rate: scenarios per second of one worker, from the recorded wall times; NaN without any.
        seconds_left: what one worker needs for the rest [s], every group by its own stored chunks (`estimate.Work`);
            NaN where the store does not say what the chunks are.
        definition: what follows ``jaxmpc study run``, quoted for a shell, as far as the provenance says; empty for a
            comparison, whose store is not given.
    """

    store: Path
    title: str
    chunks_done: int
    chunks_total: int
    scenarios_done: int
    scenarios_total: int
    failed: int
    bytes: int
    damaged: tuple[str, ...]
    rate: float
    seconds_left: float
    running: bool
    definition: str = "STUDY.toml"

    @property
    def so_far(self) -> str:
        """How much of the study is stored where."""
        share = self.scenarios_done / self.scenarios_total
        return (
            f"{self.scenarios_done} of {self.scenarios_total} scenarios ({share:.0%}), "
            f"{self.chunks_done} of {self.chunks_total} chunks, {megabytes(self.bytes)} in {self.store}"
        )

    @property
    def pace(self) -> str:
        """How fast it went and what the rest takes; empty where nothing was measured."""
        if not np.isfinite(self.rate):
            return ""
        left = self.chunks_done < self.chunks_total and np.isfinite(self.seconds_left)
        more = f"; it needs about {readable(self.seconds_left)} for the rest" if left else ""
        return f"One worker computed {self.rate:.3g} scenarios per second{more}."

    def __str__(self) -> str:
        lines = [f"{self.title}: {self.so_far}"]
        if self.failed:
            lines.append(f"{self.failed} scenarios did not run to their end (complete = 0).")
        if self.pace:
            lines.append(self.pace)
        lines += [f"Damaged: {name}" for name in self.damaged]
        again = ", give the command of the study again."
        if self.definition:
            again = f":\n  jaxmpc study run {self.definition} --store {shlex.quote(str(self.store))}"
        if self.running:
            lines.append("A run is writing it now.")
        elif self.damaged:
            lines.append(f"To compute what is damaged or missing again{again}")
        elif self.chunks_done < self.chunks_total:
            lines.append(f"To continue{again}")
        else:
            lines.append(f"Complete. To compute what a changed definition adds, and nothing else{again}")
        return "\n".join(lines)


def status(path: str | Path, verify: bool = False) -> StudyStatus:
    """Look at a store without changing it.

    Args:
        path: of the store, ending in ``.zarr``, or of the folder that holds it as ``study.zarr``.
        verify: read every file and compare checksums; without it trajectories are only looked at for their size.

    Raises:
        InputError: if there is no store or its fixed files are damaged.
    """
    store, manifest = open_manifest(path)
    root = zarr.open_group(str(store), mode="r", zarr_format=3)
    found = survey(store, manifest["contents"], deep=verify)
    tables = read_small(store, found, {name: root[name] for name in manifest["variables"]})
    counts, size = manifest["chunk_counts"], manifest["chunk_size"]
    failed, work, computed = 0, 0.0, 0
    for chunk, record in found.records.items():
        if FLAG in tables:
            failed += int((tables[FLAG][chunk * size : chunk * size + counts[chunk]] <= 0).sum())
        if "wall_time" in record["facts"]:
            work += float(record["facts"]["wall_time"])
            computed += counts[chunk]
    files = [manifest["files"], *(record["files"] for record in found.records.values())]
    return StudyStatus(
        store=store,
        title=manifest["title"] or manifest["name"],
        chunks_done=len(found.records),
        chunks_total=len(counts),
        scenarios_done=sum(counts[i] for i in found.records),
        scenarios_total=sum(counts),
        failed=failed,
        bytes=sum(sum(sizes.values()) for sizes in files),
        damaged=tuple(found.damage),
        rate=computed / work if work > 0 else float("nan"),
        seconds_left=_seconds_left(root.attrs, found),
        running=held(store),
        definition=str(
            root.attrs.get("definition_file", "STUDY.toml" if manifest["rows"] == "scenario" else "")
        ),
    )


def status_of(path: str | Path, study_hash: str) -> StudyStatus | None:
    """The state of a store if it is there, undamaged in its fixed files, and of the study with this hash."""
    try:
        _, manifest = open_manifest(path)
        return status(path) if manifest["study_hash"] == study_hash else None
    except InputError:
        return None


def _seconds_left(attributes: Mapping[str, Any], found: Survey) -> float:
    if "work" not in attributes:
        return float("nan")
    work = Work(**json.loads(attributes["work"]))
    return work.rest({chunk: record["facts"] for chunk, record in found.records.items()})
