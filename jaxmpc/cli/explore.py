"""``jaxmpc explore``: the app in the browser."""

from __future__ import annotations

from pathlib import Path

from jaxmpc.cli.options import Options, command, option, switch


@command(
    "explore",
    option(
        "process", "PROCESS", "a process file, or a shipped process (default: the thesis's)", str, nargs="?"
    ),
    option("--store", "PATH", "study to open on the second page", Path),
    option("--port", "N", "of the local server (default: a free one)", int),
    switch("--headless", "only serve and print the address"),
    epilog="The address that it prints has a token, without which nobody is let in; the server listens on this "
    "machine only. Exit status: 2 bad input, 130 stopped by Ctrl-C, 1 anything else.",
)
def explore(options: Options) -> int:
    """Tune a controller with sliders in the browser, and look into the store of any study; needs
    pip install 'jaxmpc[notebook]'.
    """
    from studies.notebooks.launch import explore

    return explore(options.process or "", options.port, options.headless, options.store)
