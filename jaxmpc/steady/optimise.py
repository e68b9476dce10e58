"""Real-time optimisation of a steady state (thesis 6.7): which CVs to ask for, and with which MVs.

The steady CVs are a function of two MVs (6.19b), given on a grid and linear over the triangles between its points.
`optimise` finds the most profitable point (6.19a) of that function inside limits of the CVs and outside forbidden bands of
the MVs, or the point closest to CVs that were demanded, as an exact mixed-integer linear programme. Its `Targets` are
setpoints for the CVs and ideal values for the MVs of a controller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmpc.check import among, is_number
from jaxmpc.errors import InputError
from jaxmpc.steady.map import SteadyMap, barycentric
from jaxmpc.steady.milp import PiecewiseMilp

Pair = tuple[float, float]
MET = 1e-7  # share of a CV's span up to which a limit counts as met and a demand as reached


@dataclasses.dataclass(frozen=True, eq=False)
class Targets:
    """A steady state to aim at, in engineering units.

    Attributes:
        status: ``optimal``: the most profitable point within the limits, or the demanded CVs; ``closest``: limits or
            demand are out of reach, and this is the point closest to them.
        feasible: whether the limits are met and the demand, if there is one, is reached.
        message: what could not be met and by how much, or that nothing was in the way.
        cv: ``"cv"``, setpoints of the CVs [CV unit].
        mv: ``"mv"``, the MVs of the map [MV unit].
        profit: (6.19a) with its sign turned [price unit per hour].
        violation: ``"cv"``, how far each CV is outside its limits [CV unit].
        deviation: ``"cv"``, CV minus demand [CV unit], NaN where nothing is demanded.
        distance: weighted sum of the absolute deviations, 0 without a demand.
        bound: proven limit of what came first: where the limits are out of reach no smaller weighted violation, else with
            a demand no smaller distance, else no larger profit.
        gap: relative gap to it.
        cv_names, mv_names: names in the order of the arrays.
    """

    status: str
    feasible: bool
    message: str
    cv: Float[np.ndarray, " cv"]
    mv: Float[np.ndarray, " mv"]
    profit: float
    violation: Float[np.ndarray, " cv"]
    deviation: Float[np.ndarray, " cv"]
    distance: float
    bound: float
    gap: float
    cv_names: tuple[str, ...]
    mv_names: tuple[str, ...]


def optimise(
    map: SteadyMap,
    prices: Mapping[str, float] | None = None,
    cv_low: Mapping[str, float | None] | Sequence[float | None] | None = None,
    cv_high: Mapping[str, float | None] | Sequence[float | None] | None = None,
    *,
    mv_ranges: Mapping[str, Sequence[Pair]] | None = None,
    mv_steps: Mapping[str, float] | None = None,
    target: Mapping[str, float] | None = None,
    weights: Mapping[str, float] | None = None,
) -> Targets:
    """The best steady state within limits.

    Without a demand the profit is maximised (6.19a), ::

        max  sum_cv price_cv Y_cv - sum_mv price_mv u_mv          (6.19a)
        s.t. Y = f(u),  cv_low <= Y <= cv_high                    (6.19b)-(6.19d)
             u_mv in one of its `mv_ranges`                       (6.19e)
             u_mv a whole number of its step in `mv_steps`

    with f linear over the triangles of the map. With a demand, sum_cv weight_cv |Y_cv - target_cv| is minimised first
    and the profit is maximised among the points that are as close. Where no point is within the CV limits, the
    weighted sum of the violations is minimised before both. MV limits are never left.

    Args:
        map: steady CVs; MVs beyond its grid are out of reach.
        prices: of each CV [per CV unit], and under the name of an MV its cost [per MV unit]; 0 where not named.
        cv_low, cv_high: limits by CV name or in CV order [CV unit]; None for no limit.
        mv_ranges: by MV name, pairs of smallest and largest value [MV unit] of which one holds: a single pair is a range,
            two leave a forbidden band between them, and ``(0, 0)`` allows off; the grid of the map where not named.
        mv_steps: by MV name, the step on whose whole multiples the MV stands [MV unit]; any value where not named.
        target: demanded CVs by name [CV unit], some or all.
        weights: of deviations and violations by CV name [1/CV unit]; 1 over the CV's span in the map where not named.

    Returns:
        `Targets`; where limits or demand are out of reach they say so and are the closest point there is.

    Raises:
        InputError: naming the field, for unknown names, numbers that are not finite, crossed limits, or MV ranges and
            steps that leave nothing of the map.
    """
    names, mv_names = map.cv_names, map.mv_names
    price = _named("prices", prices, (*names, *mv_names), "price per unit")
    low, high = _limits(map, cv_low, cv_high)
    ranges, steps = _ranges(mv_ranges, map), _steps(mv_steps, map)
    demanded = _named("target", target, names, "CV unit")
    demand = np.array([demanded.get(name, np.nan) for name in names])
    span = np.ptp(map.values[np.unique(map.triangles)], axis=0)
    span = np.where(span > 0, span, 1.0)
    weight = _weight(weights, names, span)
    value = np.array([price.get(name, 0.0) for name in names])
    cost = np.array([price.get(name, 0.0) for name in mv_names])
    milp = PiecewiseMilp(
        map=map,
        profit=map.values @ value - map.points @ cost,
        weight=weight,
        span=span,
        low=low,
        high=high,
        demand=demand,
        ranges=ranges,
        steps=steps,
    )
    best = milp.solve()
    if best is None:
        raise InputError(
            "mv_ranges, mv_steps",
            _said(map, ranges, steps),
            f"some of the map: {_said(map, _ranges(None, map), (None, None))}, less where there is no steady state",
        )
    mv = best.mv
    shares = barycentric(map.points[map.triangles], mv)
    holds = int(
        np.argmax(shares.min(axis=1))
    )  # rounding may leave the point a hair outside of every triangle
    cv = shares[holds] @ map.values[map.triangles[holds]]
    violation = np.maximum(np.maximum(cv - high, low - cv), 0.0)
    violation[violation <= MET * span] = 0.0
    deviation = cv - demand
    deviation[np.abs(deviation) <= MET * span] = 0.0
    profit = float(value @ cv - cost @ mv)
    distance = float(np.nansum(weight * np.abs(deviation)))
    # a deviation without weight is none of anyone's business
    missed = (np.nan_to_num(deviation) != 0) & (weight > 0)
    feasible = not violation.any() and not missed.any()
    reached = {"profit": profit, "distance": distance, "violation": float(weight @ violation)}[best.goal]
    scale = max(abs(reached), MET * milp.unit[best.goal])
    return Targets(
        status="optimal" if feasible else "closest",
        feasible=feasible,
        message=_message(map, cv, violation, np.where(missed, deviation, 0.0)),
        cv=cv,
        mv=mv,
        profit=profit,
        violation=violation,
        deviation=deviation,
        distance=distance,
        bound=best.bound,
        gap=abs(best.bound - reached) / scale,
        cv_names=names,
        mv_names=mv_names,
    )


def _message(map: SteadyMap, cv, violation, deviation) -> str:
    """What is out of reach, in words."""
    parts = []
    for i, (name, unit) in enumerate(zip(map.cv_names, map.cv_units, strict=True)):
        if violation[i]:
            parts.append(f"{name} {cv[i]:.6g} {unit} is {violation[i]:.4g} {unit} outside its limits")
        if deviation[i]:
            side = "above" if deviation[i] > 0 else "below"
            parts.append(f"{name} {cv[i]:.6g} {unit} is {abs(deviation[i]):.4g} {unit} {side} the demand")
    return "Within all limits." if not parts else "Out of reach: " + "; ".join(parts) + "."


def _named(path: str, given, names: tuple[str, ...], unit: str) -> dict[str, float]:
    """A mapping from some of the names to finite numbers."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(path, given, f"a mapping from name to number [{unit}]")
    for name, value in given.items():
        among(f"{path}.{name}", name, names, "one of the names", value)
        if not is_number(value):
            raise InputError(f"{path}.{name}", value, f"a finite number [{unit}]")
    return {name: float(value) for name, value in given.items()}


def _weight(given, names: tuple[str, ...], span: np.ndarray) -> np.ndarray:
    """In CV order, 1 over the span where not named."""
    named = _named("weights", given, names, "1/CV unit")
    weight = np.array([named.get(name, 1.0 / s) for name, s in zip(names, span, strict=True)])
    if (weight < 0).any() or not (weight > 0).any():
        raise InputError("weights", given, "0 or more [1/CV unit], not all of them 0")
    return weight


def _limits(map: SteadyMap, cv_low, cv_high) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limits in CV order, infinite where there are none."""
    low, high = _limit("cv_low", cv_low, map, -np.inf), _limit("cv_high", cv_high, map, np.inf)
    for name, unit, least, most in zip(map.cv_names, map.cv_units, low, high, strict=True):
        if least > most:
            expected = f"at most cv_high.{name} = {float(most)!r} [{unit}]"
            raise InputError(f"cv_low.{name}", float(least), expected)
    return low, high


def _limit(path: str, given, map: SteadyMap, infinite: float) -> np.ndarray:
    """Limits on one side."""
    names = map.cv_names
    if given is None:
        given = {}
    if not isinstance(given, Mapping):
        listed = list(np.atleast_1d(np.asarray(given, dtype=object)))
        if len(listed) != len(names):
            raise InputError(path, listed, f"{len(names)} numbers for {', '.join(names)}, None for no limit")
        given = dict(zip(names, listed, strict=True))
    none = lambda v: v is None or (isinstance(v, (int, float, np.number)) and float(v) == infinite)  # noqa: E731
    present = {name: value for name, value in given.items() if not none(value)}
    units = dict(zip(names, map.cv_units, strict=True))
    for name, value in present.items():
        if name in units and not is_number(value):
            raise InputError(f"{path}.{name}", value, f"a number [{units[name]}], None for no limit")
    found = _named(path, present, names, "CV unit")
    return np.array([found.get(name, infinite) for name in names])


def _ranges(given, map: SteadyMap) -> list[list[Pair]]:
    """The allowed ranges per MV in rising order."""
    listed_by = _by_mv(
        "mv_ranges", given, map, "a mapping from MV name to pairs of smallest and largest value"
    )
    out = []
    for (name, grid), unit in zip(map.grid.items(), map.mv_units, strict=True):
        path, listed = f"mv_ranges.{name}", listed_by.get(name, [(grid[0], grid[-1])])
        try:
            pairs = list(listed)
        except TypeError:
            pairs = []
        if not pairs:
            raise InputError(path, listed, f"one or more pairs of smallest and largest value [{unit}]")
        out.append(sorted(_pair(f"{path}[{i}]", pair, unit) for i, pair in enumerate(pairs)))
    return out


def _pair(path: str, given, unit: str) -> Pair:
    try:
        least, most = given
    except (TypeError, ValueError):
        raise InputError(path, given, f"a pair of smallest and largest value [{unit}]") from None
    if not (is_number(least) and is_number(most) and least <= most):
        raise InputError(path, given, f"two finite numbers, the smaller one first [{unit}]")
    return float(least), float(most)


def _steps(given, map: SteadyMap) -> list[float | None]:
    """The step per MV."""
    steps = _by_mv("mv_steps", given, map, "a mapping from MV name to step")
    for name, unit in zip(map.mv_names, map.mv_units, strict=True):
        if name in steps and not (is_number(steps[name]) and steps[name] > 0):
            raise InputError(f"mv_steps.{name}", steps[name], f"a positive step [{unit}]")
    return [float(steps[name]) if name in steps else None for name in map.mv_names]


def _by_mv(path: str, given, map: SteadyMap, expected: str) -> Mapping[str, Any]:
    """What is given by the names of MVs."""
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise InputError(path, given, expected)
    for name, value in given.items():
        among(f"{path}.{name}", name, map.mv_names, "one of the names", value)
    return given


def _said(map: SteadyMap, ranges, steps) -> str:
    """Ranges and steps of the MVs in words."""
    parts = []
    for name, unit, own, step in zip(map.mv_names, map.mv_units, ranges, steps, strict=True):
        pairs = " or ".join(
            f"{least:g}" if least == most else f"{least:g} to {most:g}" for least, most in own
        )
        parts.append(
            f"{name} {pairs} {unit}" + ("" if step is None else f" on whole steps of {step:g} {unit}")
        )
    return ", ".join(parts)
