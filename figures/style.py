"""How every figure looks: colours by controller, setpoints dashed, deadzones as bands, units on every axis.

The colours are the Okabe-Ito set, which stays apart for colour-blind readers and in grey. Everything is
written as PNG and PDF, each file in one go.
"""

from __future__ import annotations

import base64
import html
import io
import re
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxmpc.files import write_atomically

BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, PURPLE, BLACK, GREY = "#E69F00", "#56B4E9", "#CC79A7", "#222222", "#7F7F7F"
BAND, FUTURE = "#E3E3E3", "#F0F0F0"

# by what the controller is, so that the same controller has the same colour in every study
CONTROLLER_COLOURS = {
    ("continuous", "continuous"): BLUE,
    ("continuous", "step"): VERMILLION,
    ("mixed-integer", "step"): GREEN,
}
SPARE_COLOURS = (PURPLE, SKY, ORANGE)
PLAN = ORANGE  # what a controller intends: plans and predictions, and the run that only carries one out
SERIES = ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-."))  # three curves of one kind
VERDICT_COLOURS = {"holds": GREEN, "holds in part": ORANGE, "does not hold": VERMILLION, "not tested": GREY}

RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.formatter.useoffset": False,  # a value that hardly changes is written in full
    "axes.axisbelow": True,
    "grid.color": "#EBEBEB",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.constrained_layout.use": True,
    "figure.dpi": 100,
    "savefig.dpi": 160,
    "pdf.fonttype": 42,
    "svg.hashsalt": "jaxmpc",
}


house_style = matplotlib.rc_context(RC)  # a decorator of what draws or writes


def figure(rows: int, width: float = 7.6, row_height: float = 2.2, **options) -> tuple[Figure, list[Axes]]:
    """A figure of stacked panels that share their horizontal axis; width of the figure and height of a panel [inch]."""
    drawn, axes = grid(rows, 1, width, row_height * rows + 0.5, **{"sharex": True, **options})
    return drawn, list(axes[:, 0])


def grid(rows: int, columns: int, width: float, height: float, **options) -> tuple[Figure, np.ndarray]:
    """A figure of panels in rows and columns, axes ``"row column"``; sizes of the figure [inch].

    Pyplot does not know it: it needs no display, and nothing has to be closed.
    """
    drawn = Figure(figsize=(width, height))
    FigureCanvasAgg(drawn)
    return drawn, drawn.subplots(rows, columns, squeeze=False, **options)


@house_style
def save(drawn: Figure, out: str | Path, name: str) -> list[Path]:
    """Write ``name.png`` and ``name.pdf`` into a folder; equal figures give equal files.

    Returns:
        The two paths.
    """
    paths = []
    for kind, metadata in (("png", {"Software": None}), ("pdf", {"CreationDate": None, "Producer": None})):
        buffer = io.BytesIO()
        drawn.savefig(buffer, format=kind, metadata=metadata)
        drawn.set_layout_engine("none")  # laid out once, the same in both files
        paths.append(write_atomically(Path(out) / f"{name}.{kind}", buffer.getvalue()))
    return paths


@house_style
def png(drawn: Figure, dpi: float = 150) -> bytes:
    """A figure as PNG."""
    buffer = io.BytesIO()
    drawn.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def image(source: bytes, words: str, look: str = "") -> str:
    """A PNG as HTML that needs no further file; `words` say what it shows to readers who do not see it."""
    content = base64.b64encode(source).decode()
    return f'<img alt="{html.escape(words)}"{look} src="data:image/png;base64,{content}">'


def spans(values: np.ndarray, ratio: float) -> bool:
    """Whether the finite values are positive and the largest is more than `ratio` times the smallest."""
    finite = values[np.isfinite(values)]
    return len(finite) > 0 and finite.min() > 0 and finite.max() > ratio * finite.min()


def colour(kind: str, actuator: str, position: int = 0) -> str:
    """Colour of a controller; `position` tells further kinds apart."""
    return CONTROLLER_COLOURS.get((kind, actuator), SPARE_COLOURS[position % len(SPARE_COLOURS)])


def unit(text: str) -> str:
    """A unit as it is printed, powers included."""
    return re.sub(r"m3\b", "m³", text).replace("^2", "²")


def printed(text: str) -> str:
    """A sentence with its units as they are printed."""
    return re.sub(r"\bm3\b", "m³", text).replace(" %", "\N{NO-BREAK SPACE}%")


def name_of(channel: str) -> str:
    """The name of a CV or MV in words."""
    return channel.replace("_", " ")


def label(words: str, unit_text: str) -> str:
    """An axis label with its unit: ``flow rate [m³/h]``, ``valve move [%]``."""
    return f"{words} [{unit(unit_text)}]"


def minus(text: str) -> str:
    """A text with the signs of its negative numbers as they are printed."""
    return re.sub(r"(?<!\w)-(?=\d)", "−", text)
