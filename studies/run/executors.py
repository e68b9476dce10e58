"""Where chunks are computed: in this process, in several, or on a `dask.distributed` cluster; used by `runner`.

Each of them submits the number of a chunk and returns a `concurrent.futures.Future` of its `ChunkResult`. Processes are
spawned, never forked. They do not outlive the process that started them, however that ends.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import logging
import multiprocessing
import os
import platform
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Self

from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.programs.interrupts import held
from jaxmpc.programs.threads import THREADS, cores
from studies.definition.scenarios import code_hash
from studies.run.chunk import ChunkResult, PreparedStudy, run_chunk

AHEAD = 2  # chunks handed out per worker, so that none waits for the store
CONNECT_SECONDS = 8.0  # to reach a scheduler
ASK_SECONDS = 5.0  # between two questions how many workers a cluster has


class LostError(RuntimeError):
    """What was to compute the chunks is gone for good, or is not what it has to be."""


class Executor:
    """What the runner needs: computes a chunk in this process when it is submitted, others elsewhere."""

    def __init__(self, prepared: PreparedStudy):
        self.prepared = prepared

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def width(self) -> int:
        """Chunks to hand out at once."""
        return 1

    def submit(self, index: int) -> concurrent.futures.Future[ChunkResult]:
        """Have a chunk computed.

        Raises:
            LostError: if nothing is left that could.
        """
        future: concurrent.futures.Future[ChunkResult] = concurrent.futures.Future()
        try:
            future.set_result(run_chunk(self.prepared, index))
        except Exception as error:
            future.set_exception(error)
        return future

    def check(self) -> None:
        """Make sure that chunks under way can still arrive.

        Raises:
            LostError: if they cannot.
        """

    def stop(self) -> None:
        """End now, without waiting for chunks under way."""


# ------------------------------------------------------------------------------------------------------ processes


_received: PreparedStudy | None = None


def _receive(prepared: PreparedStudy, workers: int) -> None:
    """Make a new process ready: keep the study, share the cores, leave Ctrl-C to the parent, and end with it."""
    global _received
    _received = prepared
    os.environ.setdefault(THREADS, str(max(cores() // workers, 1)))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)  # nobody is left who could use the result


def _run_received(index: int) -> ChunkResult:
    assert _received is not None
    return run_chunk(_received, index)


class Processes(Executor):
    """Spawned processes; a process that dies ends its chunk at once, and a pool that it broke is replaced."""

    def __init__(self, prepared: PreparedStudy, workers: int):
        super().__init__(prepared)
        self.workers = workers
        self.pool = self._make()

    @property
    def width(self) -> int:
        """As in `Executor`."""
        return self.workers * AHEAD

    def _make(self) -> concurrent.futures.ProcessPoolExecutor:
        return concurrent.futures.ProcessPoolExecutor(
            self.workers, multiprocessing.get_context("spawn"), _receive, (self.prepared, self.workers)
        )

    def submit(self, index: int) -> concurrent.futures.Future[ChunkResult]:
        """As in `Executor`; starts the processes as they are needed."""
        with held():  # Ctrl-C goes to all processes of a terminal
            try:
                return self.pool.submit(_run_received, index)
            except BrokenProcessPool:
                self.pool.shutdown(wait=False, cancel_futures=True)
                self.pool = self._make()
                return self.pool.submit(_run_received, index)

    def stop(self) -> None:
        """As in `Executor`; no process is left afterwards."""
        processes = list((self.pool._processes or {}).values())
        self.pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


# ----------------------------------------------------------------------------------------------------------- dask


def connect(address: str) -> Any:
    """A client of a running `dask.distributed` scheduler.

    Raises:
        MissingToolError: if dask.distributed is not installed.
        InputError: if no scheduler answers within `CONNECT_SECONDS`.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingToolError(
            "dask.distributed is not installed. Install it with: pip install 'jaxmpc[dask]'"
        ) from error
    try:
        return Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            "dask", address, f"the address of a running scheduler, such as tcp://host:8786 ({error})"
        ) from None


def disconnect(client: Any) -> None:
    """Leave a cluster as it was, also one that is gone."""
    lost = client.status != "running"
    if lost:  # the client would report its own attempts to reconnect
        for name in ("client", "utils"):
            logging.getLogger(f"distributed.{name}").setLevel(logging.CRITICAL + 1)
    try:
        client.close(timeout=CONNECT_SECONDS)
    except Exception:
        if not lost:
            raise
    finally:
        client.status = "closed"  # it would try again when it is collected


_code = functools.cache(code_hash)  # a worker is asked with every chunk


def _hold(prepared: PreparedStudy) -> PreparedStudy:
    """On a worker: what all its chunks share; as a task it is computed again wherever it is lost."""
    return prepared


def _run_held(prepared: PreparedStudy, index: int, code: str) -> ChunkResult:
    """On a worker: a chunk, unless the worker would compute it by other code than it is stored under."""
    if _code() != code:
        raise LostError(
            f"worker {platform.node()} of the cluster has other code of jaxmpc or studies than this process; "
            "install the same version on all workers"
        )
    return run_chunk(prepared, index)


class Cluster(Executor):
    """A `dask.distributed` cluster; its scheduler computes a chunk elsewhere when a worker dies."""

    def __init__(self, prepared: PreparedStudy, client: Any, say: Callable[[str], None]):
        super().__init__(client.submit(_hold, prepared, pure=False))
        self.client, self.address, self.code = client, client.scheduler.address, code_hash()
        self.executor = client.get_executor(pure=False, retries=0)
        self._threads, self._asked = 0, -ASK_SECONDS
        if self.width == AHEAD and not self._threads:
            say("The cluster has no worker yet; the run begins as soon as there is one.")

    @property
    def width(self) -> int:
        """As in `Executor`; grows and shrinks with the cluster."""
        if time.monotonic() - self._asked >= ASK_SECONDS and self.client.status == "running":
            with contextlib.suppress(Exception):  # a lost scheduler shows in the chunks
                self._threads = sum(self.client.nthreads().values())
            self._asked = time.monotonic()
        return AHEAD * max(self._threads, 1)

    def submit(self, index: int) -> concurrent.futures.Future[ChunkResult]:
        """As in `Executor`."""
        self.check()
        return self.executor.submit(_run_held, self.prepared, index, self.code)

    def check(self) -> None:
        """As in `Executor`; a scheduler that is lost and comes back knows nothing of this run."""
        if self.client.status != "running":
            raise LostError(f"the dask scheduler at {self.address} is gone")

    def stop(self) -> None:
        """As in `Executor`; the cluster drops what it has not finished."""
        self.executor.shutdown(wait=False)
