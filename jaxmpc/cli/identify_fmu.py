"""``jaxmpc identify FILE.fmu``: a model from step tests on any FMU, its verdicts, and a page with the evidence."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxmpc.cli.options import EXIT_OPTIMAL, Argument, Options, named_number, option
from jaxmpc.errors import InputError
from jaxmpc.files import check_target

FMU_OPTIONS: tuple[Argument, ...] = (
    option("--set", "NAME=VALUE", "FMU: a start value or parameter", str, action="append"),
    option("--settle", "S", "FMU: simulated before the steps (default: until it stands still)", float),
    option("--time-limit", "S", "FMU: of one call (default: 300)", float),
)
FIELDS = {  # what an option is called where it is used
    "plant.path": "SOURCE",
    "plant.mv": "--mv",
    "plant.cv": "--cv",
    "plant.start": "--set",
    "plant.working_point": "--mv",
    "plant.dt": "--dt",
    "plant.settle": "--settle",
    "plant.time_limit": "--time-limit",
}


def identify_fmu(options: Options) -> int:
    """Step every input of an FMU, and write the model, the page and for a sweep the gain schedule."""
    out: Path = options.out
    page, schedule = out.with_suffix(".html"), out.with_suffix(".schedule.json")
    for path in (out, page, *([schedule] if options.at else [])):
        check_target("--out", path, [options.source])
    if options.dt is None:
        raise InputError("--dt", "nothing", "the sampling interval [s]")
    mvs, dvs = (
        {name: _moved(option, rest) for name, rest in _named(option, given or ())}
        for option, given in (("--mv", options.mv), ("--dv", options.dv))
    )
    at = {
        name: [_value(value) for value in values.split(",")]
        for name, values in _named("--at", options.at or ())
        if values
    }
    if at and dvs:
        raise InputError("--dv", next(iter(dvs)), "none with --at: a schedule has no measured disturbances")
    cvs = options.cv or ()
    if len(set(cvs)) != len(cvs):
        raise InputError("--cv", list(cvs), "each CV once")
    start = {name: _value(text or "") for name, text in _named("--set", options.set or ())}
    from identify.fmu_steps import identify_fmu as identified
    from identify.fmu_sweep import identify_fmu_schedule
    from jaxmpc.programs.progress import shown, watched

    given: dict[str, Any] = {"start": start, "settle": options.settle}
    given |= {} if options.time_limit is None else {"time_limit": options.time_limit}
    doing = ["reading the FMU"]
    given["told"] = lambda what: doing.__setitem__(0, what)
    wanted = (options.source, mvs, cvs, options.dt, 250 if options.samples is None else options.samples)
    try:
        with shown(), watched(lambda seconds: f"{seconds:.0f} s: {doing[0]}"):
            swept = identify_fmu_schedule(*wanted, at, **given) if at else None
            found = identified(*wanted, dvs=dvs, **given)
    except InputError as error:
        field = next(
            (error.field.replace(own, to) for own, to in FIELDS.items() if error.field.startswith(own)),
            error.field,
        )
        raise InputError(field, error.value, error.expected, error.hint) from None
    if swept is not None:
        found = _with_sweep(found, swept[1])
    status = written(found, out, page, *([schedule] if at else []))
    if swept is not None:
        swept[0].save(schedule)
    return status


def written(found: Any, out: Path, page: Path, *more: Path) -> int:
    """Write model and page of an identification, and print what was found: verdicts, notes, what to do next."""
    from figures.identification import write_page

    following = f"jaxmpc process new --model {out}"
    found = dataclasses.replace(found, advice=(*found.advice, f"Make a process of it: {following}"))
    write_page(found, page)  # the one that may be refused, for its size
    found.model.save(out)
    said(found, found.advice[:-1])
    for path in (out, page, *more):
        print(path)
    print(f"Next: {following}")
    return EXIT_OPTIMAL


def said(found: Any, advice: Sequence[str] | None = None) -> None:
    """Print the verdicts and notes of an identification, and what to do next."""
    wide = max(len(f"{row.input} on {row.cv}") for row in found.verdicts)
    for row in found.verdicts:
        print(f"{row.verdict:<6}{f'{row.input} on {row.cv}':<{wide}}  {row.says}")
    for line in (*found.notes, *(found.advice if advice is None else advice)):
        print(f"note: {line}")


def _named(name: str, given: Sequence[str]) -> list[tuple[str, str | None]]:
    """``NAME=REST`` and ``NAME`` taken apart, each name once."""
    found: dict[str, str | None] = {}
    for text in given:
        key, sign, rest = text.partition("=")
        needs = name in ("--set", "--at")
        if not key or key in found or (needs and not rest):
            raise InputError(name, text, f"{'NAME=VALUE' if needs else 'NAME or NAME=VALUE'}, each name once")
        found[key] = rest if sign else None
    return list(found.items())


def _moved(name: str, rest: str | None) -> tuple[Any, float | None]:
    """``VALUE[:STEP]``; an empty value is the start value."""
    value, sign, step = (rest or "").partition(":")
    return (_value(value) if value else None, named_number(name, f"{name}={step}")[1] if sign else None)


def _value(text: str) -> Any:
    """A number, true or false, or the name of an item."""
    if text in ("true", "false"):
        return text == "true"
    try:
        return float(text)
    except ValueError:
        return text


def _with_sweep(found: Any, swept: Mapping[str, Any]) -> Any:
    """An identification with what was found at each place: the map of gains, the verdicts there, and the responses."""
    notes = []
    for k, row in enumerate(found.verdicts):
        cv, mv = divmod(k, len(found.model.input_names))
        gains = "; ".join(f"{place}: {own.responses[cv, mv, -1]:.4g}" for place, own in swept.items())
        notes.append(f"gain of {row.input} on {row.cv} at {gains}")
    for place, own in swept.items():
        notes += [f"at {place}, {row.input} on {row.cv} is {row.verdict}: {row.says}" for row in own.verdicts]
    responses = {place: own.responses for place, own in swept.items()}
    notes = (*found.notes, *notes)
    return dataclasses.replace(found, notes=notes, alternatives={**found.alternatives, **responses})
