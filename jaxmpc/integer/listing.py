"""Lists of whole moves in a compiled program: all that a quadratic lower bound leaves below a cutoff.

A list is an array of codes with two bits per move, in the order in which the moves are assigned, block by block; moves
are of one step at most. `compiled_search` solves the best of a list; `levelset` makes lists on the host.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.integer.tables import Tables
from jaxmpc.problem.instance import QpInstance

LONGEST = 4096  # moves on a list; longer lists are left to the host
GRID_FREE = 5  # free moves up to which all combinations are looked at
BLOCK = 32  # entries of a list that are extended together
STEPS = np.array([0.0, 1.0, -1.0])  # of one move; their codes are 0, 1, 3


class LowerBound(NamedTuple):
    """The root's quadratic lower bound, see `levelset.LowerModel`; `excess` has one column per entry of `STEPS`."""

    value: Array
    center: Array
    excess: Array


class PositionLimits(NamedTuple):
    """Limits of the positions after every move, and whether a move may differ from the last by one step at most."""

    low: Array
    high: Array
    coupled: Array


def position_limits(tables: Tables, instance: QpInstance) -> PositionLimits:
    """Those of one sample."""
    used = jnp.arange(tables.column.shape[0]) < tables.count
    return PositionLimits(
        low=jnp.where(used, jnp.round(instance.row_low[tables.position]), -jnp.inf),
        high=jnp.where(used, jnp.round(instance.row_high[tables.position]), jnp.inf),
        coupled=jnp.asarray(tables.coupled) & jnp.isfinite(instance.row_high[tables.pair]),
    )


def fits(
    tables: Tables, limits: PositionLimits, points: Float[Array, "point integer"]
) -> Bool[Array, " point"]:
    """Whether whole moves satisfy the hard rows."""
    position, before = points @ tables.reach.T, points @ tables.previous.T
    good = (position >= limits.low) & (position <= limits.high)
    return jnp.all(good & (~limits.coupled | (jnp.abs(points - before) <= 1.0)), axis=1)


class Listed(NamedTuple):
    """Whole moves with a bound below a cutoff.

    `count` may be more than the arrays hold, which then hold too few; `looked_at` blocks were extended on the way.
    """

    codes: Array
    bounds: Array
    count: Array
    looked_at: Array

    @classmethod
    def empty(cls) -> Listed:
        """Nothing is left."""
        none = jnp.zeros((), dtype=int)
        return cls(jnp.zeros(LONGEST, dtype=int), jnp.full(LONGEST, jnp.inf), none, none)


def encode(points: Float[Array, "*point integer"]) -> Int[Array, "*point"]:
    """Codes of whole moves."""
    shifts = 2 * np.arange(points.shape[-1])
    return jnp.sum((points.astype(int) & 3) << shifts, axis=-1)


def decode(codes: Int[Array, "*point"], moves: int) -> Float[Array, "*point integer"]:
    """Whole moves of codes."""
    digits = (codes[..., None] >> (2 * np.arange(moves))) & 3
    return jnp.where(digits == 3, -1, digits).astype(float)


def grid_below(tables: Tables, limits: PositionLimits, model: LowerBound, sizes, cutoff) -> Listed:
    """All combinations of a few free moves."""
    left = jnp.isfinite(model.excess)
    free = sizes > 1
    rank = jnp.clip(jnp.cumsum(free) - 1, 0, GRID_FREE)
    powers = jnp.asarray(3 ** np.arange(GRID_FREE + 1))
    digit = (np.arange(3**GRID_FREE)[:, None] // powers[rank]) % 3
    # a move that is not free has one value, which is the first of those that are left
    only = jnp.argmax(left, axis=1)
    digit = jnp.where(free, digit, only)
    points = jnp.asarray(STEPS)[digit]
    own = jnp.sum(jnp.select([digit == k for k in range(3)], list(model.excess.T)), axis=1)
    away = (points - model.center) @ tables.leading.T
    bounds = model.value + own + 0.5 * jnp.sum(away**2, axis=1)
    used = np.arange(3**GRID_FREE) < powers[jnp.minimum(jnp.sum(free), GRID_FREE)]
    bounds = jnp.where(used & fits(tables, limits, points) & (bounds < cutoff), bounds, jnp.inf)
    rest = LONGEST - len(points)
    return Listed(
        jnp.pad(encode(points), (0, rest)),
        jnp.pad(bounds, (0, rest), constant_values=np.inf),
        jnp.asarray(len(points)),
        jnp.zeros((), dtype=int),
    )


def list_below(tables: Tables, limits: PositionLimits, model: LowerBound, cutoff, most) -> Listed:
    """Breadth-first search, move by move; `BLOCK` partial assignments at a time get their next move.

    After `most` blocks it is given up as too long.
    """
    moves, room = tables.column.shape[0], LONGEST + 3 * BLOCK
    reach, previous, leading = tables.reach, tables.previous, tables.leading

    def assign(carry):
        i, codes, bounds, count, looked_at = carry
        now, then = i % 2, (i + 1) % 2
        row = leading[i]
        shift = row @ model.center
        pick = jnp.stack([row, reach[i], previous[i]], axis=1)  # of the moves before, this one still zero
        step, place = row[i] * STEPS - shift, reach[i, i] * STEPS

        def extend(carry):
            begin, codes, bounds, found = carry
            parents = jax.lax.dynamic_slice(codes, (now, begin), (1, BLOCK))[0]
            before = jax.lax.dynamic_slice(bounds, (now, begin), (1, BLOCK))[0]
            there = begin + np.arange(BLOCK) < count
            term, position, last = (decode(parents, moves) @ pick).T[:, :, None]
            total = before[:, None] + 0.5 * (term + step) ** 2 + model.excess[i]
            reached = position + place
            good = (reached >= limits.low[i]) & (reached <= limits.high[i]) & there[:, None]
            good &= ~limits.coupled[i] | (jnp.abs(STEPS - last) <= 1.0)
            alive = (good & (total < cutoff)).reshape(-1)
            ranks = jnp.cumsum(alive)
            # the k-th that is alive comes k-th
            source = jnp.searchsorted(ranks, np.arange(1, 3 * BLOCK + 1), method="compare_all")
            source = jnp.minimum(source, 3 * BLOCK - 1)
            children = parents[:, None] | (jnp.asarray([0, 1, 3]) << (2 * i))
            codes = jax.lax.dynamic_update_slice(codes, children.reshape(-1)[source][None], (then, found))
            bounds = jax.lax.dynamic_update_slice(bounds, total.reshape(-1)[source][None], (then, found))
            return begin + BLOCK, codes, bounds, jnp.minimum(found + ranks[-1], LONGEST + 1)

        begin, codes, bounds, found = jax.lax.while_loop(
            lambda carry: (carry[0] < count) & (carry[3] <= LONGEST), extend, (0, codes, bounds, 0)
        )
        looked_at += begin // BLOCK
        found = jnp.where((looked_at > most) & (i + 1 < tables.count), LONGEST + 1, found)
        return i + 1, codes, bounds, found, looked_at

    codes = jnp.zeros((2, room), dtype=int)
    bounds = jnp.full((2, room), jnp.inf).at[0, 0].set(model.value)
    assigned, codes, bounds, count, looked_at = jax.lax.while_loop(
        lambda carry: (carry[0] < tables.count) & (carry[3] <= LONGEST),
        assign,
        (0, codes, bounds, jnp.asarray(1), jnp.asarray(0)),
    )
    end = assigned % 2
    there = np.arange(LONGEST) < count
    return Listed(codes[end, :LONGEST], jnp.where(there, bounds[end, :LONGEST], jnp.inf), count, looked_at)
