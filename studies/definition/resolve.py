"""Scenarios of a sweep study as numbers: presets filled in, units those of `jaxmpc`, one row per scenario.

Everything is done on whole columns, so that ten thousand scenarios take well under a second, and everything is checked here:
`Inputs` that exist describe runs that can start. Only what fixes the shape of a compiled program (structure, reference,
length) is built as typed objects, once per distinct combination.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from msgspec import UNSET

from identify.plants import open_plant
from jaxmpc.check import located, require
from jaxmpc.errors import InputError
from jaxmpc.loop.noise import check_deviation, check_seed
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS as TUNING
from jaxmpc.problem.tuning import LIMIT_PAIRS
from jaxmpc.process.plant import closing
from jaxmpc.process.reference import Reference
from studies.definition.axes import AxisTable
from studies.definition.sections import ReferenceDefinition
from studies.definition.sweep import StudyDefinition

LONGEST_RUN = 1_000_000  # samples


@dataclasses.dataclass(frozen=True, eq=False)
class Variant:
    """What fixes shapes and setpoints, shared by all scenarios that agree in it."""

    kind: str  # continuous or mixed-integer
    actuator: str  # whether MVs move as their actuators do (step) or take every value (continuous)
    structure: Structure  # of the controller
    reference: Reference  # setpoints, cut to the length of the run, filtered and ramped
    windows: Reference  # the same before that
    samples: int  # length of the run [samples]


@dataclasses.dataclass(frozen=True, eq=False)
class Inputs:
    """All scenarios in the units of `jaxmpc`; an array that does not vary has one row for all."""

    variants: tuple[Variant, ...]  # distinct shapes
    variant: np.ndarray  # "scenario", which of them
    # per field of `jaxmpc.problem.tuning.Tuning` "scenario name", and "scenario" for the bias cut-off
    tuning: dict[str, np.ndarray]
    plant: dict[str, np.ndarray]  # per parameter of the plant that is set "scenario", in the unit of its key
    point: (
        np.ndarray
    )  # "scenario mv", working point of the model [MV unit]; no columns where the model is a file
    noise: np.ndarray  # "scenario cv", standard deviation [CV unit]
    seed: np.ndarray  # "scenario", of the noise
    step_names: tuple[str, ...]  # disturbance of every step
    steps: (
        np.ndarray
    )  # "scenario step 2", steps of disturbances: time [s], offset from then on [unit of the disturbance]
    course: np.ndarray  # "scenario", named disturbances; empty text for none
    fault_kinds: tuple[tuple[str, str], ...]  # CV and kind of every sensor fault
    faults: np.ndarray  # "scenario fault 3", time [s], duration [s] and size [CV unit] of the sensor faults
    told: np.ndarray  # "scenario", whether the controller is told where the actuators stand
    preview: np.ndarray  # "scenario", whether it is told future setpoints and measured disturbances


def row(array: np.ndarray, k: int) -> np.ndarray:
    """Scenario k of an array that may have one row for all."""
    return array[k if len(array) > 1 else 0]


class Settings:
    """Base settings and axes of a definition: the value of a key in every scenario."""

    def __init__(self, definition: StudyDefinition, table: AxisTable):
        self.definition, self.fields = definition, definition.fields
        self.base, self.table, self.count = definition.base, table, len(table)

    def given(self, key: str) -> bool:
        """Whether the base or an axis sets the key."""
        return key in self.base or self.table.column(key) is not None

    def value(self, key: str, scenario: int) -> Any:
        """In one scenario, plain and typed; the default where nothing is given."""
        found = self.table.column(key)
        if found is None:
            return self.base.get(key, self.fields[key].default)
        return found[1][found[2][scenario]]

    def numbers(self, key: str, change: Callable[[float], float] | None = None) -> np.ndarray:
        """A numeric key ``"scenario"``, of length 1 if it does not vary; `change` converts each entry."""
        found = self.table.column(key)
        values = [self.base.get(key, self.fields[key].default)] if found is None else found[1]
        out = np.array(values if change is None else [change(v) for v in values], dtype=np.float64)
        return out if found is None else out[found[2]]

    def columns(self, keys: Sequence[str]) -> np.ndarray:
        """Some numeric keys ``"scenario key"``."""
        if not keys:
            return np.zeros((1, 0))
        return np.stack(np.broadcast_arrays(*[self.numbers(key) for key in keys]), axis=1)

    def texts(self, key: str) -> np.ndarray:
        """A key of texts ``"scenario"``, of length 1 if it does not vary; empty where nothing is given."""
        found = self.table.column(key)
        values = [self.base.get(key)] if found is None else found[1]
        out = np.array([value or "" for value in values], dtype=object)
        return out if found is None else out[found[2]]

    def combinations(self, keys: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """First scenario of each distinct combination of some keys' values, and each scenario's combination."""
        found = [column for key in keys if (column := self.table.column(key)) is not None]
        if not found:
            return np.array([0]), np.zeros(self.count, dtype=int)
        numbered = []
        for _, values, index in found:  # entries with equal values are one combination
            order = {value: n for n, value in enumerate(dict.fromkeys(values))}
            numbered.append(np.array([order[value] for value in values])[index])
        _, first, inverse = np.unique(np.stack(numbered, 1), axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)  # by first appearance
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        return first[order], rank[inverse.ravel()]


def resolve(definition: StudyDefinition, table: AxisTable) -> Inputs:
    """Numbers of every scenario, checked.

    Raises:
        InputError: naming the entries of the axes (or the base) whose combination is refused.
    """
    settings, process = Settings(definition, table), definition.process
    variants, variant = _variants(settings)
    kinds = np.array([v.kind == "mixed-integer" for v in variants])
    runs = np.array([v.reference.duration for v in variants])[variant], variants[0].structure.dt
    inputs = Inputs(
        variants=variants,
        variant=variant,
        tuning=_tuning(settings, kinds[variant] if len(set(kinds)) > 1 else kinds[:1]),
        plant=_plant(settings),
        point=settings.columns([f"model.{name}" for name in process.mv_names if not process.model.given]),
        noise=settings.columns([f"noise.{name}" for name in process.cv_names]),
        seed=settings.numbers("seed").astype(np.int64),
        step_names=tuple(
            s.name or process.disturbance_names[0] for s in settings.base.get("disturbance", ())
        ),
        steps=_events(settings, "disturbance", ("time", "offset"), *runs),
        course=settings.texts("course"),
        fault_kinds=tuple((fault.cv, fault.kind) for fault in settings.base.get("sensor_fault", ())),
        faults=_events(settings, "sensor_fault", ("time", "duration", "size"), *runs),
        told=settings.numbers("position_feedback").astype(bool),
        preview=settings.numbers("preview").astype(bool),
    )
    check_deviation(inputs.noise, len(process.cvs))
    check_seed(inputs.seed)
    return inputs


# --------------------------------------------------------------------------------------------------------- shapes


def _variants(settings: Settings) -> tuple[tuple[Variant, ...], np.ndarray]:
    firsts, index = settings.combinations([key for key, field in settings.fields.items() if field.shape])
    cut: dict[Any, tuple[Reference, Reference]] = {}
    variants = []
    for k in firsts.tolist():
        value = lambda key, k=k: settings.value(key, k)  # noqa: E731
        structure = _structure(settings, k)
        own = tuple(value(f"setpoint_rate.{name}") for name in settings.definition.process.cv_names)
        wanted = value("reference"), value("duration"), value("setpoint_filter"), own
        if wanted not in cut:
            cut[wanted] = _reference(settings, k, *wanted)
        reference, windows = cut[wanted]
        samples = reference.samples(structure.dt)
        path = settings.table.blame(["reference" if wanted[1] is None else "duration"], k)
        require(samples >= 1, path, wanted[1], f"one sample of {structure.dt:g} s or more")
        require(samples <= LONGEST_RUN, path, f"{samples} samples", f"a run of at most {LONGEST_RUN} samples")
        variants.append(
            Variant(value("controller"), value("actuator"), structure, reference, windows, samples)
        )
    return tuple(variants), index


def _structure(settings: Settings, k: int) -> Structure:
    """The structure of one scenario; without a control horizon the blocks decide it."""
    value = lambda key: settings.value(key, k)  # noqa: E731
    blocks, blocking = value("blocks"), value("blocking")
    process = settings.definition.process
    base = process.structure("moves", integer=value("controller") == "mixed-integer")
    of_one = blocks[0] if blocks and isinstance(blocks[0], tuple) else blocks
    horizon = value("control_horizon") or sum(of_one) or base.control_horizon
    own: dict[str, Any] = {}
    if base.integer_mvs:
        given = [value(f"integer_values.{name}") for name in process.mv_names]
        listed = base.integer_values or (None,) * len(given)
        lists = [own or shipped for own, shipped in zip(given, listed, strict=True)]
        steps = [
            step if values is None else None for step, values in zip(base.integer_step, lists, strict=True)
        ]
        dwell = [value(f"dwell.{name}") for name in process.mv_names]
        own = dict(integer_step=tuple(steps), integer_values=tuple(lists), dwell=tuple(dwell))
    same = ("prediction_horizon", "first_penalised", "integer_horizon", "mean_move_window", "mean_move_mode")

    def place(field: str) -> str:
        name = field.removeprefix("structure.")
        key = name if name in settings.fields else name.partition(".")[0]
        partner = {"blocks": ["control_horizon"], "first_penalised": ["prediction_horizon"]}.get(key, [])
        return settings.table.blame([key, *filter(settings.given, partner)], k)

    with located(place):
        return dataclasses.replace(
            base,
            control_horizon=horizon,
            blocks=() if blocking == "none" else blocks,
            blocking="moves" if blocking == "none" else blocking,
            **{key: value(key) for key in same},
            **own,
        )


def _reference(
    settings: Settings, k: int, name: Any, duration: float | None, lag: float, rates: tuple[float, ...]
) -> tuple[Reference, Reference]:
    """A named or own reference, cut to a duration [s]: filtered and ramped, and before that."""
    process = settings.definition.process
    whole = name.build(process, "base.") if isinstance(name, ReferenceDefinition) else process.reference(name)
    if duration is not None and duration != whole.duration:
        with located(lambda _: settings.table.blame(["duration"], k)):
            whole = whole.cut(duration)
    moved = whole.filtered(lag, process.dt) if lag else whole
    return (moved.ramped(rates, process.dt) if np.isfinite(rates).any() else moved), whole


# --------------------------------------------------------------------------------------------------------- tuning


def _tuning(settings: Settings, integer: np.ndarray) -> dict[str, np.ndarray]:
    """Tuning fields "scenario name"; `integer` ("scenario" or one for all): whether MVs move in whole steps."""
    process = settings.definition.process
    firsts, preset = settings.combinations(["preset"])
    tables = [process.tuning_fields(settings.value("preset", k)) for k in firsts.tolist()]
    preset = preset if len(tables) > 1 else preset[:1]
    names_of = {"cv": process.cv_names, "mv": process.mv_names, "": ("",)}
    names = {key: names_of[field.of] for key, field in TUNING.items() if not field.flag}
    out = {}
    for field, own in names.items():
        columns = []
        for name in own:
            key = f"tuning.{field}.{name}".rstrip(".")
            of_preset = np.array([_number(field, table, name) for table in tables])[preset]
            columns.append(settings.numbers(key) if settings.given(key) else of_preset)
        out[field] = np.stack(np.broadcast_arrays(*columns), axis=1) if own[0] else columns[0]
    for low, high in LIMIT_PAIRS:
        smaller, larger = np.broadcast_arrays(out[low], out[high])
        wrong = (smaller > larger) | np.isposinf(smaller) | np.isneginf(larger)
        for k, i in np.argwhere(wrong)[:1].tolist():
            name = names[low][i]
            keys = [f"tuning.{field}.{name}" for field in (low, high)]
            keys = [key for key in keys if settings.given(key)] or keys
            found = f"{low} {smaller[k, i]:g}, {high} {larger[k, i]:g}"
            expected = f"{low} of {name} at most its {high} [{settings.fields[f'tuning.{low}.{name}'].unit}]"
            raise InputError(settings.table.blame(keys, k), found, expected)
    rows = settings.numbers("tuning.oscillation_rows").astype(bool)
    rows, whole = np.broadcast_arrays(rows, integer)
    watched = np.array([[_watched(table, mv) for mv in process.mv_names] for table in tables])[preset]
    out["oscillation_rows"] = watched & (rows & whole)[:, None]
    soft = settings.numbers("soft").astype(bool)[:, None]
    if not soft.all():  # as hard everywhere as the soft controller is far outside its deadzone, as in no-soft
        out["cv_weight"] = out["cv_weight"] + np.where(soft, 0.0, out["soft_quadratic"])
        for field in ("soft_quadratic", "soft_linear"):
            out[field] = np.where(soft, out[field], 0.0)
    return out


def _watched(preset: dict[str, Any], mv: str) -> bool:
    """Whether a preset has oscillation rows for an MV."""
    given = preset.get("oscillation_rows")
    return bool(given.get(mv)) if isinstance(given, dict) else False


def _number(field: str, preset: dict[str, Any], name: str) -> float:
    """A preset's value of a field, or what holds where it says nothing."""
    value = preset.get(field)
    value = value.get(name) if isinstance(value, dict) else value
    return float(TUNING[field].default if value is None else value)


# ----------------------------------------------------------------------------------------- plant and disturbances


def _plant(settings: Settings) -> dict[str, np.ndarray]:
    """Parameters of the plant that the study sets, "scenario", in the units of their keys, all accepted by the plant."""
    process, name = settings.definition.process, settings.definition.study.plant
    out: dict[str, np.ndarray] = {}
    for key in settings.fields:
        table, _, parameter = key.partition(".")
        if table not in ("plant", "plant_scale") or not settings.given(key):
            continue
        other = f"plant_scale.{parameter}"
        if table == "plant_scale" and parameter in out:
            expected = f"nothing: plant.{parameter} is set as well; choose one"
            raise InputError(settings.table.blame([other], 0), settings.value(other, 0), expected)
        scale = settings.fields[f"plant.{parameter}"].default if table == "plant_scale" else 1.0
        out[parameter] = scale * settings.numbers(key)
    if not out:
        return out
    with closing(open_plant(process, name)) as plant:
        try:
            plant.replaced({key: np.broadcast_to(values, settings.count) for key, values in out.items()})
        except InputError as error:
            raise _located(settings, plant, out, error) from None
    return out


def _located(settings: Settings, plant: Any, given: dict[str, np.ndarray], error: InputError) -> InputError:
    """The error of the first scenario whose plant is refused, with the entries that it comes from."""
    for k in range(settings.count):
        try:
            plant.replaced({name: float(row(values, k)) for name, values in given.items()})
        except InputError as found:
            name = found.field.rpartition(".")[2]
            names = [name, *(other for other in given if other != name and other in found.expected)]
            keys = [f"{table}.{n}" for n in names for table in ("plant", "plant_scale")]
            keys = list(filter(settings.given, keys)) or [f"plant.{name}"]
            bare = re.sub(r" (\[[^]]*\]|\(SI units\))", "", found.expected)
            expected = f"{bare} [{settings.fields[keys[0]].unit}] for {keys[0]}"
            return InputError(settings.table.blame(keys, k), settings.value(keys[0], k), expected)
    return error


def _events(
    settings: Settings, table: str, names: tuple[str, ...], durations: np.ndarray, dt: float
) -> np.ndarray:
    """What ``[[base.TABLE]]`` lists, "scenario event name".

    The time lies within every run, of `durations` "scenario" [s]; a duration is positive, `dt` [s] where it is not given.
    """
    events = settings.base.get(table, ())
    keys = [f"{table}.{name}" for name in names]
    varied = [key for key in keys if settings.table.column(key) is not None]
    path, found = settings.table.blame(varied[:1], 0), f"{len(events)} of them"
    expected = f"exactly one [[base.{table}]], whose {' or '.join(names)} the axis replaces"
    require(not varied or len(events) == 1, path, found, expected)
    given = lambda event, name: dt if (v := getattr(event, name)) is UNSET else v  # noqa: E731
    columns = [
        settings.numbers(key) if key in varied else np.array([given(event, name)])
        for event in events
        for key, name in zip(keys, names, strict=True)
    ]
    if not columns:
        return np.zeros((1, 0, len(names)))
    out = np.stack(np.broadcast_arrays(*columns), axis=1).reshape(-1, len(events), len(names))
    wrong = {"time": out[:, :, 0] >= durations[:, None]}
    if "duration" in names:
        wrong["duration"] = out[:, :, 1] <= 0
    for name, bad in wrong.items():
        for k, i in np.argwhere(bad)[:1].tolist():
            within = f"a time within the run of {durations[k]:g} s"
            expected = within if name == "time" else "a duration above 0 s"
            path = settings.table.blame([f"{table}.{name}"], k) if varied else f"base.{table}[{i}].{name}"
            raise InputError(path, float(row(out, k)[i, names.index(name)]), expected)
    return out
