"""One row of the benchmark, what it must reach, and the table and the JSON file made of all rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np

RIGHT = 1e-6  # relative error up to which a solution counts
FORMAT = 1

Quantity = Literal["median_ms", "p99_ms", "rate", "ratio", "seconds", "megabytes"]
_SHOWN = {
    "median_ms": "median {} ms",
    "p99_ms": "p99 {} ms",
    "rate": "{} /s",
    "ratio": "{}x",
    "seconds": "{} s",
    "megabytes": "{} MB",
}
_LARGER_IS_BETTER = ("rate", "ratio")
TEXTS = ("name", "floor", "aim", "met", "found", "known", "by")  # columns of words; the others hold numbers


class Goal(msgspec.Struct, frozen=True):
    """What a row must reach."""

    quantity: Quantity  # field of the row
    floor: float  # that must be reached
    aim: float | None = None  # beyond the floor, None for none

    def met(self, row: Row) -> bool | None:
        """Whether the row reaches the floor with solutions that count; None where that is not known."""
        value = getattr(row, self.quantity)
        if row.status != "measured" or value is None:
            return None
        if not row.counts:
            return False
        if self.quantity == "ratio" and row.ratio_is_lower_bound and value < self.floor:
            return None
        return value >= self.floor if self.quantity in _LARGER_IS_BETTER else value <= self.floor


class Found(msgspec.Struct, frozen=True, kw_only=True):
    """What became of one instance."""

    status: str  # of the plan
    objective: float | None  # of the plan, as it says
    best: float | None  # objective known from elsewhere
    certified: bool  # whether that is the optimum
    gap: float | None  # relative, of the plan
    finished_by: str | None


class Row(msgspec.Struct, kw_only=True):
    """One line of the benchmark."""

    name: str  # what was measured
    section: str = ""  # that it belongs to; `run` writes it
    # measured, missing (a peer that is not installed), failed or not measured
    status: Literal["measured", "missing", "failed", "not measured"] = "measured"
    instances: int | None = None  # problems that were tried, or samples of a run
    solved: int | None = None  # how many of them have a solution that counts
    median_ms: float | None = None  # per problem [ms]
    p99_ms: float | None = None  # per problem [ms]
    rate: float | None = None  # problems per second
    seconds: float | None = None  # of the whole, where that is what matters [s]
    megabytes: float | None = None  # peak memory of the process [MB]
    ratio: float | None = None  # how many times as fast as `ratio_to` on the problems that both were given
    ratio_to: str | None = None  # the peer
    ratio_is_lower_bound: bool = False  # the peer was stopped at its time limit
    # largest error of the solutions, see `judge.Judge.errors`; None where there are none
    worst_error: float | None = None
    counts: bool = True  # whether no solution is wrong by more than `RIGHT`
    goals: tuple[Goal, ...] = ()  # floors and aims
    note: str = ""  # how it was measured, or what is wrong
    found: Found | None = None  # of a row that is one instance


def timed(name: str, times: Sequence[float] | np.ndarray, errors: Any, **more: Any) -> Row:
    """A row from the time ``"problem"`` [s] and the error ``"problem"`` of every problem; NaN for one without a solution.

    Args:
        more: further fields of `Row`, or others than follow from the times.
    """
    times, errors = np.asarray(times, dtype=float), np.asarray(errors, dtype=float)
    found = errors[~np.isnan(errors)]
    worst = float(found.max()) if len(found) else None
    fields = {
        "instances": len(errors),
        "solved": int((found <= RIGHT).sum()),
        "median_ms": float(np.median(times)) * 1e3,
        "p99_ms": float(np.percentile(times, 99)) * 1e3,
        "rate": len(times) / float(times.sum()),
        "worst_error": worst,
        "counts": worst is not None and worst <= RIGHT,
    }
    return Row(name=name, **{**fields, **more})


def whole(name: str, seconds: float, errors: Any, count: int | None = None, **more: Any) -> Row:
    """A row of which the seconds of the whole matter, and those of each problem where `count` were solved in one call."""
    each = {"median_ms": count and seconds / count * 1e3, "rate": count and count / seconds}
    return timed(name, [seconds], errors, **{**each, "p99_ms": None, "seconds": seconds, **more})


class Report(msgspec.Struct, kw_only=True):
    """Everything one call of the benchmark measured; the content of its JSON file."""

    format: int = FORMAT  # of this file
    machine: dict[str, Any] = {}  # cores, load, versions, devices
    options: dict[str, Any] = {}  # of the call
    complete: bool = False  # False while it runs and after an interrupt
    rows: list[Row] = []
    series: dict[str, dict[str, list[float]]] = {}  # over a run or over batch sizes, by name, for figures

    def to_json(self) -> str:
        """The JSON file, infinite and missing numbers as null, with whether each floor is met."""
        body = msgspec.to_builtins(self)
        for row, made in zip(self.rows, body["rows"], strict=True):
            for goal, shown in zip(row.goals, made["goals"], strict=True):
                shown["met"] = goal.met(row)
        return msgspec.json.format(msgspec.json.encode(body), indent=1).decode() + "\n"


def table(report: Report) -> str:
    """The rows as aligned text with the machine above and the notes below."""
    lines = [cells(row) for row in report.rows]
    heads = [name for name in cells(Row(name="")) if name == "name" or any(line[name] for line in lines)]
    head, *lines = _aligned(heads, [[line[name] for name in heads] for line in lines])
    out = [", ".join(f"{key} {value}" for key, value in report.machine.items()), "", head]
    section = None
    for row, line in zip(report.rows, lines, strict=True):
        if row.section != section:
            out.append("-" * len(head))
            section = row.section
        out.append(line)
    if any(not row.counts for row in report.rows):
        out += ["", f"! does not count: a solution is wrong by more than {RIGHT:g}, or there is none"]
    if any(row.ratio_is_lower_bound for row in report.rows):
        out += ["", ">= the peer was stopped at its time limit on some problems"]
    notes: dict[tuple[str, str], str] = {}
    for row in report.rows:  # said once, for the first of the rows that share it
        if row.note:
            notes.setdefault((row.section, row.note), row.name)
    out += ["", *(f"{name}: {note}." for (_, note), name in notes.items())] if notes else []
    if not report.complete:
        out += ["", "Not complete: what is above was measured before the benchmark was stopped."]
    return "\n".join(out) + "\n"


def _aligned(heads: list[str], lines: list[list[str]]) -> list[str]:
    """Heads and lines in columns, those of words to the left."""
    widths = [max(map(len, column)) for column in zip(heads, *lines, strict=True)]
    cut = lambda text, name, width: text.ljust(width) if name in TEXTS else text.rjust(width)  # noqa: E731
    return ["  ".join(map(cut, line, heads, widths)).rstrip() for line in (heads, *lines)]


def cells(row: Row) -> dict[str, str]:
    """The texts of one line by the heads of their columns."""
    tried = "" if row.instances is None else str(row.instances)
    if row.solved is not None and row.solved != row.instances:
        tried = f"{row.solved} of {row.instances}"
    ratio = "" if row.ratio is None else f"{number(row.ratio)}x {row.ratio_to}"
    error = "" if row.worst_error is None else f"{row.worst_error:.0e}"
    one = row.found or Found(status="", objective=None, best=None, certified=True, gap=None, finished_by=None)
    exact = lambda value: "" if value is None else f"{value:.9g}"  # noqa: E731
    words = [{None: "-", True: "met", False: "missed"}[goal.met(row)] for goal in row.goals]
    if row.status != "measured":
        error = row.status
    elif not row.counts:
        error = f"! {error}".rstrip()
    elif row.solved == 0:
        error = "none solved"
    said = lambda goal, value: _SHOWN[goal.quantity].format(number(value))  # noqa: E731
    return {
        "name": row.name,
        "n": tried,
        "median ms": number(row.median_ms),
        "p99 ms": number(row.p99_ms),
        "rate /s": number(row.rate),
        "total s": number(row.seconds),
        "MB": number(row.megabytes),
        "ratio": ">= " * (row.ratio_is_lower_bound and bool(ratio)) + ratio,
        "worst error": error,
        "floor": ", ".join(said(goal, goal.floor) for goal in row.goals),
        "aim": ", ".join(said(goal, goal.aim) for goal in row.goals if goal.aim is not None),
        "met": ", ".join(words if len(set(words)) > 1 else words[:1]),
        "found": f"{one.status} {exact(one.objective)}".strip(),
        "known": exact(one.best) + " (open)" * (not one.certified),
        "gap": "" if one.gap is None else f"{one.gap:.0e}",
        "by": one.finished_by or "",
    }


def number(value: float | None) -> str:
    """Three digits, nothing where there is no value."""
    if value is None or not math.isfinite(value):
        return ""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
