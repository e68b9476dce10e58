"""The command line: reads files and options, calls the packages, writes files, and sets the exit status.

This is the one module of `jaxmpc` that may import the other packages. Everything heavy is imported inside the
command that needs it, so that ``--help`` and wrong options answer at once. Bad input ends with one line on
standard error and exit status 2, a missing tool or a plant that fails with status 1; nothing is written in either
case. What the system refuses (a full disk, a reader that has left) ends with one line and status 1; faults of the program
show themselves.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import shlex
import sys
from pathlib import Path
from typing import Any

from jaxmpc.cli.options import COMPARISONS, parser
from jaxmpc.errors import InputError, MissingToolError, PlantError
from jaxmpc.files import check_folder, check_target, write_atomically
from jaxmpc.programs import interrupts

PLATFORM_VARIABLES = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")
EXIT_OPTIMAL, EXIT_OTHER, EXIT_BAD_INPUT, EXIT_INFEASIBLE, EXIT_LIMIT = 0, 1, 2, 3, 4


@interrupts.front_door
def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: words after ``jaxmpc``; those of the process if not given.

    Returns:
        The exit status: 0 done (for `plan`: optimal), 2 bad input with nothing written, 3 infeasible, 4 limit
        reached with a feasible plan, 130 stopped by Ctrl-C, 1 anything else.
    """
    _provide_standard_streams()
    try:
        try:
            options = parser(COMMANDS).parse_args(arguments)
            _check_platform()
            return options.run(options)
        finally:
            sys.stdout.flush()  # what cannot be written fails here, and not when the interpreter ends
    except InputError as error:
        return _complain(error, EXIT_BAD_INPUT)
    except (MissingToolError, PlantError) as error:
        return _complain(error, EXIT_OTHER)
    except KeyboardInterrupt as stop:
        return interrupts.report(stop)
    except OSError as error:  # a full disk, a reader that has left, a name that is too long
        return _fail(error)
    except MemoryError as error:
        return _complain(f"not enough memory: {error}", EXIT_OTHER)


def _complain(error: object, status: int) -> int:
    if not interrupts.being_left():  # an extension that was being loaded makes an error of Ctrl-C
        print("jaxmpc: " + " ".join(str(error).split()), file=sys.stderr)
    return status


def _fail(error: OSError) -> int:
    """What the system refused, in one line."""
    name = error.filename
    if name is None:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            return _complain(error.strerror or error, EXIT_OTHER)
        name = (
            "standard output"  # what is left in it is dropped: the interpreter would try again and complain
        )
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    return _complain(f"{os.fsdecode(name)}: {error.strerror or error}", EXIT_OTHER)


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


def _plan(options: argparse.Namespace) -> int:
    out = getattr(options, "out", None)
    if out is not None:
        check_target("--out", out, [options.case])
    from jaxmpc.controller.case import load_case, plan_to_dict

    case = load_case(options.case)
    from jaxmpc.controller.plan import solve_plan

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


def _fmu_build(options: argparse.Namespace) -> int:
    from identify.fmu import build_fmu

    out = getattr(options, "out", None)
    if out is not None:
        check_target("--out", out)
    print(build_fmu(fmi=options.fmi, out=out))
    return EXIT_OPTIMAL


def _identify(options: argparse.Namespace) -> int:
    check_target("--out", options.out)
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
    check_folder("--out", options.out)
    asked = options.out, options.quick, plant
    if options.study == "claims":
        from studies.thesis.claims_study import run_claims

        print(f"Claims: {run_claims(*asked) / 'claims.html'}")
        return EXIT_OPTIMAL
    if options.study == "rto":
        from figures.thesis.rto import draw_all as draw_rto
        from studies.thesis.rto import run_rto

        folder = run_rto(*asked)
        draw_rto(folder)
    else:
        from figures.registry import draw_study
        from studies.thesis.catalogue import run_named
        from studies.thesis.report import write_summary

        folder = run_named(options.study, *asked)
        draw_study(folder, options.study)
        write_summary(folder, options.study)
    print(f"Summary: {folder / 'summary.md'}, figures: {folder / 'figures'}")
    return EXIT_OPTIMAL


def _study_sweep(options: argparse.Namespace, given: dict[str, Any]) -> int:
    from studies.definition.scenarios import load_study

    dry = "dry_run" in given
    try:
        study = load_study(options.study, quick=options.quick, confirmed=dry or "yes" in given)
    except InputError as error:
        raise _refused(error, options.study) from None
    if dry:
        return _dry_run(study, options, given)
    from studies.run.runner import RunError, run_study
    from studies.search.study import SearchStudy

    store = given.get("store", options.out / f"{study.name}.zarr")
    spread = {"workers": given.get("workers", 1), "dask": given.get("dask")}
    try:
        command = _command(options.study, options.quick, "yes" in given)
        if isinstance(study, SearchStudy):
            from studies.search.run import run_search

            path = run_search(study, store, **spread, command=command)
        else:
            path = run_study(study, store, **spread, command=command)
    except RunError as error:
        return _complain(error, EXIT_OTHER)
    from figures.sweep.draw import draw_sweep

    folder = path.with_name(f"{path.stem}-figures")
    draw_sweep(path, folder)
    print(f"Results: {path}, figures: {folder}")
    print(
        f"Look at them with: jaxmpc study export {shlex.quote(str(path))} {shlex.quote(f'{path.stem}.csv')}"
    )
    return EXIT_OPTIMAL


def _refused(error: InputError, study: str) -> InputError:
    """The error of a definition with what the command line can do about it."""
    from studies.definition.fields import near
    from studies.definition.sweep import shipped_studies

    if error.field == "study.confirmation_limit":
        hint = "Give --yes to run them all, --dry-run to see how long that takes"
        return InputError(error.field, error.value, error.expected, hint)
    if error.field == "study" and not os.path.exists(study):
        sweeps, comparisons = ", ".join(shipped_studies()), ", ".join(COMPARISONS)
        expected = f"a comparison ({comparisons}), a sweep ({sweeps}), or a definition file that exists"
        return InputError("study", study, expected, near(study, [*COMPARISONS, *shipped_studies()]))
    return error


def _dry_run(study: Any, options: argparse.Namespace, given: dict[str, Any]) -> int:
    from studies.run.status import status_of

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
    from studies.definition.sweep import shipped_studies

    name = study if study in shipped_studies() else str(Path(study).resolve())
    return shlex.quote(name) + quick * " --quick" + confirmed * " --yes"


def _study_status(options: argparse.Namespace) -> int:
    from studies.run.status import status

    print(status(options.store, options.verify))
    return EXIT_OPTIMAL


def _study_export(options: argparse.Namespace) -> int:
    from studies.store.export import export

    suffix = {None: "csv", "netcdf": "nc"}.get(options.kind, options.kind)
    target = options.target or Path(f"{options.store.stem}.{suffix}")
    print(export(options.store, target, options.kind, options.overwrite))
    return EXIT_OPTIMAL


def _simulate(options: argparse.Namespace) -> int:
    store, mark, number = options.scenario.rpartition("#")
    if not mark or not re.fullmatch("[0-9]{1,18}", number):
        raise InputError(
            "scenario", options.scenario, "a store and a number, such as results/deadzone.zarr#12"
        )
    check_folder("--out", options.out)
    import warnings

    from studies.run.rerun import rerun

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        again = rerun(Path(store), int(number))
    for warning in caught:
        print(f"jaxmpc: {warning.message}", file=sys.stderr)
    folder = options.out / f"{Path(store).stem}-{int(number)}"
    print(again.save(folder))
    from figures.closed_loop import draw_run

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
    check_folder("--out", options.out)
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
        check_target("--json", out)
    if folder is not None:
        check_folder("--figures", folder)
    from studies.bench.run import run_bench, table, wrong

    def show(report: Any) -> None:
        print(table(report), end="", flush=True)

    report = run_bench(quick=options.quick, only=only, json_path=out, stopped=show)
    show(report)
    if folder is not None:
        from figures.thesis.solve_time import draw_benchmark

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
