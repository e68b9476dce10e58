"""What the thesis says of the three controllers (7.1, 7.2.1), measured on stored results.

A verdict follows from numbers by the rule that its row states; a statement that fails is shown as failing.
"""

from __future__ import annotations

import msgspec
import numpy as np
import xarray as xr

from studies.evaluate import (
    NEAR_CLOSED,
    completed,
    distance_to_reach,
    final_deviation,
    key_figures,
    window_deviation,
)
from studies.presets import CHOKE, GAS, OIL

HUNTING = 3  # reversals in the second half of a window that count as oscillation: more than a swing and back
OUT_OF_REACH = 0.1  # deadzone half widths between a setpoint pair and the nearest steady state of the plant
STATIONARY = 0.25  # deadzone half widths of mean deviation in the last quarter of a window


class Claim(msgspec.Struct, frozen=True):
    """One statement of the thesis and what the results say.

    Attributes:
        statement: the thesis, in our words.
        rule: when it counts as holding.
        value: the numbers.
        verdict: ``holds``, ``holds in part``, ``does not hold`` or ``not tested``.
    """

    statement: str
    rule: str
    value: str
    verdict: str


def claims(data: xr.Dataset, figures: xr.Dataset | None = None) -> list[Claim]:
    """The thesis's statements on the three controllers (7.1, 7.2.1), measured on these results.

    Args:
        data: results of the thesis study.
        figures: from `key_figures`, if already there.
    """
    data = completed(data)
    figures = key_figures(data) if figures is None else figures
    by_role = _roles(data)
    out = []
    smooth, rounded, integer = (by_role.get(role) for role in ("smooth", "rounded", "integer"))

    def late(name: str) -> np.ndarray:
        return figures.late_reversals.sel(controller=name).values

    def hunts(name: str) -> str:
        counts = late(name)
        return f"{int((counts >= HUNTING).sum())} of {len(counts)} windows, {int(counts.sum())} reversals"

    if smooth:
        out.append(
            Claim(
                "With a continuous choke, the continuous MPC does not oscillate",
                f"no window with {HUNTING} or more reversals in its second half",
                hunts(smooth),
                _verdict(bool((late(smooth) < HUNTING).all())),
            )
        )
    if rounded:
        oscillates = bool((late(rounded) >= HUNTING).any())
        out.append(
            Claim(
                "The same MPC on the step choke oscillates",
                f"a window with {HUNTING} or more reversals in its second half",
                hunts(rounded),
                _verdict(oscillates),
            )
        )
        total = int(late(rounded).sum())
        low = int(figures.late_reversals_near_closed.sel(controller=rounded))
        out.append(
            Claim(
                f"It oscillates mainly below {NEAR_CLOSED:.0f} % choke",
                f"more than half of these reversals below {NEAR_CLOSED:.0f} %",
                f"{low} of {total} reversals",
                _verdict(low > total / 2) if oscillates else "not tested",
            )
        )
    if integer:
        out.append(
            Claim(
                "Mixed-integer MPC does not oscillate",
                f"no window with {HUNTING} or more reversals in its second half",
                hunts(integer),
                _verdict(bool((late(integer) < HUNTING).all())),
            )
        )
    if rounded and integer:
        out.append(_deviation_claim(data, figures, rounded, integer))
        travel = [float(figures.choke_travel.sel(controller=name)) for name in (rounded, integer)]
        out.append(
            Claim(
                "Rounding moves the choke much more",
                "more than 1.5 times the travel (in part: more)",
                f"{travel[0]:.0f} % against {travel[1]:.0f} %, {travel[0] / max(travel[1], 1e-9):.1f} times",
                _verdict(travel[0] > travel[1], travel[0] > 1.5 * travel[1]),
            )
        )
    if smooth:
        out.append(_stationary_claim(data, smooth))
    out.append(_staircase_claim(data, figures))
    return out


def _deviation_claim(data: xr.Dataset, figures: xr.Dataset, rounded: str, integer: str) -> Claim:
    mean = figures.mean_absolute_deviation
    fewer = window_deviation(data, rounded) < window_deviation(data, integer)
    texts, smaller = [], []
    for cv in (GAS, OIL):
        a, b = (float(mean.sel(controller=name, cv=cv)) for name in (rounded, integer))
        windows = fewer[:, list(data.cv.values).index(cv)]
        texts.append(
            f"{_short(cv)} {a:.4g} against {b:.4g} m3/h, "
            f"less in {int(windows.sum())} of {len(windows)} windows"
        )
        smaller.append(a < b)
    return Claim(
        "Rounding deviates less in the mean than mixed-integer MPC",
        "smaller mean absolute deviation of gas and of oil (in part: of one)",
        "; ".join(texts),
        _verdict(*smaller),
    )


def _stationary_claim(data: xr.Dataset, controller: str) -> Claim:
    """Stationary deviations where the setpoints are out of reach together, on the smooth controller."""
    away = distance_to_reach(data) > OUT_OF_REACH
    off = np.abs(final_deviation(data, controller)).max(axis=1)
    stays = off > STATIONARY
    value = f"{int((stays & away).sum())} of {int(away.sum())} windows out of reach stay off"
    if (~away).any():
        value += f"; {int((~stays & ~away).sum())} of {int((~away).sum())} within reach arrive"
    return Claim(
        "Deviations stay where the plant has no steady state at both setpoints",
        f"mean deviation above {STATIONARY} deadzone half widths in the last quarter of every window out of "
        "reach, and of no other (in part: one of the two)",
        value,
        _verdict(bool(stays[away].all()), bool((~stays[~away]).all())) if away.any() else "not tested",
    )


def _staircase_claim(data: xr.Dataset, figures: xr.Dataset) -> Claim:
    limit = data.tuning_mean_move_limit.sel(mv=CHOKE).values
    mean = figures.largest_mean_opening.values
    stops, broken = figures.mean_move_stops.values, figures.openings_above_limit.values
    return Claim(
        "Under the mean-move limit the choke opens in a staircase",
        f"no opening while the mean is above {limit.max():.2f} %/sample, and pauses in the opening "
        "(every controller; in part: one of the two)",
        f"largest mean {', '.join(f'{m:.3f}' for m in mean)} %/sample; openings above the limit "
        f"{', '.join(map(str, broken))}; pauses {', '.join(map(str, stops))}",
        _verdict(bool((broken == 0).all()), bool((stops > 0).all())),
    )


def _roles(data: xr.Dataset) -> dict[str, str]:
    """Which controller plays which part, by what it is, not by what it is called."""
    parts = {
        ("continuous", "continuous"): "smooth",
        ("continuous", "step"): "rounded",
        ("mixed-integer", "step"): "integer",
    }
    out: dict[str, str] = {}
    for name, kind, actuator in zip(
        data.controller.values, data.kind.values, data.actuator.values, strict=True
    ):
        out.setdefault(parts.get((str(kind), str(actuator)), "other"), str(name))
    return out


def _verdict(*conditions: bool) -> str:
    if all(conditions):
        return "holds"
    return "holds in part" if any(conditions) else "does not hold"


def _short(cv: str) -> str:
    return cv.removesuffix("_rate")
