"""A log on a regular grid: what `read_log` makes of a file, with everything that it did to the data said.

Inputs (MVs, DVs) are held: at a sample stands the last value that was logged. CVs are the mean of what was logged within
half a sample around it, and missing where there is nothing. A gap in the log begins a new segment; nothing is bridged.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from identify.logged.table import Table, read_table
from jaxmpc.check import is_number
from jaxmpc.errors import InputError

GAP = 5.0  # typical intervals without a row from which on a new segment begins
HOLD = 3.0  # samples over which a missing input is held
SPIKE = 8.0  # robust standard deviations of the change from row to row from which on a jump there and back is none
SPIKE_SHARE = 0.1  # of the range of the column, which such a jump has at least
FROZEN = 30  # rows with exactly the same value, of a signal that changes otherwise
RESTLESS = 0.02  # share of rows without a change up to which a signal changes otherwise
FAR = 10.0  # ranges of an input off its median, for two rows at most: a value that it never had
UPDATED = 3  # rows from which on a CV that changes at equal intervals only is one that is held in between
HOUR = 3600.0  # s by which clocks are set back in autumn
LEAST = 20  # samples
CODES = (
    -9999.0,
    9999.0,
    -999.0,
    999.0,
    -99999.0,
    99999.0,
    -999.25,
    -32768.0,
    32767.0,
)  # for no value, if far away


@dataclasses.dataclass(frozen=True)
class Log:
    """Signals on a regular grid, in segments.

    Attributes:
        times: [s] after the first stamp; ``dt`` apart within a segment.
        values: by name; NaN where there is no value. Inputs have none missing.
        starts: first sample of each segment.
        dt: sampling interval [s].
        units: by name, where the file has them.
        quality: share of samples that have a value, by name [1].
        begin: the first stamp as it stands in the file.
        notes: what was done to the data.
    """

    times: Float[np.ndarray, " sample"]
    values: Mapping[str, Float[np.ndarray, " sample"]]
    starts: tuple[int, ...]
    dt: float
    units: Mapping[str, str]
    quality: Mapping[str, float]
    begin: str
    notes: tuple[str, ...]

    @property
    def segments(self) -> list[slice]:
        """Samples of each segment."""
        return [slice(a, b) for a, b in zip(self.starts, (*self.starts[1:], len(self.times)), strict=True)]


def read_log(
    path: str | Path,
    columns: Sequence[str],
    dt: float | None = None,
    time: str | None = None,
    *,
    held: Collection[str] = (),
    hold: float = HOLD,
    clean: bool = True,
) -> Log:
    """Read a CSV or Parquet file and put it on a regular grid.

    Args:
        path: of the file; a row of names, perhaps a row of units, then rows of values.
        columns: names of the columns that are read.
        dt: sampling interval [s]; the median of the log's own by default.
        time: column of the times; by default the first, or one called time, date or the like. Without any, rows are `dt`
            apart.
        held: those of the columns that are inputs.
        hold: samples over which a missing input is held; after that, a new segment begins with its next value.
        clean: whether outliers and frozen pieces of the other columns count as missing.

    Raises:
        InputError: naming column, row and value; also for fewer than 20 samples, or a column without any value.
    """
    if dt is not None and (not is_number(dt) or dt <= 0):
        raise InputError("--dt", dt, "a positive sampling interval [s]")
    table = read_table(path, columns, time)
    rows = len(next(iter(table.columns.values())))
    notes = list(table.notes)
    if table.stamps is None:
        if dt is None:
            expected = "the interval between two rows [s]: the file has no column of times"
            raise InputError("--dt", None, expected, "--time names it where it has another name")
        notes.append(f"the file has no times: its rows were taken to be {dt:g} s apart")
        table = table._replace(stamps=dt * np.arange(rows))
    table = _in_order(_clock_put_right(table, notes), notes)
    stamps = table.stamps
    assert stamps is not None
    for name, values in table.columns.items():
        if not np.isfinite(values).any():
            raise InputError(f"column {name}", "no value in any row", "numbers")
        if clean:
            values = _without_codes(name, values, notes)
            table.columns[name] = (_plausible if name in held else _cleaned)(name, values, notes)
    typical = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0
    if dt is None:
        dt = float(f"{typical:.6g}")
        notes.append(f"the sampling interval is the median of the log's, {dt:g} s")
    pieces = np.split(
        np.arange(len(stamps)), np.flatnonzero(np.diff(stamps) > GAP * max(typical, dt / GAP)) + 1
    )
    _tell_of_intervals(stamps, typical, dt, pieces, notes)
    return _on_grid(table, pieces, typical, dt, held, hold, notes)


def _clock_put_right(table: Table, notes: list[str]) -> Table:
    """Times that go on one hour earlier once, as local ones do in autumn, without that hour."""
    stamps, columns = table.stamps, list(table.columns.values())
    assert stamps is not None
    steps = np.diff(stamps)
    typical = float(np.median(steps)) if len(steps) else HOUR
    back = np.flatnonzero(np.abs(steps + HOUR - typical) <= 0.5 * typical)
    if len(back) != 1 or not 0 < typical < HOUR / 2:
        return table
    k = int(back[0]) + 1
    same = np.flatnonzero(stamps[:k] == stamps[k])
    if len(same) and all(np.array_equal(values[k], values[same[0]], equal_nan=True) for values in columns):
        return table  # an hour that is in the file twice
    notes.append("the clock was set back by an hour once; the hour after was put behind the one before")
    return table._replace(stamps=stamps + HOUR * (np.arange(len(stamps)) >= k))


def _in_order(table: Table, notes: list[str]) -> Table:
    """Rows by their times, of those with the same time the last."""
    stamps = table.stamps
    assert stamps is not None
    back = int((np.diff(stamps) < 0).sum())
    order = np.argsort(stamps, kind="stable")
    keep = np.append(np.diff(stamps[order]) > 0, True)
    twice = int((~keep).sum())
    if back:
        notes.append(f"rows were put in the order of their times, which go back {back} times")
    if twice:
        notes.append(f"{twice} rows have a time that a later row has too; the later row was taken")
    order = order[keep]
    columns = {name: values[order] for name, values in table.columns.items()}
    return table._replace(stamps=stamps[order], columns=columns)


def _without_codes(name: str, values: np.ndarray, notes: list[str]) -> np.ndarray:
    """A column without numbers that stand for no value, such as -9999, where all others are far away from them."""
    for code in CODES:
        own = values == code
        others = values[~own & np.isfinite(values)]
        if own.any() and others.size and np.abs(others - code).min() > FAR * max(np.ptp(others), 0.1):
            notes.append(f"{name}: {own.sum()} values of {code:g} count as missing")
            values = np.where(own, np.nan, values)
    return values


def _plausible(name: str, values: np.ndarray, notes: list[str]) -> np.ndarray:
    """An input without single values far away from all others, which count as missing."""
    low, middle, high = np.nanpercentile(values, [1, 50, 99])
    with np.errstate(invalid="ignore"):
        far = (np.abs(values - middle) > FAR * (high - low)) & (high > low)
    ends = np.append(np.flatnonzero(np.diff(far)), len(far) - 1)
    lengths = np.diff(ends, prepend=-1)
    far &= np.repeat(lengths <= 2, lengths)
    if far.any():
        notes.append(
            f"{name}: {far.sum()} outliers (more than {FAR:g} times its range away) count as missing"
        )
    return np.where(far, np.nan, values)


def _cleaned(name: str, values: np.ndarray, notes: list[str]) -> np.ndarray:
    """A CV without spikes and frozen pieces, which count as missing."""
    values = values.copy()
    known = np.flatnonzero(np.isfinite(values))
    x = values[known]
    if len(x) < LEAST:
        return values
    if (every := _held_for(x)) > 1:
        first = np.flatnonzero(np.diff(x))[0] % every + 1
        notes.append(f"{name} has a new value every {every} rows only; the rows in between count as missing")
        kept = values[known[first % every :: every]]
        values[known] = np.nan
        values[known[first % every :: every]] = kept
        return values
    changes = np.abs(np.diff(x))
    moves = changes[changes > 0]  # a frozen piece says nothing of what is usual
    usual = 1.4826 * np.median(moves if len(moves) > LEAST else changes)
    limit = max(SPIKE * usual, SPIKE_SHARE * float(np.diff(np.percentile(x, [1, 99]))[0]))
    spikes = np.zeros(len(x), bool)
    for width in (1, 2):  # rows that stay together away from both neighbours, which agree with each other
        before, after = x[: -width - 1], x[width + 1 :]
        inside = np.stack([x[1 + k : len(x) - width + k] for k in range(width)])
        away = (np.minimum(inside - before, inside - after) > limit) | (
            np.maximum(inside - before, inside - after) < -limit
        )
        back = np.abs(before - after) < limit / 3
        for k in np.flatnonzero(away.all(0) & back & (limit > 0)):
            spikes[k + 1 : k + 1 + width] = True
    frozen = _frozen(x)
    for what, flags in (("outliers (a jump there and back)", spikes), ("frozen samples", frozen & ~spikes)):
        if flags.any():
            notes.append(
                f"{name}: {flags.sum()} {what} count as missing ({100 * flags.mean():.2g} % of its values)"
            )
    values[known[spikes | frozen]] = np.nan
    return values


def _held_for(x: np.ndarray) -> int:
    """For how many rows a signal is held, if it changes at equal intervals only; else 1."""
    changes = np.flatnonzero(np.diff(x))
    apart = np.diff(changes)
    if len(apart) < LEAST or (every := int(np.median(apart))) < UPDATED or (apart % every).any():
        return 1
    return every if (apart == every).mean() > 0.5 else 1


def _frozen(x: np.ndarray) -> np.ndarray:
    """Long runs of one value after the first, of a signal that hardly ever repeats a value elsewhere."""
    ends = np.append(np.flatnonzero(np.diff(x) != 0), len(x) - 1)
    lengths = np.diff(ends, prepend=-1)
    long = lengths >= FROZEN
    long[0] = False  # a plant at rest before the first test
    others = lengths[1:][~long[1:]]
    repeats = (others - 1).sum() / max(1, others.sum())
    return np.repeat(long & (repeats <= RESTLESS), lengths)


def _tell_of_intervals(stamps: np.ndarray, typical: float, dt: float, pieces: list, notes: list[str]) -> None:
    uneven = float((np.abs(np.diff(stamps) - typical) > 0.1 * typical).mean()) if len(stamps) > 1 else 0.0
    if uneven > 0.001:
        notes.append(
            f"{100 * uneven:.2g} % of the intervals differ from the median of {typical:g} s by more than a tenth"
        )
    if len(pieces) > 1:
        longest = max(stamps[b[0]] - stamps[a[-1]] for a, b in itertools.pairwise(pieces))
        notes.append(
            f"{len(pieces) - 1} gaps (up to {longest:g} s) part the log into segments; none is bridged"
        )
    if dt > 1.5 * typical:
        notes.append(f"resampled from {typical:g} s to {dt:g} s: CVs by the mean, inputs by the last value")
    elif dt < typical / 1.5:
        notes.append(
            f"sampled every {dt:g} s from rows {typical:g} s apart: inputs held, CVs missing between the rows"
        )


def _on_grid(
    table: Table,
    pieces: list[np.ndarray],
    typical: float,
    dt: float,
    held: Collection[str],
    hold: float,
    notes: list[str],
) -> Log:
    stamps = table.stamps
    assert stamps is not None
    slack = 0.5 * min(typical, dt)  # a row belongs to a sample that is this close
    times, starts = [], []
    columns: dict[str, list[np.ndarray]] = {name: [] for name in table.columns}
    lost = {name: 0 for name in held}
    moved_within = {name: 0 for name in held}
    for rows in pieces:
        first = stamps[rows[0]]
        grid = first + dt * np.arange(int(np.floor((stamps[rows[-1]] - first + slack) / dt)) + 1)
        own = {name: values[rows] for name, values in table.columns.items()}
        made, usable = {}, np.ones(len(grid), bool)
        for name, values in own.items():
            if name in held:
                made[name], good = _held(stamps[rows], values, grid, slack, hold * max(dt, typical))
                usable &= good
                lost[name] += int((~good).sum())
                changes = np.flatnonzero(np.diff(values) != 0) + 1
                off = np.abs((stamps[rows][changes] - first + slack) % dt - slack) > slack * 1.001
                moved_within[name] += int(off.sum())
            else:
                made[name] = _mean(stamps[rows], values, grid, dt)
        for part in np.split(np.arange(len(grid)), np.flatnonzero(np.diff(usable.astype(int))) + 1):
            if usable[part[0]] and len(part) > 1:
                starts.append(sum(map(len, times)))
                times.append(grid[part] - stamps[0])
                for name in columns:
                    columns[name].append(made[name][part])
    for name, count in lost.items():
        if count:
            where = f"within {hold:g} samples" if np.isfinite(hold) else "until then"
            notes.append(f"{name}: {count} samples without a value {where} are left out, which parts the log")
        if moved_within[name]:
            notes.append(f"{name} moves between two samples {moved_within[name]} times; seen at the next one")
    count = sum(map(len, times))
    if count < LEAST:
        raise InputError(
            "data", f"{count} samples of {dt:g} s", f"at least {LEAST} samples with values of all inputs"
        )
    values = {name: np.concatenate(parts) for name, parts in columns.items()}
    quality = {name: float(np.isfinite(entry).mean()) for name, entry in values.items()}
    for name, share in quality.items():
        if share == 0:
            raise InputError(f"column {name}", "no value where the inputs have one", "numbers")
        if share < 0.999:
            notes.append(f"{name}: {100 * (1 - share):.2g} % of the samples have no value")
    merged = np.concatenate(times)
    return Log(merged, values, tuple(starts), dt, table.units, quality, table.begin, tuple(notes))


def _held(stamps: np.ndarray, values: np.ndarray, grid: np.ndarray, slack: float, longest: float):
    """The last value at each time, and whether it is not older than `longest` where rows without one followed it."""
    known = np.isfinite(values)
    if not known.any():
        return np.zeros(len(grid)), np.zeros(len(grid), bool)
    at = np.searchsorted(stamps[known], grid + slack, side="right") - 1
    row = np.searchsorted(stamps, grid + slack, side="right") - 1
    missing = ~known[np.maximum(row, 0)]
    age = grid - stamps[known][np.maximum(at, 0)]
    return values[known][np.maximum(at, 0)], (at >= 0) & ~(missing & (age > longest))


def _mean(stamps: np.ndarray, values: np.ndarray, grid: np.ndarray, dt: float) -> np.ndarray:
    """Mean of the values within half a sample of each time; NaN without any."""
    place = np.rint((stamps - grid[0]) / dt).astype(int)
    own = np.isfinite(values) & (place < len(grid))
    counts = np.bincount(place[own], minlength=len(grid))
    sums = np.bincount(place[own], weights=values[own], minlength=len(grid))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
