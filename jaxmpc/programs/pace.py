"""How long work takes, measured as it is done, so that a piece of work that does not fit the time left is not begun.

A compiled call cannot be stopped from outside, but its loops count Newton steps and end after as many as they are given.
What fits the time left follows from the pace of earlier calls on the same problems, before the first from a careful guess.
"""

from __future__ import annotations

import math

CALL = 5  # Newton steps that take as long as the rest of a call: posing a problem, judging its solution
FORGET = 0.2  # weight of a quicker call; a slower one counts at once, up to
AT_ONCE = 4.0  # times what was known: whoever else keeps the machine busy may stop a single call for long
LANE = 12  # Newton steps of a relaxation from the prices of a neighbour, before the first is seen


class Pace:
    """Seconds per Newton step of one kind of problem, and what a relaxation needs of them.

    Args:
        moves: of a problem.
        predictions: of the same.
    """

    def __init__(self, moves: int, predictions: int):
        # about three times what a core of a few years ago takes
        self.step = 1e-5 + 4e-9 * moves**3 + 2e-8 * moves * predictions
        self.lane = LANE * self.step
        self.known = False

    def took(self, seconds: float, steps: int, lanes: int = 1) -> None:
        """Learn from a call that solved lanes in so many Newton steps together."""
        if lanes <= 0 or seconds <= 0.0:
            return
        self.step = self._updated(self.step, seconds / (steps + CALL * lanes))
        self.lane = self._updated(self.lane, seconds / lanes)
        self.known = True

    def _updated(self, known: float, seen: float) -> float:
        if not self.known:
            return seen
        seen = min(seen, AT_ONCE * known)
        return seen if seen > known else (1.0 - FORGET) * known + FORGET * seen

    def steps_within(self, seconds: float | None) -> float:
        """Newton steps of one relaxation that fit, infinite where there is no limit."""
        if seconds is None or math.isinf(seconds):
            return math.inf
        return float(max(int(seconds / self.step) - CALL, 0))

    def lanes_within(self, seconds: float) -> int:
        """Relaxations, one after the other, that fit."""
        return max(int(seconds / self.lane), 0)
