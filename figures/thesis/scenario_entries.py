"""Entries of the figures around the thesis comparison: 3 to 5 and 13 without results, 12 and 25 to 38 from scenarios."""

from __future__ import annotations

from typing import Any

import xarray as xr

from figures.entry import FigureEntry
from figures.thesis import events, integer_example, open_loop, plans, soft, thesis_captions, tracking
from figures.thesis import scenario_captions as captions
from figures.thesis.thesis_entries import INPUTS_ALT, RATES_ALT

INTEGER, HARD = "mixed-integer", "no-soft"
PREDICTED = ("closed-loop", "open-loop")
PLANE_ALT = (
    "A plane with integer points, the triangle that two inequalities leave of it, and the optima marked"
)


def _without_results() -> list[FigureEntry]:
    return [
        FigureEntry(
            "3",
            "optimum of a relaxation far from that of the integer program",
            None,
            "figure_3_relaxation",
            integer_example.optima,
            caption=captions.optima,
            alt=f"{PLANE_ALT}: relaxed, rounded and integer.",
        ),
        FigureEntry(
            "4",
            "convex hull of the integer points",
            None,
            "figure_4_convex_hull",
            integer_example.convex_hull,
            caption=captions.hull,
            alt=f"{PLANE_ALT}; a grey polygon spans the feasible integer points.",
        ),
        FigureEntry(
            "5",
            "a valid inequality",
            None,
            "figure_5_valid_inequality",
            integer_example.valid_inequality,
            caption=captions.cut,
            alt=f"{PLANE_ALT}; one more line, with the narrow strip hatched that it cuts off.",
        ),
        FigureEntry(
            "13",
            "penalty of a deviation: Soft MPC and nominal",
            None,
            "figure_13_penalties",
            soft.penalties,
            caption=captions.penalties,
            alt="Two plots, oil above gas: three parabola-like penalties over the deviation, the deadzone shaded.",
        ),
    ]


def _predictions() -> list[FigureEntry]:
    alt = "Six plots over time: oil and gas rate, choke and gas lift, and the moves of both."
    return [
        FigureEntry(
            "25",
            "plan of the mixed-integer MPC at a step of the setpoints",
            "predictions",
            "figure_25_plan",
            plans.planned,
            PREDICTED[:1],
            {"controller": PREDICTED[0]},
            caption=captions.planned,
            alt=f"{alt} The past is white; the plan and its prediction lie on grey.",
        ),
        FigureEntry(
            "26",
            "evolution after that step",
            "predictions",
            "figure_26_evolution",
            plans.evolved,
            PREDICTED[:1],
            {"controller": PREDICTED[0]},
            caption=captions.evolved,
            alt=f"{alt} What happened, and the plan of the step dashed.",
        ),
        FigureEntry(
            "27",
            "oil and gas rate: open against closed loop",
            "predictions",
            "figure_27_rates_open_loop",
            open_loop.rates,
            PREDICTED,
            caption=captions.open_loop_rates,
            alt="Two line plots over time, oil rate above gas rate, each with an open-loop and a closed-loop curve.",
        ),
        FigureEntry(
            "28",
            "choke and gas lift: open against closed loop",
            "predictions",
            "figure_28_inputs_open_loop",
            open_loop.inputs,
            PREDICTED,
            caption=captions.open_loop_inputs,
            alt="Two step plots over time, choke above gas lift, each with an open-loop and a closed-loop curve.",
        ),
    ]


def _retuned(data: xr.Dataset) -> dict[str, Any]:
    at = events.retuned_at(data, INTEGER)
    return {"controller": INTEGER, "at": at, "what": "gas weights zero"}


def _disturbed(data: xr.Dataset) -> dict[str, Any]:
    low = f"{float(data.disturbance.min()):+g}".replace("-", "−")
    at = events.disturbed_at(data)
    return {"controller": INTEGER, "at": at, "what": f"{low} bar"}


def _events() -> list[FigureEntry]:
    out = []
    for first, study, what, arguments, caption, when in (
        (
            29,
            "fine-regulation",
            "fine regulation of the oil rate",
            _retuned,
            captions.fine_rates,
            lambda data: events.retuned_at(data, INTEGER),
        ),
        (
            31,
            "disturbance",
            "drop of the reservoir pressure",
            _disturbed,
            captions.disturbed_rates,
            events.disturbed_at,
        ),
    ):
        for i, (words, function, alt, said) in enumerate(
            (
                ("oil and gas rate", events.rates, RATES_ALT, caption(INTEGER)),
                ("choke and gas lift", events.inputs, INPUTS_ALT, captions.event_inputs(INTEGER, when)),
            )
        ):
            out.append(
                FigureEntry(
                    str(first + i),
                    f"{what}: {words}",
                    study,
                    f"figure_{first + i}_{function.__name__}_{study.replace('-', '_')}",
                    function,
                    (INTEGER,),
                    arguments,
                    caption=said,
                    alt=f"{alt} A dotted line marks the event.",
                )
            )
    out.append(
        FigureEntry(
            "33",
            "the disturbance",
            "disturbance",
            "figure_33_pressure",
            events.pressure,
            caption=captions.pressure,
            alt="A step plot over time: offset of the reservoir pressure.",
        )
    )
    return out


def _without_soft() -> list[FigureEntry]:
    study = "without-soft"
    out = [
        FigureEntry(
            "12",
            "nominal and Soft mixed-integer MPC",
            "soft",
            "figure_12_nominal_and_soft",
            soft.compared,
            (soft.NOMINAL, soft.SOFT),
            caption=captions.nominal_and_soft,
            alt="Oil rate with setpoint and deadzone above the choke position, each with a curve per controller.",
        ),
        FigureEntry(
            "34",
            "oil and gas rate: mixed-integer MPC without Soft MPC",
            study,
            "figure_34_rates_without_soft",
            tracking.rates,
            ("soft", "no-soft", "no-soft-plain"),
            {"controller": HARD},
            caption=captions.without_soft,
            alt="Two line plots over time, oil rate above gas rate: the measured rate and its setpoint dashed.",
        ),
        FigureEntry(
            "35",
            "choke and gas lift: mixed-integer MPC without Soft MPC",
            study,
            "figure_35_inputs_without_soft",
            tracking.inputs,
            (HARD,),
            {"controller": HARD},
            caption=thesis_captions.inputs(HARD),
            alt=INPUTS_ALT,
        ),
    ]
    for which, word in enumerate(("the first", "the second", "the third")):
        id = str(36 + which)
        out.append(
            FigureEntry(
                id,
                f"prediction and response at {word} turn of an oscillation",
                study,
                f"figure_{id}_prediction_{which + 1}",
                plans.swing,
                (HARD,),
                {"controller": HARD, "which": which},
                caption=captions.swing(HARD, which),
                alt="Four plots over time: oil and gas rate with prediction and response, choke and lift with the plan.",
            )
        )
    return out


ENTRIES = (*_without_results(), *_predictions(), *_events(), *_without_soft())
