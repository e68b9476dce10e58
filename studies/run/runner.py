"""Runs the missing chunks of a sweep study, in this process, in several, or on a `dask.distributed` cluster.

Only this process writes the store, a chunk at a time as it arrives, so whatever happens to a worker, the scheduler or
this process, everything stored stays and the same command goes on from there.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tqdm import tqdm

from jaxmpc.check import is_count
from jaxmpc.errors import InputError
from jaxmpc.programs.interrupts import last_words
from studies.definition.scenarios import Study
from studies.run.chunk import ChunkResult, PreparedStudy, prepare_study, study_layout
from studies.run.executors import Cluster, Executor, LostError, Processes, connect, disconnect
from studies.run.progress import progress_bar
from studies.store.reading import chunk_facts
from studies.store.writing import Store

TRIES = 3  # of a chunk whose worker dies
LOOK = 5.0  # s between two looks whether those who compute are still there
CLUSTER_FORGOT = concurrent.futures.BrokenExecutor("the cluster has dropped it")
Say = Callable[[str], None]


class RunError(RuntimeError):
    """Chunks that could not be computed; everything else is stored."""


def run_study(
    study: Study,
    store: str | Path,
    *,
    workers: int = 1,
    dask: str | None = None,
    command: str | None = None,
    progress: bool = True,
    say: Say = tqdm.write,
) -> Path:
    """Compute what is missing of a study and store every chunk as soon as it is done.

    Args:
        store: path that ends in ``.zarr``, or a folder that is to hold ``study.zarr``.
        workers: processes on this machine; 1 computes in this process. With more, a script of your own has to keep
            what it does below ``if __name__ == "__main__":``, as always with spawned processes.
        dask: address of a `dask.distributed` scheduler, in place of `workers`.
        command: words after ``jaxmpc study run`` that give this study, for `status`; see `chunk.study_layout`.

    Raises:
        InputError: for bad arguments, a store that another run holds, a scheduler that does not answer, or a full
            disk; what is stored stays.
        MissingToolError: if `dask` is asked for and not installed.
        RunError: naming the chunks that failed, after all others are stored, or the cluster that was lost.
        KeyboardInterrupt: after Ctrl-C, once the workers are stopped; says how much is stored.
    """
    if not is_count(workers):
        raise InputError("workers", workers, "1 or more processes")
    if dask is not None and workers != 1:
        raise InputError("workers", workers, "1 with a dask address: the cluster has workers of its own")
    with contextlib.ExitStack() as stack:
        client = None
        if dask is not None:
            client = connect(dask)
            stack.callback(disconnect, client)
        writer = stack.enter_context(Store.begin(store, study_layout(study, command), say))
        missing = writer.pending()
        if len(missing) < len(study.chunks):
            say(_stored(study, writer))
        failed: dict[int, BaseException] = {}
        try:
            if missing:
                done = chunk_facts(writer.path)
                stored = sum(len(study.chunks[i].scenarios) for i in done)
                with (
                    last_words(lambda: f"{_stored(study, writer)} Give the same command again to go on."),
                    _executor(prepare_study(study), workers, client, say) as executor,
                    progress_bar(study.name, study.count, stored, study.work, done, progress) as bar,
                ):
                    for result in _results(executor, missing, failed, say):
                        writer.commit(result.index, result.fields, result.facts)
                        bar.add(result.index, result.facts, len(study.chunks[result.index].scenarios))
        except LostError as error:
            raise RunError(
                f"Stopped: {error}. {_stored(study, writer)} Give the same command again, also with other workers, "
                "to go on."
            ) from None
        if failed:
            raise RunError(_failures(study, failed))
        say(f"{study.count} scenarios: {writer.path}")
        return writer.path


def _stored(study: Study, writer: Store) -> str:
    count = len(study.chunks) - len(writer.pending())
    return f"{count} of {len(study.chunks)} chunks are stored."


def _failures(study: Study, failed: dict[int, BaseException]) -> str:
    shown = sorted(failed.items())[:5]
    more = f" The first {len(shown)}:" if len(shown) < len(failed) else ""
    lines = [f"{len(failed)} of {len(study.chunks)} chunks failed, all others are stored.{more}"]
    for index, error in shown:
        numbers = study.chunks[index].scenarios
        lines.append(
            f"chunk {index} (scenarios {numbers[0]} to {numbers[-1]}): {type(error).__name__}: {error}."
        )
    lines.append("Give the same command again to try only these.")
    return " ".join(lines)


# -------------------------------------------------------------------------------------------------------- results


def _executor(prepared: PreparedStudy, workers: int, client: Any, say: Say) -> Executor:
    if client is not None:
        return Cluster(prepared, client, say)
    return Executor(prepared) if workers == 1 else Processes(prepared, workers)


def _results(
    executor: Executor, missing: list[int], failed: dict[int, BaseException], say: Say
) -> Iterator[ChunkResult]:
    """Results in the order of their arrival.

    When a process dies, nobody knows which of the chunks under way was to blame: these are then handed out one at a
    time, and one that is alone when it happens has `TRIES`.
    """
    waiting, suspects = list(reversed(missing)), list[int]()
    tries = dict.fromkeys(missing, 0)
    running: dict[concurrent.futures.Future[ChunkResult], int] = {}
    arrived = False
    while waiting or suspects or running:
        alone = bool(suspects)
        if alone and not running:
            index = suspects.pop()
            tries[index] += 1
            running[executor.submit(index)] = index
        while not alone and waiting and len(running) < executor.width:
            index = waiting.pop()
            running[executor.submit(index)] = index
        done, _ = concurrent.futures.wait(running, LOOK, concurrent.futures.FIRST_COMPLETED)
        for future in sorted(done, key=lambda future: future.cancelled()):  # what has arrived is stored first
            if future.cancelled():
                executor.check()
            index = running.pop(future)
            error = CLUSTER_FORGOT if future.cancelled() else future.exception()
            if error is None:
                arrived = True
                yield future.result()
            elif isinstance(error, concurrent.futures.BrokenExecutor) and tries[index] < TRIES:
                suspects.append(index)
                say(f"A worker died; chunk {index} is computed again.")
            elif isinstance(error, LostError):
                raise error
            else:
                failed[index] = error
                say(f"Chunk {index} failed: {type(error).__name__}: {error}")
                if isinstance(error, concurrent.futures.BrokenExecutor) and len(failed) > 1 and not arrived:
                    raise LostError("no worker has lived long enough to compute a single chunk")
        executor.check()
