"""The one-page summary of a comparison: key figures, a column per controller; `figures.thesis.summary` adds to it."""

from __future__ import annotations

import textwrap
from typing import Any

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import panels, style
from figures.comparison.tracking import STUDY
from figures.figure import FigureEntry
from studies.kpi.evaluate import completed, key_figures
from studies.report import summary_table

WIDTH, HEIGHT = 11.69, 8.27  # of the page [inch]
LEFT, RIGHT, TOP = 0.45, 11.25, 0.35  # borders of what is written on it [inch]
NAMED = 3.4  # width of the first column of the table [inch]
SIZE, LINE, GAP = 8.3, 0.155, 0.055  # of the text of the table [pt], height of a line and between rows [inch]
PER_INCH = 130.0  # characters of a line, times the size of the text [pt]
BOLD = 10.8  # size of plain text as wide as the heads of the columns [pt]
RULED = {"color": style.BLACK, "linewidth": 0.8}


def draw(data: xr.Dataset) -> Figure:
    """A table on a page: what each key figure is, and its value for every controller."""
    data = completed(data)
    figures = key_figures(data)
    bottom = table(blank(), data, figures)
    page = blank(HEIGHT - bottom + TOP)  # as high as the table
    table(page, data, figures)
    return page.figure  # type: ignore[return-value]


def blank(height: float = HEIGHT) -> Axes:
    """An empty page; its axes are in inches from the lower left corner."""
    drawn, ((page,),) = style.grid(1, 1, WIDTH, height)
    drawn.set_layout_engine("none")
    page.set_position((0, 0, 1, 1))
    page.axis("off")
    page.grid(False)
    page.set(xlim=(0, WIDTH), ylim=(0, height))
    return page


def table(page: Axes, data: xr.Dataset, figures: xr.Dataset) -> float:
    """Title of the study and its key figures on a page.

    Args:
        page: from `blank`.
        data: results of the controllers of `figures`.
        figures: their `key_figures`.

    Returns:
        Where the table ends [inch].
    """
    y = page.get_ylim()[1] - TOP
    page.text(LEFT, y, str(data.attrs.get("title", "")), fontsize=15, weight="bold", va="center")
    page.text(LEFT, y - 0.26, _subtitle(data), fontsize=8.5, color=style.GREY, va="center")
    count = figures.sizes["controller"]
    wide = (RIGHT - LEFT - NAMED) / count
    places = [LEFT + NAMED + wide * i for i in range(count)]
    colours = panels.run_colours(data)
    heads = [wrapped(str(label), wide, BOLD) for label in figures.label.values]
    y -= 0.5 + LINE * max(map(len, heads))
    for x, name, lines in zip(places, figures.controller.values, heads, strict=True):
        look: dict[str, Any] = {"color": colours[str(name)], "weight": "bold", "va": "bottom"}
        page.text(x, y + 0.06, "\n".join(lines), fontsize=9, **look)
    page.plot([LEFT, RIGHT], [y, y], **RULED)
    for i, (what, values) in enumerate(summary_table(data, figures)):
        widths = (NAMED, *[wide] * count)
        cells = [wrapped(style.printed(t), w, SIZE) for t, w in zip((what, *values), widths, strict=True)]
        height = LINE * max(map(len, cells)) + GAP
        if i % 2:
            page.axhspan(y - height, y, LEFT / WIDTH, RIGHT / WIDTH, color="#F5F5F5", linewidth=0)
        for x, lines in zip((LEFT + 0.05, *places), cells, strict=True):
            page.text(x, y - height / 2, "\n".join(lines), fontsize=SIZE, va="center", linespacing=1.15)
        y -= height
    return y


def wrapped(text: str, wide: float, size: float) -> list[str]:
    """Lines of a text that are about `wide` inches long at a size [pt]; at spaces that are not part of ``a / b``."""
    parts = text.replace(" / ", "\N{NO-BREAK SPACE}/ ")
    return textwrap.wrap(parts, max(8, int(wide * PER_INCH / size)), break_long_words=False) or [""]


def _subtitle(data: xr.Dataset) -> str:
    dt, (start, end) = float(data.attrs["dt"]), panels.span(data)
    seconds, unit = panels.time_unit(start, end)
    windows = int(data.window.values.max()) + 1
    return (
        f"{len(data.time)} samples of {dt:g} s ({(end - start) / seconds:.1f} {unit}), {windows} setpoint "
        f"window{'s' * (windows != 1)}; study {data.attrs.get('study', '')}, {data.attrs.get('created', '')[:10]}"
    )


def _caption(data: xr.Dataset) -> str:
    return f"Key figures of the {completed(data).sizes['controller']} finished runs, a column each."


ENTRIES = (FigureEntry("summary", "one-page summary", STUDY, draw, _caption),)
