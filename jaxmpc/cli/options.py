"""Commands and options of the command line, with their help; `cli` says what they do.

Nothing heavy is imported here, so that ``--help`` and wrong options answer at once.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")
PLANTS = ("fmu", "jax")
COMPARISONS = (
    "thesis",
    "soft",
    "predictions",
    "fine-regulation",
    "disturbance",
    "without-soft",
    "unblocked",
    "gain-scheduling",
    "mean-move",
    "time-limit",
    "rto",
    "claims",
)  # studies of a few controllers; the others are sweeps
Run = Callable[[argparse.Namespace], int]


def parser(run: Mapping[str, Run]) -> argparse.ArgumentParser:
    """The parser of the command line.

    Args:
        run: what each command calls with its options, by the words that name the command.
    """
    commands = _Commands(run)
    for add in (_plan, _fmu, _identify, _study, _results, _simulate, _figures, _explore, _bench):
        add(commands)
    return commands.parser


class _Commands:
    """Commands under construction."""

    def __init__(self, run: Mapping[str, Run]):
        self.run = run
        self.parser = argparse.ArgumentParser(
            prog="jaxmpc", description="Model predictive control with discrete actuators.", allow_abbrev=False
        )
        self.groups: dict[tuple[str, ...], Any] = {
            (): self.parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
        }

    def family(self, name: str, help: str) -> None:
        """A word that commands start with."""
        made = self.groups[()].add_parser(name, help=help, description=help, allow_abbrev=False)
        self.groups[(name,)] = made.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(self, words: str, help: str, **more: Any) -> argparse.ArgumentParser:
        """A command."""
        *family, name = words.split()
        made = self.groups[tuple(family)].add_parser(
            name,
            help=help,
            description=help,
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
            allow_abbrev=False,
            **more,
        )
        made.set_defaults(run=self.run[words])
        return made


def _plan(commands: _Commands) -> None:
    plan = commands.add(
        "plan",
        "Solve one controller step from a case file (JSON, engineering units).",
        epilog="Exit status: 0 optimal, 2 bad input (nothing is written), 3 infeasible, 4 time limit reached "
        "with a feasible plan, 1 anything else.",
    )
    plan.add_argument("case", metavar="CASE.json", type=Path, help="the case file")
    plan.add_argument(
        "--out", metavar="PLAN.json", type=Path, default=argparse.SUPPRESS, help=_default("standard output")
    )
    plan.add_argument(
        "--finish",
        choices=FINISHES,
        default="auto",
        help="how integer moves are decided; each way alone is exact",
    )


def _fmu(commands: _Commands) -> None:
    commands.family("fmu", "Build the well as an FMU.")
    build = commands.add("fmu build", "Build the gas-lifted well as a co-simulation FMU; needs a C compiler.")
    build.add_argument("--fmi", type=int, choices=(2, 3), default=2, help="major version of FMI")
    build.add_argument(
        "--out",
        metavar="FILE.fmu",
        type=Path,
        default=argparse.SUPPRESS,
        help=_default("the cache of built FMUs"),
    )


def _identify(commands: _Commands) -> None:
    identify = commands.add(
        "identify",
        "Identify a step-response model: settle the plant and step each MV alone.",
    )
    identify.add_argument("--plant", choices=PLANTS, default="fmu", help="the FMU or the JAX well")
    identify.add_argument(
        "--choke", metavar="PERCENT", type=float, default=50.0, help="choke to start from [%%]"
    )
    identify.add_argument(
        "--lift", metavar="RATE", type=float, default=7500.0, help="lift to start from [m3/h]"
    )
    identify.add_argument(
        "--steps",
        metavar=("CHOKE", "LIFT"),
        type=float,
        nargs=2,
        default=(2.0, 100.0),
        help="steps of choke [%%] and lift [m3/h]",
    )
    identify.add_argument(
        "--samples", metavar="N", type=int, default=250, help="coefficients N [samples of 10 s]"
    )
    identify.add_argument(
        "--out", metavar="MODEL.json", type=Path, default=Path("model.json"), help="where to write"
    )


def _study(commands: _Commands) -> None:
    commands.family("study", "Run studies, look at them, and export their results.")
    run = commands.add(
        "study run",
        "Run a study: the thesis comparison, another shipped study, or a sweep of your own from a TOML file.",
        epilog="Comparisons: thesis (three controllers over 78,000 s), "
        + ", ".join(COMPARISONS[1:])
        + ". Sweeps: deadzone, mismatch, "
        "blocking, robustness, tune (a search). "
        "A run that is stopped goes on where it was when the same command is given again. "
        "Exit status: 0 done, 2 bad input, 130 stopped by Ctrl-C, 1 anything else.",
    )
    run.add_argument("study", metavar="STUDY", help="name of a shipped study, or a definition FILE.toml")
    run.add_argument("--quick", action="store_true", help="the shortened version")
    run.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("results"), help="where results and figures go"
    )
    run.add_argument(
        "--plant",
        choices=PLANTS,
        default=argparse.SUPPRESS,
        help="comparisons only: drive the FMU or its JAX twin (default: fmu)",
    )
    run.add_argument(
        "--store",
        metavar="PATH.zarr",
        type=Path,
        default=argparse.SUPPRESS,
        help="sweeps only: the store (default: DIR/NAME.zarr)",
    )
    run.add_argument(
        "--workers",
        metavar="N",
        type=int,
        default=argparse.SUPPRESS,
        help="sweeps only: processes (default: 1)",
    )
    run.add_argument(
        "--dask",
        metavar="ADDRESS",
        default=argparse.SUPPRESS,
        help="sweeps only: scheduler of a dask.distributed cluster, such as tcp://host:8786",
    )
    run.add_argument(
        "--dry-run",
        action="store_true",
        default=argparse.SUPPRESS,
        help="sweeps only: say how many scenarios, chunks, bytes and minutes, and stop",
    )
    run.add_argument(
        "--yes",
        action="store_true",
        default=argparse.SUPPRESS,
        help="sweeps only: run more scenarios than the confirmation limit of the study",
    )


def _results(commands: _Commands) -> None:
    look = commands.add("study status", "Say how far a sweep is, what is damaged, and what to do next.")
    look.add_argument("store", metavar="STORE", type=Path, help="the store of a sweep")
    look.add_argument("--verify", action="store_true", help="read every file and compare checksums")
    out = commands.add("study export", "Write the results of a sweep to one file for other tools.")
    out.add_argument("store", metavar="STORE", type=Path, help="the store of a sweep")
    out.add_argument("target", metavar="FILE", type=Path, nargs="?", default=None, help="where to write")
    kinds = out.add_mutually_exclusive_group()
    for kind, what in (
        ("csv", "scenarios and key figures as text"),
        ("parquet", "the same, binary; needs pyarrow"),
        ("netcdf", "everything, trajectories included"),
    ):
        kinds.add_argument(
            f"--{kind}", dest="kind", action="store_const", const=kind, default=None, help=what
        )
    out.add_argument("--overwrite", action="store_true", help="replace the file if it is there")


def _simulate(commands: _Commands) -> None:
    rerun = commands.add("simulate", "Run one scenario of a stored sweep again, in full, and plot it.")
    rerun.add_argument("scenario", metavar="STORE#NUMBER", help="the store of a sweep and a scenario in it")
    rerun.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("results"), help="where trajectory and figure go"
    )


def _figures(commands: _Commands) -> None:
    draw = commands.add(
        "figures",
        "Draw the figures of the thesis from stored results, running the studies that are missing.",
        epilog="Without an ID the figures are listed. All that were drawn are on one HTML page, DIR/index.html. "
        "Exit status: 0 done, 2 bad input, 130 stopped by Ctrl-C, 1 anything else.",
    )
    draw.add_argument("ids", metavar="ID", nargs="*", help="numbers of figures (3 to 39) or names, or all")
    draw.add_argument("--out", metavar="DIR", type=Path, default=Path("figures-out"), help="where figures go")
    draw.add_argument(
        "--results",
        metavar="DIR",
        type=Path,
        default=Path("results"),
        help="where the results of studies are",
    )
    draw.add_argument("--quick", action="store_true", help="of the shortened studies")
    draw.add_argument("--plant", choices=PLANTS, default="fmu", help="drive the FMU or its JAX twin")


def _explore(commands: _Commands) -> None:
    app = commands.add(
        "explore",
        "Tune a controller with sliders in the browser, and look into the store of any study; needs "
        "pip install 'jaxmpc[notebook]'.",
        epilog="The address that it prints has a token, without which nobody is let in; the server listens on this "
        "machine only. Exit status: 2 bad input, 130 stopped by Ctrl-C, 1 anything else.",
    )
    app.add_argument(
        "--store", metavar="PATH", type=Path, default=None, help="study to open on the second page"
    )
    app.add_argument(
        "--port", metavar="N", type=int, default=None, help="of the local server (default: a free one)"
    )
    app.add_argument("--headless", action="store_true", help="only serve and print the address")


def _bench(commands: _Commands) -> None:
    bench = commands.add(
        "bench",
        "Time our solvers beside others on recorded samples of the thesis run, and check every solution.",
        epilog="Times are wall times [ms] or [s], rates are per second. The other solvers come with pip install "
        "'jaxmpc[bench]'; one that is not installed is named as missing. Ctrl-C prints what was measured so far. "
        "Exit status: 0 done, 2 bad input, 130 stopped by Ctrl-C, 1 ended early or one of our solutions is wrong.",
    )
    bench.add_argument(
        "--quick",
        action="store_true",
        help="a few samples of a short run, about two minutes in place of twelve",
    )
    bench.add_argument(
        "--only",
        metavar="SECTION[,SECTION]",
        default=argparse.SUPPRESS,
        help="what to measure: relaxed, batch, exact, loop, growth, startup, sweep, gpu (default: all)",
    )
    bench.add_argument(
        "--sweep",
        dest="only",
        action="store_const",
        const="sweep",
        default=argparse.SUPPRESS,
        help="what a study costs beside its closed loops: the same as --only sweep",
    )
    bench.add_argument(
        "--json",
        metavar="FILE",
        type=Path,
        default=argparse.SUPPRESS,
        help="where to write every row (default: nowhere)",
    )
    bench.add_argument(
        "--figures",
        metavar="DIR",
        type=Path,
        default=argparse.SUPPRESS,
        help="where to draw time per sample over the run and rate over batch size (default: nowhere)",
    )


def _default(text: str) -> str:
    return f"where to write (default: {text})"
