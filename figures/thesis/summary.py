"""The one-page summary of a comparison: key figures, then what the thesis says and what we see."""

from __future__ import annotations

import textwrap

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import style
from figures.comparison.summary import LEFT, RIGHT, RULED, blank, table
from figures.figure import FigureEntry
from figures.thesis.runs import INTEGER, ROUNDED, SMOOTH
from studies.kpi.evaluate import completed, key_figures
from studies.thesis.claims import claims

PLACES = (0.5, 4.2, 7.95, 10.35)  # of the columns [inch]


def draw(data: xr.Dataset) -> Figure:
    """Two tables on a page: key figures by controller, and statements of the thesis with a verdict each."""
    figures = key_figures(data)
    page = blank()
    bottom = table(page, completed(data), figures)
    _claims(page, claims(data, figures), top=bottom - 0.29)
    return page.figure  # type: ignore[return-value]


def _claims(page: Axes, said, top: float) -> None:
    """A row per statement of the thesis with what we see, the rule and the verdict."""
    for x, text in zip(PLACES, ("The thesis says", "what we see", "it holds if", "verdict"), strict=True):
        page.text(x, top, text, fontsize=9, weight="bold", va="center")
    y = top - 0.115
    page.plot([LEFT, RIGHT], [y, y], **RULED)
    for claim in said:
        texts = (claim.statement, style.printed(claim.value), style.printed(claim.rule))
        cells = [textwrap.wrap(text, wide) for text, wide in zip(texts, (56, 56, 42), strict=True)]
        height = 0.136 * max(map(len, cells)) + 0.07
        middle = y - height / 2
        for x, lines in zip(PLACES, cells, strict=False):
            page.text(x, middle, "\n".join(lines), fontsize=7.4, va="center", linespacing=1.15)
        colour = style.VERDICT_COLOURS[claim.verdict]
        page.text(PLACES[-1], middle, claim.verdict, fontsize=8.3, weight="bold", color=colour, va="center")
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
