"""Entries of the figures of the thesis comparison: 10, 11, 14 to 24, 39, and the summary page."""

from __future__ import annotations

import xarray as xr

from figures.entry import FigureEntry
from figures.thesis import closeup, solve_time, step_coefficients, summary, tracking
from figures.thesis import thesis_captions as captions

STUDY = "thesis"
SMOOTH, ROUNDED, INTEGER = "continuous-choke", "step-choke", "mixed-integer"
RUNS = (  # first figure, controller, in words
    (14, SMOOTH, "continuous MPC, continuous choke"),
    (17, ROUNDED, "continuous MPC, step choke"),
    (22, INTEGER, "mixed-integer MPC"),
)
RATES_ALT = "Two line plots over time, oil rate above gas rate: the measured rate, its setpoint dashed, and the deadzone."
INPUTS_ALT = "Two step plots over time: demanded and actual choke position above the gas-lift rate."
BIAS_ALT = "Two line plots over time around zero: output bias of the oil rate above that of the gas rate."


def _entries() -> list[FigureEntry]:
    out = [
        FigureEntry(
            id,
            f"{cv} rate: steady-state step coefficients over the choke",
            STUDY,
            f"figure_{id}_{cv}_coefficients",
            step_coefficients.draw,
            arguments={"cv": f"{cv}_rate"},
            caption=captions.coefficients(f"{cv}_rate"),
            alt=f"Three curves, one per gas-lift rate: steady change of the {cv} rate per % of choke over the choke.",
        )
        for id, cv in (("10", "oil"), ("11", "gas"))
    ]
    kinds = (
        ("rates", "oil and gas rate", tracking.rates, captions.tracking, RATES_ALT),
        ("inputs", "choke and gas lift", tracking.inputs, captions.inputs, INPUTS_ALT),
        ("bias", "output bias", tracking.bias, captions.bias, BIAS_ALT),
    )
    for first, controller, words in RUNS:
        for i, (kind, what, function, caption, alt) in enumerate(kinds):
            out.append(
                FigureEntry(
                    str(first + i),
                    f"{what}: {words}",
                    STUDY,
                    f"figure_{first + i}_{kind}_{controller.replace('-', '_')}",
                    function,
                    (controller,),
                    {"controller": controller},
                    caption=caption(controller),
                    alt=alt,
                )
            )
    seen = (captions.oscillating_rates, captions.oscillating_inputs)
    for id, (kind, what, function, _, alt), caption in zip(("20", "21"), kinds[:2], seen, strict=True):
        out.append(
            FigureEntry(
                id,
                f"{what} while the rounded controller oscillates",
                STUDY,
                f"figure_{id}_{kind}_oscillating",
                function,
                (ROUNDED,),
                {"controller": ROUNDED},
                select=_oscillating,
                caption=caption(ROUNDED),
                alt=f"{alt} A short stretch of the run.",
            )
        )
    timed = (ROUNDED, INTEGER)
    out.append(
        FigureEntry(
            "39",
            "computation time of every sample: continuous and mixed-integer MPC",
            STUDY,
            "figure_39_solve_time",
            solve_time.draw,
            timed,
            {"controllers": timed},
            caption=captions.solve_time(timed),
            alt="Two scatter plots over time on a logarithmic axis: milliseconds of each controller step.",
        )
    )
    out.append(
        FigureEntry(
            "summary",
            "one-page summary",
            STUDY,
            "summary",
            summary.draw,
            (SMOOTH, ROUNDED, INTEGER),
            caption=captions.summary,
            alt="Two tables: key figures by controller, and statements of the thesis with a verdict each.",
        )
    )
    return out


def _oscillating(data: xr.Dataset) -> xr.Dataset:
    return closeup.stretch(data, ROUNDED)


ENTRIES = tuple(_entries())
