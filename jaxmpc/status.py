"""Status codes of a solve and names of what finished it, as integers for batched arrays."""

from __future__ import annotations

OPTIMAL, LIMIT, INFEASIBLE, FAILED, UNPROVEN = 0, 1, 2, 3, 4
STATUS = ("optimal", "limit", "infeasible", "failed", "unproven")

OUT_OF_TIME = "the time limit was reached before the plan was proven to the gap that is asked for"

FINISHERS = (None, "relaxation", "fixing", "enumeration", "highs", "branch-and-bound")


def finisher_code(name: str | None) -> int:
    """Integer code of a finisher name; 0 where nothing was finished."""
    return FINISHERS.index(name)
