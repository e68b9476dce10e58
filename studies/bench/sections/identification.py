"""Step responses from noisy data whose truth is known: ours beside ordinary least squares of FIR and ARX models."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from identify.logged.fit import make_data, search
from jaxmpc.model.transfer_function import TransferFunction
from studies.bench.context import Context
from studies.bench.rows import Row, timed

LENGTH, COUNT = 60, 1200  # N; samples of 1 min
ORDER = 4  # of ARX
WOOD_BERRY = (  # Wood & Berry 1973: the top of a methanol column by reflux and steam, in minutes
    TransferFunction(12.8, (16.7,), 1.0),
    TransferFunction(-18.9, (21.0,), 3.0),
)
Signals = Float[np.ndarray, "sample input"]
Method = Callable[[Float[np.ndarray, " sample"], Signals], Float[np.ndarray, "input n"]]


def identification(context: Context) -> Iterator[Row]:
    """Rows ``identification, DATA: METHOD``; the error is of the worst coefficient over the largest of its response."""
    for kind in ("Wood-Berry, drift", "random, white noise", "random, drift"):
        logs = [_log(kind, seed) for seed in range(context.size.identified)]
        context.say(f"identification, {kind}")
        for name, method in METHODS.items():
            times, errors = [], []
            for truth, y, u in logs:
                begin = time.perf_counter()
                found = method(y, u)
                times.append(time.perf_counter() - begin)
                errors.append(float((np.abs(found - truth).max(axis=1) / np.abs(truth).max(axis=1)).max()))
            note = (
                f"error of the worst coefficient, median {np.median(errors):.2g}; {COUNT} samples, N {LENGTH}"
            )
            yield timed(f"identification, {kind}: {name}", times, errors, solved=None, counts=True, note=note)


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


def _kernel(y: np.ndarray, u: Signals) -> Float[np.ndarray, "input n"]:
    data = make_data(y, u, [slice(0, COUNT)])
    return search(data, LENGTH).steps(data)


def _past(signals: np.ndarray, lags: int) -> np.ndarray:
    """Columns of the last `lags` values of each signal, those before the first one held."""
    at = np.maximum(np.arange(len(signals))[:, None] - np.arange(1, lags + 1), 0)
    return np.concatenate([column[at] for column in signals.T], axis=1)


def _finite(y: np.ndarray, u: Signals) -> Float[np.ndarray, "input n"]:
    """Ordinary least squares of a finite impulse response and an offset."""
    columns = np.column_stack([_past(u, LENGTH), np.ones(COUNT)])
    found = np.linalg.lstsq(columns, y, rcond=None)[0]
    return np.cumsum(found[:-1].reshape(u.shape[1], LENGTH), axis=1)


def _arx(y: np.ndarray, u: Signals) -> Float[np.ndarray, "input n"]:
    """Ordinary least squares of an ARX model whose dead times (up to 8) are covered by 8 further lags of the inputs."""
    lags = ORDER + 8
    columns = np.column_stack([_past(y[:, None], ORDER), _past(u, lags), np.ones(COUNT)])[lags:]
    found = np.linalg.lstsq(columns, y[lags:], rcond=None)[0]
    own, of_inputs = found[:ORDER], found[ORDER:-1].reshape(u.shape[1], lags)
    steps = np.zeros((u.shape[1], LENGTH))
    for t in range(LENGTH):
        before = steps[:, max(t - ORDER, 0) : t][:, ::-1]
        steps[:, t] = before @ own[: before.shape[1]] + of_inputs[:, : t + 1].sum(axis=1)
    return steps


METHODS: dict[str, Method] = {"jaxmpc": _kernel, "FIR least squares": _finite, "ARX least squares": _arx}
