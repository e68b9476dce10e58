"""Charts of the interactive app to zoom into: runs side by side on one time axis, and the plan made at any time.

Runs come as results of one controller (`studies.notebooks.loop.ExploreRun.data`, or `figures.choose.stored` for a scenario
of a store). A chart is a description in Vega-Lite that the browser draws, written as it is: it is there a moment after its
run, and a page that is sent carries what draws it.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from figures import panels, style
from figures.closed_loop import RUN
from jaxmpc.errors import MissingToolError
from jaxmpc.process.process import Process
from studies.plans import plan_at
from studies.store.process import process_in

COLOURS = [style.BLUE, style.VERMILLION, style.GREEN, style.ORANGE, style.PURPLE, style.SKY]
COLOURS += ["#8C6D31", "#7F7F7F", "#A6761D", "#393B79"]
ZOOM = "zoom"  # name of the selection of the time axis
BEFORE = 60  # samples of the past beside a plan
CAPTION = "Setpoint dashed, deadzone grey, demands of stepped MVs dotted. Drag over the strip at the bottom to zoom."
LEFT = 52  # pixels for the numbers of a vertical axis: panels below each other line up
SCHEMA = "https://vega.github.io/schema/vega-lite/v6.json"
FONT = "system-ui, sans-serif"
PLAN = {  # colour and dashes of what is beside a plan
    "setpoint": ("black", [5, 3]),
    "later": ("#9DC3E6", [1, 0]),
    "actual": (style.BLUE, [1, 0]),
    "plan": (style.PLAN, [1, 0]),
}

Spec = dict[str, Any]  # of Vega-Lite


@dataclasses.dataclass(frozen=True, eq=False)
class Shown:
    """A run among others in one chart."""

    name: str
    colour: str
    data: xr.Dataset  # of one controller `RUN`


def tracking(
    runs: Sequence[Shown], zoom: Sequence[float] | None = None, width: int = 560, height: int = 96
) -> Spec:
    """Runs on one time axis: a panel for each CV and MV, and below them a strip of it to drag over, which zooms all.

    Args:
        runs: setpoint and deadzone are those of the first, which lies on top.
        zoom: start and end that are shown, in the unit of the time axis; everything if not given.
        width: of a panel [pixels].
        height: likewise.
    """
    first = runs[0].data
    process = process_in(first)
    seconds, unit = panels.time_unit(*panels.span(first))
    table = pd.concat([_rows(run, process, seconds) for run in reversed(runs)])
    above = {"orient": "top", "title": None, "symbolType": "stroke", "labelLimit": 300}
    scale = {"domain": [run.name for run in runs], "range": [run.colour for run in runs]}
    legend = above if len(runs) > 1 else None
    colour = coded("run", "nominal", scale=scale, sort=scale["domain"], legend=legend)
    of_run = {"color": colour, "detail": {"field": "run"}}
    top = [{"filter": {"field": "run", "equal": runs[0].name}}]
    out = []
    for variable, letter, i in [
        *((cv, "c", i) for i, cv in enumerate(process.cvs)),
        *((mv, "m", i) for i, mv in enumerate(process.mvs)),
    ]:
        last = variable is process.mvs[-1]
        x = _time(unit if last else None, labels=last, domain={"param": ZOOM})
        line = _mark("linear" if letter == "c" else "step-after", strokeWidth=1.6)
        layers = [{"mark": line, "encoding": of_run | {"x": x, "y": _value(f"{letter}{i}")}}]
        if letter == "c":
            band = _mark("step-after", type="area", opacity=0.18, color=style.GREY)
            held = _mark("step-after", strokeWidth=1.1, strokeDash=[5, 3], color="black")
            within = {"x": x, "y": _value(f"l{i}"), "y2": {"field": f"h{i}"}}
            layers.insert(0, {"transform": top, "mark": held, "encoding": {"x": x, "y": _value(f"s{i}")}})
            layers.insert(0, {"transform": top, "mark": band, "encoding": within})
        elif f"d{i}" in table:
            asked = _mark("step-after", strokeWidth=1.1, strokeDash=[2, 2])
            layers.insert(0, {"mark": asked, "encoding": of_run | {"x": x, "y": _value(f"d{i}")}})
        inside = [{"filter": {"param": ZOOM}}]
        out.append(
            _panel(style.label(variable.label, variable.unit), layers, width, height) | {"transform": inside}
        )
    chosen = {} if zoom is None else {"value": {"x": list(zoom)}}
    strip = {
        "width": width,
        "height": 30,
        "params": [{"name": ZOOM, "select": {"type": "interval", "encodings": ["x"]}, **chosen}],
        "mark": _mark("linear", strokeWidth=0.8),
        "encoding": of_run
        | {
            "x": _time(None, axis={"grid": False, "tickCount": 8}),
            "y": _value("c0") | {"axis": {"labels": False, "ticks": False, "minExtent": LEFT}},
        },
    }
    return described(vconcat=[*out, strip], spacing=6) | {"data": inline(table)}


def planned(data: xr.Dataset, time: float, width: int = 375, height: int = 110) -> Spec:
    """The plan made at a time [s]: CVs, MVs and their moves, a panel each; what came of it pale.

    Raises:
        InputError: for a time at which no plan was made.
    """
    process, plan = process_in(data), plan_at(data, RUN, time)
    run, times = data.sel(controller=RUN), data.time.values
    begin, end = max(plan.time - BEFORE * plan.dt, 0.0), float(plan.cv_time[-1])
    seconds, unit = panels.time_unit(begin, end)
    inside = (times >= begin) & (times <= end)
    past, later = inside & (times <= plan.time), inside & (times >= plan.time)
    made = inside & (times < plan.time)  # the moves of the time itself are not made yet
    names = list(PLAN)
    legend = {"orient": "top", "title": None, "symbolType": "stroke"}
    colours, dashes = ({"domain": names, "range": [look[k] for look in PLAN.values()]} for k in (0, 1))
    looks = {
        "color": coded("what", "nominal", sort=None, scale=colours, legend=legend),
        "strokeDash": coded("what", "nominal", scale=dashes, legend=None),
        "detail": {"field": "what"},
    }
    rule = {"type": "rule", "color": style.GREY, "strokeDash": [3, 3]}

    def panel(title: str, parts: dict[str, tuple[Any, Any]], interpolate: str, last: bool) -> Spec:
        table = pd.concat(
            [pd.DataFrame({"t": t / seconds, "y": y, "what": w}) for w, (t, y) in parts.items()]
        )
        x = _time(unit if last else None, labels=last, domain=[begin / seconds, end / seconds])
        now = {"data": {"values": [{"t": plan.time / seconds}]}, "mark": rule, "encoding": {"x": x}}
        lines = {"mark": _mark(interpolate, strokeWidth=1.5), "encoding": looks | {"x": x, "y": _value("y")}}
        return _panel(title, [now, lines], width, height) | {"data": inline(table)}

    rows: list[list[Spec]] = [[], [], []]
    for i, cv in enumerate(process.cvs):
        values, held = run.measurement.values[:, i], data.setpoint.values[inside, i]
        parts = {
            "setpoint": (np.repeat(times[inside], 2)[1:], np.repeat(held, 2)[:-1]),
            "later": (times[later], values[later]),
            "actual": (times[past], values[past]),
            "plan": (plan.cv_time, plan.cv[:, i]),
        }
        rows[0].append(panel(style.label(cv.label, cv.unit), parts, "linear", False))
    ahead = np.append(plan.move_time, [plan.move_time[-1] + plan.dt, end])
    for i, mv in enumerate(process.mvs):
        kinds = (("position", "", plan.mv, plan.mv[-1, i]), ("move", ", move", plan.move, 0.0))
        for row, (name, words, values, after) in enumerate(kinds, start=1):
            done = run[name].values[:, i]
            parts = {
                "later": (times[later], done[later]),
                "actual": (times[made], done[made]),
                "plan": (ahead, np.append(values[:, i], [after, after])),
            }
            rows[row].append(panel(style.label(mv.label + words, mv.unit), parts, "step-after", row == 2))
    return described(vconcat=[{"hconcat": row, "spacing": 16} for row in rows], spacing=6)


def as_html(spec: Spec) -> str:
    """A chart as part of a page that needs nothing else: what draws it is in it.

    Raises:
        MissingToolError: if vl-convert is not installed, which brings the script.
    """
    if not can_be_sent():
        raise MissingToolError("A page to send needs vl-convert: pip install 'jaxmpc[notebook]'")
    import vl_convert

    told = json.dumps(spec).replace("</", "<\\/")  # no text ends the script
    drawing = f"vegaEmbed('#chart', {told}, {{actions: false, renderer: 'svg'}});"
    libraries = vl_convert.javascript_bundle().replace("</script", "<\\/script")  # type: ignore[call-arg]
    return f'<div id="chart"></div><script>{libraries}</script><script>{drawing}</script>'


def can_be_sent() -> bool:
    """Whether what `as_html` needs is installed."""
    return importlib.util.find_spec("vl_convert") is not None


def altair_of(spec: Spec) -> Any:
    """A chart for ``marimo.ui.altair_chart``; Altair's own objects for one take longer than a run."""
    import altair

    class Described(altair.TopLevelMixin):
        data, params = altair.Undefined, ()

        def copy(self, *_: Any, **__: Any) -> Any:
            return self

        def to_dict(self, *_: Any, **__: Any) -> Any:
            return spec

    return Described()


def inline(table: pd.DataFrame) -> Spec:
    """A table as text within a chart; all but names are numbers."""
    names = [name for name in table.columns if name not in ("run", "what")]
    text = table.to_csv(index=False, float_format="%.7g")
    return {"values": text, "format": {"type": "csv", "parse": dict.fromkeys(names, "number")}}


def _rows(run: Shown, process: Process, seconds: float) -> pd.DataFrame:
    """A row per sample and for the end of the last: ``t``, per CV c, s (setpoint), l and h (deadzone), per MV m and d."""
    data = run.data.sel(controller=RUN)
    times = np.append(data.time.values, panels.span(run.data)[1]) / seconds
    table: dict[str, Any] = {"run": run.name, "t": times}
    half = np.asarray(data.tuning_deadzone.values, dtype=float)
    last = lambda values: np.append(values, values[-1])  # noqa: E731
    for i in range(len(process.cvs)):
        held = last(data.setpoint.values[:, i])
        table[f"c{i}"] = last(data.measurement.values[:, i])
        table |= {f"s{i}": held, f"l{i}": held - half[i], f"h{i}": held + half[i]}
    for i in range(len(process.mvs)):
        table[f"m{i}"] = last(data.position.values[:, i])
        if "demand" in data and i in process.stepped:
            table[f"d{i}"] = last(data.demand.values[:, i])
    return pd.DataFrame(table)


def _mark(interpolate: str, **look: Any) -> Spec:
    return {"type": "line", "clip": True, "interpolate": interpolate} | look


def _time(unit: str | None, *, labels: bool = True, domain: Any = None, axis: Spec | None = None) -> Spec:
    """The time axis of a panel; it is labelled if `unit` is given."""
    title = None if unit is None else f"time [{unit}]"
    scale = {"nice": False} | ({} if domain is None else {"domain": domain})
    return coded("t", "quantitative", title=title, scale=scale, axis=axis or {"labels": labels})


def _value(name: str) -> Spec:
    axis = {"minExtent": LEFT, "tickCount": 4, "format": ",.6~g"}
    return coded(name, "quantitative", title=None, scale={"zero": False}, axis=axis)


def _panel(title: str, layers: list[Spec], width: int, height: int) -> Spec:
    heading = {"text": title, "anchor": "start", "offset": 3}
    return {"title": heading, "width": width, "height": height, "layer": layers}


def coded(field: str, kind: str, **more: Any) -> Spec:
    """A field of a table along an axis, or as a colour."""
    return {"field": field, "type": kind, **more}


def described(renderer: str = "svg", **parts: Any) -> Spec:
    """A whole chart, with the fonts and lines of every chart of the app."""
    config = {
        "font": FONT,
        "view": {"stroke": "#CCCCCC"},
        "axis": {"gridColor": "#EEEEEE", "titleFontWeight": "normal"},
        "title": {"fontSize": 11, "fontWeight": "normal"},
    }
    options = {"embedOptions": {"renderer": renderer, "actions": False}}
    return {"$schema": SCHEMA, **parts, "usermeta": options, "config": config}
