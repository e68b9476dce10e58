"""Times of a log in seconds: numbers, ISO dates and the usual other orders of day, month and year."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmpc.errors import InputError

EPOCHS = ((1e17, 1e9, "nanoseconds"), (1e14, 1e6, "microseconds"), (1e11, 1e3, "milliseconds"))
PARTS = re.compile(
    r"^(\d{1,2})([./-])(\d{1,2})\2(\d{4}|\d{2})(?:[ T,]+(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d+))?)?\s*([AaPp][Mm])?)?$"
)
CLOCK = re.compile(r"^(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d+))?)?\s*([AaPp][Mm])?$")
DAY = 86400.0  # s
DAYS = (
    (25569.0, 73050.0, 25569.0),
    (719529.0, 767010.0, 719529.0),
)  # of Excel and MATLAB, 1970 to 2100, and 1970
WORDS = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%d %b %Y %H:%M:%S", "%b %d, %Y %H:%M:%S")
EXPECTED = "a time: seconds, a date like 2024-03-01 12:00:00, or seconds since 1970"


def is_stamp(text: str) -> bool:
    """Whether a text reads as a date or a time of day."""
    return bool(PARTS.match(text) or CLOCK.match(text)) or _iso(text) is not None


def is_clock(text: str) -> bool:
    """Whether a text is a time of day alone."""
    return bool(CLOCK.match(text))


def is_day(text: str) -> bool:
    """Whether a text is a date without a time."""
    return is_stamp(text) and ":" not in text


def seconds(
    name: str, given: Sequence[Any], line: int, decimal: bool
) -> tuple[Float[np.ndarray, " row"], tuple[str, ...]]:
    """Times [s] of a column, and what was assumed.

    Raises:
        InputError: with column and row, for what is no time; for dates that may be read in two ways.
    """
    field = lambda k: f"column {name}, row {line + k}"  # noqa: E731
    if isinstance(given, np.ndarray) and given.dtype.kind == "M":
        out = given.astype("datetime64[ns]").astype(np.int64) / 1e9
        return _checked(np.where(np.isnat(given), np.nan, out), given, field), ()
    if isinstance(given, np.ndarray) and given.dtype.kind in "iuf":
        return _epoch(_checked(given.astype(float), given, field))
    texts = [str(entry).strip() for entry in given]
    try:
        numbers = np.array([t.replace(",", ".") if decimal else t for t in texts], dtype=float)
    except ValueError:
        return _clock(texts, field) if texts and is_clock(texts[0]) else _dates(texts, field)
    return _epoch(_checked(numbers, texts, field))


def _checked(stamps: np.ndarray, given: Sequence[Any], field: Any) -> np.ndarray:
    if not np.isfinite(stamps).all():
        k = int(np.argmin(np.isfinite(stamps)))
        raise InputError(field(k), str(given[k]), EXPECTED)
    return stamps


def _epoch(numbers: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    for size, per_second, word in EPOCHS:
        if len(numbers) and abs(np.median(numbers)) > size:
            return numbers / per_second, (f"times were taken for {word} since 1970",)
    steps = np.abs(np.diff(numbers))
    for low, high, begin in DAYS:
        inside = len(steps) > 0 and ((numbers >= low) & (numbers <= high)).all()
        if inside and 0 < np.median(steps) < 0.1 and np.ptp(numbers * DAY) > 1:
            whole = np.round((numbers - begin) * DAY, 3)  # what is finer is rounding of the days
            return whole, ("times were taken for days, as Excel and MATLAB count them",)
    return numbers, ()


def _clock(texts: list[str], field: Any) -> tuple[np.ndarray, tuple[str, ...]]:
    """Times of day, which begin a new day where they go back by more than half of one."""
    out = np.empty(len(texts))
    for k, text in enumerate(texts):
        found = CLOCK.match(text)
        hour, minute, second = (int(found[j] or 0) for j in (1, 2, 3)) if found else (99, 0, 0)
        if found and found[5]:
            hour = hour % 12 + (12 if found[5].lower() == "pm" else 0)
        if found is None or hour > 24 or minute > 59 or second > 59:
            raise InputError(field(k), text, EXPECTED)
        out[k] = 3600 * hour + 60 * minute + second + float(f"0.{found[4] or 0}")
    days = np.cumsum(np.diff(out, prepend=out[:1]) < -DAY / 2)
    return out + DAY * days, ("times are of a day; a new one begins where they go back by half a day",)


def _dates(texts: list[str], field: Any) -> tuple[np.ndarray, tuple[str, ...]]:
    out, notes = np.empty(len(texts)), ()
    split = [PARTS.match(text) for text in texts]
    day_first = None
    if any(found and found[2] != "." for found in split):
        firsts, seconds_ = ([int(f[k]) for f in split if f] for k in (1, 3))
        if max(firsts) > 12 and max(seconds_) > 12:
            raise InputError(field(int(np.argmax(firsts))), texts[int(np.argmax(firsts))], EXPECTED)
        if (
            max(firsts) <= 12
            and max(seconds_) <= 12
            and any(a != b for a, b in zip(firsts, seconds_, strict=True))
        ):
            k = next(k for k, f in enumerate(split) if f and f[1] != f[3])
            expected = "a date that can be read in one way only, such as 2024-03-01"
            raise InputError(field(k), texts[k], expected, "Is the day or the month first?")
        day_first = max(firsts) > 12 or max(seconds_) <= 12
        notes = (f"dates were read with the {'day' if day_first else 'month'} first",)
    for k, (text, found) in enumerate(zip(texts, split, strict=True)):
        moment = _parted(found, day_first) if found else _iso(text) or _worded(text)
        if moment is None:
            raise InputError(field(k), text, EXPECTED)
        out[k] = (moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)).timestamp()
    return out, notes


def _iso(text: str) -> datetime.datetime | None:
    try:
        return datetime.datetime.fromisoformat(text.replace(" UTC", "+00:00").replace("/", "-").strip())
    except ValueError:
        return None


def _worded(text: str) -> datetime.datetime | None:
    for form in WORDS:
        try:
            return datetime.datetime.strptime(text, form)
        except ValueError:
            continue
    return None


def _parted(found: re.Match[str], day_first: bool | None) -> datetime.datetime | None:
    first, second, year = int(found[1]), int(found[3]), int(found[4])
    day, month = (first, second) if day_first or found[2] == "." else (second, first)
    hour, minute, second_ = (int(found[k] or 0) for k in (5, 6, 7))
    if found[9]:
        hour = hour % 12 + (12 if found[9].lower() == "pm" else 0)
    try:
        year = year + 2000 if year < 100 else year
        return datetime.datetime(
            year, month, day, hour, minute, second_, int((found[8] or "0")[:6].ljust(6, "0"))
        )
    except ValueError:
        return None
