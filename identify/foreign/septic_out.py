"""A SEPTIC application from a process: configuration and model files, and a report of what they cannot say.

The way back of `septic`: what has an equal comes out of it again as it went in.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from identify.foreign import mdf
from identify.foreign.cnfg import Attribute, Block, Text, written
from identify.foreign.common import TIME_UNITS, Asked, single_words
from identify.foreign.septic_meaning import Level, Report, Row
from jaxmpc.files import write_atomically
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS, Tuning
from jaxmpc.process.process import Cv, Mv, Process, Variable

LOST = {  # fields of a tuning without an equal
    "soft_linear": "no linear price there",
    "deadzone": "calculations can make a deadband there; Fulf is the weight far outside",
    "oscillation_rows": "no rows against reversals there",
    "mean_move_limit": "no limit of the mean move there",
    "frozen_limit": "no check of frozen measurements there",
    "bias_decay": "no fading bias there",
    "demand_lead": "PVPred there chooses what predictions start from",
}


@dataclasses.dataclass(frozen=True)
class Source:
    """What a configuration is made from."""

    process: Process
    model: StepResponseModel
    structure: Structure
    tuning: Tuning
    weights: str
    time_unit: str

    @property
    def names(self) -> dict[str, str]:
        """Names there by ours."""
        return single_words(self.model)

    def start(self, name: str) -> float:
        """Where a CV or MV stands at the start."""
        return float((dict(self.process.model.working_point) | dict(self.model.working_point)).get(name, 0.0))

    def scale(self, variable: Variable) -> float:
        """What one unit of a scaled variable is."""
        return variable.span if self.weights == "span" else 1.0

    def of(self, field: str, i: int) -> float:
        """A value of the tuning."""
        return float(np.asarray(getattr(self.tuning, field))[i])


def export_process(
    process: Process, model: StepResponseModel, folder: Path, preset: str, weights: str, asked: Asked
) -> tuple[list[Path], Report]:
    """Write a configuration, a file per response, and the report beside them.

    Args:
        model: of the process.
        preset: tuning; the default one if empty.
        weights: whether penalties are those of variables scaled by their spans (``span``) or of plain units (``plain``).
        asked: unit of time constants, and what the first values of model files are.
    """
    preset = preset or process.default_preset
    structure = process.structure()
    source = Source(process, model, structure, process.tuning(structure, preset), weights, asked.time_unit)
    report = Report()
    _report(source, preset, report)
    how = "times span^2" if weights == "span" else "as they are"
    report.notes.append(
        f"penalties are weights {how}, time constants in {asked.time_unit}: neither is documented there"
    )
    made, notes = mdf.write(model, folder, asked)
    report.notes += notes
    title = f"{process.name}: what of it is in the SEPTIC configuration, tuning {preset}"
    remark = [f"{process.name}, tuning {preset}; what it cannot say: {process.name}-septic.md"]
    files = [write_atomically(folder / f"{process.name}.cnfg", written(_blocks(source), remark))]
    return [*files, *made, write_atomically(folder / f"{process.name}-septic.md", report.text(title))], report


def _blocks(source: Source) -> list[Block]:
    """All blocks of a configuration in the order in which they stand there."""
    process, structure = source.process, source.structure
    texts = {"Text1": Text(process.title), "Text2": Text("")}
    horizons = {"Nhorz": structure.control_horizon, "Npred": structure.prediction_horizon}
    measured = [v for v in process.disturbances if v.name in source.model.dv_names]
    return [
        _block("System", process.name, **texts, Nsecs=process.dt),
        _block("MPCAppl", process.name, **texts, **horizons, DesMode="STOPPED"),
        *(_mv(source, i, mv) for i, mv in enumerate(process.mvs)),
        *(_cv(source, i, cv) for i, cv in enumerate(process.cvs)),
        *(_block("Dvr", source.names[v.name], **_described(v, 0.0)) for v in measured),
        Block("ExprModl", process.name, ()),
    ]


def _mv(source: Source, i: int, mv: Mv) -> Block:
    lengths = source.structure.blocks_of(i)
    weight = source.of("ideal_weight", i)
    ideal = (
        {"IvOn": source.of("ideal", i), "Fulf": weight * source.scale(mv) ** 2} if weight else {"IvOff": 0}
    )
    return _block(
        "Mvr",
        source.names[mv.name],
        **_described(mv, source.start(mv.name)),
        **_limits(source.of("mv_low", i), source.of("mv_high", i)),
        ProcessValue=source.start(mv.name),
        **ideal,
        MaxUp=min(source.of("move_high", i), 1e10),
        MaxDn=max(source.of("move_low", i), -1e10),
        MovePnlty=source.of("move_weight", i) * source.scale(mv) ** 2,
        Blocking=(len(lengths), *lengths),
    )


def _cv(source: Source, i: int, cv: Cv) -> Block:
    reference = source.process.references.get("setpoints") or source.process.reference()
    weight = source.of("cv_weight", i) + source.of("soft_quadratic", i)
    slack = source.of("slack_weight", i) * source.scale(cv) / source.structure.prediction_horizon
    cutoff, bad = float(source.tuning.bias_cutoff), source.of("bad_limit", i)
    low, high = source.of("measurement_low", i), source.of("measurement_high", i)
    return _block(
        "Cvr",
        source.names[cv.name],
        **_described(cv, source.start(cv.name)),
        **{"SetPntOn" if weight else "SetPntOff": float(np.asarray(reference.setpoints)[0, i])},
        **_limits(source.of("cv_low", i), source.of("cv_high", i)),
        Fulf=weight * source.scale(cv) ** 2,
        HighPnlty=slack,
        LowPnlty=slack,
        BiasTfilt=0 if np.isinf(cutoff) else 1 / cutoff / TIME_UNITS[source.time_unit],
        BadCntLim=0 if np.isinf(bad) else bad,
        EvalDT=source.structure.first_penalised - 1,
        MeasValidation="ON" if np.isfinite([low, high]).any() else "OFF",
        MeasHighLimit=min(high, 1e10),
        MeasLowLimit=max(low, -1e10),
    )


def _block(kind: str, name: str, **values: Any) -> Block:
    """A block of values: numbers, words, texts, and lists as tuples."""
    attributes = []
    for key, value in values.items():
        listed = value if isinstance(value, tuple) else (value,)
        attributes.append(Attribute(key, tuple(v if isinstance(v, str) else _number(v) for v in listed)))
    return Block(kind, name, tuple(attributes))


def _number(value: float) -> str:
    """The fewest digits that bring a number back; penalties are products, whose last digits are noise."""
    return f"{float(value):.12g}"


def _described(variable: Variable, at: float) -> dict[str, Any]:
    unit = "" if variable.unit == "1" else variable.unit
    return {
        "Text1": Text("" if variable.label == variable.name.replace("_", " ") else variable.label),
        "Text2": Text(""),
        "Mode": "STOPPED",
        "Unit": Text(unit),
        "Meas": at,
        "Span": variable.span,
    }


def _limits(low: float, high: float) -> dict[str, float]:
    """On where there is one, else off and as far as can be."""
    high_on, low_on = np.isfinite(high), np.isfinite(low)
    return {
        "HighOn" if high_on else "HighOff": high if high_on else 1e10,
        "LowOn" if low_on else "LowOff": low if low_on else -1e10,
    }


def _report(source: Source, preset: str, report: Report) -> None:
    """A row for everything of a process that it can have."""
    process, structure, model = source.process, source.structure, source.model

    def row(level: Level, subject: str, key: str, value: Any, says: str) -> None:
        report.rows.append(Row(level, subject, (key,), "", str(value), says))

    row("equal", "process", "dt", f"{process.dt:g}", "Nsecs")
    for key, says in (("prediction_horizon", "Npred"), ("control_horizon", "Nhorz"), ("blocks", "Blocking")):
        row("equal", "structure", key, getattr(structure, key), says)
    row("equal", "structure", "first_penalised", structure.first_penalised, "EvalDT + 1")
    row(
        "none",
        "structure",
        "blocking",
        structure.blocking,
        "whether blocks hold MVs or moves there is not documented",
    )
    for key in ("dwell", "integer_horizon"):
        if key in process.structure_fields:
            row("none", "structure", key, process.structure_fields[key], "no whole moves there")
    for variable in (*process.cvs, *process.mvs):
        kind = "mv" if isinstance(variable, Mv) else "cv"
        row("equal", f"{kind} {variable.name}", "label, unit, span", variable.unit, "Text1, Unit, Span")
        if isinstance(variable, Mv):
            kind, step = variable.actuator.kind, variable.actuator.step
            if kind != "continuous":
                told = f"{kind} {step:g}" if step else kind
                row(
                    "none",
                    f"mv {variable.name}",
                    "actuator",
                    told,
                    "positions of actuators are not documented there",
                )
    _tuning_rows(source.tuning, preset, row)
    for key, listed in (
        ("presets", [name for name in process.presets if name != preset]),
        ("references", list(process.references)),
        ("disturbances", list(process.courses)),
        ("key_figure", [one.name for one in process.key_figures]),
        ("disturbance", [v.name for v in process.disturbances if v.name not in model.dv_names]),
        ("plants", list(process.plants)),
    ):
        if listed:
            says = (
                "setpoints at the start: SetPntOn" if key == "references" else "not part of a configuration"
            )
            row("approximated" if key == "references" else "none", "process", key, ", ".join(listed), says)


def _tuning_rows(tuning: Tuning, preset: str, row: Any) -> None:
    """A row for every field of the tuning."""
    equal = {
        "cv_low": "LowOn",
        "cv_high": "HighOn",
        "mv_low": "LowOn",
        "mv_high": "HighOn",
        "move_low": "MaxDn",
        "move_high": "MaxUp",
        "measurement_low": "MeasLowLimit",
        "measurement_high": "MeasHighLimit",
        "bad_limit": "BadCntLim",
        "ideal": "IvOn",
    }
    approximated = {
        "cv_weight": "Fulf; how it enters there is not documented",
        "soft_quadratic": "added to Fulf",
        "move_weight": "MovePnlty; how it enters there is not documented",
        "slack_weight": "HighPnlty, LowPnlty: quadratic there",
        "bias_cutoff": "BiasTfilt = 1 / bias_cutoff",
        "ideal_weight": "Fulf; how it enters there is not documented",
    }
    for key, field in FIELDS.items():
        values = np.asarray(getattr(tuning, key))
        off = field.default is not None and bool((values == field.default).all())
        says = equal.get(key) or approximated.get(key) or LOST[key]
        level: Level = "equal" if key in equal or off else "approximated" if key in approximated else "none"
        row(level, f"presets.{preset}", key, values.tolist(), "asks for nothing" if off else says)
