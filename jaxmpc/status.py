"""Status codes of a solve and names of what finished it, as integers for batched arrays."""

from __future__ import annotations

OPTIMAL, LIMIT, INFEASIBLE, FAILED = 0, 1, 2, 3
STATUS = ("optimal", "limit", "infeasible", "failed")

FINISHERS = (None, "relaxation", "fixing", "enumeration", "highs", "branch-and-bound")


def finisher_code(name: str | None) -> int:
    """Integer code of a finisher name; 0 where nothing was finished."""
    return FINISHERS.index(name)
