"""The command line: reads files and options, calls the packages, writes files, and sets the exit status.

This is the one module of `jaxmpc` that may import the other packages. Everything heavy is imported inside the
command that needs it, so that ``--help`` and wrong options answer at once. Bad input ends with one line on
standard error and exit status 2, a missing tool with status 1; nothing is written in either case.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from jaxmpc.errors import InputError, MissingToolError

EXIT_OPTIMAL, EXIT_OTHER, EXIT_BAD_INPUT, EXIT_INFEASIBLE, EXIT_LIMIT = 0, 1, 2, 3, 4
EXIT_STOPPED = 130  # what shells report for Ctrl-C
FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")
PLANTS = ("fmu", "jax")


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: words after ``jaxmpc``; those of the process if not given.

    Returns:
        The exit status: 0 done (for `plan`: optimal), 2 bad input with nothing written, 3 infeasible, 4 limit
        reached with a feasible plan, 130 stopped by Ctrl-C, 1 anything else.
    """
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except InputError as error:
        return _complain(error, EXIT_BAD_INPUT)
    except MissingToolError as error:
        return _complain(error, EXIT_OTHER)
    except KeyboardInterrupt:
        print("jaxmpc: stopped", file=sys.stderr)
        return EXIT_STOPPED
    except BrokenPipeError:  # the reader of standard output has left
        sys.stderr.close()
        return EXIT_OTHER


def _complain(error: Exception, status: int) -> int:
    print("jaxmpc: " + " ".join(str(error).split()), file=sys.stderr)
    return status


def _parser() -> argparse.ArgumentParser:
    formatter = argparse.ArgumentDefaultsHelpFormatter
    parser = argparse.ArgumentParser(
        prog="jaxmpc", description="Model predictive control with discrete actuators.", allow_abbrev=False
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(group, name, run, help, **more):
        made = group.add_parser(
            name, help=help, description=help, formatter_class=formatter, allow_abbrev=False, **more
        )
        made.set_defaults(run=run)
        return made

    def family(name, help):
        made = commands.add_parser(name, help=help, description=help, allow_abbrev=False)
        return made.add_subparsers(title="commands", metavar="COMMAND", required=True)

    plan = command(
        commands,
        "plan",
        _plan,
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

    fmu = family("fmu", "Build the well as an FMU.")
    build = command(
        fmu, "build", _fmu_build, "Build the gas-lifted well as a co-simulation FMU; needs a C compiler."
    )
    build.add_argument("--fmi", type=int, choices=(2, 3), default=2, help="major version of FMI")
    build.add_argument(
        "--out",
        metavar="FILE.fmu",
        type=Path,
        default=argparse.SUPPRESS,
        help=_default("the cache of built FMUs"),
    )

    identify = command(
        commands,
        "identify",
        _identify,
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

    study = family("study", "Run studies, look at them, and export their results.")
    run = command(
        study,
        "run",
        _study_run,
        "Run a study: the thesis comparison, a shipped sweep, or a sweep of your own from a TOML file.",
        epilog="Shipped: thesis (three controllers over 78,000 s, with figures), deadzone, mismatch, blocking, robustness, "
        "tune (a search). "
        "A run that is stopped goes on where it was when the same command is given again. "
        "Exit status: 0 done, 2 bad input, 130 stopped by Ctrl-C, 1 anything else.",
    )
    run.add_argument("study", metavar="STUDY", help="name of a shipped study, or a definition FILE.toml")
    run.add_argument("--quick", action="store_true", help="the shortened version, one to three minutes")
    run.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("results"), help="where results and figures go"
    )
    run.add_argument(
        "--plant",
        choices=PLANTS,
        default=argparse.SUPPRESS,
        help="thesis only: drive the FMU or its JAX twin (default: fmu)",
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
    look = command(
        study, "status", _study_status, "Say how far a sweep is, what is damaged, and what to do next."
    )
    look.add_argument("store", metavar="STORE", type=Path, help="the store of a sweep")
    look.add_argument("--verify", action="store_true", help="read every file and compare checksums")
    out = command(study, "export", _study_export, "Write the results of a sweep to one file for other tools.")
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

    rerun = command(
        commands, "simulate", _simulate, "Run one scenario of a stored sweep again, in full, and plot it."
    )
    rerun.add_argument("scenario", metavar="STORE#NUMBER", help="the store of a sweep and a scenario in it")
    rerun.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("results"), help="where trajectory and figure go"
    )

    bench = command(
        commands,
        "bench",
        _bench,
        "Time our solvers beside others on recorded samples of the thesis run, and check every solution.",
        epilog="Times are wall times [ms] or [s], rates are per second. The other solvers come with pip install "
        "'jaxmpc[bench]'; one that is not installed is named as missing. Ctrl-C prints what was measured so far. "
        "Exit status: 0 done, 2 bad input, 1 stopped early or one of our solutions is wrong.",
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
    return parser


def _default(text: str) -> str:
    return f"where to write (default: {text})"


def _plan(options: argparse.Namespace) -> int:
    out = getattr(options, "out", None)
    if out is not None:
        _check_writable("--out", out)
    from jaxmpc.case import load_case, plan_to_dict
    from jaxmpc.files import write_atomically

    case = load_case(options.case)
    from jaxmpc.plan import solve_plan

    plan = solve_plan(
        case.model,
        case.structure,
        case.tuning,
        mv_now=case.mv_now,
        last_move=case.last_move,
        free_response=case.free_response,
        setpoint=case.setpoint,
        previous_moves=case.previous_moves,
        time_limit=case.time_limit,
        gap=case.gap,
        finish=options.finish,
    )
    body = plan_to_dict(plan)
    text = _lines(body)
    if out is None:
        print(text, end="", flush=True)
    else:
        write_atomically(out, text)
        print(
            f"jaxmpc: {body['status']}, objective {body['objective']}, gap {body['gap']}: {out}",
            file=sys.stderr,
        )
    if body["status"] == "limit" and body["objective"] is None:
        return EXIT_OTHER  # the limit came before any feasible plan
    return {"optimal": EXIT_OPTIMAL, "infeasible": EXIT_INFEASIBLE, "limit": EXIT_LIMIT}.get(
        body["status"], EXIT_OTHER
    )


def _lines(body: dict[str, Any]) -> str:
    """JSON with one field per line."""
    fields = (f" {json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in body.items())
    return "{\n" + ",\n".join(fields) + "\n}\n"


def _check_writable(field: str, path: Path) -> None:
    """Refuse a file that could not be written later; nothing is left behind."""
    if path.is_dir():
        raise InputError(field, str(path), "a file, not a folder")
    folder = path.absolute().parent
    while not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            field, str(path), f"a file in a folder that can be written ({error.strerror})"
        ) from None


def _fmu_build(options: argparse.Namespace) -> int:
    from identify.fmu import build_fmu

    out = getattr(options, "out", None)
    if out is not None:
        _check_writable("--out", out)
    print(build_fmu(fmi=options.fmi, out=out))
    return EXIT_OPTIMAL


def _identify(options: argparse.Namespace) -> int:
    _check_writable("--out", options.out)
    import contextlib

    from identify.step_test import identify_step_response, settling_notes

    with contextlib.ExitStack() as stack:
        plant = None  # the JAX well
        if options.plant == "fmu":
            from identify.fmu import FmuPlant

            plant = stack.enter_context(FmuPlant())
        model = identify_step_response(
            plant, options.choke, options.lift, tuple(options.steps), options.samples
        )
    for note in settling_notes(model):
        print(f"jaxmpc: {note}", file=sys.stderr)
    print(model.save(options.out))
    return EXIT_OPTIMAL


SWEEP_OPTIONS = ("store", "workers", "dask", "dry_run", "yes")


def _study_run(options: argparse.Namespace) -> int:
    given = vars(options)
    if options.study == "thesis":
        for name in SWEEP_OPTIONS:
            if name in given:
                raise InputError(
                    f"--{name.replace('_', '-')}", given[name], "a sweep study; thesis runs in one process"
                )
        return _study_thesis(options, given.get("plant", "fmu"))
    if "plant" in given:
        raise InputError("--plant", given["plant"], "the study thesis; sweeps run on the JAX well")
    return _study_sweep(options, given)


def _study_thesis(options: argparse.Namespace, plant) -> int:
    _check_writable("--out", options.out / "results")
    from studies.thesis import run_thesis

    folder = run_thesis(options.out, options.quick, plant)
    from figures.thesis import draw_all

    draw_all(folder)
    print(f"Summary: {folder / 'summary.md'}, figures: {folder / 'figures'}")
    return EXIT_OPTIMAL


def _study_sweep(options: argparse.Namespace, given: dict[str, Any]) -> int:
    from studies.sweep.scenarios import load_study

    dry = "dry_run" in given
    try:
        study = load_study(options.study, quick=options.quick, confirmed=dry or "yes" in given)
    except InputError as error:
        if error.field != "study.confirmation_limit":
            raise
        hint = "Give --yes to run them all, --dry-run to see how long that takes"
        raise InputError(error.field, error.value, error.expected, hint) from None
    if dry:
        print(study.describe())
        return EXIT_OPTIMAL
    from studies.sweep.runner import RunError, run_study
    from studies.sweep.search_study import SearchStudy

    store = given.get("store", options.out / f"{study.name}.zarr")
    spread = {"workers": given.get("workers", 1), "dask": given.get("dask")}
    try:
        command = _command(options.study, options.quick, "yes" in given)
        if isinstance(study, SearchStudy):
            from studies.sweep.search import run_search

            path = run_search(study, store, **spread, command=command)
        else:
            path = run_study(study, store, **spread, command=command)
    except RunError as error:
        return _complain(error, EXIT_OTHER)
    from figures.sweep import draw_sweep

    folder = path.with_name(f"{path.stem}-figures")
    draw_sweep(path, folder)
    print(f"Results: {path}, figures: {folder}")
    print(f"Look at them with: jaxmpc study export {path} {path.stem}.csv")
    return EXIT_OPTIMAL


def _command(study: str, quick: bool, confirmed: bool) -> str:
    """What follows ``jaxmpc study run`` to go on with a study, from any folder."""
    import shlex

    from studies.sweep.definition import shipped_studies

    name = study if study in shipped_studies() else str(Path(study).resolve())
    return shlex.quote(name) + quick * " --quick" + confirmed * " --yes"


def _study_status(options: argparse.Namespace) -> int:
    from studies.sweep.status import status

    print(status(options.store, options.verify))
    return EXIT_OPTIMAL


def _study_export(options: argparse.Namespace) -> int:
    from studies.sweep.export import export

    suffix = {None: "csv", "netcdf": "nc"}.get(options.kind, options.kind)
    target = options.target or Path(f"{options.store.stem}.{suffix}")
    _check_writable("FILE", target)
    print(export(options.store, target, options.kind, options.overwrite))
    return EXIT_OPTIMAL


def _simulate(options: argparse.Namespace) -> int:
    store, mark, number = options.scenario.rpartition("#")
    if not mark or not number.isdigit():
        raise InputError(
            "scenario", options.scenario, "a store and a number, such as results/deadzone.zarr#12"
        )
    _check_writable("--out", options.out / "run")
    import warnings

    from studies.sweep.rerun import rerun

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        again = rerun(Path(store), int(number))
    for warning in caught:
        print(f"jaxmpc: {warning.message}", file=sys.stderr)
    folder = options.out / f"{Path(store).stem}-{int(number)}"
    print(again.save(folder))
    from figures.sweep import draw_run

    look = {"kind": again.kind, "actuator": again.actuator}
    for path in draw_run(again.trajectory, again.deadzone, folder, again.title, **look):
        print(path)
    return EXIT_OPTIMAL


def _bench(options: argparse.Namespace) -> int:
    only = getattr(options, "only", None)
    out, folder = getattr(options, "json", None), getattr(options, "figures", None)
    if out is not None:
        _check_writable("--json", out)
    if folder is not None:
        _check_writable("--figures", folder / "figure")
    from studies.bench.run import run_bench, table, wrong

    report = run_bench(quick=options.quick, only=only, json_path=out)
    print(table(report), end="", flush=True)
    if folder is not None:
        from figures.benchmark import draw_benchmark

        for path in draw_benchmark(json.loads(report.to_json()), folder):
            print(path, file=sys.stderr)
    return EXIT_OPTIMAL if report.complete and not wrong(report) else EXIT_OTHER


if __name__ == "__main__":
    sys.exit(main())
