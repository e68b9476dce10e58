"""What the summaries of the thesis's studies say beyond key figures: its statements, and what limited solve times cost."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from jaxmpc.model.step_response import StepResponseModel
from studies.report import write_summary
from studies.tables import markdown_table
from studies.thesis.catalogue import comparison_of
from studies.thesis.claims import claims
from studies.thesis.time_limits import LimitedSteps, limited_steps


def write_thesis_summary(folder: str | Path, study: str) -> list[Path]:
    """The summary of one of `studies.thesis.catalogue.STUDIES`, beside its results.

    That of ``thesis`` has its statements too, that of ``time-limit`` what the limits cost, for which the limited steps are
    solved again.

    Returns:
        The files written.
    """

    def more(data: xr.Dataset, figures: xr.Dataset) -> list[str]:
        if study == "thesis":
            rows = ((one.statement, one.value, one.verdict, one.rule) for one in claims(data, figures))
            return ["", *markdown_table(("the thesis says", "what we see", "verdict", "holds if"), rows)]
        if study == "time-limit":
            model = StepResponseModel.load(Path(folder) / "model.json")
            return ["", *limits_table(limited_steps(data, comparison_of(study), model))]
        return []

    return write_summary(folder, more)


def limits_table(steps: list[LimitedSteps]) -> list[str]:
    """What limited solve times cost as lines of Markdown, one row per controller; percent of the exact optimum."""
    head = ("", "steps that reach their limit", "proven gap, median", "objective lost: median / 90 % / most")
    rows = []
    for one in steps:
        # the optimum itself is known to a relative gap of 1e-6
        lost = " / ".join("0" if value <= 1e-6 else f"{100 * value:.2g}" for value in one.lost)
        known = (f"{100 * one.gap:.2g} %", f"{lost} %") if one.share > 0 else ("", "")
        rows.append((one.label, f"{100 * one.share:.1f} %", *known))
    return markdown_table(head, rows)
