"""Better plans for branch and bound: relaxed nodes rounded along moves and positions, and neighbours of an incumbent."""

from __future__ import annotations

import numpy as np

from jaxmpc.integer.chain import Chain, whole
from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import around, satisfied
from jaxmpc.integer.host_search import Search, Steps
from jaxmpc.integer.nodes import Child
from jaxmpc.integer.relaxer import LANES

ROUNDS = 3  # batches of neighbours of an incumbent that are solved
NEWEST = 64  # cuts that candidates are held against


class Incumbents:
    """Looks for better plans in one search."""

    def __init__(self, search: Search, cuts: Cuts):
        self.search, self.cuts = search, cuts
        self.polished = np.inf  # value of the incumbent whose neighbours were solved

    def rounded(self, children: list[Child]) -> Steps:
        """Round moves and positions of relaxed lanes, and solve what may be better than the incumbent."""
        search, c = self.search, self.search.constants
        solved = [child.solved for child in children if child.solved is not None]
        if not solved:
            return
        moves = np.array([result.x[lane, c.integer] for result, lane in solved])
        moves = moves[np.isfinite(moves).all(axis=1)]
        moves = np.unique(np.concatenate([np.round(moves), self._walked(moves)]), axis=0).astype(int)
        low, high = (whole(values[c.integer]) for values in search.limits)
        points = search.new(list(moves[satisfied(search.chains, moves, low, high)]))
        yield from self._solve_best(points)

    def _walked(self, moves: np.ndarray) -> np.ndarray:
        """Moves that follow the positions of relaxed ones as closely as whole moves can."""
        result = np.zeros_like(moves)
        for chain in self.search.chains:
            wanted = np.cumsum(moves[:, chain.columns] * chain.counts, axis=1)
            result[:, chain.columns] = _followed(chain, wanted)
        return result

    def _solve_best(self, points: np.ndarray) -> Steps:
        """Solve the best of these points by the cuts, if any may be better than the incumbent; adds cuts."""
        if not len(points):
            return
        bounds = self.cuts.bounds(points, max(len(self.cuts.list) - NEWEST, 0))
        best = np.argsort(bounds, kind="stable")[:2]
        best = best[bounds[best] < self.search.cutoff]
        if len(best):
            yield from self.solve(points[best])

    def improved(self) -> Steps:
        """Solve the points around a new incumbent that may be better, until none is."""
        search, integer = self.search, self.search.constants.integer
        low, high = (whole(values[integer]) for values in search.limits)
        while search.value < self.polished and not search.out_of_time():
            self.polished = search.value
            assert search.x is not None
            points = search.new(list(around(search.chains, whole(search.x[integer]), low, high)))
            for _ in range(ROUNDS):
                if not len(points):
                    break
                bounds = self.cuts.bounds(points, max(len(self.cuts.list) - NEWEST, 0))
                best = np.argsort(bounds, kind="stable")
                best = best[bounds[best] < search.cutoff]
                if len(best):
                    yield from self.solve(points[best[:LANES]])
                points = points[best[LANES:]]
                if search.value < self.polished:
                    break

    def solve(self, points: np.ndarray, bounds: np.ndarray | None = None) -> Steps:
        """Solve whole moves, each for a cut and perhaps an incumbent."""
        yield from self.cuts.solve(self.search, points, bounds)
        self.search.nodes += len(points)


def _followed(chain: Chain, wanted: np.ndarray) -> np.ndarray:
    """Whole moves of a chain along wanted positions ``"lane block"``: to the nearest allowed, with the rests of a dwell."""
    moves = np.zeros(wanted.shape)
    position = np.zeros(len(wanted), dtype=int)
    for b, count in enumerate(chain.counts):
        there = np.clip(wanted[:, b], -1e15, 1e15)
        if chain.allowed is not None:
            below, above = chain.down(np.floor(there)), chain.up(np.ceil(there))
            there = np.where(there - below <= above - there, below, above)
        move = np.round((there - position) / count)
        move = np.where(chain.passes(b, position, move), move, 0)
        if chain.apart is not None:
            move = np.where((moves[:, :b] != 0) @ chain.apart[b, :b], 0, move)
        moves[:, b] = move
        position = position + (move * count).astype(int)
    return moves
