"""``jaxmpc process new``, ``check`` and ``list``: process files, which make studies of any process possible."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, Options, command, named_number, option
from jaxmpc.errors import InputError
from jaxmpc.files import check_folder, check_target


@command(
    "process new",
    option("--model", "MODEL.json", "step-response model of the process", Path, required=True),
    option("--out", "FILE.toml", "where to write (default: the model's name with .toml, beside it)", Path),
    option("--step", "MV=SIZE", "an MV that moves in steps of this size [MV unit]", str, action="append"),
    option("--on-off", "MV", "an MV that is on or off", str, action="append"),
    epilog=f"The file that it writes says what was guessed. {EXITS}",
)
def new(options: Options) -> int:
    """Write a first process file from a model, and say what was guessed."""
    from jaxmpc.files import write_atomically
    from jaxmpc.model.step_response import StepResponseModel
    from jaxmpc.process.file import load_process
    from jaxmpc.process.new import new_process

    out: Path = options.out or options.model.with_suffix(".toml")
    check_target("--out", out)
    if out.exists():
        raise InputError("--out", str(out), "a file that does not exist yet: yours is not overwritten")
    model = StepResponseModel.load(options.model)
    name = _named(out.stem)
    file = _relative(options.model, out.parent)
    fmu, lost = _fmu_of(model, out.parent)
    text, guesses = new_process(
        model,
        file,
        name,
        fmu=fmu,
        steps=dict(named_number("--step", text) for text in options.step or ()),
        switches=options.on_off or (),
    )
    write_atomically(out, text)
    load_process(out)
    print(out)
    print("Guessed, so look at it first:", *guesses, sep="\n  ")
    if lost:
        print(lost)
    print(f"Next: jaxmpc process check {out}, then jaxmpc study run comparison --process {out}")
    return EXIT_OPTIMAL


def _named(stem: str) -> str:
    """A name for a process from that of its file."""
    text = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in stem).strip("-")
    return text[:64] if text and text[0].isalpha() else f"process-{text}"[:64]


def _fmu_of(model: Any, folder: Path) -> tuple[str, str]:
    """The FMU of a model as the process file names it, or why it is not among the plants."""
    import hashlib

    found = dict(model.provenance)
    if not found.get("fmu"):
        return "", ""
    path = Path(found["fmu"])
    if not path.is_file():
        return "", f"Without the FMU as a plant: {path} is not there any more."
    if hashlib.sha256(path.read_bytes()).hexdigest() != found.get("fmu_hash"):
        return "", f"Without the FMU as a plant: {path} is another one now; identify it again."
    return _relative(path, folder), ""


def _relative(file: Path, folder: Path) -> str:
    """A path as the process file names it: relative to its folder where that is possible."""
    try:
        return file.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        return str(file.resolve())


@command(
    "process check",
    option("process", "PROCESS", "a process file, or the name of a shipped process", str),
    option("--out", "DIR", "where the picture of the responses goes", Path(".")),
    epilog=EXITS,
)
def check(options: Options) -> int:
    """Judge a process file and its model, and draw the step responses."""
    check_folder("--out", options.out)
    import numpy as np

    from figures.process import draw_responses
    from identify.judge import judge
    from identify.plants import model_of
    from jaxmpc.process.file import load_process

    process = load_process(options.process)
    model = model_of(process)
    found = judge(process, model)
    wide = max(len(finding.subject) for finding in found)
    for finding in found:
        print(f"{finding.level:<6}{finding.subject:<{wide}}  {finding.says}")
    looked = sum(finding.level != "fine" for finding in found)
    print(
        f"{process.name}: {looked} of {len(found)} findings to look at."
        if looked
        else f"{process.name}: nothing to mend."
    )
    responses = np.concatenate([np.asarray(model.coefficients), np.asarray(model.dv_coefficients)], axis=1)
    measured = list(zip(model.dv_names, model.dv_units or ("1",) * len(model.dv_names), strict=True))
    for path in draw_responses(process, responses, measured, options.out):
        print(path)
    return EXIT_OPTIMAL


@command(
    "process keys",
    option("process", "PROCESS", "a process file, or the name of a shipped process", str),
    option("--plant", "NAME", "which plant of the process (default: the first)", ""),
    epilog=EXITS,
)
def keys(options: Options) -> int:
    """List every key that studies of a process may set and vary, with unit, default and meaning."""
    from identify.plants import parameters_of
    from jaxmpc.process.file import load_process
    from studies.definition.fields import as_text, study_fields

    process = load_process(options.process)
    tuning = process.tuning(process.structure())
    at = {name: i for names in (process.cv_names, process.mv_names) for i, name in enumerate(names)}
    rows = [("key", "unit", "default", "meaning")]
    for key, field in study_fields(process, parameters_of(process, options.plant)).items():
        given = field.default
        if given is None and key.startswith("tuning."):
            name, _, channel = key.removeprefix("tuning.").partition(".")
            given = getattr(tuning, name)
            given = float(given[at[channel]] if channel else given)
        given = "" if given is None else given
        rows.append((key, field.unit, given if isinstance(given, str) else as_text(given), field.label))
    wide = [max(len(str(row[i])) for row in rows) for i in range(3)]
    for row in rows:
        print("  ".join(f"{cell:<{width}}" for cell, width in zip(row, (*wide, 0), strict=True)).rstrip())
    return EXIT_OPTIMAL


@command("process list")
def shipped(options: Options) -> int:
    """List the processes that come with the package."""
    from jaxmpc.process.file import load_process, shipped_processes

    for name, path in shipped_processes().items():
        process = load_process(path)
        print(
            f"{name:<24}{process.title}: {len(process.cvs)} CVs, {len(process.mvs)} MVs, {len(process.stepped)} stepped"
        )
    return EXIT_OPTIMAL
