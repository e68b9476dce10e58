"""What attributes of a SEPTIC application mean here: equal, approximated, or without an equal; and the report of a file.

Attributes are those of the object descriptions in github.com/equinor/vscode-septic (MIT). How penalties and spans enter
the objective and the unit of time constants are not documented there; what is assumed is said.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from identify.foreign.cnfg import Attribute, Block
from jaxmpc.errors import InputError

Level = Literal["equal", "approximated", "none", "unknown"]
HEADINGS: dict[Level, str] = {
    "equal": "Equal",
    "approximated": "Approximated",
    "none": "No equal",
    "unknown": "Unknown, not used",
}


class Meaning(NamedTuple):
    """What an attribute means here.

    Attributes:
        neutral: values with which it asks for nothing, so that nothing is lost.
    """

    level: Level
    says: str
    neutral: tuple[str, ...] = ()


class Row(NamedTuple):
    """What became of an attribute, or of all those of a block."""

    level: Level
    subject: str  # such as "Mvr valve"
    attributes: tuple[str, ...]
    place: str  # file and line; empty in what is written
    value: str
    says: str


def _all(names: str, level: Level, says: str, *neutral: str) -> dict[str, Meaning]:
    return dict.fromkeys(names.split(), Meaning(level, says, neutral))


STATION_SAYS = "display and operator station"
PROGRAM_SAYS = "the program around the controller: buffers, windows, users"
SOLVERS_SAYS = "its solvers; ours decide by themselves"
STATION = _all(
    "Auto PlotMax PlotMin PlotSpan Nfix MaxChg GrpMask GrpType LockHL LockSP LockLL LockIV",
    "none",
    STATION_SAYS,
)
VARIABLE = {
    "Text1": Meaning("equal", "label"),
    "Text2": Meaning("none", "a remark", ('""', "")),
    "Unit": Meaning("equal", "unit"),
    "Span": Meaning("equal", "span"),
    "Mode": Meaning("none", "all variables take part", ("ACTIVE",)),
    "MeasBad": Meaning("none", "no measurement at the start"),
    **STATION,
}
MEANINGS: Mapping[str, Mapping[str, Meaning]] = {
    "System": {
        "Nsecs": Meaning("equal", "dt"),
        **_all("Text1 Text2", "none", "a remark", '""', ""),
        **_all(
            "PlotMax Nhist Npred Nmodl ChngLogOn Grps GrpLock MaxLogon RootPwd MngrPwd OperPwd UserPwd Terr DebugNR DebugOn "
            "FontSize InitialGroup ShowText1WithName MinXPos MinYPos MaxXPos MaxYPos InitScreen InitXPos InitYPos InitWidth "
            "InitHeight MinimizeByHide HideCloseButton OPCSampleTimeOffset Nxupd ClipOn WdwDx WdwDy Xline Xback Xgroup "
            "Zname Zhilo Zstate Zopen Zfont Zline StepInterval AutoRun ShowUpdateCounter",
            "none",
            PROGRAM_SAYS,
        ),
    },
    "Appl": {
        "Text1": Meaning("equal", "title of the process"),
        "Text2": Meaning("none", "a remark", ('""', "")),
        "Npred": Meaning("equal", "prediction_horizon"),
        "Nhorz": Meaning("approximated", "control_horizon, no longer than the blocks reach"),
        "Nstep": Meaning("none", "not documented", ("1",)),
        "Nstart": Meaning("none", "not documented", ("0",)),
        "DesMode": Meaning("none", "a controller is always active", ("ACTIVE",)),
        "FailMax": Meaning("none", "a sample without a plan holds the MVs, however often"),
        **_all(
            "PriceOn PriceScale", "none", "prices of MVs: the real-time optimiser is another layer", "OFF"
        ),
        **_all(
            "IterOpt IterNewSens IterQpMax IterLineMax DoStdSolve SteadySolver MajItLim MajPrint ObjConPrint VerifyGrads "
            "FuncPrec FeTol OptimTol FdifIntv MaxSeconds LmPrio MaxPrioSQP UnConstrnd OpenFlag UpdFilt RelPert FeasTol "
            "EachParam LinErrorLim ColdStart PrintSens SensLimSS SensLimDyn MasterOn SimOptimal PlotMax",
            "none",
            SOLVERS_SAYS,
        ),
    },
    "Mvr": {
        **VARIABLE,
        "Meas": Meaning(
            "approximated", "where the MV stands at the start: working point, between the limits"
        ),
        "ProcessValue": Meaning("none", "actuators start at the working point"),
        "HighOn": Meaning("equal", "high", ()),
        "LowOn": Meaning("equal", "low", ()),
        **_all("HighOff LowOff", "approximated", "no limit: it is off at the start", "1e10", "-1e10"),
        **_all("MaxUp MaxDn", "equal", "move, move_high, move_low"),
        "MovePnlty": Meaning("approximated", "move_weight; how it enters there is not documented"),
        "Blocking": Meaning("equal", "blocks of this MV"),
        "IvOn": Meaning("equal", "ideal"),
        "IvOff": Meaning("approximated", "no ideal value, off at the start: ideal_weight is 0"),
        "Fulf": Meaning("approximated", "ideal_weight; how it enters there is not documented"),
        "SSval": Meaning("none", "a result, no setting"),
        "IvRoc": Meaning("none", "a new ideal value counts at once", ("-1",)),
        "IvFilt": Meaning("none", "a new ideal value counts at once", ("1",)),
        "IvPrio": Meaning("none", "no priorities: weights decide"),
        "FulfReScale": Meaning(
            "none", "the weight is the same towards and away from the ideal value", ("0", "1")
        ),
        "FulfDynScale": Meaning("approximated", "factor on ideal_weight", ("1",)),
        "Price": Meaning("none", "prices of MVs: the real-time optimiser is another layer", ("0",)),
        "PVPred": Meaning("approximated", "a setting of studies: position_feedback = true", ("OFF",)),
        "MeasValidation": Meaning("none", "positions that are told are not validated", ("OFF",)),
        "MeasHighLimit": Meaning("none", "positions that are told are not validated", ("1e10",)),
        "MeasLowLimit": Meaning("none", "positions that are told are not validated", ("-1e10",)),
        **_all("WUpHi WUpLo", "none", "not documented", "OFF"),
        "UseFactorWeight": Meaning("none", "not documented", ("0",)),
    },
    "Cvr": {
        **VARIABLE,
        "Meas": Meaning("approximated", "where the CV stands at the start: working point"),
        "SetPntOn": Meaning("equal", "a row of the reference setpoints"),
        "SetPntOff": Meaning("approximated", "no setpoint, off at the start: cv_weight is 0"),
        "HighOn": Meaning("equal", "high"),
        "LowOn": Meaning("equal", "low"),
        **_all("HighOff LowOff", "approximated", "no limit: it is off at the start", "1e10", "-1e10"),
        **_all("SetPntPrio HighPrio LowPrio", "none", "no priorities: weights decide"),
        **_all("HighBackOff LowBackOff", "none", "no steady-state problem before the dynamic one", "0"),
        "RelxParam": Meaning("none", "a limit violation is priced by its largest in the horizon"),
        "Fulf": Meaning("approximated", "cv_weight; how it enters there is not documented"),
        **_all(
            "HighPnlty LowPnlty",
            "approximated",
            "slack_weight: linear in the largest violation, quadratic there",
        ),
        "FulfReScale": Meaning("none", "the weight is the same towards and away from the setpoint", ("1",)),
        "FulfUniScale": Meaning("none", "the weight is the same towards and away from the setpoint", ("1",)),
        "FulfDynScale": Meaning("approximated", "factor on cv_weight", ("1",)),
        "SetPntChangeMode": Meaning(
            "approximated", "which of setpoint_filter and setpoint_rate a study sets"
        ),
        **_all(
            "SetPntRocUp SetPntRocDn",
            "approximated",
            "a setting of studies: setpoint_rate, the same both ways",
        ),
        "SetpTref": Meaning("approximated", "a setting of studies: setpoint_filter, one for all CVs", ("0",)),
        "SetPntFilt": Meaning("none", "setpoints are not filtered"),
        "BiasTfilt": Meaning("approximated", "bias_cutoff = 1 / time constant, one for all CVs"),
        "BiasTpred": Meaning("none", "the bias is predicted to stay", ("0",)),
        "BiasTpredMaxUp": Meaning("none", "the bias is predicted to stay", ("1e10",)),
        "BiasTpredMaxDn": Meaning("none", "the bias is predicted to stay", ("-1e10",)),
        "ConsTfilt": Meaning("none", "limits are not filtered", ("-1",)),
        "Integ": Meaning("none", "a model holds its last value: give a CV that does not integrate", ("0",)),
        "TransformType": Meaning("none", "models are linear in the CV", ("NOTRANS",)),
        "BadCntLim": Meaning("equal", "bad_limit"),
        "DesHorz": Meaning("none", "one prediction horizon for all CVs", ("0",)),
        "Neval": Meaning("approximated", "every sample counts, not some"),
        "EvalDT": Meaning("equal", "first_penalised - 1"),
        "KeepTargets": Meaning("none", "no steady-state problem before the dynamic one", ("ON",)),
        "MeasValidation": Meaning("equal", "measurement_low and measurement_high where it is ON"),
        **_all("MeasHighLimit MeasLowLimit", "equal", "measurement_high, measurement_low"),
        **_all("SSval NomVal", "none", "a result, no setting"),
        **_all("HighLimit LowLimit", "none", "not documented"),
        "UseFactorWeight": Meaning("none", "not documented", ("0",)),
        "ColdStart": Meaning("none", "the prediction goes on when a CV comes back", ("OFF",)),
    },
    "Dvr": {
        **VARIABLE,
        "Meas": Meaning("none", "0 at the start: measured disturbances are deviations", ("0",)),
        **_all(
            "MeasValidation MeasHighLimit MeasLowLimit",
            "none",
            "disturbances are not validated",
            "OFF",
            "1e10",
            "-1e10",
        ),
    },
    "ExprModl": {},
}
APPLICATIONS = ("MPCAppl", "SmpcAppl")
OTHER = {  # blocks that no controller is made of, by how their types begin
    "inputs and outputs, or other processes": "Sopc UA ExprProc FdtaProc Nois Sampl Subr Master Remote",
    "nonlinear models and their applications": "Mdl4 Multiphase Well NMPCAppl Svr",
    "a calculation, not run here: what it sets in the controller does not happen": "CalcModl CalcPvr CalcTable",
    "values and trends beside the controller": "DmmyAppl Evr Tvr Event",
    "display": "Display Appl BadXvr Chart Column Curve CvrList DvrList Dyn EvrList Free Heading Image ListMeas Message "
    "Model Msg MultiXvr MvrList Opc Priority Spacer System Table TvrList Xvr",
}


# what is counted on the terminal, and listed in the file only
BESIDE = {*OTHER, STATION_SAYS, PROGRAM_SAYS, SOLVERS_SAYS, "a remark"}


def meanings_of(block: Block) -> Mapping[str, Meaning] | None:
    """The table for a block of a controller; None for any other."""
    return MEANINGS.get("Appl" if block.kind in APPLICATIONS else block.kind)


def same(value: str, neutral: str) -> bool:
    """Whether two values are the same number or word; ``1e+010`` is ``1e10``."""
    with contextlib.suppress(ValueError):
        return float(value) == float(neutral)
    return value == neutral


@dataclasses.dataclass
class Report:
    """What became of everything in a configuration.

    Attributes:
        other: what is said of an attribute in place of the table, by block and name.
    """

    rows: list[Row] = dataclasses.field(default_factory=list)
    other: dict[tuple[int, str], tuple[Level, str]] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)

    def say(self, block: Block, name: str, level: Level, says: str) -> None:
        """Of one attribute of a block, what its value makes of it."""
        self.other[id(block), name] = level, says

    def take(self, blocks: Sequence[Block], others: Sequence[Block]) -> None:
        """A row for every attribute of the blocks of the controller, and for every other block.

        Args:
            others: blocks of other controllers.
        """
        apart = set(map(id, others))
        for block in blocks:
            table, subject = meanings_of(block), f"{block.kind} {block.name}"
            place = lambda line, file=block.file: f"{file.rpartition('/')[2]}:{line}"  # noqa: E731
            names = tuple(attribute.name for attribute in block.attributes)
            if table is None:
                level, says = _other(block)
                alg = block.find("Alg")
                self.rows.append(Row(level, subject, names, place(block.line), alg.text if alg else "", says))
            elif id(block) in apart:
                says = "of another application, or of none"
                self.rows.append(Row("none", subject, names, place(block.line), "", says))
            elif not names:
                self.rows.append(Row("equal", subject, (), place(block.line), "", "its models"))
            else:
                for one in block.attributes:
                    level, says = self.other.get((id(block), one.name)) or _found(table, one)
                    value = "(not shown)" if one.name.endswith("Pwd") else one.text
                    self.rows.append(Row(level, subject, (one.name,), place(one.line), value, says))

    def text(self, title: str) -> str:
        """The report as Markdown: what was assumed, then a table per level."""
        out = [f"# {title}", ""]
        if self.notes:
            out += ["## Assumed, changed, left out", "", *(f"- {note}" for note in self.notes), ""]
        for level, heading in HEADINGS.items():
            rows = [row for row in self.rows if row.level == level]
            out += [f"## {heading}: {sum(max(len(row.attributes), 1) for row in rows)}", ""]
            if not rows:
                continue
            out += ["| of | attribute | value | becomes | place |", "|---|---|---|---|---|"]
            for row in rows:
                cells = row.subject, ", ".join(row.attributes), row.value, row.says, row.place
                out.append(
                    "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |"
                )
            out.append("")
        return "\n".join(out)

    def summary(self) -> list[str]:
        """For the terminal: how many there are of each level, and what is lost, those alike in one line."""
        out = []
        for level, heading in HEADINGS.items():
            rows = [row for row in self.rows if row.level == level]
            out.append(f"{heading}: {sum(max(len(row.attributes), 1) for row in rows)}")
            groups: dict[tuple[str, str], list[str]] = {}
            for row in rows if level != "equal" else ():
                named = level == "unknown" or row.says not in BESIDE
                subject = (
                    f"{row.subject} ({row.place})" if level == "unknown" else row.subject.partition(" ")[0]
                )
                groups.setdefault((subject if named else "", row.says), []).extend(row.attributes)
            beside = sum(len(names) for (subject, _), names in groups.items() if not subject)
            out += [
                f"  {subject} {', '.join(dict.fromkeys(names))}: {says}"
                for (subject, says), names in groups.items()
                if subject
            ]
            out += [f"  {beside} of displays, stations, solvers and other blocks"] if beside else []
        return out


def _found(table: Mapping[str, Meaning], attribute: Attribute) -> tuple[Level, str]:
    meaning = table.get(attribute.name)
    if meaning is None:
        return "unknown", "not in the public description of this object"
    if len(attribute.values) == 1 and any(same(str(attribute.values[0]), value) for value in meaning.neutral):
        return "equal", "asks for nothing"
    return meaning.level, meaning.says


def _other(block: Block) -> tuple[Level, str]:
    """Of a block that no controller is made of."""
    says = next((text for text, starts in OTHER.items() if block.kind.startswith(tuple(starts.split()))), "")
    return ("none", says) if says else ("unknown", "no object of the public description")


def refuse_twice(blocks: Sequence[Block]) -> None:
    """Refuse two blocks of a controller with one name, and an attribute that a block has twice."""
    seen: dict[str, Block] = {}
    for block in blocks:
        if meanings_of(block) is None or block.kind == "ExprModl":
            continue
        if block.name in seen:
            expected = f"a name of its own ({seen[block.name].where} has it)"
            raise InputError(block.where, f"{block.kind}: {block.name}", expected)
        if block.kind in ("Mvr", "Cvr", "Dvr"):
            seen[block.name] = block
        lines: dict[str, int] = {}
        for attribute in block.attributes:
            name = attribute.name.removesuffix("On").removesuffix("Off")
            if name in lines and attribute.name not in ("Min", "Max"):
                expected = f"{name} once (it stands in line {lines[name]})"
                raise InputError(block.place(attribute), f"{attribute.name}= {attribute.text}", expected)
            lines[name] = attribute.line
