"""The summary of a comparison as rows of text, Markdown and CSV; `figures.thesis.summary` draws that of the thesis study."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from jaxmpc.files import write_atomically
from jaxmpc.model.step_response import StepResponseModel
from studies.definition.presets import GAS, OIL
from studies.kpi.evaluate import key_figures
from studies.store.reading import open_results
from studies.thesis.catalogue import STUDIES
from studies.thesis.claims import claims
from studies.thesis.tables import csv_text, markdown_table
from studies.thesis.time_limits import LimitedSteps, limited_steps


def write_summary(folder: str | Path, study: str) -> list[Path]:
    """Write the key figures of every run of a study as ``summary.md`` and ``summary.csv`` beside its results.

    Args:
        folder: of the study, with a finished run.
        study: a key of `studies.thesis.catalogue.STUDIES`. The Markdown of ``thesis`` has its statements too, that of
            ``time-limit`` what the limits cost, for which the limited steps are solved again.

    Returns:
        The files written.
    """
    folder = Path(folder)
    data = open_results(folder).load()
    text = markdown(data, statements=study == "thesis")
    if study == "time-limit":
        model = StepResponseModel.load(folder / "model.json")
        text += "\n" + limits_markdown(limited_steps(data, STUDIES[study](False, "jax").controllers, model))
    return [
        write_atomically(folder / "summary.md", text),
        write_atomically(folder / "summary.csv", table_csv(data)),
    ]


def summary_table(figures: xr.Dataset) -> list[tuple[str, list[str]]]:
    """The rows of the summary from `key_figures`: what it is with its unit, and one text per controller."""
    runs = [_run_texts(figures.isel(controller=i)) for i in range(figures.sizes["controller"])]
    return [(what, [run[what] for run in runs]) for what in runs[0]]


def _run_texts(run: xr.Dataset) -> dict[str, str]:
    def value(key: str, **at: str) -> float:
        return float(run[key].sel(at).sum(skipna=False))

    def both(key: str, form: str, scale: float = 1.0) -> str:
        return " / ".join(f"{scale * value(key, cv=cv):{form}}" for cv in (GAS, OIL))

    gap = value("largest_gap")
    times = [1e3 * value(f"solve_time_{key}") for key in ("median", "p99", "max")]
    violations = [f"{value(key):.0f}" for key in ("cv_violations", "mv_violations", "move_violations")]
    return {
        "choke travel [%]": f"{value('choke_travel'):.0f}",
        "choke moves / reversals": f"{value('choke_moves'):.0f} / {value('choke_reversals'):.0f}",
        "reversals in 2nd half of each window": " ".join(str(v) for v in run.late_reversals.values),
        "time between moves, mean / shortest [s]": f"{value('mean_dwell'):.0f} / {value('shortest_dwell'):.0f}",
        "lift travel [1000 m3/h]": f"{value('lift_travel') / 1000:.1f}",
        "mean deviation, gas / oil [m3/h]": both("mean_absolute_deviation", ".4g"),
        "time outside deadzone, gas / oil [min]": both("time_outside_deadzone", ".0f", 1 / 60),
        "limit violations, CV / MV / move [samples]": " / ".join(violations),
        "largest mean opening [%/sample]": f"{value('largest_mean_opening'):.3f}",
        "pauses of the staircase": f"{value('mean_move_stops'):.0f}",
        "solve time, median / p99 / max [ms]": " / ".join(map(_three_digits, times)),
        "largest gap": f"{gap:.2g}" if np.isfinite(gap) else "none proven",
        "not optimal / MVs held [samples]": f"{value('not_optimal'):.0f} / {value('fallbacks'):.0f}",
    }


def _three_digits(value: float) -> str:
    """A positive number with about three digits and never with an exponent."""
    digits = 2 - int(np.floor(np.log10(value))) if 1e-3 < value < np.inf else 0
    return f"{value:.{max(0, digits)}f}"


def markdown(data: xr.Dataset, statements: bool = True) -> str:
    """The summary as Markdown: key figures per controller, then the statements of the thesis study with their verdicts."""
    figures = key_figures(data)
    head = ["", *(str(label) for label in figures.label.values)]
    lines = [f"# {data.attrs.get('title', 'Summary')}", ""]
    lines += markdown_table(head, ([what, *values] for what, values in summary_table(figures)))
    if statements:
        rows = ((one.statement, one.value, one.verdict, one.rule) for one in claims(data, figures))
        lines += ["", *markdown_table(("the thesis says", "what we see", "verdict", "holds if"), rows)]
    return "\n".join([*lines, ""])


def limits_markdown(steps: list[LimitedSteps]) -> str:
    """What limited solve times cost as a Markdown table, one row per controller; percent of the exact optimum."""
    head = ("", "steps that reach their limit", "proven gap, median", "objective lost: median / 90 % / most")
    rows = []
    for one in steps:
        # the optimum itself is known to a relative gap of 1e-6
        lost = " / ".join("0" if value <= 1e-6 else f"{100 * value:.2g}" for value in one.lost)
        known = (f"{100 * one.gap:.2g} %", f"{lost} %") if one.share > 0 else ("", "")
        rows.append((one.label, f"{100 * one.share:.1f} %", *known))
    return "\n".join([*markdown_table(head, rows), ""])


def table_csv(data: xr.Dataset) -> str:
    """Key figures as CSV, one row per controller, key figure and channel (CV, MV or window start)."""
    figures = key_figures(data)
    rows = []
    for name in figures.controller.values:
        for key, variable in figures.data_vars.items():
            row = variable.sel(controller=name)
            labels = row[row.dims[0]].values if row.dims else [""]
            for label, value in zip(labels, np.atleast_1d(row.values), strict=True):
                unit = row.attrs["units"]
                if "cv_unit" in unit:
                    unit = unit.replace("cv_unit", str(figures.cv_unit.sel(cv=label).item()))
                rows.append([name, key, label, repr(value.item()), unit])
    return csv_text(["controller", "key_figure", "of", "value", "unit"], rows)
