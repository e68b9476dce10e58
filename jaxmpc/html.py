"""How models, tunings, plans, runs and studies show themselves in a notebook: tables and small charts in plain HTML.

The text is self-contained (inline SVG, inline styles, nothing is loaded), takes its colours from the page so that it
reads on light and dark ones, and escapes every name. The ``_repr_html_`` methods of the types call what is here.
"""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

LINE, SECOND = "#2e86c1", "#d9730d"  # readable on white and on black
POINTS = 300  # of a chart; longer series keep the least and largest value of each stretch
BORDER = "border-bottom:1px solid rgba(128,128,128,.3)"
CELL = f"padding:2px 10px 2px 0;text-align:left;vertical-align:top;background:none;{BORDER}"


class Markup(str):
    """Text that is HTML already."""


def escape(value: Any) -> Markup:
    """Any value as HTML text; `Markup` stays as it is."""
    return value if isinstance(value, Markup) else Markup(html.escape(str(value), quote=True))


def number(value: Any) -> str:
    """One number, flag or array for a table: six digits; a dash for None, a shape where there is no value to show."""
    if value is None:
        return "–"
    if isinstance(value, tuple) and any(isinstance(part, tuple) for part in value):
        return "; ".join(map(number, value))
    try:
        array = np.asarray(value)
    except Exception:  # a traced value has no numbers
        return f"traced, shape {list(np.shape(value))}"
    if array.ndim > 1 or array.size > 8:
        return f"shape {list(array.shape)}"
    if array.ndim == 1:
        return ", ".join(number(item) for item in array)
    if array.dtype.kind == "b":
        return "yes" if array else "no"
    if array.dtype.kind not in "iuf":
        return str(value)
    if not np.isfinite(array):
        return "not a number" if np.isnan(array) else "∞" if array > 0 else "−∞"
    return f"{float(array):.6g}".replace("-", "−")


def card(title: Any, *parts: str) -> Markup:
    """A titled box with its parts below each other."""
    head = f'<div style="font-weight:600;margin-bottom:4px">{escape(title)}</div>'
    style = "font-family:system-ui,sans-serif;font-size:13px;color:inherit;line-height:1.35;margin:4px 0"
    return Markup(f'<div style="{style}">{head}{"".join(escape(part) for part in parts)}</div>')


def table(head: Sequence[Any], rows: Iterable[Sequence[Any]]) -> Markup:
    """A table of cells, text or `Markup`; an empty `head` gives none."""
    top = "".join(f'<th style="{CELL};font-weight:600">{escape(cell)}</th>' for cell in head)
    cells = ("".join(f'<td style="{CELL}">{escape(cell)}</td>' for cell in row) for row in rows)
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    top = f"<thead><tr>{top}</tr></thead>" if head else ""
    return Markup(
        f'<table style="border-collapse:collapse;color:inherit;margin:2px 0 6px">{top}<tbody>{body}</tbody></table>'
    )


def facts(pairs: Mapping[str, Any] | Iterable[tuple[str, Any]]) -> Markup:
    """A line of facts: name and value, separated by dots; values that are None are left out."""
    items = pairs.items() if isinstance(pairs, Mapping) else pairs
    shown = [f"{escape(name)} <b>{escape(value)}</b>" for name, value in items if value is not None]
    return Markup(f'<div style="margin-bottom:4px;opacity:.85">{" · ".join(shown)}</div>')


@dataclasses.dataclass(frozen=True, eq=False)
class Curve:
    """A line of a chart."""

    y: Any  # "point"
    held: bool = False  # whether a value holds until the next one
    dashed: bool = False  # in the colour of the text, as setpoints are


def chart(label: str, curves: Sequence[Curve], width: int = 180, height: int = 48) -> Markup:
    """Curves over a common, evenly spaced axis as inline SVG [px]; gaps where a value is not finite.

    The label says what is drawn, in a tooltip and to screen readers.
    """
    values = [np.asarray(curve.y, dtype=float).ravel() for curve in curves]
    finite = np.concatenate([v[np.isfinite(v)] for v in values]) if values else np.zeros(0)
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    low, high = (low - 0.5, high + 0.5) if high - low <= 1e-12 * max(abs(high), 1e-300) else (low, high)
    parts = []
    if low < 0 < high:
        at = _place(0.0, low, high, height)
        ends = f'x1="0" x2="{width}" y1="{at}" y2="{at}"'
        parts.append(f'<line {ends} stroke="currentColor" stroke-opacity=".25"/>')
    colours = iter((LINE, SECOND, "#7f7f7f"))
    for curve, y in zip(curves, values, strict=True):
        colour = "currentColor" if curve.dashed else next(colours, LINE)
        look = ' stroke-dasharray="3 2" stroke-opacity=".7"' if curve.dashed else ""
        path = _path(y, curve.held, low, high, width, height)
        parts.append(f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.4"{look}/>')
    shown = escape(label)
    return Markup(
        f'<svg role="img" aria-label="{shown}" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'style="display:block;max-width:100%"><title>{shown}</title>{"".join(parts)}</svg>'
    )


def _place(value: float, low: float, high: float, height: int) -> str:
    return f"{2 + (height - 4) * (1 - (value - low) / (high - low)):.1f}"


def _path(y: np.ndarray, held: bool, low: float, high: float, width: int, height: int) -> str:
    x = np.linspace(0.0, width, max(len(y), 2))[: len(y)]
    if len(y) > POINTS:  # the least and the largest value of each stretch, in their order
        keep = [
            at[k]
            for at in np.array_split(np.arange(len(y)), POINTS // 2)
            for k in sorted({int(np.argmin(y[at])), int(np.argmax(y[at]))})
        ]
        x, y = x[keep], y[keep]
    steps, pen = [], False
    for at, value in zip(x.tolist(), y.tolist(), strict=True):
        if not math.isfinite(value):
            pen = False
            continue
        up = _place(value, low, high, height)
        steps.append(f"H{at:.1f}V{up}" if held and pen else f"{'L' if pen else 'M'}{at:.1f} {up}")
        pen = True
    return "".join(steps)


def named(names: Sequence[str], units: Sequence[str], k: int, kind: str) -> str:
    """``valve [%]``; ``MV 1`` where there are no names."""
    name = names[k] if k < len(names) else f"{kind} {k + 1}"
    return f"{name} [{units[k]}]" if k < len(units) and units[k] else name


def step_response(model: Any) -> str:
    """A `jaxmpc.model.step_response.StepResponseModel`: a chart per CV and MV, with names, units and working point."""
    known = {"sampling interval": f"{model.dt:g} s"}
    known |= {name: number(value) for name, value in model.working_point}
    origin = {key: number(value) for key, value in model.provenance if isinstance(value, str | bool)}
    try:
        steps = np.asarray(model.coefficients, dtype=float)
    except Exception:  # traced or not an array: nothing to draw
        steps = np.zeros(())
    if steps.ndim != 3:
        return card("Step-response model", facts(known | {"coefficients": number(model.coefficients)}))
    steps = np.concatenate([steps, np.asarray(model.dv_coefficients, dtype=float)], axis=1)
    rows = []
    for c, cv in enumerate(model.cv_names):
        row: list[Any] = [named(model.cv_names, model.cv_units, c, "CV")]
        for m, moved in enumerate(model.mv_names + model.dv_names):
            words = f"{cv} after a unit step of {moved}, {model.samples * model.dt:g} s"
            drawn = chart(words, [Curve(np.append(0.0, steps[c, m]))])
            row.append(Markup(f"{drawn}{escape('settles at ' + number(steps[c, m, -1]))}"))
        rows.append(row)
    head = ["", *(named(model.mv_names, model.mv_units, m, "MV") for m in range(len(model.mv_names)))]
    dvs = (named(model.dv_names, model.dv_units, d, "DV") for d in range(len(model.dv_names)))
    head += [f"{name}, measured disturbance" for name in dvs]
    note = facts({"horizon": f"{model.samples * model.dt:g} s, {model.samples} coefficients"} | origin)
    return card("Step-response model", facts(known), table(head, rows), note)


def fields(title: str, values: Any, declared: Mapping[str, Any]) -> str:
    """What an object of declared fields holds, a `jaxmpc.problem.declared.Declared` each: value, unit, default, meaning."""
    rows = []
    for key, field in declared.items():
        default = "required" if field.default is None else number(field.default)
        rows.append([key.replace("_", " "), number(getattr(values, key)), field.unit, default, field.text])
    return card(title, table(["field", "value", "unit", "default", "meaning"], rows))


def plan(solved: Any) -> str:
    """A `jaxmpc.controller.plan.Plan`: how it was solved, planned MVs and predicted CVs as charts, moves per block."""
    known = {"objective": solved.objective, "bound": solved.bound, "relative gap": solved.gap}
    parts = [facts({name: number(value) for name, value in known.items()})]
    how = {"finished by": solved.finished_by, "relaxations": solved.nodes}
    parts.append(facts(how | {"solve time": f"{1e3 * solved.solve_time_s:.3g} ms"}))
    if solved.moves is not None:
        moves, mv, cv = (np.asarray(part) for part in (solved.moves, solved.mv, solved.cv))
        rows = []
        for m in range(mv.shape[1]):
            drawn = chart(f"planned MV {m + 1}", [Curve(mv[:, m], held=True)])
            listed = " ".join(number(v) for v in moves[:8, m]) + (" …" if len(moves) > 8 else "")
            whole = 0 if solved.integer_until is None else int(solved.integer_until[m])
            relaxed = f", whole in the first {whole} of {len(mv)} samples only" if 0 < whole < len(mv) else ""
            rows.append([f"MV {m + 1}", drawn, f"to {number(mv[-1, m])}", f"block moves {listed}{relaxed}"])
        for c in range(cv.shape[1]):
            drawn = chart(f"predicted CV {c + 1}", [Curve(cv[:, c])])
            rows.append([f"CV {c + 1}", drawn, f"to {number(cv[-1, c])}", ""])
        parts.append(table([], rows))
    return card(f"Plan: {solved.status}", *parts)


def trajectory(run: Any) -> str:
    """A `jaxmpc.loop.trajectory.Trajectory`: CVs with their setpoints, MVs, and how the samples were solved."""
    rows = []
    for c, name in enumerate(run.cv_names):
        setpoint = Curve(run.setpoint[:, c], held=True, dashed=True)
        drawn = chart(f"{name}, setpoint dashed", [setpoint, Curve(run.cv[:, c])], 360)
        seen = _span(run.cv[:, c]) if run.samples else ""
        rows.append([named(run.cv_names, run.cv_units, c, "CV"), drawn, seen])
    for m, name in enumerate(run.mv_names):
        drawn = chart(name, [Curve(run.mv[:, m], held=True)], 360)
        moved = f"{_span(run.mv[:, m])}, travel {number(np.abs(run.move[:, m]).sum())}" if run.samples else ""
        rows.append([named(run.mv_names, run.mv_units, m, "MV"), drawn, moved])
    solved = {"samples not optimal": int((np.asarray(run.status) != 0).sum())}
    if run.samples:
        gap = np.asarray(run.gap, dtype=float)
        largest = "not a number in some samples" if np.isnan(gap).any() else number(gap.max())
        median = 1e3 * float(np.median(run.solve_time))
        solved |= {"largest gap": largest, "median time of a step": f"{median:.3g} ms"}
    length = f"{run.samples} samples of {run.dt:g} s, {run.samples * run.dt / 3600:.3g} h"
    return card(f"Closed loop: {length}", table([], rows), facts(solved))


def study(expanded: Any) -> str:
    """A `studies.definition.scenarios.Study`: what varies, and what a run would take."""
    about = expanded.describe()
    known = {
        "scenarios": about.scenarios,
        "compiled programs": about.compilations,
        "chunks": about.chunks,
        "models": about.models,
        "stored": f"{about.stored_bytes / 1e6:.1f} MB before compression",
        "time": f"about {about.seconds / 60:.1f} min on 2 cores",
    }
    rows = []
    for column in expanded.columns:
        values = np.asarray(column.values)
        distinct = np.unique(values.astype(str) if values.dtype.kind == "O" else values)
        shown = ", ".join(map(str, distinct[:6])) + (" …" if len(distinct) > 6 else "")
        if values.dtype.kind in "iuf" and len(distinct) > 6:
            shown = _span(values)
        rows.append([column.key, column.label, column.unit, len(distinct), shown])
    varying = table(["what varies", "in words", "unit", "values", "which"], rows) if rows else ""
    return card(f"Study: {expanded.title}", facts(known), varying)


def process(given: Any) -> str:
    """Variables of a process with units, spans and limits, and what studies of it may name."""
    rows = []
    for kind, variables in (("CV", given.cvs), ("MV", given.mvs), ("disturbance", given.disturbances)):
        for v in variables:
            actuator = getattr(v, "actuator", None)
            how = "" if actuator is None else actuator.kind
            how += f", {number(actuator.step)} {v.unit}" if actuator is not None and actuator.step else ""
            limits = [number(getattr(v, name)) if hasattr(v, name) else "" for name in ("low", "high")]
            rows.append([kind, v.name, v.unit, number(v.span), *limits, how])
    named = {
        "plants": ", ".join(given.plants),
        "presets": ", ".join(given.presets),
        "references": ", ".join(given.references),
        "sampled every": f"{number(given.dt)} s",
    }
    head = ("", "name", "unit", "span", "low", "high", "actuator")
    return card(given.title, facts(named), table(head, rows))


def _span(values: Any) -> str:
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    return f"{number(finite.min())} to {number(finite.max())}" if finite.size else "no finite value"
