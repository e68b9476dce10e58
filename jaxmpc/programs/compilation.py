"""Compilation is seen: one line on standard error for every pause in which programs are compiled.

A program of the core takes seconds to compile, in which nothing else can be seen. `watch` is called once, where the package
is imported; from then on a timer runs beside every compilation and says so if it takes long. Programs that are loaded
from the cache are not compiled, and those that are compiled in a moment end before the timer does. Who knows what the
programs are for says so with `compiling_for`; the app takes the line with `told` to show it.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from jaxmpc.programs.interrupts import being_left

QUIET = "JAXMPC_QUIET"  # environment variable: whether nothing is said of compilation
PAUSE = 1.0  # s from its first program on that nobody needs to be told of
LONG = 0.5  # s of compiling without a break; shorter ones are in the cache or not worth it
APART = 5.0  # s without compilation between two pauses


def line(subject: str) -> str:
    """What is said of a compilation.

    Args:
        subject: what the programs are for, such as ``32 moves``; may be empty.
    """
    import jax

    kept = jax.config.jax_enable_compilation_cache and jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    return "compiling" + (f" for {subject}" if subject else "") + ("; once per machine" if kept else "")


def say(text: str) -> None:
    """A line of the package on standard error, in one piece and above the bars that are there; nothing if it is closed."""
    if sys.stderr is None:
        return
    tqdm: Any = sys.modules.get("tqdm")
    above = contextlib.nullcontext() if tqdm is None else tqdm.tqdm.external_write_mode(sys.stderr)
    with contextlib.suppress(OSError, ValueError), above:  # its reader has left; it is closed
        sys.stderr.write(f"jaxmpc: {text}\n")
        sys.stderr.flush()


def is_quiet() -> bool:
    """Whether nobody is told: as asked for, or because whoever has spawned this process shows what it does."""
    from multiprocessing import parent_process

    return os.environ.get(QUIET, "0") not in ("", "0") or parent_process() is not None


class Compilation:
    """What this process has compiled and is compiling; every program is compiled inside `of_a_program`."""

    def __init__(self):
        self.subjects: list[str] = []  # the last one counts
        self.listeners: list[Callable[[str], object]] = [say]  # the last one counts
        self._lock = threading.Lock()
        self._running: set[object] = set()
        self._begun = self._pause = self._ended = -math.inf  # now, of this pause, last time
        self._said = False
        self._timer: threading.Timer | None = None

    @contextlib.contextmanager
    def of_a_program(self) -> Iterator[None]:
        """A program is compiled as long as this is entered; several threads may."""
        program = object()
        try:
            self._begin(program)
            yield
        finally:
            self._end(program)

    def _begin(self, program: object) -> None:
        with self._lock:
            self._running.add(program)
            if len(self._running) > 1:
                return
            self._begun = time.monotonic()
            if self._begun - self._ended > APART:
                self._pause, self._said = self._begun, False
            if self._said or is_quiet():
                return
            self._timer = threading.Timer(max(LONG, self._pause + PAUSE - self._begun), self._tell)
            self._timer.daemon = True
            with contextlib.suppress(RuntimeError):  # no thread can be started
                self._timer.start()

    def _end(self, program: object) -> None:
        with self._lock:
            if program not in self._running:  # Ctrl-C came first
                return
            self._running.remove(program)
            if self._running:
                return
            self._ended = time.monotonic()
            timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()
            with contextlib.suppress(RuntimeError):
                timer.join()

    def _tell(self) -> None:
        self._said = True
        if not being_left():
            self.listeners[-1](line(self.subjects[-1] if self.subjects else ""))


_compilation = Compilation()


def watch() -> None:
    """From now on compilations of this process are seen.

    JAX tells of a compilation only afterwards and has no public hook; without this function of it nothing is said.
    """
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src import compiler

        compiler.backend_compile_and_load = _seen(compiler.backend_compile_and_load)


def _seen(compile: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(compile)
    def compiled(*arguments, **options):
        with _compilation.of_a_program():
            return compile(*arguments, **options)

    return compiled


def compiling_for(subject: str) -> contextlib.AbstractContextManager[None]:
    """The line says what is compiled, as long as this is entered.

    Args:
        subject: follows "compiling for", such as ``32 moves and 2 x 250 predictions``.
    """
    return _entered(_compilation.subjects, subject)


def told(listener: Callable[[str], object]) -> contextlib.AbstractContextManager[None]:
    """The line goes to a listener in place of standard error, as long as this is entered.

    Args:
        listener: is called with it in a thread of its own, while the program is compiled.
    """
    return _entered(_compilation.listeners, listener)


@contextlib.contextmanager
def _entered(stack: list[Any], entry: Any) -> Iterator[None]:
    stack.append(entry)
    try:
        yield
    finally:
        stack.remove(entry)
