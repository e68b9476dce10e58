"""Step responses from noisy data whose truth is known, and from published data: ours beside FIR and ARX models of SIPPY."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter

from identify.logged.fit import chosen, fitted, make_data
from identify.logged.identify import HELD_OUT
from jaxmpc.model.transfer_function import TransferFunction
from studies.bench.context import Context
from studies.bench.rows import Row
from studies.bench.sections.published import Method, compared, published

LENGTH, COUNT = 60, 1200  # N; samples of 1 min
ORDER = 4  # of ARX
WOOD_BERRY = (  # Wood & Berry 1973: the top of a methanol column by reflux and steam, in minutes
    TransferFunction(12.8, (16.7,), 1.0),
    TransferFunction(-18.9, (21.0,), 3.0),
)
Signals = Float[np.ndarray, "sample input"]


def identification(context: Context) -> Iterator[Row]:
    """Rows ``identification, DATA: METHOD``; the error is of the worst coefficient over the largest of its response."""
    installed = importlib.util.find_spec("sippy_unipi") is not None
    methods = {name: method if installed or method is _kernel else None for name, method in METHODS.items()}
    for kind in ("Wood-Berry, drift", "random, white noise", "random, drift"):
        logs = [_log(kind, seed) for seed in range(context.size.identified)]
        context.say(f"identification, {kind}")

        def judged(found: list[np.ndarray], logs=logs):
            errors = [
                float((np.abs(steps - truth).max(axis=1) / np.abs(truth).max(axis=1)).max())
                for steps, (truth, _, _) in zip(found, logs, strict=True)
            ]
            note = (
                f"error of the worst coefficient, median {np.median(errors):.2g}; {COUNT} samples, N {LENGTH}"
            )
            return errors, note

        yield from compared(kind, methods, [(y, u) for _, y, u in logs], LENGTH, judged)
    yield from published(context, methods)


def _log(kind: str, seed: int) -> tuple[Float[np.ndarray, "input n"], Float[np.ndarray, " sample"], Signals]:
    """True responses, a CV with noise of a fifth of its size, and two inputs."""
    rng = np.random.default_rng(seed)
    functions = WOOD_BERRY if kind.startswith("Wood") else [_random(rng) for _ in range(2)]
    u = np.stack([np.repeat(rng.normal(size=COUNT // hold + 1), hold)[:COUNT] for hold in (15, 22)], axis=1)
    steps = np.array([function.step_response(np.arange(1.0, COUNT + 1)) for function in functions])
    impulse = np.diff(steps, prepend=0.0, axis=1)
    y = sum(np.convolve(np.append(0.0, s - s[0]), g)[:COUNT] for s, g in zip(u.T, impulse, strict=True))
    size = 0.2 * np.std(y)
    noise = size * rng.normal(size=COUNT)
    if kind.endswith("drift"):
        noise = 0.5 * noise + 0.1 * size * rng.normal(size=COUNT).cumsum()
    return steps[:, :LENGTH], y + noise, u


def _random(rng: np.random.Generator) -> TransferFunction:
    """Stable, second order, with dead time and a zero that may be on the wrong side."""
    constants = tuple(rng.uniform(1.0, 8.0, 2))
    return TransferFunction(
        rng.uniform(0.5, 2.0), constants, float(rng.integers(0, 8)), rng.uniform(-4.0, 4.0)
    )


def _kernel(y: np.ndarray, u: Signals, length: int) -> Float[np.ndarray, "input n"]:
    data = make_data(y, u, [slice(0, len(y))])
    trained, _ = chosen(data, length, round((1 - HELD_OUT) * len(y)))
    return fitted(data, length, trained, 30).steps(data)


def _sippy(kind: Literal["FIR", "ARX"]) -> Method:
    """Least squares by SIPPY: of a finite impulse response, or of an ARX model whose lags cover dead times up to 8."""

    def method(y: np.ndarray, u: Signals, length: int) -> Float[np.ndarray, "input n"]:
        identify = importlib.import_module("sippy_unipi").system_identification
        orders: dict[str, Any] = {"FIR_orders": [length, 0], "ARX_orders": [ORDER, ORDER + 8, 0]}
        signals = (y - y.mean())[None], (u - u.mean(axis=0)).T
        found = identify(*signals, kind, **{f"{kind}_orders": orders[f"{kind}_orders"]})
        pulse = np.eye(1, length + 1)[0]
        of_inputs = zip(found.NUMERATOR[0], found.DENOMINATOR[0], strict=True)
        responses = [lfilter([0.0, *numerator], denominator, pulse) for numerator, denominator in of_inputs]
        return np.cumsum(responses, axis=1)[:, 1:]

    return method


METHODS: dict[str, Method] = {"jaxmpc": _kernel, "SIPPY, FIR": _sippy("FIR"), "SIPPY, ARX": _sippy("ARX")}
