"""Serves the interactive app to one user on this machine; the command ``jaxmpc explore`` calls it.

The server is part of this process, so that it ends with it however that happens; and the process ends with the one that has
started it, or else it would go on where nobody can stop it. Its address holds a token, see `guard`.
"""

from __future__ import annotations

import contextlib
import html
import importlib.util
import os
import secrets
import shutil
import signal
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.process.file import load_process
from jaxmpc.programs.interrupts import in_the_end
from studies.notebooks.guard import TOKEN, Guard

APP = Path(__file__).with_name("explore.py")
LOOPBACK = "127.0.0.1"
LOOK = 1.0  # s between looks at who has started this process


def explore(
    process: str | Path = "",
    port: int | None = None,
    headless: bool = False,
    store: str | Path | None = None,
) -> int:
    """Serve the app on this machine until it is stopped; its address is printed.

    It also ends with the process that has started this one, unless a closed terminal is ignored (``nohup``).

    Args:
        process: to explore, a shipped one or a process file; the default one if not given.
        port: of the page; a free one if not given.
        headless: whether not to open a browser.
        store: study store that the second page opens.

    Returns:
        1 where the server has ended by itself, or nobody is left who could stop it.

    Raises:
        InputError: for a process that cannot be read, a port that does not exist or is in use, or a store that is not there;
            before anything is served.
        MissingToolError: if marimo is not installed.
    """
    if port is not None and not 1 <= port <= 65535:
        raise InputError("port", port, "1 to 65535")
    if store is not None and not Path(store).exists():
        raise InputError("store", str(store), "an existing study store")
    for tool in ("marimo", "altair"):
        if importlib.util.find_spec(tool) is None:
            raise MissingToolError(f"The app needs {tool}: pip install 'jaxmpc[notebook]'")
    if process:
        load_process(process)
    parent = os.getppid()
    with _listen(port) as listening, _letter(headless) as letter:
        token, own_port = secrets.token_urlsafe(32), listening.getsockname()[1]
        address = f"http://{LOOPBACK}:{own_port}/?{TOKEN}={token}"
        app = _app()
        meta = {"store": "" if store is None else str(Path(store).resolve()), "first": First(process)}
        serving = _serve(Guard(app, own_port, token, meta, entered=letter.close), listening)
        print(f"jaxmpc: {address}", flush=True)
        letter.send(address)
        _wait(serving, parent)
    return 1


class First:
    """The first run of the app, made while a browser opens: modules and programs are loaded when the page asks for them.

    Attributes:
        said: lines about compilation that nobody has heard yet.
        loaded: set when its modules are imported, which two threads must not do at once.
    """

    def __init__(self, process: str | Path = ""):
        self.said: list[str] = []
        self.loaded = threading.Event()
        self._found: Future[Any] = Future()
        threading.Thread(target=self._run, args=(process,), daemon=True).start()

    def explorer(self) -> Any:
        """The process, as soon as its first run is made.

        Raises:
            InputError: for a process that cannot be run.
        """
        return self._found.result()

    def _run(self, process: str | Path) -> None:
        try:
            from jaxmpc.programs.compilation import told
            from studies.notebooks import controls, loop

            with told(self.said.append):
                self.loaded.set()  # from here on a page may listen, and is the last to
                explored = loop.explorer(process or loop.DEFAULT_PROCESS)
                explored.first.append(loop.run(explored, controls.first_base(explored)))
            self._found.set_result(explored)
        except BaseException as error:  # whoever waits for it gets it
            self.loaded.set()
            self._found.set_exception(error)


def _listen(port: int | None) -> socket.socket:
    try:
        return socket.create_server((LOOPBACK, port or 0))
    except OSError as error:
        raise InputError("port", port, f"one that is free ({error.strerror})") from None


def _app() -> Any:
    """The ASGI application of the notebook; who may use it is left to the guard."""
    import marimo

    return marimo.create_asgi_app(quiet=True).with_app(path="", root=str(APP)).build()


def _serve(app: Guard, listening: socket.socket) -> threading.Thread:
    """Answer in a thread; Ctrl-C is left to the main thread."""
    import uvicorn

    config = uvicorn.Config(
        app, log_level="critical", timeout_keep_alive=300, ws_ping_interval=1, ws_ping_timeout=60
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    return thread


def _wait(serving: threading.Thread, parent: int) -> None:
    """Until the server has ended, or whoever has started this process."""
    while serving.is_alive() and (os.getppid() == parent or _goes_on()):
        serving.join(LOOK)


def _goes_on() -> bool:
    """Whether this process was told to outlive its terminal."""
    return hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


class _Letter:
    """Hands the address to the browser in a file of this user, as others can read the arguments of a program."""

    def __init__(self, folder: Path | None):
        self.folder = folder

    def send(self, address: str) -> None:
        """Open the page; it leads to the address."""
        if self.folder is None:
            return
        page = self.folder / "open.html"
        page.write_text(f'<meta http-equiv="refresh" content="0; url={html.escape(address)}">')
        # A browser that is searched for may keep its caller waiting.
        threading.Thread(target=webbrowser.open, args=(page.as_uri(),), daemon=True).start()

    def close(self) -> None:
        """Remove it, once it was read."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)


@contextlib.contextmanager
def _letter(headless: bool) -> Iterator[_Letter]:
    """In the home folder if possible: browsers in a sandbox of their own do not see temporary folders."""
    home = os.path.expanduser("~")
    place = home if os.access(home, os.W_OK) else None
    letter = _Letter(None if headless else Path(tempfile.mkdtemp(prefix="jaxmpc-explore-", dir=place)))
    with in_the_end(letter.close), _before_a_signal(letter.close):
        yield letter


@contextlib.contextmanager
def _before_a_signal(remove: Callable[[], object]) -> Iterator[None]:
    """Remove something also where a signal ends this process, as closing its terminal does."""

    def end(number: int, _: object) -> None:
        remove()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    here = threading.current_thread() is threading.main_thread()
    names = [name for name in ("SIGTERM", "SIGHUP") if here and hasattr(signal, name)]
    numbers = [n for n in (getattr(signal, name) for name in names) if signal.getsignal(n) is signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
