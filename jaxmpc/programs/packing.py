"""Many small arrays as one: what passes between host and device at every sample goes in one piece.

A compiled call costs some microseconds for every array that goes in or comes out, which adds up to more than the arithmetic
of a sample. What changes from sample to sample is packed (`Packing`); on the host its parts are views, nothing is copied.
What stays is taken apart only once (`flattened`), as a module of arrays would be at every call.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

FLOAT = np.dtype(float)


@dataclasses.dataclass(frozen=True)
class Packing:
    """Where the arrays of a tree lie in one array ``"lane entry"``; hashable, so that it can be a static argument."""

    form: Any  # structure of the tree
    shapes: tuple[tuple[int, ...], ...]  # of its arrays, without the lane axis
    kinds: tuple[np.dtype, ...]  # their types

    @classmethod
    def of(cls, tree: Any) -> Packing:
        """The packing of a tree whose arrays (or shapes) have a lane axis first."""
        leaves, form = jax.tree.flatten(tree)
        return cls(form, tuple(tuple(v.shape[1:]) for v in leaves), tuple(v.dtype for v in leaves))

    def pack(self, tree: Any):
        """One array ``"lane entry"`` of floats, NumPy's if all parts are."""
        leaves = self.form.flatten_up_to(tree)
        xp: Any = np if all(isinstance(v, np.ndarray) for v in leaves) else jnp
        return xp.concatenate([v.reshape(v.shape[0], -1).astype(float, copy=False) for v in leaves], axis=1)

    def unpack(self, packed) -> Any:
        """The tree again; views of `packed` where that is NumPy's and the part is of floats."""
        parts, begin = [], 0
        for shape, kind in zip(self.shapes, self.kinds, strict=True):
            end = begin + math.prod(shape)
            part = packed[:, begin:end].reshape(packed.shape[0], *shape)
            parts.append(part if kind == FLOAT else part.astype(kind))
            begin = end
        return self.form.unflatten(parts)


class Form:
    """All of a tree but its arrays, as a static argument: hashed once, where a module would be at every call."""

    def __init__(self, structure: Any, rest: Any):
        self.structure, self.rest = structure, rest
        self._hash = hash((structure, rest))

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other or not isinstance(other, Form):
            return self is other
        return self._hash == other._hash and (self.structure, self.rest) == (other.structure, other.rest)


def flattened(tree: Any) -> tuple[list[jax.Array], Form]:
    """The arrays of a tree, and its form; all else in the tree must be hashable.

    Python's numbers belong to the form: a plant whose parameters a program knows takes a fifth fewer operations.
    """
    arrays, rest = eqx.partition(tree, lambda leaf: isinstance(leaf, (jax.Array, np.ndarray, np.generic)))
    return [jnp.asarray(leaf) for leaf in jax.tree.leaves(arrays)], Form(jax.tree.structure(arrays), rest)


def rebuilt(form: Form, leaves: Any) -> Any:
    """The tree again; see `flattened`."""
    return eqx.combine(jax.tree.unflatten(form.structure, leaves), form.rest)


class PackedCall:
    """A compiled ``function(constant, *given)`` that takes and returns what changes in one piece.

    A copy learns the packings anew: forms of trees do not survive one.
    """

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self._packings: tuple[Packing, Packing] | None = None

    def __reduce__(self):
        return PackedCall, (self.function,)

    def __call__(self, constant: Any, flat: tuple[list[jax.Array], Form], *given: Any) -> Any:
        """What it returns, NumPy's arrays; `flat` is the constant `flattened`, all given has a lane axis first."""
        if self._packings is None:
            shapes = jax.eval_shape(self.function, constant, *given)
            self._packings = Packing.of(given), Packing.of(shapes)
        (leaves, form), (into, out) = flat, self._packings
        return out.unpack(np.asarray(_packed(leaves, into.pack(given), self.function, form, into)))


@functools.partial(jax.jit, static_argnames=("function", "form", "packing"))
def _packed(leaves, packed, function, form: Form, packing: Packing):
    out = function(rebuilt(form, leaves), *packing.unpack(packed))
    return Packing.of(out).pack(out)
