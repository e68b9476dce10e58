"""Rows on two events: fine regulation of the oil rate (7.2.4) and a drop of the reservoir pressure (7.2.5)."""

from __future__ import annotations

import numpy as np
import xarray as xr

from studies.definition.presets import CHOKE, LIFT, OIL
from studies.kpi.loop import moves_of, travel
from studies.store.comparison import provenance
from studies.thesis.claims.record import (
    LATE,
    SETTLED,
    STATIONARY,
    Evidence,
    Finding,
    Row,
    both,
    index,
    late,
    late_deviation,
)
from studies.thesis.claims.why import compromise, exchange, price_of_a_step

PRECISE = 0.1  # half widths of deviation that count as none
REST = 10.0  # m3/h, changes of the lift below that are rest


# ------------------------------------------------------------------------------------------------ fine regulation


def _retuned(evidence: Evidence) -> tuple[xr.Dataset, xr.Dataset]:
    """The run before and after its weights change."""
    data = evidence.data
    definition = provenance(data, "definition")
    name = evidence.roles["integer"]
    known = next(one for one in definition["controllers"] if one["name"] == name)
    before = data.time.values < known["then"][0]["at"]
    run = evidence.run("integer")
    return run.isel(time=np.flatnonzero(before)), run.isel(time=np.flatnonzero(~before))


def _drift(run: xr.Dataset) -> float:
    """Last minus first lift of the last `LATE` seconds [m3/h]."""
    lift = late(run).position.sel(mv=LIFT).values
    return float(lift[-1] - lift[0])


def _choke_travel(run: xr.Dataset) -> float:
    position = run.position.sel(mv=CHOKE).values
    return float(travel(moves_of(position, position[0])))


def _both_stand(evidence: Evidence) -> Finding:
    before, _ = _retuned(evidence)
    off = late_deviation(before)
    return Finding(
        f"{both(off, before.cv.values, '+.1f')}",
        tuple(bool(away > STATIONARY) for away in np.abs(off) / evidence.half("integer")),
        f"{compromise(before, off)}; {exchange(before)}",
    )


def _inputs_rest(evidence: Evidence) -> Finding:
    before, _ = _retuned(evidence)
    end = late(before)
    moved, lift = _choke_travel(end), _drift(before)
    return Finding(
        f"choke travel {moved:g} %, lift {lift:+.1f} m3/h in {LATE:.0f} s",
        (moved == 0, abs(lift) <= REST),
        "the choke has not come to rest" if moved else "the lift has not come to rest yet",
    )


def _oil_arrives(evidence: Evidence) -> Finding:
    _, after = _retuned(evidence)
    off, half = late_deviation(after), evidence.half("integer")
    oil = index(after, OIL)
    earlier = after.isel(time=slice(None, -int(LATE / float(after.attrs["dt"]))))
    return Finding(
        f"{both(off, after.cv.values, '+.2f')} off at the end",
        (bool(abs(off[oil]) <= STATIONARY * half[oil]), bool(abs(off[oil]) <= PRECISE * half[oil])),
        f"it is still on its way, {late_deviation(earlier)[oil]:+.2f} m3/h the {LATE:.0f} s before: the lift takes "
        f"{_drift(after):+.1f} m3/h in {LATE:.0f} s, held back by its move weight",
    )


def _lift_works(evidence: Evidence) -> Finding:
    before, after = _retuned(evidence)
    moved = _choke_travel(after)
    lift = float(after.position.sel(mv=LIFT).values[-1] - before.position.sel(mv=LIFT).values[-1])
    return Finding(
        f"choke travel {moved:g} %, lift {lift:+.0f} m3/h",
        (moved == 0, abs(lift) > REST),
        "the choke moves as well" if moved else "the lift hardly moves",
    )


# ------------------------------------------------------------------------------------------------ disturbance


def _disturbed(evidence: Evidence) -> tuple[xr.Dataset, xr.Dataset]:
    """The run before and after the reservoir pressure leaves its nominal value."""
    run = evidence.run("integer")
    k = int(np.flatnonzero(evidence.data.disturbance.values != 0)[0])
    return run.isel(time=slice(0, k)), run.isel(time=slice(k, None))


def _lift_answers(evidence: Evidence) -> Finding:
    before, after = _disturbed(evidence)
    lift = [float(late(run).position.sel(mv=LIFT).mean()) for run in (before, after)]
    moved = _choke_travel(after)
    return Finding(
        f"lift from {lift[0]:.0f} to {lift[1]:.0f} m3/h, choke travel {moved:g} %",
        (lift[1] > lift[0] + REST,),
        "the controller answers otherwise",
    )


def _oil_returns(evidence: Evidence) -> Finding:
    _, after = _disturbed(evidence)
    off, half = late_deviation(after), evidence.half("integer")
    oil = index(after, OIL)
    lowest = float((after.measurement - after.setpoint).values[:, oil].min())
    saved, price = price_of_a_step(late(after), off)
    return Finding(
        f"oil {lowest:+.1f} m3/h at its lowest, {both(off, after.cv.values, '+.1f')} at the end",
        (bool(abs(off[oil]) < abs(lowest) / 2), bool(abs(off[oil]) <= STATIONARY * half[oil])),
        f"the loop has settled there (lift {_drift(after):+.1f} m3/h in the last {LATE:.0f} s): {compromise(after, off)}; "
        f"{exchange(after)}. A step of the choke would save {max(saved, 0.0):.0f} over the horizon and costs {price:.0f}",
    )


INTEGER = ("integer",)

ROWS = (
    Row(
        "both-stand-off",
        "7.2.4",
        "Two setpoints that are out of reach together leave both rates off them",
        f"{SETTLED} before the gas weights become zero",
        f"more than {STATIONARY} half widths, oil and gas (in part: one)",
        "fine-regulation",
        ("29",),
        INTEGER,
        _both_stand,
    ),
    Row(
        "inputs-rest",
        "7.2.4",
        "Choke and lift rest meanwhile, at a stationary point",
        f"choke travel and change of the lift in the last {LATE:.0f} s before the gas weights become zero",
        f"no choke move, and at most {REST:g} m3/h of lift (in part: one of the two)",
        "fine-regulation",
        ("30",),
        INTEGER,
        _inputs_rest,
    ),
    Row(
        "oil-arrives",
        "7.2.4",
        "Without gas weights the oil rate meets its setpoint",
        f"{SETTLED}, with Q, S and s of gas zero",
        f"oil up to {PRECISE} half widths (in part: up to {STATIONARY})",
        "fine-regulation",
        ("29",),
        INTEGER,
        _oil_arrives,
    ),
    Row(
        "lift-works",
        "7.2.4",
        "The lift does that work while the choke rests",
        "choke travel and change of the lift from then on",
        f"no choke move, and more than {REST:g} m3/h of lift (in part: one of the two)",
        "fine-regulation",
        ("30",),
        INTEGER,
        _lift_works,
    ),
    Row(
        "lift-answers",
        "7.2.5",
        "A drop of the reservoir pressure is met with more lift",
        f"mean lift of the last {LATE:.0f} s before the drop and at the end",
        f"more than {REST:g} m3/h more",
        "disturbance",
        ("32", "33"),
        INTEGER,
        _lift_answers,
    ),
    Row(
        "oil-returns",
        "7.2.5",
        "That brings the oil rate back to its setpoint",
        f"{SETTLED}, and the lowest y - r after the drop",
        f"oil up to {STATIONARY} half widths (in part: less than half of the lowest)",
        "disturbance",
        ("31",),
        INTEGER,
        _oil_returns,
    ),
)
