"""The inputs of an FMU in step tests: where they stand, and which steps they can make.

`identify.fmu_steps` makes the steps. Only values that an input can have are stepped to: within its range, whole where it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from identify.fmu_description import BITS, NUMBERS, FmuDescription, FmuVariable, Value
from jaxmpc.check import is_number
from jaxmpc.errors import InputError

WAYS = {"up": 1.0, "down": -1.0, "half up": 0.5, "half down": -0.5}  # sizes of the tests
SHARE = 0.01  # of the range of an input, or of its value: a step if none is given
FURTHER = 10.0  # times the step of the tests, where those have shown nothing
PRECISE = 0.001  # of the largest coefficient: standard error that repetitions are to reach
MOST_REPEATS = 2000
MOST_SAMPLES = 2_000_000  # simulated for the tests of one input
WIDEST = 1e12  # a range beyond says nothing


class Moved(NamedTuple):
    """An MV or DV of an FMU.

    Attributes:
        channel: its name in the model.
        variable: of the FMU.
        rest: where it stands before the steps [its unit].
        targets: by test, where it is stepped to.
    """

    channel: str
    variable: FmuVariable
    rest: float
    targets: dict[str, float]


def moved(
    description: FmuDescription,
    option: str,
    channel: str,
    name: str,
    value: Value | None,
    step: float | None,
    ways: Sequence[str] = tuple(WAYS),
) -> tuple[Moved, list[str]]:
    """An input with the steps that it can make, and what is to be said of them.

    Args:
        description: of the FMU.
        option: that names the input, for errors.
        channel: its name in the model.
        name: its name in the FMU.
        value: where it stands; its start value if None.
        step: size of its steps [its unit]; the least that makes sense if None.
        ways: tests to be made.

    Raises:
        InputError: naming option and input, for a variable that cannot be moved, a value that it cannot have, or a step that
            it can make in no direction.
    """
    found, field = description.variable(option, name), f"{option} {name}"
    if not found.movable or found.type not in NUMBERS:
        what = f"{found.type}, {found.variability} {found.causality}"
        raise InputError(
            option, name, f"an input or a tunable parameter that holds a number (this is {what})"
        )
    rest = found.number if value is None else float(found.exactly(field, value))
    if rest is None:
        raise InputError(field, "no value", f"{found.expected}: the FMU has no start value")
    if found.nearest(rest) != rest:
        raise InputError(field, rest, found.expected, "That is its start value; give another")
    if step is not None and not (is_number(step) and step != 0):
        raise InputError(field, step, "a step that is not zero")
    targets, notes = _targets(found, rest, None if step is None else abs(step), ways)
    if not {"up", "down"} & set(targets):
        expected = f"a step to {found.expected}, from {rest:g} up or down"
        raise InputError(field, "no step" if step is None else step, expected)
    for way, other in (("up", "down"), ("down", "up")):
        if way not in targets:
            notes.append(
                f"{channel} can be stepped {other} only from {rest:g}: the model is that of steps {other}"
            )
    return Moved(channel, found, rest, targets), notes


def _targets(
    v: FmuVariable, rest: float, size: float | None, ways: Sequence[str]
) -> tuple[dict[str, float], list[str]]:
    """By test, where an input is stepped to: values that it can have."""
    if v.type == "Enumeration" and size is None:
        above = [value for value in v.items.values() if value > rest]
        below = [value for value in v.items.values() if value < rest]
        nearest = {"up": min(above, default=None), "down": max(below, default=None)}
        return {way: float(to) for way, to in nearest.items() if to is not None}, []
    notes = []
    if size is None:
        size = _size(v, rest)
        if not size:
            size = 1.0
            notes.append(f"steps of {v.name} are of 1: it stands at 0 and declares no range; give a size")
    targets = {}
    for way in ways:
        wanted = rest + WAYS[way] * size
        to = float(v.nearest(wanted))
        if abs(to - wanted) <= 1e-9 * size and to != rest:
            targets[way] = to
    return targets, notes


def _size(v: FmuVariable, rest: float) -> float:
    """Of a step that is not given; 0 where nothing says it."""
    if v.type == "Boolean":
        return 1.0
    low, high = v.limits
    bounded = v.low is not None and v.high is not None and high - low < WIDEST
    size = SHARE * ((high - low) if bounded else abs(rest))
    return max(1.0, math.floor(size)) if v.type in BITS else size


def further(one: Moved) -> float | None:
    """Where a step ten times as large goes, within the range of an input; None if no further than the tests."""
    tested = max(abs(to - one.rest) for to in one.targets.values())
    ends = (float(one.variable.nearest(one.rest + sign * FURTHER * tested)) for sign in (1, -1))
    return next((to for to in ends if abs(to - one.rest) > 1.5 * tested), None)


def error_of(one: Moved) -> float:
    """Standard error of a coefficient from runs with noise of 1 [per input unit]."""
    shares = [1 / (one.targets[way] - one.rest) for way in ("up", "down") if way in one.targets]
    return math.hypot(*shares, sum(shares)) / len(shares)  # of the tests, and of the run without steps


def repeats(one: Moved, total: Mapping[str, Any], base: Any, noise: Any, samples: int, before: float) -> int:
    """How often a test is made, so that the mean of the noise is small beside the responses.

    Args:
        one: input that is stepped.
        total: a run of each of its tests, ``"sample cv"`` [CV unit].
        base: the mean without steps.
        noise: standard deviations, by CV.
        samples: of a response.
        before: simulated before a step [samples].
    """
    smooth = max(samples // 10, 1)
    kernel = np.ones(smooth) / smooth
    need = 1.0
    for i in np.flatnonzero(noise):
        ways = [way for way in ("up", "down") if way in one.targets]
        changes = [np.abs(np.convolve((total[w] - base)[1:, i], kernel, "valid")).max() for w in ways]
        peak, error = max(changes), noise[i] * error_of(one) * abs(one.targets[ways[0]] - one.rest)
        if peak > 5 * noise[i] / math.sqrt(smooth):
            need = max(need, (error / (PRECISE * peak)) ** 2)
    cost = len(one.targets) * (samples + before)
    return int(min(math.ceil(need), MOST_REPEATS, max(MOST_SAMPLES / cost, 2)))


def scatter(runs: Mapping[str, Any]) -> Any:
    """Standard deviation of the noise, by CV, where runs ``"run sample cv"`` of a test differ most in time."""
    found = []
    for own in (own for own in runs.values() if len(own) > 3):
        wide = max(own.shape[1] // 4, 1)
        means = np.add.reduceat(own.var(axis=0, ddof=1), np.arange(0, own.shape[1] - wide + 1, wide)) / wide
        found.append(np.sqrt(means[:-1] if len(means) > 1 else means).max(axis=0))
    return np.max(found, axis=0) if found else 0.0


def actuator_of(v: FmuVariable) -> dict[str, Any] | None:
    """How an MV of this type moves, in the words of a process file."""
    if v.type == "Boolean":
        return {"kind": "on-off"}
    if v.type == "Enumeration":
        return {"kind": "values", "values": sorted(v.items.values())}
    return {"kind": "stepped", "step": 1.0} if v.type in BITS else None
