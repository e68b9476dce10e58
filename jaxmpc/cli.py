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
from jaxmpc.options import COMPARISONS, parser

EXIT_OPTIMAL, EXIT_OTHER, EXIT_BAD_INPUT, EXIT_INFEASIBLE, EXIT_LIMIT = 0, 1, 2, 3, 4
EXIT_STOPPED = 130  # what shells report for Ctrl-C


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: words after ``jaxmpc``; those of the process if not given.

    Returns:
        The exit status: 0 done (for `plan`: optimal), 2 bad input with nothing written, 3 infeasible, 4 limit
        reached with a feasible plan, 130 stopped by Ctrl-C, 1 anything else.
    """
    options = parser(COMMANDS).parse_args(arguments)
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
    if options.study in COMPARISONS:
        for name in SWEEP_OPTIONS:
            if name in given:
                raise InputError(
                    f"--{name.replace('_', '-')}",
                    given[name],
                    f"a sweep study; {options.study} runs in one process",
                )
        return _study_comparison(options, given.get("plant", "fmu"))
    if "plant" in given:
        raise InputError("--plant", given["plant"], "a comparison such as thesis; sweeps run on the JAX well")
    return _study_sweep(options, given)


def _study_comparison(options: argparse.Namespace, plant) -> int:
    _check_writable("--out", options.out / "results")
    asked = options.out, options.quick, plant
    if options.study == "claims":
        from studies.claims_study import run_claims

        print(f"Claims: {run_claims(*asked) / 'claims.html'}")
        return EXIT_OPTIMAL
    if options.study == "rto":
        from figures.rto import draw_all as draw_rto
        from studies.rto import run_rto

        folder = run_rto(*asked)
        draw_rto(folder)
    else:
        from figures.comparison import draw_all
        from studies.catalogue import run_named
        from studies.report import write_summary

        folder = run_named(options.study, *asked)
        draw_all(folder, options.study)
        write_summary(folder, options.study)
    print(f"Summary: {folder / 'summary.md'}, figures: {folder / 'figures'}")
    return EXIT_OPTIMAL


def _study_sweep(options: argparse.Namespace, given: dict[str, Any]) -> int:
    from studies.sweep.scenarios import load_study

    dry = "dry_run" in given
    try:
        study = load_study(options.study, quick=options.quick, confirmed=dry or "yes" in given)
    except InputError as error:
        raise InputError(error.field, error.value, error.expected, _hint(error, options.study)) from None
    if dry:
        return _dry_run(study, options, given)
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


def _hint(error: InputError, study: str) -> str:
    """What to do about a definition that is refused."""
    from studies.sweep.fields import near

    if error.field == "study.confirmation_limit":
        return "Give --yes to run them all, --dry-run to see how long that takes"
    if error.field == "study" and not Path(study).exists():
        return error.hint or near(study, COMPARISONS)
    return error.hint


def _dry_run(study: Any, options: argparse.Namespace, given: dict[str, Any]) -> int:
    from studies.sweep.status import status_of

    print(study.describe())
    found = status_of(given.get("store", options.out / f"{study.name}.zarr"), study.hash)
    if found is not None:
        print(f"so far      {found.so_far}", *filter(None, [found.pace]), sep="\n")
    limit = study.definition.study.confirmation_limit
    more = f" and with --yes: it has more than {limit} scenarios (study.confirmation_limit)"
    print(f"To run it, give the command without --dry-run{more if study.count > limit else ''}.")
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


def _figures(options: argparse.Namespace) -> int:
    from figures.registry import FIGURES

    if not options.ids:
        for id, entry in FIGURES.items():
            print(f"{id:>8}  {entry.title}  ({entry.study or 'no study'})")
        return EXIT_OPTIMAL
    _check_writable("--out", options.out / "figure")
    from figures.gallery import write_gallery
    from figures.produce import produce

    asked = {"results": options.results, "out": options.out, "quick": options.quick, "plant": options.plant}
    for path in produce(options.ids, **asked):
        print(path)
    print(f"All on one page: {write_gallery(options.ids, **asked)}")
    return EXIT_OPTIMAL


def _explore(options: argparse.Namespace) -> int:
    from studies.notebooks.launch import explore

    return explore(options.port, options.headless, options.store)


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


COMMANDS = {
    "plan": _plan,
    "fmu build": _fmu_build,
    "identify": _identify,
    "study run": _study_run,
    "study status": _study_status,
    "study export": _study_export,
    "simulate": _simulate,
    "figures": _figures,
    "explore": _explore,
    "bench": _bench,
}


if __name__ == "__main__":
    sys.exit(main())
