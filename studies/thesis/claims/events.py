"""Measures of two events: fine regulation of the oil rate (7.2.4) and a drop of the reservoir pressure (7.2.5)."""

from __future__ import annotations

import numpy as np

from studies.store.reading import provenance
from studies.thesis.claims.limits import LATE, PRECISE, REST, STATIONARY
from studies.thesis.claims.record import (
    Evidence,
    Finding,
    Run,
    choke_travel,
    index,
    late,
    late_deviation,
    name_of,
)
from studies.thesis.claims.why import compromise, exchange, price_of_a_step
from studies.thesis.well import LIFT, OIL


def _lift(run: Run) -> np.ndarray:
    return run.position.sel(mv=LIFT).values


def _drift(run: Run) -> float:
    """Last minus first lift of the last `LATE` seconds [m3/h]."""
    lift = _lift(late(run))
    return float(lift[-1] - lift[0])


# ------------------------------------------------------------------------------------------------ fine regulation


def _retuned(evidence: Evidence, run: Run) -> tuple[Run, Run]:
    """The run before and after its weights change."""
    controllers = provenance(evidence.data, "definition")["controllers"]
    known = next(one for one in controllers if one["name"] == name_of(run))
    before = run.time.values < known["then"][0]["at"]
    return run.isel(time=np.flatnonzero(before)), run.isel(time=np.flatnonzero(~before))


def both_stand(evidence: Evidence, run: Run) -> Finding:
    """Both rates stay off setpoints that are out of reach together."""
    before, _ = _retuned(evidence, run)
    off = late_deviation(before)
    numbers = {"off": evidence.rates(off), "pulls": compromise(before, off), "worth": exchange(before)}
    return Finding(tuple(np.abs(off) / run.tuning_deadzone.values > STATIONARY), numbers)


def inputs_rest(evidence: Evidence, run: Run) -> Finding:
    """Choke and lift have come to rest by then."""
    before, _ = _retuned(evidence, run)
    moved, lift = choke_travel(late(before)), _drift(before)
    why = "choke" if moved else "lift"
    return Finding((moved == 0, abs(lift) <= REST), {"moved": moved, "lift": lift}, why)


def oil_arrives(evidence: Evidence, run: Run) -> Finding:
    """The oil rate meets its setpoint when the gas rate counts no more."""
    _, after = _retuned(evidence, run)
    off, half, oil = late_deviation(after), run.tuning_deadzone.values, index(after, OIL)
    earlier = after.isel(time=slice(None, -int(LATE / float(after.attrs["dt"]))))
    return Finding(
        (abs(off[oil]) <= STATIONARY * half[oil], abs(off[oil]) <= PRECISE * half[oil]),
        {"off": evidence.rates(off), "earlier": late_deviation(earlier)[oil], "drift": _drift(after)},
    )


def lift_works(evidence: Evidence, run: Run) -> Finding:
    """The lift does that work, not the choke."""
    before, after = _retuned(evidence, run)
    moved, lift = choke_travel(after), _lift(after)[-1] - _lift(before)[-1]
    why = "choke" if moved else "lift"
    return Finding((moved == 0, abs(lift) > REST), {"moved": moved, "lift": lift}, why)


# ------------------------------------------------------------------------------------------------ disturbance


def _disturbed(run: Run) -> tuple[Run, Run]:
    """The run before and after the reservoir pressure leaves its nominal value."""
    k = int(np.flatnonzero(run.disturbance.values != 0)[0])
    return run.isel(time=slice(0, k)), run.isel(time=slice(k, None))


def lift_answers(evidence: Evidence, run: Run) -> Finding:
    """A pressure drop is met with more lift."""
    runs = _disturbed(run)
    before, after = (float(late(run).position.sel(mv=LIFT).mean()) for run in runs)
    return Finding(
        (after > before + REST,), {"before": before, "after": after, "moved": choke_travel(runs[1])}
    )


def oil_returns(evidence: Evidence, run: Run) -> Finding:
    """The oil rate comes back to its setpoint."""
    _, after = _disturbed(run)
    off, half, oil = late_deviation(after), run.tuning_deadzone.values, index(after, OIL)
    lowest = float((after.measurement - after.setpoint).values[:, oil].min())
    saved, price = price_of_a_step(late(after), off)
    numbers = {"lowest": lowest, "off": evidence.rates(off), "drift": _drift(after), "price": price}
    numbers |= {"pulls": compromise(after, off), "worth": exchange(after), "saved": max(saved, 0.0)}
    return Finding((abs(off[oil]) < abs(lowest) / 2, abs(off[oil]) <= STATIONARY * half[oil]), numbers)
