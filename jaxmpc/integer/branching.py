"""Where a node of branch and bound parts: at a move or a position between two whole values, in a gap, or at a dwell.

What earlier branchings gained (pseudo-costs) and what the node's own prices prove tell which is best; where too little was
seen, the children of the best candidates are relaxed (reliability branching: Achterberg, Koch and Martin 2005).
"""

from __future__ import annotations

import numpy as np

from jaxmpc.integer.chain import whole
from jaxmpc.integer.feasible import MoveLimits
from jaxmpc.integer.host_search import Search
from jaxmpc.integer.lower_bound import LowerModel, radii
from jaxmpc.integer.nodes import Branching, Child, Node, choices, room
from jaxmpc.integer.relaxer import LANES

RELIABLE = 3  # branchings of a variable in a direction from which their gains are believed
TRIED = LANES // 2  # candidates whose children are relaxed before one is chosen
FRACTION = 1e-6  # distance from whole numbers that counts
KEPT = 4096  # sets of free moves whose radii are kept


class Branchings:
    """The branchings of one search, and what they have gained so far."""

    def __init__(self, search: Search):
        self.search = search
        count = len(search.constants.integer)
        self.rows = np.concatenate([np.eye(count), search.constants.reached])
        self.gains, self.seen = np.zeros((2, 2 * count)), np.zeros((2, 2 * count), dtype=int)
        self.radii_of: dict[bytes, np.ndarray] = {}

    def radii(self, model: LowerModel) -> np.ndarray:
        """`lower_bound.radii` of moves and positions, with the moves held that the node was solved with fixed."""
        free = model.upper > model.lower
        key = free.tobytes()
        if key not in self.radii_of:
            if len(self.radii_of) > KEPT:
                self.radii_of.clear()
            held = self.search.constants.schur[np.ix_(free, free)]
            self.radii_of[key] = radii(held, self.rows[:, free]) if free.any() else np.zeros(len(self.rows))
        return np.maximum(self.radii_of[key], 1e-300)

    def of(self, node: Node) -> list[Branching]:
        """The branchings whose children are to be relaxed, the most promising first."""
        limits, model = node.limits, node.model
        count = len(model.center)
        at = self.rows @ model.center
        low, high = np.concatenate([limits.lower, limits.low]), np.concatenate([limits.upper, limits.high])
        cut = np.clip(np.floor(at), low, high - 1).astype(int)
        part, following = at - cut, cut + 1
        rest = 1.0 - part
        for chain in self.search.chains:
            if chain.allowed is not None:  # a gap is left on either side
                rows = count + chain.columns
                cut[rows], following[rows] = chain.down(cut[rows]), chain.up(following[rows])
                part[rows], rest[rows] = at[rows] - cut[rows], following[rows] - at[rows]
        between = (high > low) & (part > FRACTION) & (rest > FRACTION)
        for chain in self.search.chains:
            moves, positions = chain.columns, count + chain.columns
            if chain.allowed is None:
                between[positions[0]] = False  # the first position is the first move
            if between[positions].any() and choices(limits, chain) <= room(limits.lower, limits.upper, chain):
                between[moves[1:]] = False  # a valve's few positions decide its many moves
        radius = self.radii(model)
        clash, further = self._too_close(node, radius)
        if clash.any():  # such a block is at rest or moves
            between |= clash
            cut = np.where(clash, np.where(at > 0, 0, -1), cut)
            following = np.where(clash, cut + 1, following)
            part = np.where(clash, np.maximum(at - cut, 0.0), part)
            rest = np.where(clash, np.maximum(following - at, 0.0), rest)
        rows = np.flatnonzero(between)
        if not len(rows):
            return [self._halved(node)]
        away = np.stack([part, rest])
        gain = np.where(np.isfinite(radius), 0.5 * away**2 / radius, 0.0)
        gain = np.maximum(gain, further)
        moves = rows[rows < count]
        # the least of a side: with prices of chords the center need not be where nothing is left out
        down = np.minimum.accumulate(model.excess, axis=1)
        up = np.minimum.accumulate(model.excess[:, ::-1], axis=1)[:, ::-1]
        gain[0, moves] += down[moves, cut[moves] - model.lower[moves]]
        gain[1, moves] += up[moves, cut[moves] + 1 - model.lower[moves]]
        estimate = gain.copy()
        for kind in (slice(0, count), slice(count, None)):
            total, seen = self.gains[:, kind].sum(axis=1), self.seen[:, kind].sum(axis=1)
            mean = total / np.maximum(seen, 1)
            own = self.gains[:, kind] / np.maximum(self.seen[:, kind], 1)
            known = np.where(self.seen[:, kind] > 0, own, mean[:, None])
            estimate[:, kind] = np.maximum(estimate[:, kind], known * away[:, kind])
        score = self.score(estimate[0], estimate[1], node.bound)
        best = rows[np.argsort(-score[rows], kind="stable")[:TRIED]]
        reliable = self.seen[:, best].min(axis=0) >= RELIABLE
        tried = [row for k, row in enumerate(best) if k == 0 or not reliable[k]]
        return [
            Branching(int(r), int(cut[r]), int(following[r]), (float(gain[0, r]), float(gain[1, r])))
            for r in tried
        ]

    def _too_close(self, node: Node, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Entries that are moves within the dwell of others, and by what the others at rest raise the bound of a side."""
        limits, center = node.limits, node.model.center
        count = len(center)
        clash, gain = np.zeros(2 * count, dtype=bool), np.zeros((2, 2 * count))
        for chain in self.search.chains:
            if chain.apart is None:
                continue
            moves = chain.columns
            at, low, high = center[moves], limits.lower[moves], limits.upper[moves]
            moving = np.where(
                at > FRACTION, (low <= 0) & (high > 0), (at < -FRACTION) & (low < 0) & (high >= 0)
            )
            clash[moves] = moving & (moving @ chain.apart)
            own = np.where(np.isfinite(radius[moves]), 0.5 * at**2 / radius[moves], 0.0)
            others = np.where(chain.apart & moving, own, 0.0).max(axis=1)
            gain[np.where(at > 0, 1, 0), moves] = np.where(clash[moves], others, 0.0)
        return clash, gain

    def score(self, down, up, bound: float):
        """Of a branching by the gains of its children."""
        room = self.search.cutoff - bound
        least = 1e-6 * self.search.reference if np.isfinite(self.search.value) else 1e-12
        return np.maximum(np.minimum(down, room), least) * np.maximum(np.minimum(up, room), least)

    def _halved(self, node: Node) -> Branching:
        """All moves are whole, but the relaxation is not exact there: separate the dearest move's value from others."""
        limits, model = node.limits, node.model
        free = np.flatnonzero(limits.upper > limits.lower)
        passing = self._passing(node)
        if passing is not None:
            return passing
        if not len(free):
            return Branching(0, int(limits.lower[0]), int(limits.lower[0]) + 1, (0.0, 0.0))
        place = np.clip(np.round(model.center[free]), limits.lower[free], limits.upper[free]).astype(int)
        own = model.excess[free, place - model.lower[free]]
        k = int(np.argmax(own + 1e-9 * (limits.upper - limits.lower)[free]))
        row = int(free[k])
        cut = int(min(place[k], limits.upper[row] - 1))
        return Branching(row, cut, cut + 1, (0.0, 0.0))

    def _passing(self, node: Node) -> Branching | None:
        """A branching on the move or the start of a block that passes a position that is not allowed, if there is one."""
        limits, count = node.limits, len(node.model.center)
        for chain in self.search.chains:
            if chain.allowed is None or chain.counts.max() == 1:
                continue
            moves = whole(node.model.center[chain.columns])
            before = np.cumsum(moves * chain.counts) - moves * chain.counts
            for b, column in enumerate(chain.columns):
                if chain.passes(b, before[b], moves[b]):
                    continue
                if limits.lower[column] < limits.upper[column]:
                    cut = int(np.clip(moves[b], limits.lower[column], limits.upper[column] - 1))
                    return Branching(int(column), cut, cut + 1, (0.0, 0.0))
                row = int(chain.columns[b - 1]) if b else 0
                if b and limits.low[row] < limits.high[row]:
                    cut = int(chain.down(np.clip(before[b], limits.low[row], limits.high[row] - 1)))
                    return Branching(count + row, cut, int(chain.up(np.asarray(cut + 1))), (0.0, 0.0))
        return None

    def learn(self, node: Node, branching: Branching, side: int, bound: float) -> None:
        """Take down what one child gained per step."""
        at = float(self.rows[branching.row] @ node.model.center)
        away = at - branching.cut if side == 0 else branching.next - at
        if away > FRACTION and np.isfinite(bound):
            self.gains[side, branching.row] += max(bound - node.bound, 0.0) / away
            self.seen[side, branching.row] += 1


def children_of(node: Node, branching: Branching) -> tuple[Child, Child]:
    """The children, not relaxed yet: at most the cut, and from the next value on."""
    count = len(node.limits.lower)
    row = branching.row % count
    down, up = (Child(MoveLimits(*map(np.copy, node.limits)), node.start) for _ in range(2))
    if branching.row < count:
        down.limits.upper[row], up.limits.lower[row] = branching.cut, branching.next
    else:
        down.limits.high[row], up.limits.low[row] = branching.cut, branching.next
    return down, up
