"""The one-page summary of a comparison: key figures, then what the thesis says and what we see."""

from __future__ import annotations

import textwrap

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from figures.thesis.runs import INTEGER, ROUNDED, SMOOTH
from studies.kpi.evaluate import key_figures
from studies.thesis.claims import claims
from studies.thesis.report import summary_table

LEFT, RIGHT = 0.04, 0.96
RULED = {"color": style.BLACK, "linewidth": 0.8}


def draw(data: xr.Dataset) -> Figure:
    """Two tables on a page: key figures by controller, and statements of the thesis with a verdict each."""
    figures = key_figures(data)
    drawn, ((page,),) = style.grid(1, 1, 11.69, 8.27)
    drawn.set_layout_engine("none")
    page.set_position((0, 0, 1, 1))
    page.axis("off")
    page.grid(False)
    page.set(xlim=(0, 1), ylim=(0, 1))
    page.text(LEFT, 0.955, str(data.attrs.get("title", "")), fontsize=15, weight="bold", va="center")
    page.text(LEFT, 0.925, _subtitle(data), fontsize=8.5, color=style.GREY, va="center")
    bottom = _key_figures(page, data, figures, top=0.885)
    _claims(page, claims(data, figures), top=bottom - 0.035)
    return drawn


def _subtitle(data: xr.Dataset) -> str:
    hours = float(data.time.values[-1] + data.attrs["dt"]) / 3600
    windows = int(data.window.values.max()) + 1
    return (
        f"{len(data.time)} samples of {data.attrs['dt']:g} s ({hours:.1f} h), {windows} setpoint windows; "
        f"study {data.attrs.get('study', '')}, {data.attrs.get('created', '')[:10]}"
    )


def _key_figures(page: Axes, data: xr.Dataset, figures: xr.Dataset, top: float) -> float:
    """A row per key figure, a column per controller; returns where the table ends."""
    columns = [0.30 + 0.225 * i for i in range(figures.sizes["controller"])]
    for x, name, label in zip(columns, figures.controller.values, figures.label.values, strict=True):
        colour = panels.run_colour(data, str(name))
        page.text(x, top, str(label), fontsize=9, weight="bold", color=colour, va="center")
    rows, height = summary_table(figures), 0.0245
    y = top - 0.014
    page.plot([LEFT, RIGHT], [y, y], **RULED)
    for i, (what, values) in enumerate(rows):
        at = y - height * (i + 0.6)
        if i % 2:
            page.axhspan(at - height / 2, at + height / 2, LEFT, RIGHT, color="#F5F5F5", linewidth=0)
        for x, text in zip((0.045, *columns), (style.printed(what), *values), strict=True):
            page.text(x, at, text, fontsize=8.3, va="center")
    return y - height * (len(rows) + 0.2)


def _claims(page: Axes, said, top: float) -> None:
    """A row per statement of the thesis with what we see, the rule and the verdict."""
    places = (0.045, 0.36, 0.68, 0.885)
    for x, text in zip(places, ("The thesis says", "what we see", "it holds if", "verdict"), strict=True):
        page.text(x, top, text, fontsize=9, weight="bold", va="center")
    y = top - 0.014
    page.plot([LEFT, RIGHT], [y, y], **RULED)
    for claim in said:
        texts = (claim.statement, style.printed(claim.value), style.printed(claim.rule))
        cells = [textwrap.wrap(text, wide) for text, wide in zip(texts, (56, 56, 42), strict=True)]
        height = 0.0165 * max(map(len, cells)) + 0.0085
        middle = y - height / 2
        for x, lines in zip(places, cells, strict=False):
            page.text(x, middle, "\n".join(lines), fontsize=7.4, va="center", linespacing=1.15)
        colour = style.VERDICT_COLOURS[claim.verdict]
        page.text(places[-1], middle, claim.verdict, fontsize=8.3, weight="bold", color=colour, va="center")
        y -= height
        page.plot([LEFT, RIGHT], [y, y], color="#DDDDDD", linewidth=0.5)


def _caption(data: xr.Dataset) -> str:
    return (
        f"Key figures of the {data.sizes['controller']} runs, and statements of the thesis about this comparison with "
        "what our well shows and a verdict by a stated rule."
    )


ENTRIES = (
    FigureEntry("summary", "one-page summary", "thesis", draw, _caption, needs=(SMOOTH, ROUNDED, INTEGER)),
)
