"""From a log to an `Identification`: fit on the first part, judge on the last, refit on all, and say what cannot be told.

`jaxmpc identify DATA.csv` calls it. Every CV is fitted by itself with all inputs at once (multiple inputs, single output).
"""

from __future__ import annotations

import dataclasses
import datetime
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from identify.logged.fit import (
    Data,
    Fit,
    bands,
    chosen,
    fitted,
    make_data,
    residuals,
    search,
    simulated,
)
from identify.logged.judge import excitations
from identify.logged.log import LEAST, Log, read_log
from identify.logged.low_order import LowOrder, low_order
from identify.logged.noise import innovations
from identify.logged.residuals import examined
from identify.logged.told import CvResult, advice, method_notes, pair_verdict
from jaxmpc.check import is_count
from jaxmpc.errors import InputError
from jaxmpc.model.identification import Identification, Record
from jaxmpc.model.step_response import make_model

HELD_OUT = 0.27  # share of the samples that the first fit does not see
TRIED, COLUMNS = (32, 64, 128), 384  # lags of first fits where N is not given; most of all inputs
ROOM = 0.7  # of the lags of a first fit, in which it settles
COARSER = 4  # times the interval where responses do not settle within COLUMNS
MARGIN, SHORTEST = 1.25, 10  # N over the settling time of the first fit; least N
SETTLED, LAGS = 0.003, 5.8  # of the largest coefficient: settled; so many lags of a first order


def identify_log(
    path: str | Path,
    mv: Sequence[str],
    cv: Sequence[str],
    dv: Sequence[str] = (),
    *,
    dt: float | None = None,
    samples: int | None = None,
    time: str | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    progress: bool = False,
) -> Identification:
    """Identify a step-response model from logged data.

    Args:
        path: of a CSV or Parquet file, see `read_log`.
        mv, cv, dv: names, those of its columns if `columns` does not say another.
        dt: sampling interval [s]; the median of the log's own by default.
        samples: N; by default long enough for the slowest response of a first fit.
        time: column of the times.
        columns: of the file by name, where they have other names.
        units: by name, where the file has none.
        progress: whether a bar on standard error shows how far it is, from two seconds on.

    Returns:
        The model, refitted on all data, with 95 % bands, verdicts and low-order alternatives. Its records show what the fit
        on the first 73 % predicts; the rest is marked as not used.

    Raises:
        InputError: for bad options, what `read_log` refuses, and data from which nothing can be told.
    """
    if not mv or not cv:
        raise InputError("--mv" if not mv else "--cv", [], "at least one name of a column")
    if samples is not None and not is_count(samples):
        raise InputError("--samples", samples, "a whole number of 1 or more")
    inputs = (*mv, *dv)
    read = lambda dt: _read(path, inputs, cv, columns or {}, units or {}, dt, time)  # noqa: E731
    log, signals, moving, cut, all_data = read(dt)
    notes: list[str] = []
    with tqdm(
        total=len(cv) * (3 if samples is None else 2), desc="identify", delay=2, disable=not progress
    ) as bar:
        if samples is None:
            samples, short = _length(all_data, cut, log, bar, notes)
            while short and dt is None:
                log, signals, moving, cut, all_data = read(COARSER * log.dt)
                samples, short = _length(all_data, cut, log, bar, notes)
        elif samples > max(own.stop - own.start for own in log.segments) - 2:
            raise InputError("--samples", samples, "fewer samples than the longest segment of the log has")
        found = {
            name: _identified(data, samples, cut, signals, moving, bar) for name, data in all_data.items()
        }
    excited = excitations(inputs, [log.units.get(name, "") for name in inputs], signals, log.segments)
    verdicts = tuple(
        pair_verdict(name, log, inputs[j], excited[j], found[name], j)
        for name in cv
        for j in range(len(inputs))
    )
    if all(row.verdict == "bad" for row in verdicts):
        reasons = "; ".join(dict.fromkeys(row.says for row in verdicts))
        raise InputError("data", str(path), "moves that tell at least one response", reasons)
    silent = np.array([row.verdict == "none" for row in verdicts]).reshape(len(cv), len(inputs), 1)
    steps = np.where(silent, 0.0, np.stack([found[name].steps for name in cv]))
    notes = [*log.notes, *notes, *method_notes(log, found, inputs, samples, cut)]
    return Identification(
        _model(path, log, mv, cv, dv, steps, verdicts, notes),
        verdicts,
        tuple(notes),
        advice(verdicts, log, samples),
        np.stack([found[name].band for name in cv]),
        {"low order (first order and dead time)": _alternative(found, cv, samples)},
        (_record(path, log, cv, signals, found, cut),),
    )


def _read(
    path: str | Path,
    inputs: Sequence[str],
    cv: Sequence[str],
    columns: Mapping[str, str],
    units: Mapping[str, str],
    dt: float | None,
    time: str | None,
) -> tuple[Log, np.ndarray, np.ndarray, int, dict[str, Data]]:
    """A log that can tell something, its inputs, which of them move, where the first part ends, and each CV with them."""
    column = {name: columns.get(name, name) for name in (*inputs, *cv)}
    log = read_log(path, list(column.values()), dt, time, held=[column[name] for name in inputs])
    own = {
        field: {name: getattr(log, field)[at] for name, at in column.items() if at in getattr(log, field)}
        for field in ("values", "units", "quality")
    }
    given = {name: unit for name, unit in units.items() if name in column}
    log = dataclasses.replace(log, **(own | {"units": given | own["units"]}))
    signals = np.stack([log.values[name] for name in inputs], axis=1)
    moving = np.array([any(np.ptp(u[own]) > 0 for own in log.segments) for u in signals.T])
    if not moving.any():
        raise InputError("data", str(path), f"an input that moves; {', '.join(inputs)} never do")
    for name in cv:
        if np.nanstd(log.values[name]) == 0:
            raise InputError(f"column {name}", float(np.nanmean(log.values[name])), "a CV that changes")
    cut = round((1 - HELD_OUT) * len(log.times))
    for name in cv:
        known = int(np.isfinite(log.values[name][:cut]).sum())
        if known < LEAST:
            expected = f"at least {LEAST} values in the first {100 * (1 - HELD_OUT):.0f} % of the log"
            raise InputError(f"column {name}", f"{known} values", expected)
    all_data = {name: make_data(log.values[name], signals[:, moving], log.segments) for name in cv}
    return log, signals, moving, cut, all_data


def _length(all_data: dict[str, Data], cut: int, log: Log, bar: tqdm, notes: list[str]) -> tuple[int, bool]:
    """N by the slowest response of first fits, longer until all settle well before they end; and whether none is so long."""
    inputs = next(iter(all_data.values())).inputs.shape[1]
    longest = max(own.stop - own.start for own in log.segments)
    most = min(longest - 2, max(SHORTEST, min(COLUMNS // inputs, longest // 2)))
    tried = [*(length for length in TRIED if length < most), most]
    slowest, length, waiting = 0, most, list(all_data.values())
    for length in tried:
        while waiting:
            settled = _settled(waiting[0].until(cut), length)
            if settled > ROOM * length and length < most:
                break  # the others can wait for a longer one
            slowest = max(slowest, settled)
            waiting.pop(0)
            bar.update()
        if not waiting:
            break
    samples = min(most, max(SHORTEST, int(np.ceil(MARGIN * slowest)) + 1))
    short = slowest > 0.9 * most
    if short and COLUMNS // inputs < longest // 2 and longest // COARSER > 4 * SHORTEST:
        notes.append(
            f"responses take longer than {most} samples of {log.dt:g} s: every {COARSER} were made one; --dt says otherwise"
        )
        return samples, True
    if short:
        notes.append(f"N = {samples}, all that could be tried; a response may be slower: try a larger --dt")
    else:
        notes.append(
            f"N = {samples} samples ({samples * log.dt:g} s): a first fit settles in {slowest * log.dt:g} s"
        )
    return samples, False


def _settled(data: Data, length: int) -> int:
    """Samples after which the responses of a CV stay where they end, as far as the data tell."""
    fit = search(data, length)
    steps, doubt = fit.steps(data), bands(data, fit)
    known = np.abs(steps).max(axis=1) > doubt.max(axis=1)
    slowest = 1.0
    for s, band in zip(steps[known], doubt[known], strict=True):
        low = low_order(s, band, integrating=fit.integrating)
        # noise hides where a response ends, not how fast it is
        slowest = max(slowest, low.dead_time + LAGS * low.lag)
        if fit.integrating:  # its rate settles
            s, band = np.diff(s, prepend=0.0), np.abs(np.diff(band, prepend=0.0))
        outside = np.abs(s - s[-1]) > SETTLED * np.abs(s).max() + 0.5 * band
        slowest = max(slowest, float(np.flatnonzero(outside)[-1]) + 2 if outside.any() else 1.0)
    return min(length, int(np.ceil(slowest)))


def _identified(
    data: Data, length: int, cut: int, signals: np.ndarray, moving: np.ndarray, bar: tqdm
) -> CvResult:
    training = data.until(cut)
    trained, overruled = chosen(data, length, cut)
    bar.update()
    final = fitted(data, length, trained, 30)
    bar.update()
    count, places = len(moving), np.flatnonzero(moving)
    steps, band = np.zeros((count, length)), np.full((count, length), np.nan)
    steps[places], band[places] = final.steps(data), bands(data, final)
    whole = lambda fit: simulated(data, fit, cut)  # noqa: E731
    alone = whole(trained)
    rough = _replaced(trained, data, bands(training, trained))
    errors = np.concatenate([innovations(final.noise, left) for left in residuals(data, final)])
    low: list[LowOrder | None] = [
        low_order(s, b, integrating=final.integrating) if m else None
        for s, b, m in zip(steps, band, moving, strict=True)
    ]
    tested = examined(errors, signals, data.segments, length)
    fits = _fit(data, alone, cut), _fit(data, whole(rough), cut)
    return CvResult(data, final, *fits, low, steps, band, alone, tested, overruled)


def _replaced(fit: Fit, data: Data, band: np.ndarray) -> Fit:
    """The fit with low-order responses in place of its own."""
    length = fit.posterior.mean.shape[1]
    shapes = fit.steps(data)
    made = [
        low_order(s, b, integrating=fit.integrating).response(length)
        for s, b in zip(shapes, band, strict=True)
    ]
    impulse = np.linalg.solve(data.to_steps(fit.integrating, length), np.array(made)[:, :, None])[:, :, 0]
    return dataclasses.replace(fit, posterior=dataclasses.replace(fit.posterior, mean=impulse))


def _fit(data: Data, predicted: np.ndarray, cut: int) -> float:
    """How much of the part that was left out is predicted [%]: 100 (1 - |y - p| / |y - mean of y|), p with an own offset."""
    total, off = 0.0, 0.0
    for own in data.segments:
        at = slice(max(own.start, cut), own.stop)
        if own.stop <= cut or not np.ptp(data.inputs[at], axis=0).any():
            continue
        y, p = data.output[at], predicted[at]
        known = np.isfinite(y)
        if known.any():
            total += float(((y[known] - y[known].mean()) ** 2).sum())
            off += float(((y - p)[known] ** 2).sum())
    return 100 * (1 - np.sqrt(off / total)) if total > 0 else float("nan")


def _model(path, log: Log, mv, cv, dv, steps: np.ndarray, verdicts, notes):
    units = lambda names: [log.units.get(name, "1") for name in names] if log.units else ()  # noqa: E731
    point = {name: float(np.round(np.nanmedian(log.values[name]), 12)) for name in (*mv, *cv)}
    facts = {
        "source": Path(path).name,
        "method": "kernel-based regularised least squares on logged data",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "begin": log.begin,
        "samples_used": len(log.times),
        "verdicts": [list(row) for row in verdicts],
        "notes": list(notes),
    }
    return make_model(
        steps[:, : len(mv)],
        log.dt,
        cv,
        mv,
        cv_units=units(cv),
        mv_units=units(mv),
        working_point=point,
        provenance=facts,
        dv_coefficients=steps[:, len(mv) :],
        dv_names=dv,
        dv_units=units(dv),
    )


def _alternative(found: dict[str, CvResult], cv: Sequence[str], samples: int) -> np.ndarray:
    return np.stack(
        [[low.response(samples) if low else np.zeros(samples) for low in found[name].low] for name in cv]
    )


def _record(
    path, log: Log, cv: Sequence[str], signals: np.ndarray, found: dict[str, CvResult], cut: int
) -> Record:
    measured = np.stack([log.values[name] for name in cv], axis=1)
    predicted = np.full_like(measured, np.nan)
    for (i, name), own in itertools.product(enumerate(cv), log.segments):
        y = log.values[name][own]
        level = np.nanmean(y) if np.isfinite(y).any() else np.nan
        predicted[own, i] = level + found[name].data.output_scale * found[name].predicted[own]
    return Record(Path(path).name, log.times, signals, measured, predicted, np.arange(len(log.times)) < cut)
