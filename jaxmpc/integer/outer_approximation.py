"""Closing an integer problem with HiGHS: MILPs over tangents of quadratic cuts, the master of `highs`.

The master is linear, the cuts of solved problems are not: each is given to it by its tangents at the candidates that it
has to exclude. Part of the curvature is separable and goes into the master's binaries exactly: with 0 <= D <= S
diagonal on the moves still free, R(d) - 1/2 d'D d is convex and is what the tangents bound. A listed candidate that
the cuts do not exclude is solved, which adds a cut and perhaps an incumbent; when none is left, the master has to
agree, and what it still proposes joins the list.
"""

from __future__ import annotations

import numpy as np

from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import around, satisfied
from jaxmpc.integer.host_search import GROUP, Offload, Search, Steps
from jaxmpc.integer.lower_bound import LowerModel, enumerate_below

LISTED = 2_000  # candidates the tangents are chosen by
BEAM = 256  # partial candidates kept where the list would be longer
TANGENTS = 64  # added between two master problems at most
WIDEST = 20_000  # binaries of a master, one for every value of a free move


def outer_approximation(
    search: Search, model: LowerModel, cuts: Cuts, lower, upper, seconds: float | None
) -> Steps:
    """Close the reduced problem with MILPs over cuts.

    What HiGHS claims is held against all plans that are solved: one that it may still choose is a witness, whose value no
    bound may be above. A claim that is disproven ends it, and nothing of the claim is used.

    Args:
        search: state of the solve.
        model: root's lower model.
        cuts: known so far; more are added.
        lower: limits of the integer moves, equal where a move is fixed.
        upper: the same.
        seconds: time limit from here on, None for none.

    Returns:
        Whether it is closed, and the bound reached.

    Raises:
        ContradictionError: where HiGHS has claimed what a known plan disproves.
    """
    if (upper - lower).sum() > WIDEST:
        return False, search.root_bound
    # HiGHS is loaded when it is first needed
    from jaxmpc.integer.highs import ROUNDING, ReducedMilp, contradiction

    c = search.constants
    limit = None if seconds is None else search.spent + seconds
    tangents = _Tangents(search, cuts, lower, upper)
    unit = search.reference if np.isfinite(search.value) else c.scale
    master = ReducedMilp(search.chains, lower, upper, tangents.own, unit=unit)
    best_bound = search.root_bound
    points = _listed(search, model, lower, upper)
    told = 0
    while True:
        yield from _solve_candidates(search, cuts, points, limit)
        tangents.exclude(points, search.cutoff)
        for tangent in tangents.list[told:]:
            master.add_cut(*tangent)
        told = len(tangents.list)
        left = None if limit is None else limit - search.spent
        if left is not None and left <= 0:
            return False, best_bound
        witness = tangents.witness(search, master.forbidden, lower, upper)
        slack = ROUNDING * (abs(witness) + unit) if np.isfinite(witness) else 0.0
        master.set_cutoff(
            max(search.cutoff, witness + 0.1 * slack) if np.isfinite(witness) else search.cutoff
        )
        solved = yield Offload(lambda left=left: master.solve(left))
        if solved is None:
            return False, best_bound
        bound, point, finished = solved
        if bound > witness + slack:
            raise ContradictionError(contradiction(bound, witness, "a known plan"))
        if point is not None:
            fits = satisfied(search.chains, point[None], lower, upper)[0]
            value = float(tangents.values(point[None])[0])  # minus infinity before the first tangent
            if not fits or (np.isfinite(value) and bound > value + ROUNDING * (abs(value) + unit)):
                whose = "its own plan" if fits else "its own plan, which breaks hard rows,"
                raise ContradictionError(contradiction(bound, value, whose))
        search.still_open = max(search.still_open, min(bound, search.value))
        best_bound = max(best_bound, min(bound, search.value))
        if bound >= search.cutoff:
            search.discard(search.cutoff)
            return True, best_bound
        search.stopped = (
            search.stopped or master.out_of_time
        )  # by its own clock, which may run a little faster
        if point is None or not finished:
            return False, best_bound
        search.nodes += 1
        allowed = not search.restricted or satisfied(search.chains, point[None], lower, upper)[0]
        # rounding of the master, or moves that nothing can follow: what they are worth is known, what is left matters
        if tangents.knows(point) or not allowed or (search.followed and point.tobytes() in search.seen):
            master.forbid(point)
        points = around(search.chains, point, lower, upper)


class ContradictionError(Exception):
    """HiGHS has claimed what a known plan disproves."""


class _Tangents:
    """Linear cuts of R less the separable curvature, chosen from the quadratic cuts."""

    def __init__(self, search: Search, cuts: Cuts, lower: np.ndarray, upper: np.ndarray):
        c = self.constants = search.constants
        self.cuts, self.lower = cuts, lower
        self.free = np.flatnonzero(upper > lower)
        self.diagonal = np.zeros(len(lower))
        self.diagonal[self.free] = diagonal_share(c.schur[np.ix_(self.free, self.free)])
        values = lower[:, None] + np.arange(int((upper - lower).max(initial=0)) + 1)[None, :]
        self.weight = c.own_weight + 0.5 * self.diagonal
        self.own = self.weight[:, None] * values.astype(float) ** 2
        self.list: list[tuple[float, np.ndarray, np.ndarray]] = []
        self.taken: set[bytes] = set()

    def knows(self, point: np.ndarray) -> bool:
        """Whether a tangent was taken at this point."""
        return point.tobytes() in self.taken

    def exclude(self, points: np.ndarray, cutoff: float) -> None:
        """Add tangents until the master's bound of all points that the cuts exclude is at the cutoff."""
        points = points[self.cuts.bounds(points) >= cutoff]
        bounds = self.values(points)
        for _ in range(TANGENTS):
            if not len(points) or bounds.min() >= cutoff:
                return
            point = points[np.argmin(bounds)]
            if self.knows(point):
                bounds[np.argmin(bounds)] = np.inf
                continue
            self.taken.add(point.tobytes())
            self.list.append(self._restricted(*self.cuts.tangent(point)))
            bounds = np.maximum(bounds, self._bound(self.list[-1], points))

    def values(self, points: np.ndarray) -> np.ndarray:
        """What the master pays for whole moves ``"point integer"``."""
        values = np.full(len(points), -np.inf)
        for tangent in self.list:
            values = np.maximum(values, self._bound(tangent, points))
        return values

    def witness(self, search: Search, forbidden: set[bytes], lower: np.ndarray, upper: np.ndarray) -> float:
        """The least value in the master of a solved plan that it may still choose; infinite without one."""
        keys = [key for key in search.seen if key not in forbidden]
        points = np.array([np.frombuffer(key, dtype=int) for key in keys]).reshape(len(keys), len(lower))
        points = points[satisfied(search.chains, points, lower, upper)]
        return float(self.values(points).min(initial=np.inf)) if self.list else np.inf

    def _bound(self, tangent, points) -> np.ndarray:
        value, place, slope = tangent
        return value + (points - place) @ slope + points**2 @ self.weight

    def _restricted(self, value: float, at: np.ndarray, gradient: np.ndarray):
        """The cut over the free moves, the others being at `lower`, without the separable curvature."""
        away = self.lower - at
        away[self.free] = 0.0
        bent = self.constants.schur @ away
        value = float(value + gradient @ away + 0.5 * away @ bent)
        place = at + away
        level = float(value - 0.5 * self.diagonal @ place**2)
        return level, place, gradient + bent - self.diagonal * place


def diagonal_share(curvature: np.ndarray) -> np.ndarray:
    """Diagonal D with 0 <= D <= `curvature`: the scaled diagonal, as large as the least eigenvalue lets it be."""
    if not len(curvature):
        return np.zeros(0)
    scale = np.sqrt(np.maximum(np.diag(curvature), 0.0))
    if not (scale > 0.0).all():
        return np.zeros(len(curvature))
    least = np.linalg.eigvalsh(curvature / np.outer(scale, scale))[0]
    return max(least - 1e-9, 0.0) * scale**2


def _listed(search: Search, model: LowerModel, lower, upper) -> np.ndarray:
    """Candidates below the incumbent; good ones only where there are too many."""
    found = enumerate_below(
        model, search.chains, lower, upper, search.cutoff, LISTED, check_time=search.check_time
    )
    if found is None:
        found = enumerate_below(
            model, search.chains, lower, upper, search.cutoff, None, beam=BEAM, check_time=search.check_time
        )
    points = np.zeros((0, len(lower)), dtype=int) if found is None else found[0]
    return points[satisfied(search.chains, points, lower, upper)]


def _solve_candidates(search: Search, cuts: Cuts, points: np.ndarray, limit: float | None) -> Steps:
    """Solve listed candidates, cheapest first, until the cuts exclude the rest."""
    while limit is None or search.spent < limit:
        fresh = np.array([p.tobytes() not in search.seen for p in points], dtype=bool)
        points = points[fresh]
        bounds = cuts.bounds(points)
        points, bounds = points[bounds < search.cutoff], bounds[bounds < search.cutoff]
        if not len(points):
            return
        best = points[np.argsort(bounds, kind="stable")[:GROUP]]
        yield from cuts.solve(search, best)
        search.nodes += len(best)
