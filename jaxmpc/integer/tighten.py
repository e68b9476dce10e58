"""Tighter relaxations: curvature of the tracking cost that whole positions pay along chords.

At whole positions w the square w^2 and the straight lines between its values there are the same; between them the lines lie
above it. Any curvature D of the positions that leaves the objective convex may therefore be paid along these chords
(quadratic convex reformulation; Billionnet, Elloumi and Lambert 2012), and the relaxation rises. For an actuator that is on
or off the chord is one straight line. The D of largest sum is a semidefinite programme,

    max sum D   subject to   S_w - 2 diag(D) >= 0,   D >= 0,

with S_w the curvature of the objective in the positions once the continuous moves are minimised out; its dual is how loose
the relaxation is for positions that are anywhere.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from jaxtyping import Float

LEAST = 1e-2  # of the curvature of a position: shares below it tighten next to nothing and leave the objective flatter
SHARE = 0.9  # of what could be moved: the rest keeps the objective curved, so that few Newton steps solve it
SECONDS, LOADING = (
    6e-7,
    1.0,
)  # what the programme takes by the fourth power of the positions; loading its solver
TIMES = 4.0  # share of the time left that it may take is the inverse: the search needs the rest
SAFE = 1e-9  # share of the curvature that stays, so that rounding leaves the objective convex


def chord_weights(
    curvature: Float[np.ndarray, "position position"], seconds: float | None = None
) -> Float[np.ndarray, " position"] | None:
    """The curvature of each position that chords may pay, of largest sum [objective per squared step].

    Args:
        curvature: of the objective in the positions, positive semidefinite; 1/2 w'S w.
        seconds: that are left for the whole search, None for no limit; the programme is not begun where it takes too many.

    Returns:
        D; zeros where there is nothing to gain; None where the time does not suffice.
    """
    if seconds is not None:
        expected = SECONDS * len(curvature) ** 4 + (0.02 if "clarabel" in sys.modules else LOADING)
        if seconds < TIMES * expected:
            return None
    import clarabel  # here, because few problems come so far
    import scipy.sparse as sp

    solver: Any = clarabel  # names its parts at run time

    size = np.sqrt(np.maximum(np.diag(curvature), 0.0))
    nothing = np.zeros(len(size))
    if not size.any():
        return nothing
    unit = np.where(size > 0.0, size, 1.0)
    scaled = curvature / np.outer(unit, unit)
    worth = unit**2 / unit.max() ** 2
    # the cone wants columns of the upper triangle one after the other
    rows, columns = np.triu_indices(len(size))
    rank = np.lexsort((rows, columns))
    rows, columns = rows[rank], columns[rank]
    weights = np.where(rows == columns, 1.0, np.sqrt(2.0))
    place = np.flatnonzero(rows == columns)
    count = len(size)
    inside = sp.csc_matrix((np.full(count, 2.0), (place, np.arange(count))), shape=(len(rows), count))
    constraints = sp.vstack([inside, -sp.identity(count)]).tocsc()
    values = np.concatenate([weights * scaled[rows, columns], nothing])
    cones = [solver.PSDTriangleConeT(count), solver.NonnegativeConeT(count)]
    settings = solver.DefaultSettings()
    settings.verbose = False
    if seconds is not None:
        settings.time_limit = 0.5 * seconds
    none = sp.csc_matrix((count, count))
    solution = solver.DefaultSolver(none, -worth, constraints, values, cones, settings).solve()
    if seconds is not None and solution.status == solver.SolverStatus.MaxTime:
        return None
    found = np.asarray(solution.x)
    if not np.isfinite(found).all():
        return nothing
    found = np.where(found > LEAST, found, 0.0)
    found = _convex_share(scaled, found) * found
    return SHARE * np.where(found > LEAST, found, 0.0) * unit**2


def _convex_share(curvature: np.ndarray, found: np.ndarray) -> float:
    """The largest share of `found` that leaves the curvature positive semidefinite, a little less."""
    # directions without curvature have eigenvalues of zero, which come out a little below it as often as not
    rounding = len(curvature) * np.finfo(float).eps * np.trace(curvature)
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        good = np.linalg.eigvalsh(curvature - 2.0 * middle * np.diag(found))[0] >= -rounding
        low, high = (middle, high) if good else (low, middle)
        if good and middle > 1.0 - SAFE:
            break
    return (1.0 - SAFE) * low
