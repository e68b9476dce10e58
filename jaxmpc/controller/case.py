"""One controller step as a file: the case that `jaxmpc plan` reads, and the plan that it writes.

A case holds everything that one optimisation needs (thesis 5.1, 6.1-6.5), in engineering units, as JSON that
any language can write. Reading is strict: unknown fields, wrong shapes and impossible numbers are refused,
with the path of the field, before anything is computed. `make_model`, `Structure` and `make_tuning` do the
checks that are theirs; this file adds what belongs to a single step. The command line, tests and replays of
logged steps call it.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from jaxmpc.check import among
from jaxmpc.controller.given import ARRAYS, check_position, checked_since, step_array
from jaxmpc.decoding import decode
from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically
from jaxmpc.model.step_response import StepResponseModel, make_model
from jaxmpc.problem.declared import declared
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS as TUNING
from jaxmpc.problem.tuning import Tuning, make_tuning
from jaxmpc.relaxed.gap import check_gap, check_time_limit

DEFAULT_GAP = 1e-6
LARGEST_FILE = 64 * 2**20  # bytes; a hundred thousand samples of four CVs take 10 MiB
LONGEST_HORIZON = 100_000  # samples; beyond it the file is wrong, and memory runs out before any other check


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """One controller step, checked."""

    model: StepResponseModel  # step responses
    structure: Structure  # horizons, blocks and integer steps; its names and dt are the model's
    tuning: Tuning  # weights and limits
    mv_now: np.ndarray  # ``"mv"``, MVs before the move that is to be decided [MV unit]
    last_move: np.ndarray  # ``"mv"``, the move that was applied at the previous sample [MV unit]
    # ``"horizon cv"``, what the CVs do without further moves, bias included [CV unit]
    free_response: np.ndarray
    setpoint: np.ndarray  # ``"horizon cv"`` [CV unit]
    # ``"block mv"``, where the search may start [MV unit per sample], or ``None``
    previous_moves: np.ndarray | None = None
    # per MV, samples since its last move, None for long ago; or ``None``
    samples_since_move: tuple[int | None, ...] | None = None
    time_limit: float | None = None  # of the solve [s], or ``None``
    gap: float = DEFAULT_GAP  # relative gap at which the plan counts as optimal


class _ModelFields(msgspec.Struct, forbid_unknown_fields=True):
    dt: float
    cv: list[str]
    mv: list[str]
    coefficients: list[list[list[float]]]


class _StructureFields(msgspec.Struct, forbid_unknown_fields=True):
    prediction_horizon: int
    control_horizon: int
    first_penalised: int
    blocking: str
    blocks: Any = []  # lengths, or an object of them by MV
    integer_step: dict[str, Any] = {}
    integer_values: dict[str, Any] = {}
    dwell: dict[str, Any] = {}
    integer_horizon: int | dict[str, Any] = {}


_IN_STEP = {key: field for key, field in TUNING.items() if field.in_step}
_TuningFields: Any = msgspec.defstruct(
    "_TuningFields",
    [
        (key, dict[str, Any], {})
        if field.flag
        else (key, list[float] | None, None)
        if field.optional
        else (key, list[float | None] if field.infinite else list[float])
        for key, field in _IN_STEP.items()
    ],
    forbid_unknown_fields=True,
    kw_only=True,
)


class _LimitFields(msgspec.Struct, forbid_unknown_fields=True):
    time_s: float | None = None
    gap: float = DEFAULT_GAP


class _CaseFields(msgspec.Struct, forbid_unknown_fields=True):
    model: _ModelFields
    structure: _StructureFields
    tuning: _TuningFields  # pyright: ignore[reportInvalidTypeForm]
    mv_now: list[float]
    last_move: list[float]
    free_response: list[list[float]]
    setpoint: list[list[float]]
    previous_moves: list[list[float]] | None = None
    samples_since_move: list[int | None] | None = None
    limits: _LimitFields | None = None


_PLAIN_STRUCTURE = ("prediction_horizon", "control_horizon", "first_penalised", "blocking")
_RARE = ("integer_values", "dwell", "integer_horizon")  # what few cases have
_PLAN = (
    *("status", "objective", "bound", "gap", "moves", "mv", "cv", "eps_high", "eps_low"),
    *("nodes", "solve_time_s", "finished_by"),
)
_UNIT = {
    "model.dt": "s",
    "model.coefficients": "CV unit per MV unit",
    "samples_since_move": "samples",
    "limits.time_s": "s",
    "limits.gap": "relative",
    **{f"structure.{key}": field.unit for key, field in declared(Structure).items()},
    **{f"tuning.{key}": field.unit for key, field in _IN_STEP.items()},
    **{key: unit for key, (unit, *_) in ARRAYS.items()},
}


def load_case(path: str | Path) -> Case:
    """Read a case file.

    Raises:
        InputError: for a file that cannot be read, text that is not JSON, and everything `make_case` refuses.
    """
    try:
        with open(path, "rb") as file:
            text = file.read(LARGEST_FILE + 1)
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError("case file", str(path), f"a readable file ({reason})") from error
    if len(text) > LARGEST_FILE:
        raise InputError("case file", str(path), f"a file of {LARGEST_FILE // 2**20} MiB at most")
    try:
        body = json.loads(text, object_pairs_hook=_without_repeats)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # bad syntax, bad UTF-8, absurd numbers or nesting
        raise InputError("case file", str(path), f"a JSON object ({error})") from error
    return make_case(body)


def make_case(body: Any) -> Case:
    """Check a decoded case file.

    Returns:
        The case, with infinite limits where the file has null.

    Raises:
        InputError: naming the path of the field, for unknown or missing fields, wrong types (true and false
            are not numbers), wrong shapes, NaN, crossed limits, and whatever else makes the step meaningless.
    """
    fields = decode(body, _CaseFields, name="case", table="an object {...}", expected=_told)
    model = make_model(fields.model.coefficients, fields.model.dt, fields.model.cv, fields.model.mv)
    structure = _structure(fields.structure, model)
    limits = fields.limits or _LimitFields()
    case = Case(
        model=model,
        structure=structure,
        tuning=make_tuning(structure, **_given(fields.tuning)),
        **{key: step_array(key, getattr(fields, key), structure) for key in ARRAYS},
        samples_since_move=checked_since(structure, fields.samples_since_move),
        time_limit=check_time_limit("limits.time_s", limits.time_s),
        gap=check_gap("limits.gap", limits.gap),
    )
    check_position(structure, case.tuning, case.mv_now)
    return case


def case_to_dict(case: Case) -> dict[str, Any]:
    """The content of the case file that reads back as `case`; infinite limits become ``None``.

    The bias filter and the mean-move limit are the controller's memory, not part of one step: a caller that
    logs a step passes the move limits that held in that step.
    """
    structure, model = case.structure, case.model
    rare = {key: _by_name(structure, getattr(structure, key)) for key in _RARE}
    tuning = {key: np.asarray(getattr(case.tuning, key)).tolist() for key in _IN_STEP}
    tuning = {key: v for key, v in tuning.items() if not TUNING[key].optional or np.any(v)}
    for key, field in _IN_STEP.items():
        if field.flag:
            tuning[key] = {structure.mv_names[i]: tuning[key][i] for i in structure.integer_mvs}
    body = {
        "model": {
            "dt": model.dt,
            "cv": list(model.cv_names),
            "mv": list(model.mv_names),
            "coefficients": np.asarray(model.coefficients).tolist(),
        },
        "structure": {
            **{key: getattr(structure, key) for key in _PLAIN_STRUCTURE},
            "blocks": _blocks(structure),
            "integer_step": _by_name(structure, structure.integer_step),
            **{key: values for key, values in rare.items() if values},
        },
        "tuning": _plain(tuning),
        **{key: np.asarray(getattr(case, key)).tolist() for key in ARRAYS if getattr(case, key) is not None},
        "limits": {"time_s": case.time_limit, "gap": case.gap},
    }
    if case.samples_since_move is not None:
        body["samples_since_move"] = list(case.samples_since_move)
    return body


def _given(fields: Any) -> dict[str, Any]:
    """The fields of a tuning, without those that may be left out and are."""
    values = {key: getattr(fields, key) for key in _IN_STEP}
    return {key: value for key, value in values.items() if value is not None}


def _by_name(structure: Structure, values: tuple) -> dict[str, Any]:
    """Those of the MVs that have one."""
    return {name: v for name, v in zip(structure.mv_names, values, strict=False) if v is not None}


def dump_case(case: Case, path: str | Path) -> Path:
    """Write `case` as a case file, in one go; returns the path."""
    return write_atomically(path, json.dumps(case_to_dict(case), indent=1, allow_nan=False))


def plan_to_dict(plan: Any) -> dict[str, Any]:
    """The content of a plan file: the fields of a `Plan`, with null where a number is not finite.

    The reason is there only where the plan is not optimal, `integer_until` where an integer horizon leaves moves relaxed.
    """
    some = {name: _plain(getattr(plan, name, None)) for name in ("reason", "integer_until")}
    body = {name: _plain(getattr(plan, name)) for name in _PLAN}
    return body | {name: value for name, value in some.items() if value is not None}


def _plain(value: Any) -> Any:
    """Arrays and numbers as JSON values; JSON has no NaN and no infinity."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, (int, float)):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return _plain(np.asarray(value).tolist())


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object; a repeated key would silently drop the first value."""
    body = dict(pairs)
    if len(body) < len(pairs):
        keys = [key for key, _ in pairs]
        repeated = next(key for key in keys if keys.count(key) > 1)
        raise InputError(repeated, [value for key, value in pairs if key == repeated], "this key once")
    return body


def _unit(path: str) -> str:
    return f" [{_UNIT[path]}]" if _UNIT.get(path) else ""


def _told(path: str, words: str) -> str:
    return words + _unit(path)


def _blocks(structure: Structure) -> Any:
    """The blocks as a case file has them."""
    if not structure.own_blocks:
        return list(structure.blocks)
    return {name: list(structure.blocks_of(mv)) for mv, name in enumerate(structure.mv_names)}


def _given_blocks(given: Any, names: tuple[str, ...]) -> tuple[Any, ...]:
    """The blocks of a case file: a list for all MVs, or one per MV."""
    if not isinstance(given, dict):
        return tuple(decode(given, list[int], "structure.blocks", expected=_told))
    listed, unit = ", ".join(names), _unit("structure.blocks")
    for name, lengths in given.items():
        _check_mv(f"structure.blocks.{name}", lengths, name, names)
    for name in names:
        if name not in given:
            raise InputError(
                f"structure.blocks.{name}",
                "nothing",
                f"lengths of its blocks{unit}: each of {listed} needs its own",
            )
    expected = lambda _, words: words + unit  # noqa: E731
    lists = (decode(given[name], list[int], f"structure.blocks.{name}", expected=expected) for name in names)
    return tuple(map(tuple, lists))


def _check_mv(path: str, value: Any, name: str, names: tuple[str, ...]) -> None:
    among(path, name, names, "one of the MV names", value)


def _given_horizon(given: int | dict[str, Any], integer: dict[str, Any], names: tuple[str, ...]) -> tuple:
    """The integer horizon of a case file: one for all MVs, or those of some."""
    if not isinstance(given, dict):
        return (given,) * len(names)
    for name, horizon in given.items():
        if name not in integer:
            expected = f"one of the MVs with an integer_step ({', '.join(integer) or 'there is none'})"
            raise InputError(f"structure.integer_horizon.{name}", horizon, expected)
        if horizon is None:
            expected = "a whole number of samples, 1 or more; leave an MV out whose moves are all whole"
            raise InputError(f"structure.integer_horizon.{name}", horizon, expected)
    return tuple(given.get(name) for name in names)


def _structure(fields: _StructureFields, model: StepResponseModel) -> Structure:
    of_mvs = {
        "integer_step": (None, "a positive step [MV unit]; leave a continuous MV out"),
        "integer_values": (None, "a list of values [MV unit]; leave a continuous MV out"),
        "dwell": (1, "a whole number of samples; leave an MV without dwell out"),
    }
    per_mv: dict[str, Any] = {}
    for key, (absent, expected) in of_mvs.items():
        per_mv[key] = [absent] * len(model.mv_names)
        for name, value in getattr(fields, key).items():
            path = f"structure.{key}.{name}"
            _check_mv(path, value, name, model.mv_names)
            if value is None:
                raise InputError(path, value, expected)
            per_mv[key][model.mv_names.index(name)] = value
    for key in ("prediction_horizon", "control_horizon"):
        if getattr(fields, key) > LONGEST_HORIZON:
            raise InputError(f"structure.{key}", getattr(fields, key), f"at most {LONGEST_HORIZON} samples")
    return Structure(
        cv_names=model.cv_names,
        mv_names=model.mv_names,
        dt=model.dt,
        prediction_horizon=fields.prediction_horizon,
        control_horizon=fields.control_horizon,
        first_penalised=fields.first_penalised,
        blocks=_given_blocks(fields.blocks, model.mv_names),
        blocking=fields.blocking,  # type: ignore[arg-type]  # `Structure` checks it
        integer_step=tuple(per_mv["integer_step"]),
        integer_values=tuple(per_mv["integer_values"]),
        dwell=tuple(per_mv["dwell"]),
        integer_horizon=_given_horizon(
            fields.integer_horizon, {**fields.integer_step, **fields.integer_values}, model.mv_names
        ),
    )
