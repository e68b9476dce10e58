"""A first process file from a step-response model: what the model does not say is guessed, and every guess says so.

`jaxmpc process new` calls it. The guesses follow one idea: an MV typically moves over a quarter of its range, the span of a
CV is what that does to it, and a deviation of one span costs as much as ten of the largest moves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from jaxmpc.errors import InputError, near
from jaxmpc.files import toml_value
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.file import VARIABLE
from jaxmpc.process.process import amount

SETTLED = 0.02  # of the largest value of a response: within it, it has settled
LEAST_HORIZON = 20  # samples
LONGEST_BLOCK = 64  # samples
STOP = 1e7  # s


def new_process(
    model: StepResponseModel,
    file: str,
    name: str,
    *,
    fmu: str = "",
    steps: Mapping[str, float] | None = None,
    switches: Sequence[str] = (),
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> tuple[str, list[str]]:
    """The text of a process file for a model, and what was guessed for it.

    Args:
        model: of the process, which is its own plant until there is a better one.
        file: of the model, as the process file names it.
        name: of the process.
        fmu: from which the model was identified, as the process file names it; the first plant.
        steps: sizes of the steps of MVs that do not take every value [MV unit].
        switches: MVs that are on or off.
        limits: low and high of MVs, where they are known [MV unit].

    Returns:
        ``(text, guesses)``.

    Raises:
        InputError: for names that no process may have, MVs that the model has not, or steps that are not positive.
    """
    found = dict(model.provenance)
    moved = {mv: dict(how) for mv, how in dict(found.get("actuators", ())).items()}
    listed = {mv: how["values"] for mv, how in moved.items() if how["kind"] == "values"}
    switches = (
        *switches,
        *(mv for mv, how in moved.items() if how["kind"] == "on-off" and mv not in switches),
    )
    own = {mv: how["step"] for mv, how in moved.items() if how["kind"] == "stepped" and mv not in switches}
    steps = own | dict(steps or {})
    _check(model, steps, switches)
    point = dict(model.working_point)
    cv_units, mv_units = (units or ("1",) * len(names) for units, names in _names(model))
    declared = dict(found.get("ranges", ()))
    known = declared | dict(limits or {})
    ranges = {
        mv: known.get(mv) or _range(unit, point.get(mv), mv in switches)
        for mv, unit in zip(model.mv_names, mv_units, strict=True)
    }
    spans = np.array([(high - low) / (1 if mv in switches else 4) for mv, (low, high) in ranges.items()])
    moves = {
        mv: high - low if mv in {*switches, *listed} else steps.get(mv) or _round((high - low) / 50)
        for mv, (low, high) in ranges.items()
    }
    gains = np.asarray(model.coefficients)[:, :, -1]
    reach = np.abs(gains) @ spans
    cv_spans = [_round(value) if value > 0 else 1.0 for value in reach]
    horizon, control = _horizons(model)
    guesses = [] if model.cv_units and model.mv_units else ["all units: the model names none"]
    if not point:
        guesses.append(
            "the working point: the model has none, so that all CVs and MVs are deviations from it"
        )
    for (mv, (low, high)), unit in zip(ranges.items(), mv_units, strict=True):
        if mv not in known:
            how = ", one or the other" if mv in switches else f", and at most {moves[mv]:g} per sample"
            guesses.append(f"the range of {mv}: {low:g} to {amount(high, unit)}{how}")
        elif mv not in switches:
            guesses.append(f"the largest move of {mv}: {amount(moves[mv], unit)} per sample")
    guesses += [
        f"the span of {cv}: {amount(span, unit)}, by what the MVs do to it"
        for cv, span, unit in zip(model.cv_names, cv_spans, cv_units, strict=True)
    ]
    guesses.append(f"horizons of {horizon} and {control} samples, by how long the responses take")
    guesses.append("all weights, deadzones and setpoints")
    lines = _head(model, file, name, fmu)
    for cv, unit, span in zip(model.cv_names, cv_units, cv_spans, strict=True):
        lines += [
            "[[cv]]",
            *_variable(cv, unit, span, "guessed from the gains and the ranges of the MVs"),
            "",
        ]
    for mv, unit, span in zip(model.mv_names, mv_units, spans.tolist(), strict=True):
        low, high = ranges[mv]
        lines += [
            "[[mv]]",
            *_variable(mv, unit, span, f"guessed: {'all' if mv in switches else 'a quarter'} of its range"),
        ]
        guessed = "" if mv in known else " # guessed"
        guessed = " # as the FMU declares it" if mv in declared and mv not in (limits or {}) else guessed
        lines += [f"low = {low:g}{guessed}", f"high = {high:g}{guessed}"]
        if mv in switches:
            lines += ['actuator = { kind = "on-off" } # stands at low or at high']
        elif mv in listed:
            lines += [
                f"move = {moves[mv]:g}",
                f'actuator = {{ kind = "values", values = {list(listed[mv])} }}',
            ]
        elif mv in steps:
            lines += [f"move = {moves[mv]:g} # guessed: largest move per sample"]
            lines += [f'actuator = {{ kind = "stepped", step = {steps[mv]:g} }}']
        else:
            lines += [f"move = {moves[mv]:g} # guessed: largest move per sample"]
        lines.append("")
    for dv, unit in zip(model.dv_names, model.dv_units or ("1",) * len(model.dv_names), strict=True):
        lines += [
            "[[disturbance]] # measured: the model has responses to it",
            *_variable(dv, unit, 1.0, "guessed"),
            "",
        ]
    for cv, unit, span in zip(model.cv_names, cv_units, cv_spans, strict=True):
        if fmu:
            break  # an FMU has no loads on its CVs
        lines += ["[[disturbance]] # not measured: added to the CV"]
        lines += [
            f'name = "output.{cv}"',
            f"unit = {toml_value(unit)}",
            f'label = "load on {cv.replace("_", " ")}"',
        ]
        lines += [f"span = {_round(span / 5):g}", ""]
    stepped = [moves[mv] if mv in switches else steps.get(mv, 0.0) for mv in model.mv_names]
    jumps = np.abs(gains) @ stepped  # what one step of each of them does
    zones = [
        _rounded_up(max(span / 50, jump / 2)) for span, jump in zip(cv_spans, jumps.tolist(), strict=True)
    ]
    lines += _tuning(model, cv_spans, list(moves.values()), zones, horizon, control)
    shifts = [
        _shift(low, high, point.get(mv, 0.0), span, steps.get(mv), mv in switches)
        for (mv, (low, high)), span in zip(ranges.items(), spans.tolist(), strict=True)
    ]
    lines += _references(model, np.array(shifts), point, horizon)
    return "\n".join(lines), guesses


def _check(model: StepResponseModel, steps: Mapping[str, float], switches: Sequence[str]) -> None:
    """Refuse what no process could be made of."""
    for kind in ("cv", "mv", "dv"):
        for name in getattr(model, f"{kind}_names"):
            if not VARIABLE.fullmatch(name):
                expected = "a name of letters, digits and '_', a letter first"
                raise InputError(f"model.{kind}", name, expected, "Rename it in the model file")
    for option, names in (("--step", steps), ("--on-off", switches)):
        for mv in names:
            if mv not in model.mv_names:
                known = f"an MV of the model: {', '.join(model.mv_names)}"
                raise InputError(option, mv, known, near(mv, model.mv_names))
    for mv, step in steps.items():
        if not 0 < step < math.inf:
            raise InputError("--step", f"{mv}={step:g}", "a positive step [MV unit]")
        if mv in switches:
            raise InputError("--step", f"{mv}={step:g}", "nothing: it is on or off")


def _names(model: StepResponseModel) -> tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]:
    return (model.cv_units, model.cv_names), (model.mv_units, model.mv_names)


def _round(value: float, digits: int = 2) -> float:
    """A number of few digits, which a person would have chosen."""
    return float(f"{value:.{digits}g}")


def _rounded_up(value: float) -> float:
    """A number of two digits that is not less."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return _round(math.ceil(value / digit - 1e-9) * digit)


def _range(unit: str, point: float | None, switch: bool) -> tuple[float, float]:
    """Low and high limit of an MV."""
    if unit == "%":
        return 0.0, 100.0
    if switch:
        return 0.0, 1.0
    if point:
        return tuple(sorted((0.0, _round(2 * point))))  # type: ignore[return-value]
    return -10.0, 10.0


def _shift(low: float, high: float, at: float, span: float, step: float | None, switch: bool) -> float:
    """How far an MV is shifted for a setpoint, towards its farther limit.

    A third of its span, or between two positions, where rounding hunts; a switch goes to its other end.
    """
    way, room = (1, high - at) if high - at >= at - low else (-1, at - low)
    if switch:
        return way * room
    size = span / 3 if step is None else (max(int(span / 3 / step), 1) + 0.5) * step
    return way * (size if size <= room else min(step or size, room) / 2)


def _horizons(model: StepResponseModel) -> tuple[int, int]:
    """Prediction and control horizon [samples]: until all responses have settled, and four fifths of that."""
    s = np.asarray(model.coefficients)
    off = np.abs(s - s[:, :, -1:]) > SETTLED * np.abs(s).max(axis=2, keepdims=True)
    last = int(np.flatnonzero(off.any(axis=(0, 1)))[-1]) + 2 if off.any() else 1
    horizon = max(min(round(1.2 * last), model.samples), LEAST_HORIZON)
    return horizon, max(4 * horizon // 5, 1)


def blocks_of(horizon: int) -> list[int]:
    """Blocks that sum to a control horizon: single samples first, then longer and longer ones."""
    out, size = [], 1
    while sum(out) < horizon:
        for _ in range(4 if size == 1 else 2):
            if sum(out) < horizon:
                out.append(min(size, horizon - sum(out)))
        size = min(2 * size, LONGEST_BLOCK)
    return out


def _head(model: StepResponseModel, file: str, name: str, fmu: str) -> list[str]:
    return [
        "# A process for studies of MPC with discrete actuators. What is guessed says so: look at it first.",
        "# `jaxmpc process check` judges this file and draws the responses.",
        "",
        f"name = {toml_value(name)}",
        f"dt = {model.dt:g} # s, that of the model",
        "",
        "[model]",
        f"file = {toml_value(file)}",
        "",
        *(_fmu_plant(model, fmu) if fmu else []),
        "[plants.model] # the model is its own plant; studies may vary gains, dead times and time scales of it",
        'kind = "model"',
        "",
    ]


def _fmu_plant(model: StepResponseModel, fmu: str) -> list[str]:
    """The FMU with the start values, names and working point of the identification."""
    found, point = dict(model.provenance), dict(model.working_point)
    options = {
        "start": dict(found.get("start", ())),
        "variables": dict(found.get("variables", ())),
        "working_point": {mv: point[mv] for mv in model.mv_names if mv in point},
    }
    lines = [f"{key} = {toml_value(values)}" for key, values in options.items() if values]
    lines += [f"settle = {found['settle']:g} # s, before a loop begins"] if found.get("settle") else []
    lines += [f"stop_time = {STOP:g} # s; the FMU is told that runs end later than its experiment"] * bool(
        found.get("stops")
    )
    head = ["[plants.fmu] # the first plant: what the model was identified from", 'kind = "fmu"']
    return [*head, f"source = {toml_value(fmu)}", "", "[plants.fmu.options]", *lines, ""]


def _variable(name: str, unit: str, span: float, why: str) -> list[str]:
    return [f"name = {toml_value(name)}", f"unit = {toml_value(unit)}", f"span = {span:g} # {why}"]


def _table(names: Sequence[str], values: Sequence[float]) -> str:
    return toml_value({name: float(value) for name, value in zip(names, values, strict=True)})


def _tuning(
    model: StepResponseModel,
    spans: Sequence[float],
    moves: Sequence[float],
    zones: Sequence[float],
    horizon: int,
    control: int,
) -> list[str]:
    cvs, mvs = model.cv_names, model.mv_names
    weights = [_round(1 / span**2) for span in spans]
    return [
        "[structure]",
        f"prediction_horizon = {horizon} # samples; guessed: until all responses have settled",
        f"control_horizon = {control} # samples; guessed",
        f"blocks = {blocks_of(control)} # samples; they sum to the control horizon",
        "",
        "[presets.default] # guessed: a deviation of one span costs as much as ten of the largest moves",
        f"cv_weight = {_table(cvs, weights)} # 1/CV unit^2",
        f"move_weight = {_table(mvs, [_round(0.1 / move**2) for move in moves])} # 1/MV unit^2",
        f"deadzone = {_table(cvs, zones)} # CV unit, half widths; half of what one step of the MVs does, at least",
        f"soft_quadratic = {_table(cvs, weights)} # beyond the deadzone",
        f"soft_linear = {_table(cvs, [0.0] * len(cvs))}",
        f"bias_cutoff = {_round(1 / (2 * model.dt)):g} # rad/s, guessed",
        "",
    ]


def _references(
    model: StepResponseModel, shifts: np.ndarray, point: Mapping[str, float], horizon: int
) -> list[str]:
    """Setpoints that the MVs can hold: one MV after the other is shifted, and at last all are back."""
    gains = np.asarray(model.coefficients)[:, :, -1]
    start = np.array([point.get(cv, 0.0) for cv in model.cv_names])
    held = np.cumsum(np.concatenate([np.zeros((1, len(shifts))), np.diag(shifts)]), axis=0)
    rows = [start + gains @ shift for shift in (*held, 0 * shifts)]
    wait = math.ceil(1.2 * horizon) * model.dt

    def windows(count: int) -> str:
        listed = [
            "[" + ", ".join(f"{v:.6g}" for v in (k * wait, *row)) + "]" for k, row in enumerate(rows[:count])
        ]
        return "[" + ", ".join(listed) + "]"

    listed = ", ".join(model.cv_names)
    return [
        f"[references.steps] # guessed: what the MVs hold when shifted one after the other; rows: start [s], {listed}",
        f"duration = {len(rows) * wait:g} # s",
        f"windows = {windows(len(rows))}",
        "",
        "[references.quick]",
        f"duration = {2 * wait:g}",
        f"windows = {windows(2)}",
        "",
    ]
