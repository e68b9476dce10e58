"""The one-page summary of a comparison: key figures, then what the thesis says and what we see."""

from __future__ import annotations

import contextlib
import textwrap
from collections.abc import Iterator

import matplotlib.pyplot as plt
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from studies.kpi.evaluate import key_figures
from studies.thesis.claims import claims
from studies.thesis.report import summary_table

PAGE = (11.69, 8.27)  # inch, A4 across


@contextlib.contextmanager
def draw(data: xr.Dataset) -> Iterator[Figure]:
    """The page.

    Args:
        data: results of the thesis study.
    """
    figures = key_figures(data)
    rows = summary_table(figures)
    said = claims(data, figures)
    with plt.rc_context({**style.RC, "figure.constrained_layout.use": False}):
        drawn = plt.figure(figsize=PAGE)
        try:
            page = drawn.add_axes((0, 0, 1, 1))
            page.axis("off")
            page.grid(False)
            page.set_xlim(0, 1)
            page.set_ylim(0, 1)
            page.text(0.04, 0.955, str(data.attrs.get("title", "")), fontsize=15, weight="bold", va="center")
            page.text(0.04, 0.925, _subtitle(data), fontsize=8.5, color=style.GREY, va="center")
            bottom = _key_figures(page, data, figures, rows, top=0.885)
            _claims(page, said, top=bottom - 0.035)
            yield drawn
        finally:
            plt.close(drawn)


def _subtitle(data: xr.Dataset) -> str:
    hours = float(data.time.values[-1] + data.attrs["dt"]) / 3600
    windows = int(data.window.values.max()) + 1
    return (
        f"{len(data.time)} samples of {data.attrs['dt']:g} s ({hours:.1f} h), {windows} setpoint windows; "
        f"study {data.attrs.get('study', '')}, {data.attrs.get('created', '')[:10]}"
    )


def _key_figures(page, data, figures, rows, top: float) -> float:
    columns = [0.30 + 0.225 * i for i in range(figures.sizes["controller"])]
    for x, name, label in zip(columns, figures.controller.values, figures.label.values, strict=True):
        colour = panels.run_colour(data, str(name))
        page.text(x, top, str(label), fontsize=9, weight="bold", color=colour, va="center")
    y = top - 0.014
    page.plot([0.04, 0.96], [y, y], color=style.BLACK, linewidth=0.8)
    height = 0.0245
    for i, (what, values) in enumerate(rows):
        y_row = y - height * (i + 0.6)
        if i % 2:
            page.axhspan(y_row - height / 2, y_row + height / 2, 0.04, 0.96, color="#F5F5F5", linewidth=0)
        page.text(0.045, y_row, style.printed(what), fontsize=8.3, va="center")
        for x, text in zip(columns, values, strict=True):
            page.text(x, y_row, text, fontsize=8.3, va="center")
    return y - height * (len(rows) + 0.2)


def _claims(page, said, top: float) -> None:
    for x, text in (
        (0.045, "The thesis says"),
        (0.36, "what we see"),
        (0.68, "it holds if"),
        (0.885, "verdict"),
    ):
        page.text(x, top, text, fontsize=9, weight="bold", va="center")
    y = top - 0.014
    page.plot([0.04, 0.96], [y, y], color=style.BLACK, linewidth=0.8)
    for claim in said:
        cells = [
            (0.045, textwrap.wrap(claim.statement, 56)),
            (0.36, textwrap.wrap(style.printed(claim.value), 56)),
            (0.68, textwrap.wrap(style.printed(claim.rule), 42)),
        ]
        lines = max(len(text) for _, text in cells)
        height = 0.0165 * lines + 0.0085
        for x, text in cells:
            page.text(x, y - height / 2, "\n".join(text), fontsize=7.4, va="center", linespacing=1.15)
        colour = style.VERDICT_COLOURS[claim.verdict]
        page.text(
            0.885, y - height / 2, claim.verdict, fontsize=8.3, weight="bold", color=colour, va="center"
        )
        y -= height
        page.plot([0.04, 0.96], [y, y], color="#DDDDDD", linewidth=0.5)
