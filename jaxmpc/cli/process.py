"""``jaxmpc process new``, ``check`` and ``list``: process files, which make studies of any process possible."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxmpc.cli.model import FIRST_ENTRY, TIME_UNIT, WHICH, asked_in
from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, Options, choice, command, named_number, option
from jaxmpc.errors import InputError
from jaxmpc.files import check_folder, check_target

WEIGHTS = option(
    "--weights",
    "span|plain",
    "whether SEPTIC's penalties are of variables scaled by their spans, or plain (default: span)",
    str,
    choices=("span", "plain"),
)


@command(
    "process new",
    option("--model", "MODEL.json", "step-response model of the process", Path),
    option(
        "--septic",
        "DIR",
        "SEPTIC application in place of a model: a .cnfg and its .mdf files, or the .cnfg",
        Path,
    ),
    option("--out", "FILE.toml", "where to write (default: the model's name with .toml, beside it)", Path),
    option("--step", "MV=SIZE", "an MV that moves in steps of this size [MV unit]", str, action="append"),
    option("--on-off", "MV", "an MV that is on or off", str, action="append"),
    option("--application", "NAME", "of SEPTIC: which application of several", ""),
    WEIGHTS,
    FIRST_ENTRY,
    WHICH,
    TIME_UNIT,
    epilog=f"The file that it writes says what was guessed; of SEPTIC a report beside it says what has no equal. {EXITS}",
)
def new(options: Options) -> int:
    """Write a first process file from a model or a SEPTIC application, and say what was guessed."""
    if bool(options.model) == bool(options.septic):
        raise InputError(
            "--model", options.model and str(options.model), "a model, or with --septic an application"
        )
    if options.septic:
        return _new_from_septic(options)
    for key in ("application", "weights", "first_entry", "which", "time_unit"):
        if (value := getattr(options, key)) not in (None, ""):
            raise InputError(f"--{key.replace('_', '-')}", value, "nothing: it is of --septic")
    from jaxmpc.files import write_atomically
    from jaxmpc.model.step_response import StepResponseModel
    from jaxmpc.process.file import load_process
    from jaxmpc.process.new import new_process

    out: Path = options.out or options.model.with_suffix(".toml")
    _check_new(out)
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


def _new_from_septic(options: Options) -> int:
    """Write process file, model and report of a SEPTIC application."""
    from identify.foreign.septic import Choices, read_application
    from jaxmpc.files import toml_text, write_atomically
    from jaxmpc.process.file import load_process, process_of

    folder = options.septic if options.septic.is_dir() else options.septic.parent
    out: Path = options.out or folder / f"{_named(options.septic.resolve().stem)}.toml"
    model_file, page = out.with_suffix(".json"), out.with_name(f"{out.stem}-septic.md")
    for target in (out, model_file, page):
        _check_new(target)
    steps = dict(named_number("--step", text) for text in options.step or ())
    choices = Choices(options.application, options.weights or "span", steps, tuple(options.on_off or ()))
    made = read_application(options.septic, model_file.name, _named(out.stem), asked_in(options), choices)
    process_of(made.body, out.parent, files=False)  # what it refuses is refused before anything is written
    made.model.save(model_file)
    write_atomically(page, made.report.text(f"{out.stem}: what became of the SEPTIC application"))
    write_atomically(out, toml_text(made.body))
    load_process(out)
    print(out, model_file, page, sep="\n")
    print(*made.report.summary(), *made.report.notes, sep="\n  ")
    print(f"Next: jaxmpc process check {out}, then jaxmpc study run comparison --process {out}")
    return EXIT_OPTIMAL


@command(
    "process export",
    option("process", "PROCESS", "a process file, or the name of a shipped process", str),
    choice("--to", ("septic",), "format"),
    option("--out", "DIR", "folder to write", Path, required=True),
    option("--preset", "NAME", "tuning (default: the first)", ""),
    WEIGHTS,
    FIRST_ENTRY,
    TIME_UNIT,
    epilog=f"A report in the folder says what the format cannot say. {EXITS}",
)
def export(options: Options) -> int:
    """Write tuning and model of a process as a SEPTIC application, and say what is lost."""
    if options.out.is_file():
        raise InputError("--out", str(options.out), "a folder")
    check_folder("--out", options.out)
    from identify.foreign.septic_out import export_process
    from identify.plants import model_of
    from jaxmpc.process.file import load_process

    process = load_process(options.process)
    process.tuning_fields(options.preset or None)
    files, report = export_process(
        process, model_of(process), options.out, options.preset, options.weights or "span", asked_in(options)
    )
    print(*files, sep="\n")
    print(*report.summary(), *report.notes, sep="\n  ")
    return EXIT_OPTIMAL


def _check_new(target: Path) -> None:
    """Refuse a file that could not be written, or that is there already."""
    check_target("--out", target)
    if target.exists():
        raise InputError("--out", str(target), "a file that does not exist yet: yours is not overwritten")


def _named(stem: str) -> str:
    """A name for a process from that of its file."""
    text = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in stem).strip("-")
    return text[:64] if text and text[0].isalpha() else f"process-{text}"[:64]


def _fmu_of(model: Any, folder: Path) -> tuple[str, str]:
    """The FMU of a model as the process file names it, or why it is not among the plants."""
    from identify.fmu import fmu_digest

    found = dict(model.provenance)
    if not found.get("fmu"):
        return "", ""
    path = Path(found["fmu"])
    if not path.is_file():
        return "", f"Without the FMU as a plant: {path} is not there any more."
    if fmu_digest(path) != found.get("fmu_hash"):
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
    measured = [(name, model.units[name]) for name in model.dv_names]
    for path in draw_responses(process, model.responses, measured, options.out):
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
    rows = [("key", "unit", "default", "meaning")]
    for key, field in study_fields(process, parameters_of(process, options.plant)).items():
        given = field.held(process, tuning)
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
