"""Lanes: many variants of one thing, with what they share kept once; how programs run over them.

A sweep over tunings has one dynamic matrix, and batching it with the rest would cost a copy per lane. `Lanes` therefore
keeps what has a lane axis apart from what has none, and `one_by_one` makes a CPU take one lane after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import numpy as np

from jaxmpc.errors import InputError

F = TypeVar("F", bound=Callable)
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Lanes(eqx.Module, Generic[T_co]):
    """A batch of `T`, split into arrays with a leading lane axis and everything else."""

    each: Any  # a `T` with the arrays that have a lane axis, None in all other places
    shared: Any  # a `T` with None in these places and what all lanes share in the others

    @property
    def count(self) -> int | None:
        """Number of lanes; None where everything is shared."""
        sizes = {np.shape(leaf)[0] for leaf in jax.tree.leaves(self.each)}
        if len(sizes) > 1:
            raise InputError("lanes", sorted(sizes), "arrays with lane axes of one length")
        return sizes.pop() if sizes else None

    @property
    def value(self) -> T_co:
        """The `T` whose arrays have a lane axis where `each` has them."""
        return eqx.combine(self.each, self.shared)

    def vmap(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """The results of ``function(lane, *arguments)``, whose arguments have a lane axis each."""
        return jax.vmap(lambda own, *rest: function(eqx.combine(own, self.shared), *rest))(
            self.each, *arguments
        )

    def lane(self, k: int) -> T_co:
        """The `T` of lane k alone."""
        return eqx.combine(jax.tree.map(lambda leaf: leaf[k], self.each), self.shared)

    def take(self, index: np.ndarray) -> Lanes[T_co]:
        """The lanes at these positions, repeats allowed; their arrays are NumPy's."""
        return Lanes(jax.tree.map(lambda leaf: np.asarray(leaf)[index], self.each), self.shared)


def per_lane(value: T) -> Lanes[T]:
    """Lanes whose every JAX array has a lane axis, such as what `eqx.filter_vmap` returns."""
    return Lanes(*eqx.partition(value, eqx.is_array))


def for_all(value: T) -> Lanes[T]:
    """Lanes that share everything."""
    return Lanes(*eqx.partition(value, lambda _: False))


def lanes_of(trees: Sequence[T], *, shared: bool | None = None) -> Lanes[T]:
    """Lanes of separate trees of one form.

    Args:
        shared: whether the first is shared by all lanes, however many there are; if not given, where it is the only one.
    """
    nothing = jax.tree.map(lambda _: None, trees[0])
    if len(trees) == 1 if shared is None else shared:
        return Lanes(nothing, trees[0])
    return Lanes(jax.tree.map(lambda *leaves: np.stack(leaves), *trees), nothing)


def in_pieces(call: Callable[..., T], size: int, *arrays: np.ndarray) -> T:
    """What a call finds for the entries of arrays, `size` at a time, so that one program serves any number of them.

    The last piece is filled up with the last entry.
    """
    count = len(arrays[0])
    entry = np.minimum(np.arange(-(-count // size) * size), count - 1).reshape(-1, size)
    pieces = [jax.tree.map(np.asarray, call(*(array[own] for array in arrays))) for own in entry]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *pieces)


def one_by_one(function: F) -> F:
    """The function with a `jax.vmap` that on a CPU solves lane after lane, so that none pays for the slowest.

    Loops of lanes that differ in length then end when each is done. Accelerators take all lanes in lockstep.
    """
    traced: Any = jax.jit(function, inline=True)  # once for a lane by itself and for those of a batch
    lane: Any = jax.custom_batching.custom_vmap(traced)

    @lane.def_vmap
    def _(size: int, batched, *arguments):
        leaves, form = jax.tree.flatten(arguments)
        mine = jax.tree.leaves(tuple(batched))

        def call(some):
            some = iter(some)
            whole = [next(some) if its else v for v, its in zip(leaves, mine, strict=True)]
            # vmapped once more, this is a batch again
            return lane(*form.unflatten(whole))

        own = [v for v, its in zip(leaves, mine, strict=True) if its]
        if jax.default_backend() == "cpu":
            result: Any = jax.lax.map(call, own)
        else:
            axes = jax.tree.map(lambda its: 0 if its else None, tuple(batched))
            result = jax.vmap(traced, in_axes=axes, axis_size=size)(*arguments)
        return result, jax.tree.map(lambda _: True, result)

    return lane
