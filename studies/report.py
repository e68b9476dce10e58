"""The summary of a comparison, of any process, as rows of text, Markdown and CSV."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr

from jaxmpc.files import write_atomically
from jaxmpc.process.process import Process
from studies.kpi.evaluate import key_figures
from studies.store.process import process_in
from studies.store.reading import open_results
from studies.tables import csv_text, markdown_table


def write_summary(
    folder: str | Path, more: Callable[[xr.Dataset, xr.Dataset], list[str]] = lambda data, figures: []
) -> list[Path]:
    """Write the key figures of every run of a study as ``summary.md`` and ``summary.csv`` beside its results.

    Args:
        folder: of the study, with a finished run.
        more: further lines of the Markdown, from the results and their key figures.

    Returns:
        The files written.
    """
    folder = Path(folder)
    data = open_results(folder).load()
    figures = key_figures(data)
    lines = [*markdown(data, figures), *more(data, figures), ""]
    return [
        write_atomically(folder / "summary.md", "\n".join(lines)),
        write_atomically(folder / "summary.csv", table_csv(figures)),
    ]


def summary_table(data: xr.Dataset, figures: xr.Dataset) -> list[tuple[str, list[str]]]:
    """The rows of the summary: what it is with its unit, and one text per controller.

    Args:
        data: the results.
        figures: their `key_figures`.
    """
    process = process_in(data)
    mean_move = data.tuning_mean_move_limit.values
    limited = [str(mv) for mv, own in zip(data.mv.values, mean_move.T, strict=True) if np.isfinite(own).any()]
    runs = [
        _run_texts(figures.isel(controller=i), process, limited) for i in range(figures.sizes["controller"])
    ]
    return [(what, [run[what] for run in runs]) for what in runs[0]]


def _run_texts(run: xr.Dataset, process: Process, limited: list[str]) -> dict[str, str]:
    def value(key: str, **at: str) -> float:
        return float(run[key].sel(at).sum(skipna=False))

    def of_cvs(key: str, form: str, scale: float = 1.0) -> str:
        return " / ".join(f"{scale * value(key, cv=cv.name):{form}}" for cv in process.cvs)

    gap = value("largest_gap")
    times = [1e3 * value(f"solve_time_{key}") for key in ("median", "p99", "max")]
    violations = [f"{value(key):.0f}" for key in ("cv_violations", "mv_violations", "move_violations")]
    out = {}
    for i, mv in enumerate(process.mvs):
        at = {"mv": mv.name}
        out[f"{mv.label} travel [{mv.unit}]"] = _long(value("travel", **at))
        if i not in process.stepped:
            continue
        out[f"{mv.label} moves / reversals"] = f"{value('moves', **at):.0f} / {value('reversals', **at):.0f}"
        late = run.late_reversals.sel(at).values
        out[f"{mv.label} reversals in 2nd half of each window"] = " ".join(str(v) for v in late)
        between = f"{value('mean_dwell', **at):.0f} / {value('shortest_dwell', **at):.0f}"
        out[f"time between {mv.label} moves, mean / shortest [s]"] = between
    names, units = (
        " / ".join(cv.label for cv in process.cvs),
        " / ".join(dict.fromkeys(cv.unit for cv in process.cvs)),
    )
    out |= {
        f"mean deviation, {names} [{units}]": of_cvs("mean_absolute_deviation", ".4g"),
        f"time outside deadzone, {names} [min]": of_cvs("time_outside_deadzone", ".0f", 1 / 60),
        "limit violations, CV / MV / move [samples]": " / ".join(violations),
    }
    for mv in process.mvs:
        if mv.name in limited:
            out[f"largest mean rise of the {mv.label} [{mv.unit}/sample]"] = (
                f"{value('largest_mean_rise', mv=mv.name):.3f}"
            )
            out[f"pauses of the {mv.label} staircase"] = f"{value('mean_move_stops', mv=mv.name):.0f}"
    return out | {
        "solve time, median / p99 / max [ms]": " / ".join(map(_three_digits, times)),
        "largest gap": f"{gap:.2g}" if np.isfinite(gap) else "none proven",
        "not optimal / MVs held [samples]": f"{value('not_optimal'):.0f} / {value('fallbacks'):.0f}",
    }


def _long(value: float) -> str:
    """A number without an exponent, with three digits or more."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _three_digits(value: float) -> str:
    """A positive number with about three digits and never with an exponent."""
    digits = 2 - int(np.floor(np.log10(value))) if 1e-3 < value < np.inf else 0
    return f"{value:.{max(0, digits)}f}"


def markdown(data: xr.Dataset, figures: xr.Dataset) -> list[str]:
    """The summary as lines of Markdown: key figures per controller."""
    head = ["", *(str(label) for label in figures.label.values)]
    title = [f"# {data.attrs.get('title', 'Summary')}", ""]
    return title + markdown_table(head, ([what, *values] for what, values in summary_table(data, figures)))


def table_csv(figures: xr.Dataset) -> str:
    """Key figures as CSV, one row per controller, key figure and channel (CV, MV or window start)."""
    rows = []
    for name in figures.controller.values:
        for key, variable in figures.data_vars.items():
            row = variable.sel(controller=name)
            for place in np.ndindex(row.shape):
                at = [str(row[axis].values[i]) for axis, i in zip(row.dims, place, strict=True)]
                unit = row.attrs["units"]
                for axis, channel in zip(row.dims, at, strict=True):
                    if f"{axis}_unit" in unit:
                        unit = unit.replace(
                            f"{axis}_unit", str(figures[f"{axis}_unit"].sel({axis: channel}).item())
                        )
                rows.append([name, key, " ".join(at), repr(row.values[place].item()), unit])
    return csv_text(["controller", "key_figure", "of", "value", "unit"], rows)
