"""Differential equations of plants: classical Runge-Kutta steps with held inputs, and steady states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmpc.check import is_number
from jaxmpc.errors import InputError
from jaxmpc.programs.numerics import largest

NEWTON_STEPS = 25


def whole_steps(dt: Any, substep: Any) -> int:
    """Number of integration steps in one sample; raises `InputError` if that is no whole number."""
    for name, value in (("dt", dt), ("substep", substep)):
        if not is_number(value) or value <= 0:
            raise InputError(f"plant.{name}", value, "a positive number of seconds")
    steps = round(dt / substep)
    if abs(dt / substep - steps) > 1e-9 or steps < 1:
        raise InputError("plant.dt", dt, f"a whole number of substeps of {substep} s")
    return steps


def runge_kutta(slope: Callable[[tuple], Any], x: tuple, steps, substep: float) -> tuple:
    """Integrate ``dx/dt = slope(x)`` over `steps` classical fourth-order Runge-Kutta steps of `substep` seconds."""

    def one(_, x):
        # the stages are a loop, so that a program holds the slope once
        def stage(i, k):
            h = jnp.asarray([0.0, 0.5 * substep, 0.5 * substep, substep])[i]
            ahead = tuple(a + h * b[jnp.maximum(i - 1, 0)] for a, b in zip(x, k, strict=True))
            return tuple(b.at[i].set(new) for b, new in zip(k, slope(ahead), strict=True))

        k = jax.lax.fori_loop(0, 4, stage, tuple(jnp.zeros((4, *jnp.shape(a))) for a in x))
        return tuple(a + substep / 6 * (b[0] + 2 * (b[1] + b[2]) + b[3]) for a, b in zip(x, k, strict=True))

    return jax.lax.fori_loop(0, steps, one, x)


class Settled(NamedTuple):
    """What `settle` finds."""

    state: Float[Array, " state"]  # scaled; of the last round, where none is steady
    drift: Float[Array, ""]  # largest scaled rate of change left [1/s]
    rounds: Int[Array, ""]  # of simulation on the way


def settle(
    drift: Callable[[Array], Array],
    onward: Callable[[Array, Array], Array],
    start: Float[Array, " state"],
    *,
    first_step: float,
    tolerance: float,
    rounds: int,
) -> Settled:
    """A steady state for held inputs: Newton's method, from states further and further along a simulation.

    Newton's method alone is lost between one-way valves and the like, and simulation alone is slow to finish. A result of
    Newton's method counts only if it lies near the state it started from.

    Args:
        drift: rate of change of a scaled state [1/s].
        onward: ``(state, wanted)``: the state one round of simulation later, or itself where that is not wanted.
        start: scaled.
        first_step: pseudo time step of the first of Newton's steps [s].
        tolerance: largest drift that counts as steady [1/s].
        rounds: of simulation at most.
    """

    def size(s):
        return largest(drift(s))

    def newton_step(count, s):
        # The growing time step keeps the matrix regular where a state has no unique equilibrium.
        step = first_step * 10.0 ** jnp.minimum(count, 12)
        return s + jnp.linalg.solve(jnp.eye(s.shape[0]) / step - jax.jacfwd(drift)(s), drift(s))

    def polish(s):
        new = jax.lax.fori_loop(0, NEWTON_STEPS, newton_step, s)
        near = largest((new - s) / (jnp.abs(s) + 0.05)) < 0.3
        return jnp.where(near & (size(new) <= tolerance), new, s)

    def unfinished(carry):
        s, done = carry
        return (size(s) > tolerance) & (done < rounds)

    def advance(carry):
        s, done = carry
        s = polish(s)
        wanted = ~(size(s) <= tolerance)
        return onward(s, wanted), done + wanted

    s, done = jax.lax.while_loop(unfinished, advance, (start, jnp.asarray(0)))
    return Settled(s, size(s), done)
