"""The controls of the app for a process: what can be chosen, how far sliders go, and the base table that they make."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from figures import style
from figures.explore import COLOURS, Shown
from jaxmpc.check import require
from jaxmpc.errors import InputError
from jaxmpc.files import toml_value
from studies.notebooks.export import cell_text
from studies.notebooks.loop import LISTS, SHORT, Explorer, ExploreRun, nested, tuning_of

RATIOS = 2.0 ** np.arange(-5, 6)  # to the preset's own value, so that one slider serves values of any size
NOW = "now"  # name of the run that the controls make


@dataclasses.dataclass(frozen=True)
class Slider:
    """A number to be moved."""

    label: str
    value: float
    steps: list[float]


@dataclasses.dataclass(frozen=True, eq=False)
class Pin:
    """A run that is kept beside others."""

    name: str
    colour: str
    run: ExploreRun


def choices(explored: Explorer) -> dict[str, dict[str, Any]]:
    """What is chosen from a few: for each of them the words and what they stand for, the default first.

    ``rounded`` is a continuous controller whose demands stepped actuators round.
    """
    process = explored.process
    kinds = {"continuous": ("continuous", "continuous")}
    if process.stepped:
        kinds = {"mixed-integer": ("mixed-integer", "step"), "rounded": ("continuous", "step"), **kinds}
    blocking = explored.fields["blocking"]
    references = {f"{name}, {_duration(r.duration)}": name for name, r in process.references.items()}
    return {
        "controller": kinds,
        "preset": {name: name for name in process.presets},
        "blocking": {
            name: name for name in sorted(blocking.choices, key=lambda name: name != blocking.default)
        },
        "run": {f"a short step, {_duration(SHORT * process.dt)}": "", **references},
    }


def tuning_sliders(explored: Explorer, preset: str) -> dict[str, Slider]:
    """Weights and deadzones by key, as a preset has them."""
    process, tuning = explored.process, tuning_of(explored, preset)
    out = {}
    for i, mv in enumerate(process.mvs):
        key, least = f"tuning.move_weight.{mv.name}", 1 / mv.span**2
        out[key] = _ratios(explored, key, f"{mv.label}, move weight", float(tuning.move_weight[i]), least)
    for i, cv in enumerate(process.cvs):
        zone = float(tuning.deadzone[i])
        steps = np.linspace(0.0, 4 * zone if zone else cv.span / 5, 41)
        label = f"{cv.label}, deadzone [{style.unit(cv.unit)}]"
        out[f"tuning.deadzone.{cv.name}"] = Slider(label, zone, _with(steps, zone))
    for i, cv in enumerate(process.cvs):
        key, least = f"tuning.cv_weight.{cv.name}", 1 / cv.span**2
        out[key] = _ratios(explored, key, f"{cv.label}, weight", float(tuning.cv_weight[i]), least)
    return out


def scenario_sliders(explored: Explorer) -> dict[str, Slider]:
    """Setpoints of a short run, disturbances, and the working point of the model."""
    process, out = explored.process, {}
    after = explored.short_step()["setpoints"][1]
    known = np.concatenate([reference.setpoints for reference in process.references.values()])
    for i, cv in enumerate(process.cvs):
        low, high = known[:, i].min(), known[:, i].max()
        room = 0.25 * (high - low) or cv.span
        low, high = max(low - room, cv.low), min(high + room, cv.high)
        label = f"{cv.label}, setpoint [{style.unit(cv.unit)}]"
        out[f"setpoint.{cv.name}"] = Slider(label, after[i], _with(np.linspace(low, high, 101), after[i]))
    for disturbance in process.disturbances:
        steps = np.linspace(-4, 4, 33) * disturbance.span
        label = f"{disturbance.label} [{style.unit(disturbance.unit)}]"
        out[f"disturbance.{disturbance.name}"] = Slider(label, 0.0, _with(steps, 0.0))
    if process.disturbances:
        times = np.arange(SHORT) * process.dt
        out["disturbance.time"] = Slider("disturbances from [s]", float(times[SHORT // 2]), times.tolist())
    for key, field in explored.fields.items():
        if key.startswith("model."):
            steps = np.linspace(field.low, field.high, 51)
            out[key] = Slider(
                f"{field.label} [{style.unit(field.unit)}]", field.default, _with(steps, field.default)
            )
    return out


def further_fields(explored: Explorer) -> list[dict[str, str]]:
    """Every key that has no control of its own, a row each for a table to search in."""
    own = {"controller", "actuator", "preset", "blocking", "soft", "reference"}
    own |= {*tuning_sliders(explored, explored.process.default_preset), *scenario_sliders(explored)}
    rows = []
    for key, _, start in chosen_fields(
        explored,
        explored.process.default_preset,
        [k for k in explored.fields if k not in own and k.partition(".")[0] not in LISTS],
    ):
        field = explored.fields[key]
        unit = "" if field.unit == "1" else style.unit(field.unit)
        rows.append({"setting": field.label, "default": start or "–", "unit": unit, "key": key})
    return rows


def chosen_fields(explored: Explorer, preset: str, keys: Sequence[str]) -> list[tuple[str, str, str]]:
    """Some keys with a label and the text of what holds without them."""
    tuning, found = tuning_of(explored, preset), [explored.fields[key] for key in keys]
    words = (f"{field.label} [{field.unit or field.kind}]" for field in found)
    values = (cell_text(field.held(explored.process, tuning)) for field in found)
    return list(zip(keys, words, values, strict=True))


def example_lists(explored: Explorer) -> str:
    """What can happen during a run of this process, as a text for `listed` in which nothing counts yet."""
    process, dt = explored.process, explored.process.dt
    cv, mv = process.cvs[0], process.mv_names[0]
    deadzone = {"deadzone": {cv.name: float(f"{cv.span / 10:.3g}")}}
    rows: list[tuple[str, dict[str, Any]]] = [
        ("sensor_fault", {"cv": cv.name, "kind": "missing", "time": 60 * dt, "duration": 10 * dt}),
        ("sensor_fault", {"cv": cv.name, "kind": "spike", "time": 90 * dt, "size": cv.span}),
        ("event", {"time": 60 * dt, "mv_off": [mv]}),
        ("event", {"time": 120 * dt, "mv_on": [mv], "tuning": deadzone}),
    ]
    if process.disturbances:
        first = process.disturbances[0]
        rows += [
            ("disturbance", {"time": time * dt, "offset": offset, "name": first.name})
            for time, offset in ((40, first.span), (100, 0.0))
        ]
    tables = (
        [f"[[base.{table}]]", *(f"{k} = {toml_value(v)}" for k, v in row.items()), ""] for table, row in rows
    )
    return "\n".join(f"# {line}" if line else "" for lines in tables for line in lines)


def listed(text: str) -> dict[str, Any]:
    """What a text in the words of a study file lists: disturbances, events and faults of sensors.

    Raises:
        InputError: for what is no TOML, and for other tables.
    """
    expected = f"lists as in a study file, {', '.join(f'[[base.{name}]]' for name in LISTS)}"
    try:
        body = tomllib.loads(text)
    except ValueError as error:
        raise InputError("events", text, f"{expected} ({error})") from None
    base = body.get("base", {})
    others = sorted({*body} - {"base"}) if isinstance(base, dict) else ["base"]
    require(not others, "events", others, expected)
    others = sorted({*base} - {*LISTS})
    require(not others, "events", others, expected, "Everything else of a base has a control of its own")
    return base


def base_of(
    explored: Explorer,
    chosen: Mapping[str, Any],
    soft: bool,
    tuning: Mapping[str, float],
    scenario: Mapping[str, float],
    further: Mapping[str, str],
    events: str = "",
) -> dict[str, Any]:
    """The base table that the controls make.

    Args:
        chosen: what stands for the words of `choices`.
        soft: whether there is Soft MPC.
        tuning: values of `tuning_sliders`.
        scenario: values of `scenario_sliders`.
        further: texts of `further_fields` by key; an empty one sets nothing.
        events: text that `listed` reads. Steps of its disturbances come before those of the sliders, which must be later if
            they are of the same disturbance.

    Raises:
        InputError: naming the key of a text that it does not accept.
    """
    process = explored.process
    kind, actuator = chosen["controller"]
    values: dict[str, Any] = {"controller": kind, "actuator": actuator}
    values |= {"preset": chosen["preset"], "blocking": chosen["blocking"], "soft": soft}
    values |= tuning
    values |= {key: value for key, value in scenario.items() if key.startswith("model.")}
    values |= {
        key: explored.fields[key].parse(f"base.{key}", text) for key, text in further.items() if text.strip()
    }
    after = [scenario[f"setpoint.{name}"] for name in process.cv_names]
    base = nested(values) | {"reference": chosen["run"] or explored.short_step(after)}
    steps = [
        {"time": scenario["disturbance.time"], "offset": scenario[f"disturbance.{name}"], "name": name}
        for name in process.disturbance_names
        if scenario[f"disturbance.{name}"]
    ]
    lists = listed(events)
    if steps:
        before = lists.get("disturbance", [])
        lists["disturbance"] = [*before, *steps] if isinstance(before, list) else before
    return base | lists


def first_base(explored: Explorer) -> dict[str, Any]:
    """The base table of the controls as they are at first."""
    chosen = {name: next(iter(options.values())) for name, options in choices(explored).items()}
    starts = [tuning_sliders(explored, chosen["preset"]), scenario_sliders(explored)]
    tuning, scenario = ({key: slider.value for key, slider in sliders.items()} for sliders in starts)
    return base_of(explored, chosen, True, tuning, scenario, {})


def free_name(pins: Sequence[Pin]) -> str:
    """A letter that no pinned run has yet."""
    taken = {pin.name for pin in pins}
    return next(name for name in map(chr, range(ord("A"), ord("Z") + 1)) if name not in taken)


def pinned(pins: tuple[Pin, ...], name: str, run: ExploreRun) -> tuple[Pin, ...]:
    """Pins with one more run, in a colour that none of them has; in place of the one of that name, if there is one."""
    name = name.strip() or free_name(pins)
    name = f"{name}, pinned" if name == NOW else name
    others = tuple(pin for pin in pins if pin.name != name)
    taken = {pin.colour for pin in others}
    colour = next((c for c in COLOURS[1:] if c not in taken), COLOURS[-1])
    return (*others, Pin(name, colour, run))


def unpinned(pins: tuple[Pin, ...], name: str) -> tuple[Pin, ...]:
    """Pins without one of them."""
    return tuple(pin for pin in pins if pin.name != name)


def named(run: ExploreRun, pins: Sequence[Pin]) -> tuple[dict[str, ExploreRun], list[str]]:
    """This run and the pinned ones by name, and their colours."""
    runs = {NOW: run, **{pin.name: pin.run for pin in pins}}
    return runs, [COLOURS[0], *(pin.colour for pin in pins)]


def shown(run: ExploreRun, pins: Sequence[Pin]) -> list[Shown]:
    """The same as a chart takes them."""
    runs, colours = named(run, pins)
    return [Shown(name, colour, one.data) for (name, one), colour in zip(runs.items(), colours, strict=True)]


def _ratios(explored: Explorer, key: str, label: str, value: float, least: float) -> Slider:
    steps = [float(f"{ratio * (value or least):.4g}") for ratio in RATIOS]
    return Slider(
        f"{label} [{style.unit(explored.fields[key].unit)}]",
        value,
        _with(steps if value else [0.0, *steps], value),
    )


def _with(steps: Any, value: float) -> list[float]:
    """Steps of a slider, rounded to four digits; the nearest one makes room for the value."""
    rounded = sorted({float(f"{step:.4g}") for step in steps})
    nearest = int(np.argmin(np.abs(np.array(rounded) - value)))
    rounded[nearest] = value
    return rounded


def _duration(seconds: float) -> str:
    size, unit = next(((s, u) for s, u in ((3600.0, "h"), (60.0, "min")) if seconds >= 2 * s or s == 60.0))
    return f"{seconds / size:.3g} {unit}"
