"""Scenarios of a sweep study as numbers: presets filled in, units those of `jaxmpc`, one row per scenario.

Everything is done on whole columns, so that ten thousand scenarios take well under a second, and everything is checked here:
`Inputs` that exist describe runs that can start. Only what fixes the shape of a compiled program (structure, reference,
length) is built as typed objects, once per distinct combination.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from msgspec import UNSET

from jaxmpc.errors import InputError
from jaxmpc.loop.noise import check_deviation, check_seed
from jaxmpc.process.reference import Reference
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS as TUNING
from jaxmpc.problem.tuning import LIMIT_PAIRS
from jaxmpc.process.well.equations import CV_NAMES, MV_NAMES, WellParameters, check_parameters
from jaxmpc.process.well.plant import check_inputs
from studies.definition import presets, references
from studies.definition.axes import AxisTable
from studies.definition.fields import FIELDS, PLANT_FIELDS, SHIPPED, plant_si
from studies.definition.refusing import located, require
from studies.definition.sections import ReferenceDefinition
from studies.definition.sweep import StudyDefinition

_NAMES_OF = {"cv": CV_NAMES, "mv": MV_NAMES, "": ("",)}
NAMES = {key: _NAMES_OF[field.of] for key, field in TUNING.items() if not field.flag}
SHAPE_KEYS = tuple(field.key for field in FIELDS.values() if field.shape)
LONGEST_RUN = 1_000_000  # samples


@dataclasses.dataclass(frozen=True, eq=False)
class Variant:
    """What fixes shapes and setpoints, shared by all scenarios that agree in it."""

    kind: str  # continuous or mixed-integer
    actuator: str  # continuous or step
    structure: Structure  # of the controller
    reference: Reference  # setpoints, cut to the length of the run
    samples: int  # length of the run [samples]


@dataclasses.dataclass(frozen=True, eq=False)
class Inputs:
    """All scenarios in the units of `jaxmpc`; an array that does not vary has one row for all."""

    variants: tuple[Variant, ...]  # distinct shapes
    variant: np.ndarray  # "scenario", which of them
    # per field of `jaxmpc.problem.tuning.Tuning` "scenario name", and "scenario" for the bias cut-off
    tuning: dict[str, np.ndarray]
    # per field of `jaxmpc.process.well.equations.WellParameters` "scenario", SI units
    plant: dict[str, np.ndarray]
    point: np.ndarray  # "scenario 2", working point of the model: choke [%], gas lift [m3/h]
    noise: np.ndarray  # "scenario cv", standard deviation [CV unit]
    seed: np.ndarray  # "scenario", of the noise
    # "scenario step 2", steps of the reservoir pressure: time [s], offset from then on [bar]
    pressure: np.ndarray
    fault_kinds: tuple[tuple[str, str], ...]  # CV and kind of every sensor fault
    faults: np.ndarray  # "scenario fault 3", time [s], duration [s] and size [CV unit] of the sensor faults
    told: np.ndarray  # "scenario", whether the controller is told where the actuators stand


def row(array: np.ndarray, k: int) -> np.ndarray:
    """Scenario k of an array that may have one row for all."""
    return array[k if len(array) > 1 else 0]


class Settings:
    """Base settings and axes of a definition: the value of a key in every scenario."""

    def __init__(self, definition: StudyDefinition, table: AxisTable):
        self.base, self.table, self.count = definition.base, table, len(table)

    def given(self, key: str) -> bool:
        """Whether the base or an axis sets the key."""
        return key in self.base or self.table.column(key) is not None

    def value(self, key: str, scenario: int) -> Any:
        """In one scenario, plain and typed; the default where nothing is given."""
        found = self.table.column(key)
        if found is None:
            return self.base.get(key, FIELDS[key].default)
        return found[1][found[2][scenario]]

    def numbers(self, key: str, change: Callable[[float], float] | None = None) -> np.ndarray:
        """A numeric key ``"scenario"``, of length 1 if it does not vary; `change` converts each entry."""
        found = self.table.column(key)
        values = [self.base.get(key, FIELDS[key].default)] if found is None else found[1]
        out = np.array(values if change is None else [change(v) for v in values], dtype=np.float64)
        return out if found is None else out[found[2]]

    def columns(self, keys: Sequence[str]) -> np.ndarray:
        """Some numeric keys ``"scenario key"``."""
        return np.stack(np.broadcast_arrays(*[self.numbers(key) for key in keys]), axis=1)

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
    settings = Settings(definition, table)
    variants, variant = _variants(settings)
    kinds = np.array([v.kind == "mixed-integer" for v in variants])
    runs = np.array([v.reference.duration for v in variants])[variant], variants[0].structure.dt
    inputs = Inputs(
        variants=variants,
        variant=variant,
        tuning=_tuning(settings, kinds[variant] if len(set(kinds)) > 1 else kinds[:1]),
        plant=_plant(settings),
        point=settings.columns(("model.choke", "model.lift")),
        noise=settings.columns([f"noise.{name}" for name in CV_NAMES]),
        seed=settings.numbers("seed").astype(np.int64),
        pressure=_events(settings, "disturbance", ("time", "offset"), *runs),
        fault_kinds=tuple((fault.cv, fault.kind) for fault in settings.base.get("sensor_fault", ())),
        faults=_events(settings, "sensor_fault", ("time", "duration", "size"), *runs),
        told=settings.numbers("position_feedback").astype(bool),
    )
    check_inputs(inputs.point[:, 0], inputs.point[:, 1])
    check_deviation(inputs.noise, len(CV_NAMES))
    check_seed(inputs.seed)
    return inputs


# --------------------------------------------------------------------------------------------------------- shapes


def _variants(settings: Settings) -> tuple[tuple[Variant, ...], np.ndarray]:
    firsts, index = settings.combinations(SHAPE_KEYS)
    cut: dict[tuple[Any, Any], Reference] = {}
    variants = []
    for k in firsts.tolist():
        value = lambda key, k=k: settings.value(key, k)  # noqa: E731
        structure = _structure(settings, k)
        wanted = value("reference"), value("duration")
        if wanted not in cut:
            cut[wanted] = _reference(settings, k, *wanted)
        reference = cut[wanted]
        samples = reference.samples(structure.dt)
        path = settings.table.blame(["reference" if wanted[1] is None else "duration"], k)
        require(samples >= 1, path, wanted[1], f"one sample of {structure.dt:g} s or more")
        require(samples <= LONGEST_RUN, path, f"{samples} samples", f"a run of at most {LONGEST_RUN} samples")
        variants.append(Variant(value("controller"), value("actuator"), structure, reference, samples))
    return tuple(variants), index


def _structure(settings: Settings, k: int) -> Structure:
    """The structure of one scenario; without a control horizon the blocks decide it."""
    value = lambda key: settings.value(key, k)  # noqa: E731
    blocks, blocking = value("blocks"), value("blocking")
    horizon = value("control_horizon") or sum(blocks[0] if isinstance(blocks[0], tuple) else blocks)
    base = presets.structure("moves", integer=value("controller") == "mixed-integer")
    own: dict[str, Any] = {}
    if base.integer_mvs:
        lists = [value(f"integer_values.{name}") for name in MV_NAMES]
        steps = [step if values is None else None for step, values in zip(base.steps, lists, strict=True)]
        dwell = [value(f"dwell.{name}") for name in MV_NAMES]
        own = dict(integer_step=tuple(steps), integer_values=tuple(lists), dwell=tuple(dwell))
    same = ("prediction_horizon", "first_penalised", "integer_horizon", "mean_move_window", "mean_move_mode")

    def place(field: str) -> str:
        name = field.removeprefix("structure.")
        key = name if name in FIELDS else name.partition(".")[0]
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


def _reference(settings: Settings, k: int, name: Any, duration: float | None) -> Reference:
    """A named or own reference, cut to a duration [s]; changes that the run would not reach are left out."""
    whole = name.build("base.") if isinstance(name, ReferenceDefinition) else references.NAMED[name]()
    if duration is None or duration == whole.duration:
        return whole
    expected = f"more than 0 s and at most the reference's {whole.duration:g} s"
    require(0 < duration <= whole.duration, settings.table.blame(["duration"], k), duration, expected)
    kept = whole.times < duration
    return Reference(whole.times[kept], whole.setpoints[kept], float(duration))


# --------------------------------------------------------------------------------------------------------- tuning


def _tuning(settings: Settings, integer: np.ndarray) -> dict[str, np.ndarray]:
    """Tuning fields "scenario name"; `integer` ("scenario" or one for all): whether the choke moves in whole steps."""
    firsts, preset = settings.combinations(["preset"])
    tables = [presets.tuning_fields(settings.value("preset", k)) for k in firsts.tolist()]
    preset = preset if len(tables) > 1 else preset[:1]
    out = {}
    for field, names in NAMES.items():
        columns = []
        for name in names:
            key = f"tuning.{field}.{name}".rstrip(".")
            of_preset = np.array([_number(field, table, name) for table in tables])[preset]
            columns.append(settings.numbers(key) if settings.given(key) else of_preset)
        out[field] = np.stack(np.broadcast_arrays(*columns), axis=1) if names[0] else columns[0]
    for low, high in LIMIT_PAIRS:
        smaller, larger = np.broadcast_arrays(out[low], out[high])
        wrong = (smaller > larger) | np.isposinf(smaller) | np.isneginf(larger)
        for k, i in np.argwhere(wrong)[:1].tolist():
            name = NAMES[low][i]
            keys = [f"tuning.{field}.{name}" for field in (low, high)]
            keys = [key for key in keys if settings.given(key)] or keys
            found = f"{low} {smaller[k, i]:g}, {high} {larger[k, i]:g}"
            expected = f"{low} of {name} at most its {high} [{FIELDS[f'tuning.{low}.{name}'].unit}]"
            raise InputError(settings.table.blame(keys, k), found, expected)
    rows = settings.numbers("tuning.oscillation_rows").astype(bool)
    rows, whole = np.broadcast_arrays(rows, integer)
    out["oscillation_rows"] = np.stack([rows & whole, np.zeros_like(whole)], axis=1)
    soft = settings.numbers("soft").astype(bool)[:, None]
    if not soft.all():  # as hard everywhere as the soft controller is far outside its deadzone, as in no-soft
        out["cv_weight"] = out["cv_weight"] + np.where(soft, 0.0, out["soft_quadratic"])
        for field in ("soft_quadratic", "soft_linear"):
            out[field] = np.where(soft, out[field], 0.0)
    return out


def _number(field: str, preset: dict[str, Any], name: str) -> float:
    """A preset's value of a field, or what holds where it says nothing."""
    value = preset.get(field)
    value = value[name] if isinstance(value, dict) else value
    return TUNING[field].default if value is None else value


# ----------------------------------------------------------------------------------------------- well and pressure


def _plant(settings: Settings) -> dict[str, np.ndarray]:
    """Well parameters "scenario" in SI units, all accepted by `check_parameters`."""
    out = {}
    for name in PLANT_FIELDS:
        absolute, relative = f"plant.{name}", f"plant_scale.{name}"
        if settings.given(absolute) and settings.given(relative):
            expected = f"nothing: {absolute} is set as well; choose one"
            raise InputError(settings.table.blame([relative], 0), settings.value(relative, 0), expected)
        if settings.given(absolute):
            out[name] = settings.numbers(absolute, lambda value, name=name: plant_si(name, value))
        elif settings.given(relative):
            out[name] = SHIPPED[name] * settings.numbers(relative)
        else:
            out[name] = np.array([SHIPPED[name]])
    try:
        check_parameters(WellParameters(**out))
    except InputError as error:
        raise _located(settings, out, error) from None
    return out


def _located(settings: Settings, plant: dict[str, np.ndarray], error: InputError) -> InputError:
    """The error of the first scenario whose well is refused, with the entries that it comes from."""
    for k in range(settings.count):
        try:
            check_parameters(WellParameters(**{n: float(row(values, k)) for n, values in plant.items()}))
        except InputError as found:
            name = found.field.removeprefix("well.")
            names = [name, *["trip_end"] * found.expected.endswith("trip_end")]  # what it is compared with
            keys = [f"{table}.{n}" for n in names for table in ("plant", "plant_scale")]
            keys = list(filter(settings.given, keys)) or [f"plant.{name}"]
            expected = found.expected.replace(" (SI units)", "").replace(" [Pa]", "")
            expected = f"{expected} [{FIELDS[keys[0]].unit}] for {keys[0]}"
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
