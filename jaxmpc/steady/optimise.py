"""Real-time optimisation of the well's steady state (thesis 6.7): which rates to ask for, and with which choke and lift.

The steady rates are a function of choke and lift (6.19b), given on a grid and linear over the triangles between its
points. `optimise` finds the most profitable point (6.19a) of that function inside limits of the rates and outside a
forbidden band of the lift, or the point closest to rates that were demanded, as an exact mixed-integer linear
programme. Its `Targets` are setpoints for the CVs and, by `jaxmpc.controller.targets`, for the MVs of a controller.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxmpc.check import is_number
from jaxmpc.errors import InputError
from jaxmpc.steady.map import SteadyMap, barycentric
from jaxmpc.steady.milp import PiecewiseMilp

LIFT_RANGES = ((0.0, 0.0), (2000.0, 10_000.0))  # m3/h: no lift, or enough of it not to slug (thesis 6.7.1)
MET = 1e-7  # share of a CV's span up to which a limit counts as met and a demand as reached


@dataclasses.dataclass(frozen=True, eq=False)
class Targets:
    """A steady state to aim at, in engineering units.

    Attributes:
        status: ``optimal``: the most profitable point within the limits, or the demanded rates; ``closest``: limits or
            demand are out of reach, and this is the point closest to them.
        feasible: whether the limits are met and the demand, if there is one, is reached.
        message: what could not be met and by how much, or that nothing was in the way.
        cv: ``"cv"``, setpoints of the CVs [CV unit].
        mv: ``"mv"``, choke [%] and lift [m3/h].
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
    lift_ranges: Sequence[tuple[float, float]] = LIFT_RANGES,
    choke: tuple[float, float] = (0.0, 100.0),
    choke_step: float | None = None,
    target: Mapping[str, float] | None = None,
    weights: Mapping[str, float] | None = None,
) -> Targets:
    """The best steady state within limits.

    Without a demand the profit is maximised (6.19a), ::

        max  sum_cv price_cv Y_cv - price_lift u_lift                     (6.19a)
        s.t. Y = f(u_choke, u_lift),  cv_low <= Y <= cv_high              (6.19b)-(6.19d)
             u_lift in one of `lift_ranges`                               (6.19e)
             u_choke in the range `choke`, and a whole number of `choke_step` if given

    with f linear over the triangles of the map. With a demand, sum_cv weight_cv |Y_cv - target_cv| is minimised first
    and the profit is maximised among the points that are as close. Where no point is within the CV limits, the
    weighted sum of the violations is minimised before both. MV limits are never left.

    Args:
        map: steady CVs; choke and lift beyond its grid are out of reach.
        prices: per m3 of each CV, and under the name of the lift the cost per m3 of lift gas; 0 where not named.
        cv_low, cv_high: limits by CV name or in CV order [CV unit]; None for no limit.
        lift_ranges: pairs of smallest and largest lift [m3/h]; ``(0, 0)`` allows no lift.
        choke: smallest and largest position [%].
        choke_step: the choke stands on whole multiples of it [%]; None for any position.
        target: demanded CVs by name [CV unit], some or all.
        weights: of deviations and violations by CV name [1/CV unit]; 1 over the CV's span in the map where not named.

    Returns:
        `Targets`; where limits or demand are out of reach they say so and are the closest point there is.

    Raises:
        InputError: naming the field, for unknown names, numbers that are not finite, crossed limits, or lift and choke
            limits that leave nothing of the map.
    """
    names, lift_name = map.cv_names, map.mv_names[1]
    price = _named("prices", prices, (*names, lift_name), "price per m3")
    low = _limits("cv_low", cv_low, map, -np.inf)
    high = _limits("cv_high", cv_high, map, np.inf)
    for name, unit, least, most in zip(names, map.cv_units, low, high, strict=True):
        if least > most:
            raise InputError(
                f"cv_low.{name}", float(least), f"at most cv_high.{name} = {float(most)!r} [{unit}]"
            )
    ranges = _ranges(lift_ranges)
    choke_low, choke_high = _pair("choke", choke, "%")
    if choke_step is not None and not (is_number(choke_step) and choke_step > 0):
        raise InputError("choke_step", choke_step, "a positive step [%], or None for any position")
    demanded = _named("target", target, names, "CV unit")
    demand = np.array([demanded.get(name, np.nan) for name in names])
    span = np.ptp(map.values[np.unique(map.triangles)], axis=0)
    span = np.where(span > 0, span, 1.0)
    weighed = _named("weights", weights, names, "1/CV unit")
    weight = np.array([weighed.get(name, 1.0 / s) for name, s in zip(names, span, strict=True)])
    if (weight < 0).any() or not (weight > 0).any():
        raise InputError("weights", weights, "0 or more [1/CV unit], not all of them 0")

    value = np.array([price.get(name, 0.0) for name in names])
    cost_of_lift = price.get(lift_name, 0.0)
    milp = PiecewiseMilp(
        map=map,
        profit=map.values @ value - cost_of_lift * map.points[:, 1],
        weight=weight,
        span=span,
        low=low,
        high=high,
        demand=demand,
        lift_ranges=ranges,
        choke=(choke_low, choke_high),
        choke_step=choke_step,
    )
    best = milp.solve()
    if best is None:
        step = "" if choke_step is None else f" on whole steps of {choke_step:g} %"
        raise InputError(
            "lift_ranges, choke",
            f"{[list(r) for r in ranges]} m3/h, {choke_low:g} to {choke_high:g} %{step}",
            f"some of the map: lift {map.lift[0]:g} to {map.lift[-1]:g} m3/h, choke {map.choke[0]:g} to "
            f"{map.choke[-1]:g} %, less where there is no steady state",
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
    profit = float(value @ cv - cost_of_lift * mv[1])
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
        mv_names=map.mv_names,
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
        if name not in names:
            raise InputError(f"{path}.{name}", value, f"one of the names {', '.join(names)}")
        if not is_number(value):
            raise InputError(f"{path}.{name}", value, f"a finite number [{unit}]")
    return {name: float(value) for name, value in given.items()}


def _limits(path: str, given, map: SteadyMap, infinite: float) -> np.ndarray:
    """Limits in CV order, infinite where there are none."""
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


def _pair(path: str, given, unit: str) -> tuple[float, float]:
    try:
        least, most = given
    except (TypeError, ValueError):
        raise InputError(path, given, f"a pair of smallest and largest value [{unit}]") from None
    if not (is_number(least) and is_number(most) and least <= most):
        raise InputError(path, given, f"two finite numbers, the smaller one first [{unit}]")
    return float(least), float(most)


def _ranges(given) -> list[tuple[float, float]]:
    """The lift ranges in rising order."""
    try:
        pairs = list(given)
    except TypeError:
        pairs = []
    if not pairs:
        raise InputError("lift_ranges", given, "one or more pairs of smallest and largest lift [m3/h]")
    return sorted(_pair(f"lift_ranges[{i}]", pair, "m3/h") for i, pair in enumerate(pairs))
