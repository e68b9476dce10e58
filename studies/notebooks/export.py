"""What leaves the app: settings of a run as a study file and as Python, what differs between runs, and a page to send."""

from __future__ import annotations

import dataclasses
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from figures import explore as draw
from figures import style
from jaxmpc import html
from jaxmpc.files import toml_keys
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import by_name
from studies.definition.fields import as_text
from studies.definition.sections import Section
from studies.notebooks.loop import ExploreRun, in_force, shown_figures, written

TEMPLATE = Path(__file__).with_name("page.html")


def as_toml(done: ExploreRun, name: str = "explored") -> str:
    """A run as a study file without axes: `jaxmpc study run` repeats it, and an axis makes a sweep of it."""
    body = done.definition.body
    lines = ["[study]", *toml_keys(body["study"] | {"name": name}), "", "[base]", *toml_keys(body["base"])]
    return "\n".join(lines) + "\n"


def as_python(done: ExploreRun) -> str:
    """Structure and tuning of a run, its events, faults and disturbances, as Python that makes the same objects, every
    field written out.
    """
    structure, tuning = done.scenario.structure, done.scenario.tuning
    given = {field.name: getattr(structure, field.name) for field in dataclasses.fields(Structure)}
    lines = ["from math import inf", "", "from jaxmpc import Structure, make_tuning", ""]
    lines += ["structure = Structure(", *(f"    {name}={value!r}," for name, value in given.items()), ")"]
    values = (f"    {key}={value!r}," for key, value in by_name(structure, tuning).items())
    lines += ["tuning = make_tuning(", "    structure,", *values, ")"]
    return "\n".join([*lines, *_happening(done)]) + "\n"


def _happening(done: ExploreRun) -> list[str]:
    """What happens during a run, as Python of arguments of `jaxmpc.simulate`."""
    scenario, samples, lines = done.scenario, done.trajectory.samples, []
    if scenario.events:
        lines += ["", "from jaxmpc import Event", "", "events = ["]
        lines += [*(f"    {event!r}," for event in scenario.events), "]"]
    faults = done.definition.base.get("sensor_fault", ())
    if faults:
        lines += [
            "",
            "from jaxmpc import SensorFault, fault_errors",
            "",
            f"faults = fault_errors(structure, {samples}, [",
        ]
        lines += [*(f"    {fault.fault()!r}," for fault in faults), "])"]
    if scenario.disturbance is not None:
        names, given = done.definition.process.disturbance_names, scenario.disturbance[:samples]
        lines += [
            "",
            "import numpy as np",
            "",
            f"disturbance = np.zeros({given.shape})  # {', '.join(names)}",
        ]
        changes = np.flatnonzero(np.diff(given, axis=0, prepend=0.0).any(axis=1))
        lines += [f"disturbance[{k}:] = {given[k].tolist()}" for k in changes]
    return lines


def differences(runs: Sequence[ExploreRun]) -> list[list[str]]:
    """What is not the same in all runs: label, key, the value in each run, and the unit; a row per key."""
    found = [in_force(run) for run in runs]
    fields = runs[0].definition.fields
    rows = []
    for key in found[0]:
        texts = [value_text(values[key]) for values in found]
        if len(set(texts)) > 1:
            label, unit = (
                (fields[key].label, fields[key].unit) if key in fields else (key.replace("_", " "), "")
            )
            rows.append([label, key, *texts, "" if unit == "1" else style.unit(unit)])
    return rows


def value_text(value: Any) -> str:
    """A value of a key as it is read: six digits, what is not set as a dash."""
    if value is None or (isinstance(value, (tuple, list)) and not value):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return html.number(value)
    if isinstance(value, Section):
        told = {name: getattr(value, name) for name in value.__struct_fields__}
        return ", ".join(
            f"{name} {value_text(one)}"
            for name, one in told.items()
            if isinstance(one, (str, float, tuple, dict)) and one not in ("", (), {})
        )
    if isinstance(value, dict):
        return " ".join(f"{name} {value_text(one)}" for name, one in value.items())
    if isinstance(value, tuple):
        inner = [value_text(one) for one in value]
        return (
            "; ".join(inner) if any(isinstance(one, (tuple, Section)) for one in value) else " ".join(inner)
        )
    return str(value)


def figures_table(runs: Mapping[str, ExploreRun], colours: Sequence[str]) -> str:
    """The key figures of some runs beside each other, as HTML."""
    first, *others = runs.values()
    rows = []
    for key, words, unit in shown_figures(first.definition.process):
        now, shown = written(first.kpis[key], unit)
        before = []
        for other in others:
            number, own = written(other.kpis[key], unit)
            before.append(number if own == shown else f"{number} {own}")
        rows.append([words, now, *before, shown])
    return html.table(["", *_named(runs, colours), ""], rows)


def differences_table(runs: Mapping[str, ExploreRun], colours: Sequence[str]) -> str:
    """What differs between some runs, as HTML."""
    rows = differences(list(runs.values()))
    if not rows:
        return "<p>Nothing differs.</p>"
    return html.table(["what differs", "key", *_named(runs, colours), ""], rows)


def as_page(runs: Mapping[str, ExploreRun], colours: Sequence[str]) -> str:
    """Runs as one HTML page that needs nothing else: the chart, key figures, what differs, and the study file of each.

    Raises:
        MissingToolError: without what brings the script of the chart.
    """
    process = next(iter(runs.values())).definition.process
    shown = [
        draw.Shown(name, colour, run.data) for (name, run), colour in zip(runs.items(), colours, strict=True)
    ]
    chart = draw.tracking(shown, width=720)
    files = "".join(
        f"<details><summary>{html.escape(name)} as a study file</summary><pre>{html.escape(as_toml(run))}</pre></details>"
        for name, run in runs.items()
    )
    blanks = {"title": html.escape(process.title or process.name), "caption": html.escape(draw.CAPTION)}
    blanks |= {"chart": draw.as_html(chart), "figures": figures_table(runs, colours), "files": files}
    blanks["differences"] = differences_table(runs, colours) if len(runs) > 1 else ""
    return string.Template(TEMPLATE.read_text(encoding="utf-8")).substitute(blanks)


def _named(runs: Mapping[str, ExploreRun], colours: Sequence[str]) -> list[html.Markup]:
    """Names of runs in their colours."""
    return [
        html.Markup(f'<b style="color:{colour}">{html.escape(name)}</b>')
        for name, colour in zip(runs, colours, strict=True)
    ]


def cell_text(value: Any) -> str:
    """A value as `studies.definition.fields.Field.parse` reads it; empty where nothing is set."""
    if value is None or (isinstance(value, tuple) and not value):
        return ""
    return (
        f"{value:.12g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else as_text(value)
    )
