"""A first process file from a step-response model: what the model does not say is guessed, and every guess says so.

`jaxmpc process new` calls it. The guesses follow one idea: an MV typically moves over a quarter of its range, the span of a
CV is what that does to it, and a deviation of one span costs as much as ten of the largest moves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from jaxmpc.check import among
from jaxmpc.errors import InputError
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
    mvs = _mvs(model, steps or {}, switches, limits or {})
    point, units = dict(model.working_point), model.units
    gains = np.asarray(model.coefficients)[:, :, -1]
    reach = np.abs(gains) @ [mv.span for mv in mvs]
    spans = {cv: _round(value) if value > 0 else 1.0 for cv, value in zip(model.cv_names, reach, strict=True)}
    horizon, control = _horizons(model)
    lines = _head(model, file, name, fmu)
    for cv, span in spans.items():
        why = "guessed from the gains and the ranges of the MVs"
        lines += ["[[cv]]", *_variable(cv, units[cv], span, why), ""]
    for mv in mvs:
        lines += mv.lines()
    for dv in model.dv_names:
        head = "[[disturbance]] # measured: the model has responses to it"
        lines += [head, *_variable(dv, units[dv], 1.0, "guessed"), ""]
    for cv, span in spans.items() if not fmu else ():  # an FMU has no loads on its CVs
        lines += [
            "[[disturbance]] # not measured: added to the CV",
            f'name = "output.{cv}"',
            f"unit = {toml_value(units[cv])}",
            f'label = "load on {cv.replace("_", " ")}"',
            f"span = {_round(span / 5):g}",
            "",
        ]
    stepped = [mv.move if mv.kind == "on-off" else mv.step for mv in mvs]
    jumps = np.abs(gains) @ stepped  # what one step of each of them does
    zones = [
        _rounded_up(max(span / 50, jump / 2))
        for span, jump in zip(spans.values(), jumps.tolist(), strict=True)
    ]
    lines += _tuning(model, list(spans.values()), [mv.move for mv in mvs], zones, horizon, control)
    shifts = [
        _shift(mv.low, mv.high, point.get(mv.name, 0.0), mv.span, mv.step or None, mv.kind == "on-off")
        for mv in mvs
    ]
    lines += _references(model, np.array(shifts), point, horizon)
    return "\n".join(lines), _guesses(model, mvs, spans, horizon, control)


class _Mv(NamedTuple):
    """An MV of the file.

    Attributes:
        source: of its limits, a comment; None where they are guessed.
        kind: of its actuator; empty where it takes every value.
        step: of whole steps [MV unit]; 0 without.
        values: that it takes.
    """

    name: str
    unit: str
    low: float
    high: float
    source: str | None
    kind: Literal["", "on-off", "values", "stepped"]
    step: float
    values: tuple[float, ...]

    @property
    def span(self) -> float:
        """How far it typically moves [MV unit]."""
        return (self.high - self.low) / (1 if self.kind == "on-off" else 4)

    @property
    def move(self) -> float:
        """Largest move per sample [MV unit]."""
        if self.kind in ("on-off", "values"):
            return self.high - self.low
        return self.step or _round((self.high - self.low) / 50)

    def lines(self) -> list[str]:
        """Its section."""
        share = "all" if self.kind == "on-off" else "a quarter"
        source = " # guessed" if self.source is None else self.source
        move = f"move = {self.move:g}"
        guessed = f"{move} # guessed: largest move per sample"
        actuator = {
            "": [guessed],
            "on-off": ['actuator = { kind = "on-off" } # stands at low or at high'],
            "values": [move, f'actuator = {{ kind = "values", values = {list(self.values)} }}'],
            "stepped": [guessed, f'actuator = {{ kind = "stepped", step = {self.step:g} }}'],
        }
        return [
            "[[mv]]",
            *_variable(self.name, self.unit, self.span, f"guessed: {share} of its range"),
            f"low = {self.low:g}{source}",
            f"high = {self.high:g}{source}",
            *actuator[self.kind],
            "",
        ]


def _mvs(
    model: StepResponseModel,
    steps: Mapping[str, float],
    switches: Sequence[str],
    limits: Mapping[str, tuple[float, float]],
) -> list[_Mv]:
    """The MVs with what is asked for, what the model was identified from says, and guesses; see `new_process`."""
    found, point = dict(model.provenance), dict(model.working_point)
    moved = {mv: dict(how) for mv, how in dict(found.get("actuators", ())).items()}
    of = lambda kind: [mv for mv, how in moved.items() if how["kind"] == kind]  # noqa: E731
    switches = list(dict.fromkeys([*switches, *of("on-off")]))
    steps = {mv: moved[mv]["step"] for mv in of("stepped") if mv not in switches} | dict(steps)
    _check(model, steps, switches)
    declared, out = dict(found.get("ranges", ())), []
    for mv in model.mv_names:
        known = limits.get(mv) or declared.get(mv)
        low, high = known or _range(model.units[mv], point.get(mv), mv in switches)
        source = "" if mv in limits else " # as the FMU declares it" if mv in declared else None
        listed = mv in of("values")
        kind = "on-off" if mv in switches else "values" if listed else "stepped" if mv in steps else ""
        values = moved[mv]["values"] if listed else ()
        out.append(_Mv(mv, model.units[mv], low, high, source, kind, steps.get(mv, 0.0), values))
    return out


def _guesses(
    model: StepResponseModel, mvs: Sequence[_Mv], spans: Mapping[str, float], horizon: int, control: int
) -> list[str]:
    """What the file says that nobody said."""
    out = [] if model.cv_units and model.mv_units else ["all units: the model names none"]
    if not model.working_point:
        out.append("the working point: the model has none, so that all CVs and MVs are deviations from it")
    for mv in mvs:
        if mv.source is None:
            how = ", one or the other" if mv.kind == "on-off" else f", and at most {mv.move:g} per sample"
            out.append(f"the range of {mv.name}: {mv.low:g} to {amount(mv.high, mv.unit)}{how}")
        elif mv.kind != "on-off":
            out.append(f"the largest move of {mv.name}: {amount(mv.move, mv.unit)} per sample")
    out += [
        f"the span of {cv}: {amount(span, model.units[cv])}, by what the MVs do to it"
        for cv, span in spans.items()
    ]
    out.append(f"horizons of {horizon} and {control} samples, by how long the responses take")
    return [*out, "all weights, deadzones and setpoints"]


def _check(model: StepResponseModel, steps: Mapping[str, float], switches: Sequence[str]) -> None:
    """Refuse what no process could be made of."""
    for kind in ("cv", "mv", "dv"):
        for name in getattr(model, f"{kind}_names"):
            if not VARIABLE.fullmatch(name):
                expected = "a name of letters, digits and '_', a letter first"
                raise InputError(f"model.{kind}", name, expected, "Rename it in the model file")
    for option, names in (("--step", steps), ("--on-off", switches)):
        for mv in names:
            among(option, mv, model.mv_names, "an MV of the model:")
    for mv, step in steps.items():
        if not 0 < step < math.inf:
            raise InputError("--step", f"{mv}={step:g}", "a positive step [MV unit]")
        if mv in switches:
            raise InputError("--step", f"{mv}={step:g}", "nothing: it is on or off")


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
