"""Whole moves of steps that the compiled search left open: envelope, finite limits, search on the host.

Between `integer.solve`, which knows scaled problems only, and its callers, which know engineering units.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxmpc.errors import InputError
from jaxmpc.integer.actuators import Actuator
from jaxmpc.integer.chain import chains_of, resting, rows_of, whole
from jaxmpc.integer.feasible import satisfied
from jaxmpc.integer.host_search import NOT_CLOSED, Known, SearchResult
from jaxmpc.integer.nearest import UndecidedError, fastest_return, nearest
from jaxmpc.integer.relaxer import Relaxations, Relaxer
from jaxmpc.integer.solve import solve_integers
from jaxmpc.integer.tables import Constants
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.memory import check_ranges
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.linear_algebra import one_thread
from jaxmpc.relaxed.gap import closes
from jaxmpc.relaxed.newton import MOST_STEPS
from jaxmpc.status import LIMIT, OPTIMAL, UNPROVEN

WIDEST_ENVELOPE = 4  # steps up to which the envelope of the squared integer move is built


@one_thread()
def finish_steps(
    relaxer_of: Callable[[int], Relaxer],
    instances: QpInstance,
    root: Relaxations,
    *,
    previous_moves: Float[np.ndarray, "scenario block mv"],
    gap: float,
    time_limit: float | None,
    finish: str,
    actuators: Sequence[Sequence[Actuator]] = (),
    recover: bool = False,
    spent: float | Float[np.ndarray, " scenario"] = 0.0,
    known: Sequence[Known] | None = None,
) -> list[SearchResult]:
    """Solve one step of every scenario; all have the same integer moves.

    Args:
        relaxer_of: compiled relaxations for integer ranges of so many steps.
        instances: the problems, first axis ``"scenario"``, NumPy's arrays.
        root: their relaxations for moves of one step.
        previous_moves: start [MV unit].
        gap: relative gap.
        time_limit: seconds of work per scenario, None for none.
        finish: one of `integer.solve.FINISHES`.
        actuators: what the integer MVs must keep besides limits and rows, per scenario; none if that is all.
        recover: let MVs outside their limits return the shortest way that these leave.
        spent: seconds that every scenario has taken already.
        known: what the compiled search has found for moves of one step, per scenario.

    Returns:
        How the steps ended.

    Raises:
        InputError: for ranges of whole moves that cannot be searched.
    """
    clock, relaxer = Clock(), relaxer_of(1)
    if actuators:
        instances = _restricted(relaxer, instances, actuators, recover)
        root = relaxer.solve_roots(instances, root.warm)
    lower, upper = _bounded(relaxer_of, instances, actuators)
    constants = relaxer.scenario(0)
    integer = constants.integer
    check_ranges(constants.structure, lower[:, integer], upper[:, integer])
    widest = int(max(np.abs(lower[:, integer]).max(), np.abs(upper[:, integer]).max()))
    if widest > 1:
        relaxer = relaxer_of(widest if widest <= WIDEST_ENVELOPE else 0)
        instances = eqx.tree_at(lambda i: (i.lower, i.upper), instances, (lower, upper))
        most = relaxer.pace.steps_within(_left(time_limit, spent, clock))
        root = relaxer.solve_roots(instances, relaxer.cold(instances), most)
        # (6.6) of more than one step is more than the compiled search pays
        known = None if known is None else [one._replace(value=np.inf) for one in known]
    elif time_limit is not None and ((root.status != OPTIMAL) & (root.steps < MOST_STEPS)).any():
        # the time it was given was a guess
        left = _left(time_limit, spent, clock)
        if relaxer.pace.fits(left):
            root = relaxer.solve_roots(instances, root.warm, relaxer.pace.steps_within(left))
    starts = []
    for i, moves in enumerate(previous_moves):
        own = relaxer.scenario(i)
        wanted = moves.T.reshape(-1)[own.integer] / own.scales[own.integer]
        starts.append([np.clip(np.nan_to_num(wanted), -1e6, 1e6)])
    rest: dict[str, Any] = dict(gap=gap, time_limit=time_limit, finish=finish, actuators=actuators)
    used = np.broadcast_to(spent + clock.seconds / len(starts), len(starts))
    found = solve_integers(
        relaxer, instances, root, starts=starts, last=False, spent=used, known=known, **rest
    )
    for i, result in enumerate(found):
        left = None if time_limit is None else time_limit - result.seconds
        if result.status in (LIMIT, UNPROVEN) and (left is None or left > 0):
            weight = relaxer.scenario(i).chords_within(left)
            if weight is not None and weight.any():
                own = rest | {"actuators": actuators[i : i + 1]}
                found[i] = _tightened(relaxer, instances, i, result, starts[i], own)
    return found


def _left(time_limit: float | None, spent, clock: Clock) -> float | None:
    """Seconds that the scenario with the least still has."""
    return None if time_limit is None else time_limit - float(np.max(spent)) - clock.seconds


def _tightened(
    relaxer: Relaxer, instances: QpInstance, index: int, found: SearchResult, starts: list[np.ndarray], rest
) -> SearchResult:
    """The search of one scenario that is still open, on its tighter relaxation."""
    clock, own = Clock(), relaxer.with_chords(index)
    one = jax.tree.map(lambda leaf: leaf[index : index + 1], instances)
    most = own.pace.steps_within(_left(rest["time_limit"], found.seconds, clock))
    root = own.solve_roots(one, own.cold(one), most)
    if found.x is not None:
        starts = [*starts, whole(found.x[own.scenario(0).integer])]
    used = np.array([found.seconds + clock.seconds])
    (result,) = solve_integers(own, one, root, starts=[starts], spent=used, **rest)
    result.nodes, result.root = result.nodes + found.nodes, found.root
    bound = max(result.bound, found.bound)
    if found.value < result.value:  # time ran out before the second search came so far
        result.x, result.value = found.x, found.value
    result.bound = min(bound, result.value)
    closed = closes(result.value, result.bound, own.scenario(0).scale, rest["gap"])
    if result.x is not None and closed != (result.status == OPTIMAL):
        by = result.finished_by or "branch-and-bound"
        if closed:
            result.status, result.finished_by, result.reason = OPTIMAL, by, None
        else:
            result.status, result.finished_by, result.reason = UNPROVEN, None, NOT_CLOSED
    return result


def _restricted(
    relaxer: Relaxer, instances: QpInstance, actuators: Sequence[Sequence[Actuator]], recover: bool
) -> QpInstance:
    """The problems with the limits that the actuators leave: positions within the allowed ones, blocks at rest."""
    lower, upper, row_low, row_high = (
        np.array(v) for v in (instances.lower, instances.upper, instances.row_low, instances.row_high)
    )
    for i, own in enumerate(actuators):
        c = relaxer.scenario(i)
        low, high = lower[i, c.integer], upper[i, c.integer]
        one = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], instances)
        chains = chains_of(c.structure, c.size, one, own)
        for chain, actuator, mv in zip(chains, own, c.structure.integer_mvs, strict=True):
            rest, columns = resting(c.structure, actuator, mv), chain.columns
            outside = recover and chain.restricted and ((chain.low > 0) | (chain.high < 0)).any()
            if outside:  # as fast as move limits allow may not end in an allowed position, or be too soon
                low[columns], high[columns] = np.minimum(low[columns], 0.0), np.maximum(high[columns], 0.0)
            low[columns] = np.where(rest, np.maximum(low[columns], 0.0), low[columns])
            high[columns] = np.where(rest, np.minimum(high[columns], 0.0), high[columns])
            reached = chain.low, chain.high
            if outside:
                with contextlib.suppress(UndecidedError):
                    reached = fastest_return(chain, whole(low[columns]), whole(high[columns])) or reached
            rows = c.position[columns]
            row_low[i, rows], row_high[i, rows] = rows_of(*reached)
        lower[i, c.integer], upper[i, c.integer] = low, high
    values = lower, upper, row_low, row_high
    return eqx.tree_at(lambda i: (i.lower, i.upper, i.row_low, i.row_high), instances, values)


def _bounded(
    relaxer_of, instances: QpInstance, actuators: Sequence[Sequence[Actuator]]
) -> tuple[np.ndarray, np.ndarray]:
    """Limits ``"scenario n"``, finite for integer moves that have none: the level set of a rounded plan."""
    lower, upper = np.array(instances.lower), np.array(instances.upper)
    integer = relaxer_of(1).scenario(0).integer
    if np.isfinite(lower[:, integer]).all() and np.isfinite(upper[:, integer]).all():
        return lower, upper
    relaxer = relaxer_of(0)
    start = relaxer.cold(instances)
    root = relaxer.solve_roots(instances, start)
    center = root.x[:, integer]
    fixed_low, fixed_high = lower.copy(), upper.copy()
    for i in range(len(lower)):
        own = jax.tree.map(lambda leaf, i=i: leaf[i], instances)
        wanted = np.clip(center[i], lower[i, integer], upper[i, integer])
        near = _whole_near(relaxer.scenario(i), own, wanted, actuators[i] if actuators else ())
        fixed_low[i, integer] = fixed_high[i, integer] = near
    fixed = eqx.tree_at(lambda i: (i.lower, i.upper), instances, (fixed_low, fixed_high))
    value = relaxer.solve_roots(fixed, start).snapped
    radius = np.stack([relaxer.scenario(i).radius for i in range(len(lower))])
    reach = np.sqrt(2.0 * np.maximum(value - root.bound, 0.0)[:, None] * radius) + 1.0
    if not np.isfinite(reach).all():
        raise InputError(
            "tuning.move_low",
            "infinite",
            "finite move or MV limits for an integer MV that has neither weight nor effect, or that no whole moves"
            " near the relaxed ones satisfy",
        )
    lower[:, integer] = np.maximum(lower[:, integer], np.ceil(center - reach))
    upper[:, integer] = np.minimum(upper[:, integer], np.floor(center + reach))
    return lower, upper


def _whole_near(
    constants: Constants, instance: QpInstance, wanted: np.ndarray, actuators: Sequence[Actuator]
) -> np.ndarray:
    """Whole moves near `wanted` that satisfy the hard rows; the rounded ones where there are none within reach."""
    chains = chains_of(constants.structure, constants.size, instance, actuators)
    lower, upper = (whole(np.asarray(v)[constants.integer]) for v in (instance.lower, instance.upper))
    middle = whole(np.floor(wanted + 0.5))
    for reach in (0, 3, 30):
        with contextlib.suppress(UndecidedError):
            found = nearest(
                chains, wanted, np.maximum(lower, middle - reach), np.minimum(upper, middle + reach)
            )
            if found is not None:
                return found
    if not actuators:
        return np.round(wanted)
    still = np.zeros((1, len(wanted)), dtype=int)
    return still[0] if satisfied(chains, still, lower, upper)[0] else np.full(len(wanted), np.nan)
