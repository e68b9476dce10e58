"""What the figures of a sweep study need to know of its store: what varies, which runs are there, which is the default.

A study is recognised by its columns and not by its name, so that any study with such columns gets the same figures.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from figures import style
from jaxmpc.errors import InputError
from jaxmpc.process.process import Mv, Process
from studies.definition.fields import as_text, study_fields
from studies.store.layout import FLAG
from studies.store.process import process_in
from studies.store.reading import open_study, provenance

CONTROLLER = ("controller", "actuator")
STRUCTURE = ("blocking", "blocks", "prediction_horizon", "control_horizon")
TUNING = (*STRUCTURE, "preset", "soft", "first_penalised", "mean_move_window", "mean_move_mode")
UNCERTAIN = ("plant.", "plant_scale.", "noise.", "disturbance.", "seed")
ACTUATORS = {"step": "stepped", "continuous": "continuous"}  # in words
SETTLED = "settled width"  # what deviations of CVs with different units are divided by
EVEN = 1.5  # largest over smallest distance of values that count as evenly spaced
UNEVEN = 4.0  # beyond it on both scales, values are drawn at equal distances


@dataclasses.dataclass(frozen=True, eq=False)
class SweepAxis:
    """Something that varies between the scenarios."""

    key: str  # of the column; of the first one for columns that move together
    label: str
    unit: str  # "1" without unit, "" for text
    values: np.ndarray  # "scenario", numbers or text
    linked: tuple[str, ...] = ()  # keys of the columns that move with it, one to one

    @property
    def numeric(self) -> bool:
        """Whether its values are numbers."""
        return self.values.dtype.kind in "biuf"

    @property
    def uncertain(self) -> bool:
        """Whether it is what a controller does not choose: plant, noise, disturbance."""
        return self.key.startswith(UNCERTAIN)

    @property
    def unique(self) -> list:
        """Its distinct values: numbers increasing, texts in the order of the scenarios."""
        return list(np.unique(self.values)) if self.numeric else list(dict.fromkeys(self.values.tolist()))

    @property
    def title(self) -> str:
        """For an axis or a colour bar."""
        return f"{self.label} [{style.unit(self.unit)}]" if self.numeric else self.label

    def text(self, value) -> str:
        """One of its values in words, with the unit."""
        if not self.numeric:
            return str(value)
        return f"{value:g}" + (f" {style.unit(self.unit)}" if self.unit != "1" else "")

    @property
    def scale(self) -> str:
        """``linear`` or ``log`` if the values are spaced like that, else ``equal`` distances."""
        spread = {"linear": spacing(np.array(self.unique))}
        if min(self.unique) > 0:
            spread["log"] = spacing(np.log(self.unique))
        best = min(spread, key=lambda name: (spread[name] > EVEN, spread[name]))
        return best if spread[best] <= UNEVEN else "equal"


def spacing(values: np.ndarray) -> float:
    """Largest over smallest distance of increasing values."""
    steps = np.diff(values)
    return float(steps.max() / steps.min()) if len(steps) else 1.0


def load(store: str | Path) -> xr.Dataset:
    """The finished scenarios of a store, trajectories unread; attributes ``missing``, ``total`` and ``store`` besides.

    Raises:
        InputError: if there is no store, or no scenario of it is finished.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Damaged in")  # such scenarios are counted as missing
        data = open_study(store)
    there = np.flatnonzero(data[FLAG].values > 0)
    if not len(there):
        expected = f"a finished scenario ({data.sizes['scenario']} in the study)"
        raise InputError("store", str(store), expected, "Give the command of the study to compute them")
    facts = {"missing": data.sizes["scenario"] - len(there), "total": data.sizes["scenario"]}
    return data.isel(scenario=there).assign_attrs({**facts, "store": str(store)})


def figure_of(data: xr.Dataset, name: str) -> xr.DataArray:
    """A key figure over the scenarios, or an `InputError` that names it.

    ``NAME.CHANNEL`` is that of one CV or MV; one per MV without a channel that of `shown_mv`.
    """
    name, _, channel = name.partition(".")
    if name not in data.data_vars:
        raise InputError(name, sorted(map(str, data.data_vars)), f"the key figure {name} in the store")
    values = data[name]
    if "mv" in values.dims and not channel:
        channel = shown_mv(process_in(data)).name
    if not channel:
        return values
    axis = str(values.dims[-1])
    if axis not in ("cv", "mv") or channel not in values[axis].values:
        known = ", ".join(map(str, values[axis].values)) if axis in ("cv", "mv") else "no channel"
        raise InputError(name, channel, f"one of {known}")
    return values.sel({axis: channel})


def shown_mv(process: Process) -> Mv:
    """The MV whose moves a figure shows: the first with a stepped actuator, or the first where there is none."""
    return process.mvs[next(iter(process.stepped), 0)]


def deviation(data: xr.Dataset, cv: str | None = None, name: str = "mean_absolute_deviation") -> xr.DataArray:
    """A deviation per scenario: of one CV in its unit, or the mean over the CVs of deviation / settled width [1]."""
    values = figure_of(data, name)
    if cv is not None:
        return values.sel(cv=cv)
    settled = {known.name: known.settled for known in process_in(data).cvs}
    scale = xr.DataArray([settled[str(name)] for name in data.cv.values], dims="cv")
    return (values / scale).mean("cv", skipna=False)


def travel_title(mv: Mv) -> str:
    """Of an axis with the travel of an MV."""
    return style.label(f"{mv.label} travel", mv.unit)


def quantities(data: xr.Dataset) -> list[tuple[str, np.ndarray]]:
    """What a tuning trades: travel of `shown_mv` and the mean deviation of each CV, with the titles of their axes."""
    process = process_in(data)
    mv = shown_mv(process)
    out = [(travel_title(mv), figure_of(data, f"travel.{mv.name}").values)]
    for cv in process.cvs:
        out.append((style.label(f"mean deviation, {cv.label}", cv.unit), deviation(data, cv.name).values))
    return out


def rows_by(*keys: Iterable) -> dict[tuple, np.ndarray]:
    """Positions of the scenarios with equal values of all keys ``"scenario"``, in the order in which they appear."""
    found: dict[tuple, list[int]] = {}
    for row, key in enumerate(zip(*keys, strict=True)):
        found.setdefault(key, []).append(row)
    return {key: np.array(rows) for key, rows in found.items()}


def columns(data: xr.Dataset) -> dict[str, np.ndarray]:
    """Values of the columns that differ between scenarios."""
    own = {
        str(name): coord.values
        for name, coord in data.coords.items()
        if coord.dims == ("scenario",) and name not in ("scenario", "scenario_hash")
    }
    return {name: values for name, values in own.items() if len(set(values.tolist())) > 1}


def sweep_axes(data: xr.Dataset) -> list[SweepAxis]:
    """What varies, in the order of the study; controller and actuator as one axis, columns that move together as one."""
    out: list[SweepAxis] = []
    found = columns(data)
    for key, values in found.items():
        if key in CONTROLLER:
            if not any(axis.key == "controller" for axis in out):
                out.append(SweepAxis("controller", "controller", "", controllers(data)))
            continue
        if key in ("prediction_horizon", "control_horizon") and _decides(found.get("blocks"), values):
            continue
        axis = axis_of(data, key)
        if axis.numeric and not np.isfinite(values.astype(float)).all():  # a limit that does not bind
            texts = np.array([f"{value:g}" for value in values], dtype=object)
            axis = dataclasses.replace(axis, values=texts)
        for i, known in enumerate(out):
            alike = known.numeric == axis.numeric and known.key != "controller"
            if alike and _decides(known.values, values) and _decides(values, known.values):
                out[i] = dataclasses.replace(known, linked=(*known.linked, key))
                break
        else:
            out.append(axis)
    return out


def axis_of(data: xr.Dataset, key: str) -> SweepAxis:
    """A column of the study."""
    attrs = data[key].attrs
    return SweepAxis(key, attrs.get("long_name", key), attrs.get("units", ""), data[key].values)


def _decides(first: np.ndarray | None, second: np.ndarray) -> bool:
    """Whether equal values of the first mean equal values of the second."""
    if first is None:
        return False
    return len(set(zip(first.tolist(), second.tolist(), strict=True))) == len(set(first.tolist()))


def setting(data: xr.Dataset, key: str) -> Any:
    """What the base of the study says of a key, or its preset, or the default; None if the store does not know."""
    if key in data.coords:  # an axis of one value
        return data[key].values[0]
    definition = provenance(data, "definition")
    if not isinstance(definition, dict):
        return None
    bases = [definition.get("base", {})]
    if provenance(data, "quick"):
        bases.insert(0, definition.get("quick", {}).get("base", {}))
    for body in bases:
        for name in key.split("."):
            body = body.get(name) if isinstance(body, dict) else None
        if body is not None:
            return body
    preset = setting(data, "preset") if key.startswith("tuning.") else None
    return default_setting(process_in(data), key, preset)


def default_setting(process: Process, key: str, preset: str | None = None) -> Any:
    """Value of a key where a study names at most a preset; None where nothing fixes it."""
    field = study_fields(process, ()).get(key)
    return None if field is None else field.held(process, process.tuning(process.structure(), preset))


def default_tuning(data: xr.Dataset) -> np.ndarray:
    """Which scenarios have the first preset and the blocking of the process; none in a study that varies neither.

    Returns:
        ``"scenario"``.
    """
    process, found = process_in(data), columns(data)
    varied = [key for key in found if key in TUNING or key.startswith("tuning.")]
    deciding = [f"tuning.deadzone.{cv}" for cv in process.cv_names] + [
        f"tuning.move_weight.{mv.name}" for mv in process.mvs
    ]
    mask = np.full(data.sizes["scenario"], bool(varied))
    for key in dict.fromkeys((*varied, *deciding, "preset", "soft")):
        value, wanted = found[key] if key in found else setting(data, key), default_setting(process, key)
        if value is None:  # nothing can be said without those that decide
            mask &= key not in deciding
        elif wanted is not None:
            each = np.broadcast_to(value, mask.shape)
            mask &= [one == (as_text(wanted) if isinstance(one, str) else wanted) for one in each]
    return mask


def controller_of(data: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Kind of the controller and ``step`` or ``continuous`` actuators of each scenario."""
    fields = study_fields(process_in(data), ())

    def of(key: str) -> np.ndarray:
        if key in data.coords:
            return data[key].values
        return np.full(data.sizes["scenario"], setting(data, key) or fields[key].default, dtype=object)

    return of(CONTROLLER[0]), of(CONTROLLER[1])


def controllers(data: xr.Dataset) -> np.ndarray:
    """The controller of each scenario in words; its actuators only where they vary."""
    kind, actuator = controller_of(data)
    vary = len(set(actuator.tolist())) > 1
    words = [controller_words(*one) if vary else f"{one[0]} MPC" for one in zip(kind, actuator, strict=True)]
    return np.array(words, dtype=object)


def controller_words(kind: str, actuator: str) -> str:
    """A controller and its actuators: ``mixed-integer MPC, stepped actuators``."""
    return f"{kind} MPC, {ACTUATORS.get(actuator, actuator)} actuators"


@dataclasses.dataclass(frozen=True, eq=False)
class Variant:
    """Scenarios that differ only in what no controller chooses."""

    label: str  # what sets them apart from other variants
    colour: str  # of the controller, the same in every figure
    rows: np.ndarray  # positions of its scenarios


def variants(data: xr.Dataset, axes: list[SweepAxis]) -> list[Variant]:
    """The scenarios by everything that a controller or an operator chooses."""
    chosen = [axis for axis in axes if not axis.uncertain]
    everything = {(): np.arange(data.sizes["scenario"])}
    kind, actuator = controller_of(data)
    out: list[Variant] = []
    for i, (key, rows) in enumerate((rows_by(*(a.values.tolist() for a in chosen)) or everything).items()):
        words = [
            ("" if axis.key in ("controller", "reference") else f"{axis.label} ") + axis.text(value)
            for axis, value in zip(chosen, key, strict=True)
        ]
        colour = style.colour(str(kind[rows[0]]), str(actuator[rows[0]]), i)
        if colour in [known.colour for known in out]:  # the controller alone does not tell them apart
            colour = style.SPARE_COLOURS[i % len(style.SPARE_COLOURS)]
        label = ", ".join(words) or controller_words(str(kind[rows[0]]), str(actuator[rows[0]]))
        out.append(Variant(label, colour, rows))
    return out
