"""Ctrl-C on the command line: one line on standard error and exit status 130, at any moment and within two seconds.

A command that is stopped unwinds, which ends its workers and removes what is temporary, but for no longer than `GRACE`:
Python hears of a signal only once compiled code returns, so a thread of its own watches for it. Then the process ends
without its interpreter being torn down, which would crash while XLA compiles in threads of its own: they use devices that
are freed. Where the process is the command, `jaxmpc` installs this before it imports JAX; `jaxmpc.cli.main.main` is the
`front_door`. For a library nothing changes: Ctrl-C raises `KeyboardInterrupt`.
"""

# ruff: noqa: E402, Ctrl-C waits before most is imported

from __future__ import annotations

import os
import signal
import sys


def is_command() -> bool:
    """Whether this process is ``jaxmpc`` or ``python -m jaxmpc.cli``, and not a worker that it has spawned."""
    program = sys.argv[0] if getattr(sys, "argv", None) else ""
    if "--multiprocessing-fork" in sys.orig_argv:
        return False
    name = os.path.splitext(os.path.basename(program))[0]
    return name == "jaxmpc" or (program == "-m" and "jaxmpc.cli" in sys.orig_argv)


if is_command() and hasattr(signal, "pthread_sigmask"):  # until `install`
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

import atexit
import contextlib
import functools
import logging
import subprocess
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

STATUS = 130  # what shells report for Ctrl-C
GRACE = 1.0  # s for a command to unwind
TIDY = 0.5  # s for each of the last things to do; the reader of standard output may keep it waiting


class _Exit:
    """How this process ends after Ctrl-C; installed in the process of a command only."""

    def __init__(self):
        self.installed = self.unwinds = self.holds = self.waits = self.begun = self.said = False
        self.words: list[Callable[[], str]] = []
        self.spoken = ""
        self.removals: list[Callable[[], Any]] = []
        self.status: int | None = None

    def install(self) -> None:
        """Watch for Ctrl-C, unless whoever started this process has it ignored."""
        if self.installed or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
            return
        if threading.current_thread() is not threading.main_thread():
            return
        self.installed = True
        atexit.register(self._finish)  # the first that is registered is the last that is called
        heard, bell = os.pipe()
        os.set_blocking(bell, False)
        threading.Thread(target=self._watch, args=(heard,), daemon=True).start()
        signal.signal(signal.SIGINT, self.interrupted)
        signal.set_wakeup_fd(bell, warn_on_full_buffer=False)

    def interrupted(self, *_: object) -> None:
        if self.begun:  # a second Ctrl-C changes nothing
            return
        if self.holds:
            self.waits = True
            return
        self.begun = True
        _silence()
        if self.unwinds:
            raise KeyboardInterrupt
        self.leave()

    def _watch(self, heard: int) -> None:
        while signal.SIGINT not in os.read(heard, 64):
            pass
        threading.Event().wait(GRACE)
        self.leave()

    def _finish(self) -> None:
        """End a command that is done before its interpreter is torn down, which Ctrl-C would end without a word."""
        if self.status is not None:
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
                os._exit(self.status)

    def leave(self) -> NoReturn:
        """Say so and end the process."""
        try:
            _silence()
            if not self.said:
                self.said = True
                text = self.spoken or " ".join(filter(None, map(_try, self.words)))
                os.write(2, f"{stopped(text)}\n".encode())  # past a print that waits for its reader
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            for last in (*reversed(self.removals), sys.stdout.flush):
                _try(last)
        finally:
            os._exit(STATUS)


_exit = _Exit()


def _try(last: Callable[[], Any]) -> Any:
    """What it returns, or None if it fails or takes more than `TIDY`."""
    found = []

    def work() -> None:
        with contextlib.suppress(BaseException):
            found.append(last())

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(TIDY)
    return found[0] if found else None


def _silence() -> None:
    """What fails because it is being stopped is not worth a line."""
    sys.excepthook = sys.unraisablehook = threading.excepthook = lambda *_: None
    logging.disable()
    warnings.simplefilter("ignore")


def stopped(text: str) -> str:
    """The line that says so."""
    return f"jaxmpc: stopped: {text}" if text else "jaxmpc: stopped"


def install() -> None:
    """From now on Ctrl-C ends this process with its line, also before `front_door` is reached."""
    _exit.install()
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def front_door(main: Callable[[list[str] | None], int]) -> Callable[..., int]:
    """A main function that ends the process after Ctrl-C, where it is called for the words of the process."""

    @functools.wraps(main)
    def door(arguments: list[str] | None = None) -> int:
        if arguments is not None:  # called by a program that goes on
            return main(arguments)
        install()
        try:
            _exit.unwinds = True
            status = main(None)
        except BaseException:  # an extension that was being loaded makes an ImportError of Ctrl-C
            if _exit.begun:
                _exit.leave()
            raise
        finally:
            _exit.unwinds = False
        if _exit.begun:
            _exit.leave()
        _exit.status = status
        return status

    return door


def report(stop: KeyboardInterrupt) -> int:
    """The exit status of a command that was stopped; says so where the process goes on."""
    if not _exit.begun:
        print(stopped(str(stop)), file=sys.stderr)
    return STATUS


def being_left() -> bool:
    """Whether this process ends at once, so that nothing need be waited for."""
    return _exit.begun


@contextlib.contextmanager
def last_words(words: Callable[[], str]) -> Iterator[None]:
    """What the line after Ctrl-C says, as long as this is entered.

    Args:
        words: says what is kept and what to do, after it has stored what is not stored yet; may be called in a thread.

    Raises:
        KeyboardInterrupt: with these words, after Ctrl-C.
    """
    _exit.words.append(words)
    try:
        yield
    except KeyboardInterrupt:
        _exit.spoken = words()
        raise KeyboardInterrupt(_exit.spoken) from None
    finally:
        _exit.words.remove(words)


def before_leaving(remove: Callable[[], Any]) -> None:
    """Have something temporary removed that the end of the interpreter would remove; twice must be once."""
    _exit.removals.append(remove)


@contextlib.contextmanager
def in_the_end(remove: Callable[[], Any]) -> Iterator[None]:
    """Remove something temporary when this is left, also where the process ends before that; twice must be once."""
    _exit.removals.append(remove)
    try:
        yield
    finally:
        remove()
        _exit.removals.remove(remove)


@contextlib.contextmanager
def held() -> Iterator[None]:
    """On the command line Ctrl-C counts afterwards; processes that are started meanwhile never see it."""
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    _exit.holds = True
    try:
        yield
    finally:
        _exit.holds = False
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if _exit.waits:
            _exit.interrupted()


def run_program(words: list[str], environment: dict[str, str]) -> tuple[int, str]:
    """Run a program; should this process be stopped, it ends with everything that it has started.

    Returns:
        Exit status, and what it printed.
    """
    with contextlib.ExitStack() as stack:
        with held():
            process = subprocess.Popen(
                words,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
            stack.enter_context(in_the_end(functools.partial(_end, process)))
        said, _ = process.communicate()
        return process.returncode, said


def _end(process: subprocess.Popen) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
        process.wait()
