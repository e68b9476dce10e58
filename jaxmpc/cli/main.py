"""The command line: reads files and options, calls the packages, writes files, and sets the exit status.

The files of this folder are the only ones of `jaxmpc` that may import the other packages, and only inside the command
that needs them, so that ``--help`` and wrong options answer at once. Bad input ends with one line on
standard error and exit status 2, a missing tool or a plant that fails with status 1; nothing is written in either
case. What the system refuses (a full disk, a reader that has left) ends with one line and status 1; faults of the program
show themselves.
"""

from __future__ import annotations

import contextlib
import gc
import io
import os
import sys

from jaxmpc.cli import (
    bench,
    explore,
    figures,
    fmu_controller,
    identify,
    model,
    plan,
    process,
    replay,
    study,
    update,
)
from jaxmpc.cli.options import EXIT_BAD_INPUT, EXIT_OTHER, EXIT_UNREAD, Command, complain, parser
from jaxmpc.errors import InputError, MissingToolError, PlantError
from jaxmpc.programs import interrupts

# Objects between two looks for cycles of garbage: imports and programs that are traced make many objects and little
# garbage, and with Python's own 700 a fifth of the time until the first result went into looking.
SELDOM = 50_000
PLATFORM_VARIABLES = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")


@interrupts.front_door
def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: words after ``jaxmpc``; those of the process if not given.

    Returns:
        The exit status: 0 done (for `plan`: optimal), 2 bad input with nothing written, 3 infeasible, 4 limit
        reached with a feasible plan, 130 stopped by Ctrl-C, 141 the reader of standard output has left, 1 anything else.
    """
    gc.set_threshold(SELDOM)
    _provide_standard_streams()
    try:
        try:
            options = parser(COMMANDS).parse_args(arguments)
            _check_platform()
            return options.run(options)
        finally:
            sys.stdout.flush()  # what cannot be written fails here, and not when the interpreter ends
    except InputError as error:
        return complain(error, EXIT_BAD_INPUT)
    except (MissingToolError, PlantError) as error:
        return complain(error, EXIT_OTHER)
    except KeyboardInterrupt as stop:
        return interrupts.report(stop)
    except OSError as error:  # a full disk, a reader that has left, a name that is too long
        return _fail(error)
    except MemoryError as error:
        return complain(f"not enough memory: {error}", EXIT_OTHER)


def _fail(error: OSError) -> int:
    """What the system refused, in one line; a reader that has read enough, as `head` does, is no fault."""
    name = error.filename
    if name is None:
        unread = isinstance(error, BrokenPipeError)
        if not unread:
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
                return complain(error.strerror or error, EXIT_OTHER)
        name = "standard output"
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  (the interpreter would try the rest again and complain)
        if unread:
            return EXIT_UNREAD
    return complain(f"{os.fsdecode(name)}: {error.strerror or error}", EXIT_OTHER)


def _provide_standard_streams() -> None:
    """Streams that were closed by the caller fail when they are written to; any name can be printed on the others."""
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = open(os.open(os.devnull, os.O_RDONLY), "w")  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _check_platform() -> None:
    """Refuse a platform of JAX that this machine does not have."""
    asked = {name: os.environ[name] for name in PLATFORM_VARIABLES if os.environ.get(name)}
    if not asked:
        return
    import jax

    try:
        jax.local_devices()  # of the platform that is used
    except (RuntimeError, AssertionError):
        for name in PLATFORM_VARIABLES:
            jax.config.update(name.lower(), "")
        there = sorted({"cpu", jax.default_backend()})
        absent = [name for name, value in asked.items() if not set(value.split(",")) <= set(there)]
        name = (absent or list(asked))[0]
        expected = f"a platform that this machine has for JAX: {', '.join(there)}"
        raise InputError(name, asked[name], expected) from None


COMMANDS = {
    command.words: command
    for part in (
        plan,
        identify,
        fmu_controller,
        model,
        process,
        study,
        replay,
        update,
        figures,
        explore,
        bench,
    )
    for command in vars(part).values()
    if isinstance(command, Command)
}


if __name__ == "__main__":
    sys.exit(main())
