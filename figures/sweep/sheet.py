"""What figures of a sweep study share: the title above and the caption below, colour bars, rings."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from figures import style

RING: dict[str, Any] = {"marker": "o", "linestyle": "none", "markerfacecolor": "none"}
CHARACTERS = 18.0  # of the caption, per inch
LEGEND_AT = 0.24  # below the top [inch]


def write(drawn: Figure, data: xr.Dataset, lines: Iterable[str], legend: Sequence[Artist] = ()) -> None:
    """Title of the study above, with a legend of these handles below it; under the panels the caption.

    The caption has the given sentences, then how many scenarios are missing.
    """
    size = drawn.get_size_inches()
    title = str(data.attrs.get("title", "")) + ("\n " if legend else "")  # the second line is the legend's
    drawn.suptitle(title, fontsize=10.5, x=0.01, ha="left")
    if legend:
        place = {"loc": "upper left", "bbox_to_anchor": (0.0, 1 - LEGEND_AT / size[1]), "borderaxespad": 0.1}
        drawn.legend(handles=list(legend), ncols=len(legend), fontsize=8, **place)
    wide = int(CHARACTERS * size[0])
    sentences = [style.printed(line) for line in [*lines, missing(data)] if line]
    text = "\n".join(line for sentence in sentences for line in textwrap.wrap(sentence, wide))
    if text:
        drawn.supxlabel(text, fontsize=7.5, color="#555555", x=0.01, ha="left")


def missing(data: xr.Dataset) -> str:
    """What the note says of scenarios that are not finished; empty if all are."""
    count, total = int(data.attrs.get("missing", 0)), int(data.attrs.get("total", 0))
    if not count:
        return ""
    return f"{count} of {total} scenarios {'is' if count == 1 else 'are'} missing: not computed, or stopped early."


def colour_bar(mappable: Any, axes: Any, label: str = "", **options) -> Colorbar:
    """A colour bar beside a panel or an array of panels, with plain numbers on a logarithmic scale too."""
    drawn: Any = np.atleast_1d(axes)[0].figure
    bar = drawn.colorbar(mappable, ax=axes, label=label, **options)
    bar.outline.set_visible(False)
    if isinstance(mappable.norm, LogNorm):
        bar.set_ticks(LogLocator(subs=(1, 2, 5)))
        bar.minorticks_off()
        bar.formatter = FuncFormatter(lambda value, _: f"{value:g}")
    return bar


def ring(axes: Axes, x, y, label: str | None = None, size: float = 11.0) -> None:
    """Mark points with a ring, dark on light and light on dark, and name the first of them if there is a label."""
    x, y = np.atleast_1d(x), np.atleast_1d(y)
    axes.plot(x, y, **RING, markersize=size, markeredgecolor="white", markeredgewidth=3.2, zorder=5)
    axes.plot(x, y, **RING, markersize=size, markeredgecolor=style.BLACK, markeredgewidth=1.3, zorder=5.1)
    if label:
        box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
        look: dict[str, Any] = {
            "fontsize": 8.5,
            "weight": "bold",
            "color": style.BLACK,
            "zorder": 6,
            "bbox": box,
        }
        axes.annotate(label, (x[0], y[0]), xytext=(9, 7), textcoords="offset points", **look)
