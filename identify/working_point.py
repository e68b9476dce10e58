"""Plants at a working point, whatever their kind: names and units, values by name, and the start of a run there.

`identify.step_test`, `identify.sweep` and `identify.schedule` call it. A plant need not have more than `init` and `step`;
of the following, what it has is used.

- `signals`: names and units of its CVs, MVs and disturbances, as `jaxmpc.process.plant.Signals`.
- ``steady(mv)``: the steady state of held MVs, as `jaxmpc.process.plant.Steady`. Without it a plant is held at a working
  point that is not its own until a step response would have settled.
- ``check_mv(mv)``: an `InputError` for MVs outside their range, each of them one value or an array.
- `test_steps`: step of each MV that suits a step test.
- ``facts()``: its `kind` and a `hash` of everything that decides its responses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmpc.check import as_floats
from jaxmpc.errors import InputError
from jaxmpc.process.plant import JaxPlant, Signals

Values = Mapping[str, float] | Sequence[float] | Float[np.ndarray, " mv"]


def facts_of(plant: Any) -> dict[str, Any]:
    """What a plant is: `kind`, for example ``jax`` or ``fmu``, and `hash`, empty for a plant that has no `facts`."""
    return plant.facts() if hasattr(plant, "facts") else {"kind": type(plant).__name__, "hash": ""}


def signals_of(plant: Any, given: Signals | None = None) -> Signals:
    """Names and units of the CVs and MVs of a plant, unless they are given.

    Raises:
        InputError: where neither says them.
    """
    found = getattr(plant, "signals", None) if given is None else given
    if found is None:
        expected = "the names of the CVs and MVs, which this plant does not say"
        raise InputError("signals", given, expected, "Give Signals(cv_names, mv_names, cv_units, mv_units)")
    return found


def own_start(plant: Any) -> tuple[Any, Float[np.ndarray, " mv"]]:
    """A plant at its own working point: its state, None where it keeps that itself, and its MVs there [MV unit]."""
    state = plant.init()
    outputs = plant.measure(state) if isinstance(plant, JaxPlant) else state
    return state if isinstance(plant, JaxPlant) else None, np.array(outputs.mv, dtype=np.float64)


def start(plant: Any, point: Float[np.ndarray, " mv"]) -> tuple[Any, bool]:
    """A plant in the steady state of MVs [MV unit]: its state as in `own_start`, and whether it stands there already.

    A plant that stands elsewhere has yet to be held at the working point.
    """
    state, stands = own_start(plant)
    there = np.array_equal(stands, point)
    if not there and hasattr(plant, "steady"):
        return plant.steady(point).state, True
    return state, there


def point_of(plant: Any, signals: Signals, given: Values | None) -> Float[np.ndarray, " mv"]:
    """The MVs of a working point in MV order [MV unit]; the plant's own where none is given.

    Raises:
        InputError: naming the MV, for values that are missing, not finite or outside the range of the plant.
    """
    if given is None:
        return own_start(plant)[1]
    point = in_order("working_point", given, signals)
    check_mv(plant, point)
    return point


def in_order(path: str, given: Values | None, signals: Signals) -> Float[np.ndarray, " mv"]:
    """One finite number for each MV, given by name or in MV order."""
    names = signals.mv_names
    units = units_of(signals)
    expected = f"a number for each of {', '.join(map('{} [{}]'.format, names, units))}"
    if isinstance(given, Mapping):
        if set(given) != set(names):
            raise InputError(path, dict(given), expected)
        given = [given[name] for name in names]
    values = as_floats(path, given, expected)
    if values.shape != (len(names),):
        raise InputError(path, given, expected)
    for name, unit, value in zip(names, units, values, strict=True):
        if not np.isfinite(value):
            raise InputError(f"{path}.{name}", float(value), f"a finite number [{unit}]")
    return values


def units_of(signals: Signals) -> tuple[str, ...]:
    """Units of the MVs for messages."""
    return tuple(unit or "MV unit" for unit in signals.mv_units or ("",) * len(signals.mv_names))


def check_mv(plant: Any, mv: Sequence[Any] | np.ndarray) -> None:
    """Refuse MVs, one value or an array each, that are outside the range of a plant that says it."""
    if hasattr(plant, "check_mv"):
        plant.check_mv([np.asarray(one).tolist() for one in mv])
