"""A process from a SEPTIC application: the configuration and its model files become a process file, a model and a report.

`septic_meaning` says what each attribute means here, `septic_out` is the way back.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from identify.foreign import mdf, septic_tuning
from identify.foreign.cnfg import Block
from identify.foreign.common import Asked, Imported, Pairs, assemble, foreign_names
from identify.foreign.septic_application import Application, application_of
from identify.foreign.septic_meaning import Report
from identify.foreign.septic_tuning import NO_LIMIT
from jaxmpc.check import require
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.new import new_process

DEFAULTS = {  # attributes whose defaults are used where they are left out
    "Appl": ("Nhorz", "Npred"),
    "Mvr": ("Span", "MaxUp", "MaxDn", "MovePnlty", "Blocking"),
    "Cvr": ("Span", "Fulf", "HighPnlty", "LowPnlty"),
    "Dvr": ("Span",),
}


class Converted(NamedTuple):
    """A process made of an application: the content of its file, its model, and the report."""

    body: dict[str, Any]
    model: StepResponseModel
    report: Report


@dataclasses.dataclass(frozen=True)
class Choices:
    """What a configuration leaves open.

    Attributes:
        application: which one, where there are several.
        weights: whether penalties are those of variables scaled by their spans (``span``) or of plain units (``plain``).
        steps: sizes of the steps of MVs that do not take every value [MV unit].
        switches: MVs that are on or off.
    """

    application: str = ""
    weights: Literal["span", "plain"] = "span"
    steps: Mapping[str, float] = dataclasses.field(default_factory=dict)
    switches: tuple[str, ...] = ()


def files_in(given: Sequence[Path]) -> tuple[Path | None, list[Path]]:
    """The configuration, if there is one, and the model files of files and folders."""
    folders = [path for path in given if path.is_dir()]
    named = [path for path in given if not path.is_dir()]
    configurations = [path for path in named if path.suffix.lower() == ".cnfg"]
    configurations += [path for folder in folders for path in sorted(folder.glob("*.cnfg"))]
    if len(configurations) > 1:
        listed = ", ".join(path.name for path in configurations)
        raise InputError("FILE", [str(path) for path in given], "one .cnfg file", f"Name one of {listed}")
    models = [path for path in named if path.suffix.lower() in mdf.SUFFIXES]
    if configurations and not models and not folders:  # the file alone was named: its models lie beside it
        folders = [configurations[0].parent]
    models += [path for folder in folders for path in mdf.models_in(folder)]
    return (configurations[0] if configurations else None), models


def read_models(given: Sequence[Path], asked: Asked) -> Imported:
    """The model of model files, whose names are those of the configuration if there is one."""
    configuration, files = files_in(given)
    require(files, "FILE", [str(path) for path in given], "model files: .mdf or .pdf")
    if configuration is None or asked.cvs:
        return mdf.read(files, asked)
    try:
        own = application_of(configuration)
    except InputError as error:
        hint = (
            "Name the model files, and --cv, --mv and --dv" if error.field == "--application" else error.hint
        )
        raise InputError(error.field, error.value, error.expected, hint) from None
    return assemble(_responses(own, files, asked), _timed(own, asked), "SEPTIC model files")


def _responses(own: Application, files: Sequence[Path], asked: Asked) -> Pairs:
    """Responses of the variables of an application, with units and the working point that the configuration has."""
    names = own.names
    told = dataclasses.replace(asked, **names)
    inputs = (*names["mvs"], *names["dvs"])
    elsewhere = {kind: [b.name for b in own.others if b.kind in kind] for kind in (("Cvr",), ("Mvr", "Dvr"))}
    mine, left = [], []
    for path in files:
        try:
            mdf.pair_of(path, names["cvs"], inputs)
            mine.append(path)
        except InputError:
            if not all(elsewhere.values()):
                raise
            mdf.pair_of(path, *elsewhere.values())
            left.append(path.name)
    pairs = mdf.read_models(mine, told, names["cvs"], inputs)
    pairs.notes += [f"not used, as models of another application: {', '.join(left)}"] if left else []
    for block in (*own.cvs, *own.mvs, *own.dvs):
        pairs.units[block.name] = block.word("Unit", "")
    for block in (*own.cvs, *own.mvs):
        pairs.working_point[block.name] = block.number("Meas", "the measurement at the start", 0.0)
    return pairs


def _timed(own: Application, asked: Asked) -> Asked:
    """With the sampling interval of the configuration, where none is asked for."""
    if asked.dt is not None or own.system is None or own.system.find("Nsecs") is None:
        return asked
    dt = own.system.number("Nsecs", "the sampling interval [s]", 0.0)
    require(dt > 0, own.system.where, dt, "Nsecs above 0 s")
    return dataclasses.replace(asked, dt=dt)


def read_application(given: Path, model_file: str, name: str, asked: Asked, choices: Choices) -> Converted:
    """A process from a folder with a configuration and its model files, or from the configuration.

    Args:
        model_file: name of the model file, as the process file names it.
        name: of the process.
        asked: what the model files leave open; `time_unit` is that of time constants in the configuration.

    Raises:
        InputError: with file and line.
    """
    require(given.exists(), "--septic", str(given), "a folder or a configuration that is there")
    configuration, files = files_in([given])
    require(configuration, "--septic", str(given), "a folder with a .cnfg file")
    require(files, "--septic", str(given), "model files, .mdf or .pdf, beside the configuration")
    assert configuration is not None
    own = application_of(configuration, choices.application)
    report = Report()
    pairs = _responses(own, files, asked)
    limits = {block.name: _limits(block, report) for block in (*own.mvs, *own.cvs)}
    _start_inside(pairs, {mv: limits[mv] for mv in own.names["mvs"]}, report)
    model, notes = assemble(pairs, _timed(own, asked), "SEPTIC")
    report.notes += notes
    if own.system is None or own.system.find("Nsecs") is None:
        report.notes.append(
            f"sampling interval {model.dt:g} s, that of the model files: the configuration has no Nsecs"
        )
    report.notes += _looks(own)
    ours = {old: new for new, old in foreign_names(model).items()}
    body = _body(own, model, model_file, name, choices, ours, limits, report)
    septic_tuning.fill(body, own, choices.weights, asked.time_unit, ours, report)
    report.take(own.blocks, own.others)
    return Converted(body, model, report)


def _looks(own: Application) -> list[str]:
    """What makes the model mean something else, and which defaults are used."""
    out = []
    for block in own.cvs:
        if block.number("Integ", "0, or 1 for an open integrator", 0):
            out.append(
                f"look: {block.name} integrates (Integ); the model holds its last value and predicts too little after it"
            )
        if block.word("TransformType", "NOTRANS") != "NOTRANS":
            out.append(
                f"look: the model of {block.name} is that of a transformed value (TransformType), which is not undone here"
            )
    groups = {"Appl": (own.head,), "Mvr": own.mvs, "Cvr": own.cvs, "Dvr": own.dvs}
    left: dict[str, list[str]] = {}
    for kind, keys in DEFAULTS.items():
        for key in keys:
            left.setdefault(key, []).extend(block.name for block in groups[kind] if block.find(key) is None)
    told = [f"{key} of {', '.join(names)}" for key, names in left.items() if names]
    return out + (
        [f"left out, so with the default of the public description: {'; '.join(told)}"] if told else []
    )


def _limits(block: Block, report: Report) -> tuple[float, float]:
    """Low and high of a variable that are in force at the start."""
    out = []
    for key, none in (("Low", -math.inf), ("High", math.inf)):
        value = block.number(f"{key}On", "a limit", none)
        if abs(value) >= NO_LIMIT:
            report.say(block, f"{key}On", "equal", "no limit")
            value = none
        block.number(f"{key}Off", "a limit", 0.0)
        out.append(value)
    low, high = out
    found = block.find("LowOn")
    if found is not None:
        require(low < high, block.place(found), low, f"less than the high limit {high:g} of {block.name}")
    return low, high


def _start_inside(pairs: Pairs, limits: Mapping[str, tuple[float, float]], report: Report) -> None:
    """Move the working point of MVs between their limits, where they could not stand."""
    for name, (low, high) in limits.items():
        there = pairs.working_point[name]
        inside = min(max(there, low), high)
        if inside != there:
            pairs.working_point[name] = inside
            report.notes.append(f"{name} starts at {inside:g}: its Meas of {there:g} is outside its limits")


def _body(
    own: Application,
    model: StepResponseModel,
    file: str,
    name: str,
    choices: Choices,
    ours: Mapping[str, str],
    limits: Mapping[str, tuple[float, float]],
    report: Report,
) -> dict[str, Any]:
    """The content of a first process file, with what the configuration knows in place of guesses."""
    named = lambda mv: ours.get(mv, mv)  # noqa: E731
    text, _ = new_process(
        model,
        file,
        name,
        steps={named(mv): step for mv, step in choices.steps.items()},
        switches=[named(mv) for mv in choices.switches],
        limits={ours[mv]: limits[mv] for mv in own.names["mvs"] if all(map(math.isfinite, limits[mv]))},
    )
    body = tomllib.loads(text)
    title = own.head.word("Text1", "")
    body = {"name": body["name"], **({"title": title} if title else {}), **body}
    body["source"] = (
        f"SEPTIC configuration {own.head.file.rpartition('/')[2]}, {own.head.kind} {own.head.name}"
    )
    for kind, blocks in (("cv", own.cvs), ("mv", own.mvs), ("disturbance", own.dvs)):
        for entry, block in zip(
            body.get(kind, []), blocks, strict=False
        ):  # loads follow the measured disturbances
            _describe(entry, block)
            for key, value in zip(("low", "high"), limits.get(block.name, ()), strict=False):
                entry.pop(key, None)
                entry |= {key: value} if math.isfinite(value) else {}
            if kind == "mv":
                _move(entry, block, ours[block.name] in map(named, choices.switches), report)
    body["references"]["setpoints"] = _setpoints(body, own, model)
    report.notes.append(
        "guessed, from the gains: references steps and quick; reference setpoints is that of the configuration"
    )
    return body


def _describe(entry: dict[str, Any], block: Block) -> None:
    """Label, unit and span of a variable."""
    if block.word("Text1", ""):
        entry["label"] = block.word("Text1", "")
    entry["unit"] = block.word("Unit", "") or "1"
    entry["span"] = block.number("Span", "the expected operating span", 10.0)
    found = block.find("Span")
    require(entry["span"] > 0, block.place(found) if found else block.where, entry["span"], "a span above 0")


def _move(entry: dict[str, Any], block: Block, switch: bool, report: Report) -> None:
    """The largest move per sample, and where the actuator stands; other moves up and down stand in the preset."""
    up, down = septic_tuning.moves_of(block)
    entry.pop("move", None)
    if block.number("ProcessValue", "where the actuator stands", math.nan) == block.number(
        "Meas", "the demand", 0.0
    ):
        report.say(block, "ProcessValue", "equal", "working point")
    if switch:
        for name in ("MaxUp", "MaxDn"):
            report.say(block, name, "none", "on or off: a move is the whole range")
        require({"low", "high"} <= set(entry), block.where, block.name, "limits of an MV that is on or off")
    elif max(up, -down) < NO_LIMIT:
        entry["move"] = max(up, -down)


def _setpoints(body: Mapping[str, Any], own: Application, model: StepResponseModel) -> dict[str, Any]:
    """The setpoints of the configuration, from the start on; where a CV has none, it stands where it starts."""
    start = dict(model.working_point)
    row: list[float] = [0.0]
    for entry, block in zip(body["cv"], own.cvs, strict=True):
        found = block.find("SetPntOn", "SetPntOff")
        row.append(block.number_of(found, "a setpoint") if found else start.get(entry["name"], 0.0))
    return {"duration": body["references"]["quick"]["duration"], "windows": [row]}
