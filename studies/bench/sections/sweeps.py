"""What a sweep study costs beside its closed loops: runner, store, opening results, resuming, memory."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.errors import InputError
from studies.bench.context import Context
from studies.bench.judge import taken
from studies.bench.rows import Goal, Row
from studies.definition.scenarios import Study, expand_sweep
from studies.definition.sweep import StudyDefinition
from studies.run.chunk import stored_variables
from studies.run.runner import run_study
from studies.store.layout import Column, StoreLayout
from studies.store.reading import chunk_facts, kpi_frame
from studies.store.writing import Store
from studies.thesis.well import WELL

CHUNK = 64
QUIET: dict[str, Any] = {"progress": False, "say": lambda _: None}
SHARE = 0.05  # of the time of the closed loops that everything else may take
GROWTH = 1.1  # of the peak memory when there are many times as many scenarios


def sweeps(context: Context) -> Iterator[Row]:
    """Rows of overhead, opening, resuming and memory."""
    size = context.size
    with tempfile.TemporaryDirectory(prefix="jaxmpc-bench-") as name:
        folder = Path(name)
        yield _overhead(context, folder, size.sweep_chunks, size.sweep_samples)
        yield _opening(context, folder, size.sweep_stored)
        yield _resuming(context, folder, size.sweep_scanned)
        yield from _memory(context, folder, size.sweep_memory)


def _overhead(context: Context, folder: Path, chunks: int, samples: int) -> Row:
    context.say(f"{chunks} chunks of {CHUNK} continuous scenarios, {samples} samples, stored")
    run_study(_study(1, samples), folder / "warm.zarr", **QUIET)
    study = _study(chunks, samples)
    elapsed, path = taken(lambda: run_study(study, folder / "overhead.zarr", **QUIET))
    simulated = sum(facts["simulation_time"] for facts in chunk_facts(path).values())
    frame, rest = kpi_frame(path), elapsed - simulated
    row = _row(f"all but the closed loops, {chunks} chunks of {CHUNK}", rest, len(frame), SHARE * simulated)
    row.note = (
        f"runner, key figures and store in {elapsed:.1f} s, of which {simulated:.1f} s are closed loops: "
        f"{100 * rest / simulated:.1f} %; the floor is {100 * SHARE:.0f} %, compiled before"
    )
    return _counted(row, np.asarray(frame["complete"]).sum())


def _opening(context: Context, folder: Path, count: int) -> Row:
    context.say(f"key figures of {count} stored scenarios")
    layout = _layout(count, CHUNK)
    with _made_up(folder / "opening.zarr", layout, len(layout.chunk_scenarios)) as store:
        path = store.path
    seconds, frame = taken(lambda: kpi_frame(path))
    row = _row(
        f"key figures of {count} scenarios as a table", seconds, count, 2.0 if count >= 10_000 else None
    )
    return _counted(row, (np.asarray(frame[f"travel.{WELL.mv_names[0]}"]) == np.arange(count)).sum())


def _resuming(context: Context, folder: Path, chunks: int) -> Row:
    context.say(f"what is missing of {chunks} chunks")
    with _made_up(folder / "resuming.zarr", _layout(chunks * 2, 2), chunks - 1) as store:
        seconds, missing = taken(store.pending)
    row = _row(f"what is missing of {chunks} chunks", seconds, chunks, 1.0 if chunks >= 1000 else None)
    row.counts = missing == [chunks - 1]
    return row


def _row(what: str, seconds: float, instances: int, most: float | None) -> Row:
    """A row of the seconds of a whole, which may be so many."""
    goals = () if most is None else (Goal("seconds", most),)
    return Row(name=f"sweep: {what}", instances=instances, seconds=seconds, goals=goals)


def _counted(row: Row, right: Any) -> Row:
    """The row with how many of its instances came out right, which all have to."""
    row.solved = int(right)
    row.counts = row.solved == row.instances
    return row


def _memory(context: Context, folder: Path, chunks: tuple[int, int]) -> Iterator[Row]:
    few = None
    for count in chunks:
        context.say(f"peak memory of {count * CHUNK} scenarios")
        command = [sys.executable, "-m", __name__, str(count), str(folder / f"memory-{count}.zarr")]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        row = Row(name=f"sweep: peak memory of {count * CHUNK} scenarios", instances=count * CHUNK)
        if done.returncode:
            row.status, row.counts, row.note = "failed", False, " ".join(done.stderr.split())[-200:]
        else:
            row.megabytes = float(done.stdout.split()[-1])
            row.goals = () if few is None else (Goal("megabytes", GROWTH * few),)
            row.note = (
                "continuous, 20 samples, a process of its own; more scenarios must not need a tenth more"
            )
            few = row.megabytes
        yield row


def _study(chunks: int, samples: int) -> Study:
    body = {
        "study": {"name": "bench", "chunk_size": CHUNK, "confirmation_limit": 10**6},
        "base": {"actuator": "step", "reference": "quick", "duration": 10.0 * samples},
        "axes": [
            {
                "key": f"tuning.move_weight.{WELL.mv_names[0]}",
                "range": {"from": 60.0, "to": 2000.0, "count": CHUNK * chunks, "scale": "log"},
            }
        ],
    }
    return expand_sweep(StudyDefinition.from_dict(body))


def _layout(count: int, size: int) -> StoreLayout:
    everyone = np.arange(count)
    return StoreLayout(
        name="made-up",
        title="made-up",
        study_hash="made-up",
        chunk_size=size,
        chunk_scenarios=tuple(everyone[i : i + size] for i in range(0, count, size)),
        scenario_hashes=tuple(str(k) for k in everyone),
        columns=(Column("seed", "seed", "1", everyone.astype(float)),),
        variables=stored_variables(WELL, ()),
        coords={"cv": (list(WELL.cv_names), "", "CV"), "mv": (list(WELL.mv_names), "", "MV")},
        provenance={},
    )


@contextlib.contextmanager
def _made_up(path: Path, layout: StoreLayout, chunks: int) -> Iterator[Store]:
    """A store with its first chunks filled: every number is that of its scenario."""
    with Store.begin(path, layout, say=lambda _: None) as store:
        for i, numbers in enumerate(layout.chunk_scenarios[:chunks]):
            fields = {}
            for variable in layout.variables:
                shape = layout.shape(variable)
                wide = np.broadcast_to(numbers.reshape(-1, *[1] * len(shape)), (len(numbers), *shape))
                fields[variable.name] = wide.astype(variable.dtype)
            store.commit(i, fields, {})
        yield store


def _peak_megabytes() -> float:
    try:
        import resource
    except ImportError:
        raise InputError("memory", sys.platform, "a system that reports the memory of a process") from None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


if __name__ == "__main__":  # one measurement of memory, in a process of its own
    run_study(_study(int(sys.argv[1]), 20), Path(sys.argv[2]), **QUIET)
    print(_peak_megabytes())
