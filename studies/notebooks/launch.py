"""Starts the interactive app in the browser; the command ``jaxmpc explore`` calls it."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

from jaxmpc.errors import InputError, MissingToolError

APP = Path(__file__).with_name("explore.py")


def explore(port: int | None = None, headless: bool = False, store: str | Path | None = None) -> int:
    """Serve the app on this machine until it is stopped.

    Args:
        port: of the page; a free one if not given.
        headless: whether not to open a browser.
        store: study store that the second page opens.

    Returns:
        The exit status of the server.

    Raises:
        InputError: for a port that does not exist or a store that is not there; before anything is started.
        MissingToolError: if marimo is not installed.
    """
    if port is not None and not 1 <= port <= 65535:
        raise InputError("port", port, "1 to 65535")
    if store is not None and not Path(store).exists():
        raise InputError("store", str(store), "an existing study store")
    for tool in ("marimo", "altair"):
        if importlib.util.find_spec(tool) is None:
            raise MissingToolError(f"The app needs {tool}: pip install 'jaxmpc[notebook]'")
    return subprocess.call(command(port, headless, store))


def command(port: int | None, headless: bool, store: str | Path | None) -> list[str]:
    """The command that serves the app; arguments of `explore`."""
    words = [sys.executable, "-m", "marimo", "--quiet" if headless else "--yes", "run", str(APP)]
    words += ["--no-sandbox", "--no-token"]
    words += ["--port", str(port)] if port is not None else []
    words += ["--headless"] if headless else []
    return words + (["--", "--store", str(Path(store).resolve())] if store is not None else [])
