"""How long work takes, measured as it is done, so that a piece of work that does not fit the time left is not begun.

A compiled call cannot be stopped from outside, but its loops count Newton steps and end after as many as they are given.
What fits the time left follows from the pace of earlier calls on the same problems, before the first from a careful guess.
"""

from __future__ import annotations

import math

CALL = 5  # Newton steps that take as long as the rest of a call: posing a problem, judging its solution
FORGET = 0.5  # weight of a quicker call; a slower one counts at once, up to
AT_ONCE = 4.0  # times what was known: whoever else keeps the machine busy may stop a single call for long
TAIL, MOST_TAIL = (
    1.5e-3,
    20e-3,
)  # what a step takes after its search, before it is known [s]; the most kept for it
# Newton steps that are taken in any case if they should fit into so many seconds, so that any limit lets something be found
ALWAYS, GRACE = 8, 2e-3
CAREFUL = 3.0  # times what a core of a few years ago takes is the first guess
LANE = 12  # Newton steps of a relaxation from the prices of a neighbour, before the first is seen


class Pace:
    """Seconds per Newton step of one kind of problem, and what a relaxation needs of them.

    Args:
        moves: of a problem.
        predictions: of the same.
    """

    def __init__(self, moves: int, predictions: int):
        usual = 3e-6 + 1.3e-9 * moves**3 + 7e-9 * moves * predictions
        self.always = min(ALWAYS, int(GRACE / usual))
        self.step = CAREFUL * usual
        self.lane = LANE * self.step
        self.known = False
        self.tail = TAIL

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
        """Newton steps of one relaxation that fit, infinite where there is no limit; a few quick ones always do."""
        if seconds is None or math.isinf(seconds):
            return math.inf
        return float(max(int(seconds / self.step) - CALL, self.always))

    def fits(self, seconds: float | None) -> bool:
        """Whether a call leads anywhere in so many seconds."""
        return seconds is None or seconds > CALL * self.step

    def lanes_within(self, seconds: float) -> int:
        """Relaxations, one after the other, that fit."""
        return max(int(seconds / self.lane), 0)

    def before_tail(self, limit: float | None) -> float | None:
        """When a search has to end for its step to end in time."""
        return None if limit is None else max(limit - self.tail, 0.0)

    def ended(self, late: float) -> None:
        """Learn from a step that its time limit has stopped, so many seconds after it (negative before it)."""
        change = 0.5 * late if late > 0.0 else max(FORGET * late, -1e-4)
        self.tail = min(max(self.tail + change, 0.0), MOST_TAIL)
