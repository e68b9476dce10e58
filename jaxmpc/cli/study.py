"""``jaxmpc study run``, ``status`` and ``export``, and ``jaxmpc simulate``: studies and what they have stored."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path
from typing import Any

from jaxmpc.cli.options import (
    EXIT_OPTIMAL,
    EXIT_OTHER,
    EXITS,
    PLANTS,
    Options,
    command,
    complain,
    option,
    switch,
)
from jaxmpc.errors import InputError, near
from jaxmpc.files import check_folder

ALONE = "rto", "claims"  # studies of the thesis with a program of their own
DASK = "scheduler of a dask.distributed cluster, such as tcp://host:8786"
DRY_RUN = "say how many scenarios, chunks, bytes and minutes, and stop"
STORE = option("store", "STORE", "the store of a sweep", Path)
KINDS = {
    "csv": "scenarios and key figures as text",
    "parquet": "the same, binary; needs pyarrow",
    "netcdf": "everything, trajectories included",
}
SWEEP_OPTIONS = ("store", "workers", "dask", "dry_run", "yes")


@command(
    "study run",
    option("study", "STUDY", "name of a shipped study, or a definition FILE.toml", str),
    switch("--quick", "the shortened version"),
    option("--out", "DIR", "where results and figures go", Path("results")),
    option("--process", "PROCESS", "process file or shipped process, where the study names none", str),
    option(
        "--plant", "NAME", "comparisons only: which plant of the process (default: that of the study)", str
    ),
    option("--store", "PATH.zarr", "sweeps only: the store (default: DIR/NAME.zarr)", Path),
    option("--workers", "N", "sweeps only: processes (default: 1)", int),
    option("--dask", "ADDRESS", f"sweeps only: {DASK}", str),
    switch("--dry-run", f"sweeps only: {DRY_RUN}", default=None),
    switch("--yes", "sweeps only: run more scenarios than the confirmation limit of the study", default=None),
    epilog="Comparisons: comparison (of any process, with --process), thesis (three controllers over 78,000 s), soft, "
    "predictions, fine-regulation, disturbance, without-soft, unblocked, gain-scheduling, mean-move, time-limit, rto, "
    "claims. Sweeps: deadzone, mismatch, blocking, robustness, tune (a search); of other shipped processes wood-berry, "
    "shell-fractionator, quadruple-tank, on-off-heater, pump-tank, step-choke-well. "
    f"A run that is stopped goes on where it was when the same command is given again. {EXITS}",
)
def run(options: Options) -> int:
    """Run a study: the thesis comparison, that of your own process, another shipped study, or a sweep from a TOML file."""
    from studies.definition.catalogue import is_comparison

    if options.study in ALONE or is_comparison(options.study):
        for name in SWEEP_OPTIONS:
            if (value := getattr(options, name)) is not None:
                expected = f"a sweep study; {options.study} runs in one process"
                raise InputError(f"--{name.replace('_', '-')}", value, expected)
        check_folder("--out", options.out)
        return _study_alone(options) if options.study in ALONE else _study_comparison(options)
    if options.plant is not None:
        raise InputError(
            "--plant", options.plant, "a comparison such as thesis; a sweep names its plant in [study]"
        )
    return _study_sweep(options)


def _of_the_well(options: Options) -> tuple[Path, bool, str]:
    """Where a study of the thesis goes, whether it is the quick one, and on which plant of the well."""
    if options.process is not None:
        expected = f"nothing: {options.study} is of the well of the thesis"
        raise InputError("--process", options.process, expected)
    return options.out, options.quick, options.plant or PLANTS[0]


def _summed_up(folder: Path) -> int:
    print(f"Summary: {folder / 'summary.md'}, figures: {folder / 'figures'}")
    return EXIT_OPTIMAL


def _study_alone(options: Options) -> int:
    asked = _of_the_well(options)
    if options.study == "claims":
        from studies.thesis.claims_study import run_claims

        print(f"Claims: {run_claims(*asked) / 'claims.html'}")
        return EXIT_OPTIMAL
    from figures.thesis.rto import draw_all as draw_rto
    from studies.thesis.rto import run_rto

    folder = run_rto(*asked)
    draw_rto(folder)
    return _summed_up(folder)


def _study_comparison(options: Options) -> int:
    from figures.registry import draw_study
    from studies.definition.catalogue import load_comparison
    from studies.thesis import catalogue

    if options.study in catalogue.STUDIES:
        from studies.thesis.report import write_thesis_summary

        folder = catalogue.run_thesis(options.study, *_of_the_well(options))
        draw_study(folder, options.study)
        write_thesis_summary(folder, options.study)
    else:
        from studies.report import write_summary
        from studies.run.named import run_named

        given = dict(quick=options.quick, plant=options.plant or "", process=options.process or "")
        comparison = load_comparison(options.study, **given)
        folder = run_named(comparison, options.out)
        draw_study(folder, "comparison")
        write_summary(folder)
    return _summed_up(folder)


def _study_sweep(options: Options) -> int:
    from studies.load import load_study

    confirmed = bool(options.dry_run or options.yes)
    try:
        study = load_study(options.study, quick=options.quick, confirmed=confirmed, process=options.process)
    except InputError as error:
        raise _refused(error, options.study) from None
    store = options.out / f"{study.name}.zarr" if options.store is None else options.store
    if options.dry_run:
        return _dry_run(study, store)
    from studies.run.runner import RunError, run_study
    from studies.search.study import SearchStudy

    workers = 1 if options.workers is None else options.workers
    spread = {"workers": workers, "dask": options.dask, "command": _again(options)}
    try:
        if isinstance(study, SearchStudy):
            from studies.search.run import run_search

            path = run_search(study, store, **spread)
        else:
            path = run_study(study, store, **spread)
    except RunError as error:
        return complain(error, EXIT_OTHER)
    from figures.sweep.draw import draw_sweep

    folder = path.with_name(f"{path.stem}-figures")
    draw_sweep(path, folder)
    print(f"Results: {path}, figures: {folder}")
    print(f"Look at them with: jaxmpc study export {shlex.join([str(path), f'{path.stem}.csv'])}")
    return EXIT_OPTIMAL


def _refused(error: InputError, study: str) -> InputError:
    """The error of a definition with what the command line can do about it."""
    from studies.definition.catalogue import shipped_comparisons
    from studies.definition.sweep import shipped_studies

    if error.field == "study.confirmation_limit":
        hint = "Give --yes to run them all, --dry-run to see how long that takes"
        return InputError(error.field, error.value, error.expected, hint)
    if error.field == "study" and not os.path.exists(study):
        known = [*shipped_comparisons(), *ALONE]
        sweeps, comparisons = ", ".join(shipped_studies()), ", ".join(known)
        expected = f"a comparison ({comparisons}), a sweep ({sweeps}), or a definition file that exists"
        return InputError("study", study, expected, near(study, [*known, *shipped_studies()]))
    return error


def _dry_run(study: Any, store: Path) -> int:
    from studies.run.status import status_of

    print(study.describe())
    found = status_of(store, study.hash)
    if found is not None:
        print(f"so far      {found.so_far}", *filter(None, [found.pace]), sep="\n")
    limit = study.definition.study.confirmation_limit
    more = f" and with --yes: it has more than {limit} scenarios (study.confirmation_limit)"
    print(f"To run it, give the command without --dry-run{more if study.count > limit else ''}.")
    return EXIT_OPTIMAL


def _again(options: Options) -> str:
    """What follows ``jaxmpc study run`` to go on with a study, from any folder."""
    from studies.definition.sweep import shipped_studies

    name = options.study if options.study in shipped_studies() else str(Path(options.study).resolve())
    own = f" --process {shlex.quote(str(options.process))}" if options.process else ""
    return shlex.quote(name) + own + bool(options.quick) * " --quick" + bool(options.yes) * " --yes"


@command("study status", STORE, switch("--verify", "read every file and compare checksums"))
def status(options: Options) -> int:
    """Say how far a sweep is, what is damaged, and what to do next."""
    from studies.run import status

    print(status.status(options.store, options.verify))
    return EXIT_OPTIMAL


@command(
    "study export",
    STORE,
    option("target", "FILE", "where to write", Path, nargs="?"),
    *(
        switch(f"--{kind}", what, dest="kind", action="store_const", const=kind)
        for kind, what in KINDS.items()
    ),
    switch("--overwrite", "replace the file if it is there"),
)
def export(options: Options) -> int:
    """Write the results of a sweep to one file for other tools."""
    from studies.store import export

    suffix = {None: "csv", "netcdf": "nc"}.get(options.kind, options.kind)
    target = options.target or Path(f"{options.store.stem}.{suffix}")
    print(export.export(options.store, target, options.kind, options.overwrite))
    return EXIT_OPTIMAL


@command(
    "simulate",
    option("scenario", "STORE#NUMBER", "the store of a sweep and a scenario in it", str),
    option("--out", "DIR", "where trajectory and figure go", Path("results")),
)
def simulate(options: Options) -> int:
    """Run one scenario of a stored sweep again, in full, and plot it."""
    store, mark, number = options.scenario.rpartition("#")
    if not mark or not re.fullmatch("[0-9]{1,18}", number):
        expected = "a store and a number, such as results/deadzone.zarr#12"
        raise InputError("scenario", options.scenario, expected)
    check_folder("--out", options.out)
    import warnings

    from jaxmpc.programs.progress import shown
    from studies.rerun import rerun

    with warnings.catch_warnings(record=True) as caught, shown():
        warnings.simplefilter("always", UserWarning)
        again = rerun(Path(store), int(number))
    for warning in caught:
        print(f"jaxmpc: {warning.message}", file=sys.stderr)
    folder = options.out / f"{Path(store).stem}-{int(number)}"
    print(again.save(folder))
    from figures.closed_loop import draw_run

    look = {"kind": again.kind, "actuator": again.actuator}
    for path in draw_run(
        again.trajectory, again.deadzone, folder, again.title, process=again.process, **look
    ):
        print(path)
    return EXIT_OPTIMAL
