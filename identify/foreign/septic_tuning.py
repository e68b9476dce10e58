"""Structure and tuning of a SEPTIC application in ours: horizons, blocks, weights, limits of moves, filters, deadbands."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from identify.foreign.cnfg import Block
from identify.foreign.common import TIME_UNITS
from identify.foreign.septic_application import Application
from identify.foreign.septic_meaning import Report
from jaxmpc.check import require

NO_LIMIT = 1e10  # size of a limit that is none
DEFAULT_BLOCKS = (2, 4, 7, 11, 16, 22)
DEFAULT_HORIZON = 80
# deadband: a calculation that takes the weight of a CV away while another one says that it is inside
SWITCH = re.compile(
    r"setfulfdynscale\(\s*(\w+)\s*,\s*if\(\s*(\w+)\s*,\s*0(?:\.0*)?\s*,\s*1(?:\.0*)?\s*\)\s*\)", re.I
)
BAND = r"abs\(\s*{cv}\s*-\s*\w+\s*\)\s*<=?\s*([\w.]+)"


def fill(
    body: dict[str, Any],
    own: Application,
    weights: str,
    time_unit: str,
    ours: Mapping[str, str],
    report: Report,
) -> None:
    """Put structure and tuning of an application into the content of a process file.

    Args:
        weights: whether penalties are those of scaled variables (``span``) or of plain ones (``plain``).
        time_unit: of time constants.
        ours: names of variables here, by those of the configuration.
    """
    prediction = _count(own.head, "Npred", DEFAULT_HORIZON)
    body["structure"] = {
        "prediction_horizon": prediction,
        **_control(own, prediction, report),
        "blocking": "inputs",
        **_first(own, report),
    }
    report.notes.append(
        "assumed: a block holds an MV (blocking = inputs); whether blocks hold MVs or moves there is not documented"
    )
    assumed = {
        "span": "weights are penalties of variables scaled by their spans (penalty / span^2); "
        "--weights plain takes them as they are",
        "plain": "weights are penalties as they are; --weights span takes them for variables scaled by their spans",
    }
    report.notes.append(f"assumed: {assumed[weights]}; neither is documented")
    scale = {
        b.name: b.number("Span", "span", 10.0) if weights == "span" else 1.0 for b in (*own.cvs, *own.mvs)
    }
    preset: dict[str, Any] = {
        "cv_weight": {ours[b.name]: _cv_weight(b, report) / scale[b.name] ** 2 for b in own.cvs},
        "move_weight": {
            ours[b.name]: _penalty(b, "MovePnlty", "penalty of moves") / scale[b.name] ** 2 for b in own.mvs
        },
        "slack_weight": {ours[b.name]: _slack(b, prediction) / scale[b.name] for b in own.cvs},
    }
    ideal = {b.name: b.number("IvOn", "an ideal value", 0.0) for b in own.mvs if b.find("IvOn")}
    if ideal:
        preset["ideal"] = {ours[name]: value for name, value in ideal.items()}
        preset["ideal_weight"] = {
            ours[b.name]: _fulf(b, "ideal value") / scale[b.name] ** 2 for b in own.mvs if b.name in ideal
        }
    _bands(preset, own, ours, report)
    _moves(preset, own, body, ours)
    _measurements(preset, own, ours, report)
    _bias(preset, own, time_unit, report)
    body["presets"] = {"septic": preset}


def _count(block: Block, name: str, default: int, least: int = 1) -> int:
    value = block.number(name, "samples", default)
    found = block.find(name)
    where = block.place(found) if found else block.where
    require(value == int(value) >= least, where, value, f"a whole number of samples, {least} or more: {name}")
    return int(value)


def _control(own: Application, prediction: int, report: Report) -> dict[str, Any]:
    """Control horizon and blocks: as far as the longest list reaches, within both horizons; shorter lists go on."""
    asked = _count(own.head, "Nhorz", DEFAULT_HORIZON)
    lists = {block.name: _blocks(block) for block in own.mvs}
    horizon = min(asked, prediction, max(map(sum, lists.values())))
    out = []
    for block in own.mvs:
        given = lists[block.name]
        fitted = _fitted(given, horizon)
        out.append(fitted)
        if fitted != given:
            how = "cut" if sum(given) > horizon else "the last one longer"
            report.say(
                block,
                "Blocking",
                "approximated",
                f"blocks {fitted}: {how}, to a control horizon of {horizon}",
            )
    if horizon == asked:
        report.say(own.head, "Nhorz", "equal", "control_horizon")
    same = all(one == out[0] for one in out)
    return {"control_horizon": horizon, "blocks": out[0] if same else out}


def _blocks(block: Block) -> list[int]:
    found = block.find("Blocking")
    if found is None:
        return list(DEFAULT_BLOCKS)
    given = block.numbers("Blocking", "sizes of blocks [samples]")
    good = given and all(value >= 1 and value == int(value) for value in given)
    require(good, block.place(found), f"Blocking= {found.text}", "whole numbers of samples, 1 or more")
    return [int(value) for value in given]


def _fitted(blocks: list[int], horizon: int) -> list[int]:
    """Blocks that sum to a horizon: cut there, or the last one made longer."""
    out: list[int] = []
    for block in blocks:
        if sum(out) < horizon:
            out.append(min(block, horizon - sum(out)))
    return [*out[:-1], out[-1] + horizon - sum(out)]


def _first(own: Application, report: Report) -> dict[str, int]:
    """Samples that are not evaluated: one number for all CVs, the fewest."""
    left = {b.name: _count(b, "EvalDT", 0, least=0) for b in own.cvs}
    first = min(left.values())
    for block in own.cvs:
        if left[block.name] != first:
            report.say(
                block, "EvalDT", "approximated", f"{first}, as of another CV: one first_penalised for all"
            )
    return {"first_penalised": first + 1} if first else {}


def _penalty(block: Block, name: str, what: str) -> float:
    value = block.number(name, what, 1.0)
    found = block.find(name)
    require(value >= 0, block.place(found) if found else block.where, value, f"0 or more: {what}")
    return value


def _cv_weight(block: Block, report: Report) -> float:
    """`Fulf`, where there is a setpoint at the start."""
    off = block.find("SetPntOn") is None
    if off and block.find("SetPntOff") is None:
        report.notes.append(f"{block.name} has no SetPntOn or SetPntOff: no setpoint, cv_weight 0")
    weight = _fulf(block, "setpoint")
    return 0.0 if off else weight


def _fulf(block: Block, of: str) -> float:
    """`Fulf` of a setpoint or an ideal value, as it counts in the dynamic problem."""
    factor = _penalty(block, "FulfDynScale", "factor on Fulf in the dynamic problem")
    return _penalty(block, "Fulf", f"penalty of deviations from the {of}") * factor


def _slack(block: Block, prediction: int) -> float:
    """Linear price that costs what the quadratic one does, for a violation of one unit that lasts over the horizon."""
    return prediction * max(
        _penalty(block, f"{side}Pnlty", "penalty of violations") for side in ("High", "Low")
    )


def _bands(preset: dict[str, Any], own: Application, ours: Mapping[str, str], report: Report) -> None:
    """Deadbands that calculations make of `FulfDynScale`: inside the deadzone nothing costs, outside `soft_quadratic`."""
    calculations = {
        block.name: (block, block.word("Alg", "")) for block in own.blocks if block.kind == "CalcPvr"
    }
    values = {block.name: block for block in own.blocks if block.kind == "Evr"}
    for block, alg in calculations.values():
        match = SWITCH.fullmatch(alg.strip())
        if not match or match[1] not in ours or match[1] not in own.names["cvs"]:
            continue
        cv, inside = match[1], calculations.get(match[2])
        band = re.search(BAND.format(cv=re.escape(cv)), inside[1]) if inside else None
        size = math.nan
        if band and band[1] in values:
            size = values[band[1]].number("Meas", "half width of a deadband", math.nan)
        elif band and re.fullmatch(r"\d+(\.\d*)?", band[1]):
            size = float(band[1])
        if not size > 0:
            report.notes.append(
                f"look: {block.name} ({block.where}) switches the weight of {cv}; its deadband was not understood"
            )
            continue
        name = ours[cv]
        for field in ("deadzone", "soft_quadratic"):
            preset.setdefault(field, {})
        preset["deadzone"][name] = size
        preset["soft_quadratic"][name] = preset["cv_weight"][name]
        preset["cv_weight"][name] = 0.0
        report.notes.append(
            f"approximated: the deadband of {cv} ({block.where}) is deadzone = {size:g} around the setpoint; there it lies "
            "around what the calculation says, and its weight comes back from the whole deviation"
        )


def moves_of(block: Block) -> tuple[float, float]:
    """Largest moves up and down in one sample; the latter is negative."""
    up = block.number("MaxUp", "largest move up", 10.0)
    down = block.number("MaxDn", "largest move down", -10.0)
    for name, value, good in (("MaxUp", up, up >= 0), ("MaxDn", down, down <= 0)):
        found = block.find(name)
        sign = "0 or more" if name == "MaxUp" else "0 or less"
        require(good, block.place(found) if found else block.where, value, f"a move of {sign} in one sample")
    found = block.find("MaxUp")
    require(
        up > 0 or down < 0, block.place(found) if found else block.where, up, "an MV that may move up or down"
    )
    return up, down


def _moves(preset: dict[str, Any], own: Application, body: dict[str, Any], ours: Mapping[str, str]) -> None:
    """Moves that are not as large down as up; what is on or off has no limit of moves."""
    for block, entry in zip(own.mvs, body["mv"], strict=True):
        up, down = moves_of(block)
        if up != -down and entry.get("actuator", {}).get("kind") != "on-off":
            preset.setdefault("move_high", {})[ours[block.name]] = up if up < NO_LIMIT else math.inf
            preset.setdefault("move_low", {})[ours[block.name]] = down if -down < NO_LIMIT else -math.inf
    for key, sign in (("move_high", 1), ("move_low", -1)):
        for entry in body["mv"] if key in preset else ():
            preset[key].setdefault(entry["name"], sign * entry.get("move", math.inf))


def _measurements(preset: dict[str, Any], own: Application, ours: Mapping[str, str], report: Report) -> None:
    """Which measurements count, and how many bad ones switch a CV off."""
    for block in own.cvs:
        name, on = ours[block.name], block.word("MeasValidation", "OFF")
        found = block.find("MeasValidation")
        require(on in ("ON", "OFF"), block.place(found) if found else block.where, on, "ON or OFF")
        for side in ("High", "Low"):
            key, value = (
                f"Meas{side}Limit",
                block.number(f"Meas{side}Limit", "a limit of measurements", math.inf),
            )
            if on == "OFF":
                report.say(
                    block,
                    key,
                    "equal" if abs(value) >= NO_LIMIT else "approximated",
                    "not in force: MeasValidation is OFF",
                )
            elif abs(value) < NO_LIMIT:
                preset.setdefault(f"measurement_{side.lower()}", {})[name] = value
        low, high = (preset.get(f"measurement_{side}", {}).get(name) for side in ("low", "high"))
        found = block.find("MeasLowLimit")
        if found and low is not None and high is not None:
            require(low <= high, block.place(found), low, f"at most MeasHighLimit = {high:g}")
        limit = _count(block, "BadCntLim", 0, least=0)
        if limit:
            preset.setdefault("bad_limit", {})[name] = limit
        else:
            report.say(block, "BadCntLim", "equal", "never switched off")


def _bias(preset: dict[str, Any], own: Application, time_unit: str, report: Report) -> None:
    """The cut-off of the bias filter: one for all CVs, by the slowest."""
    constants = {
        block.name: block.number("BiasTfilt", "time constant of the bias filter", 0.0) for block in own.cvs
    }
    for block in own.cvs:
        require(constants[block.name] >= 0, block.where, constants[block.name], "BiasTfilt of 0 or more")
    slowest = max(constants.values())
    if not slowest:
        return
    preset["bias_cutoff"] = 1 / (slowest * TIME_UNITS[time_unit])
    report.notes.append(f"assumed: time constants are in {time_unit}, which is not documented (--time-unit)")
    for block in own.cvs:
        if constants[block.name] != slowest:
            report.say(
                block,
                "BiasTfilt",
                "approximated",
                f"{slowest:g} {time_unit}, the slowest: one bias_cutoff for all CVs",
            )
