"""Lanes: many variants of one thing, with what they share kept once; run side by side on one device or on several.

A sweep over tunings has one dynamic matrix. Batching it with the rest would cost a copy per lane, and the single matrix
product that assembles all Newton matrices (`relaxed_problem.weighted_gram`). `Lanes` therefore keeps what has a lane axis
apart from what has none. `controller_batch` makes such controllers, `map_lanes` runs a function over lanes, and
`closed_loop.simulate_batches` closes their loops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxmpc.controller.continuous import ContinuousController, may_switch
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning, stack_tunings

BUILT_AT_ONCE = 256  # lanes; condensing one holds a weighted copy of the dynamic matrix for a moment
AXIS = "variant"  # name of the mesh axis
T = TypeVar("T")


class Lanes(eqx.Module, Generic[T]):
    """A batch of `T`, split into arrays with a leading lane axis and everything else.

    Attributes:
        each: a `T` with the arrays that have a lane axis, None in all other places.
        shared: a `T` with None in these places and what all lanes share in the others.
    """

    each: Any
    shared: Any

    @property
    def count(self) -> int | None:
        """Number of lanes; None where everything is shared."""
        sizes = {np.shape(leaf)[0] for leaf in jax.tree.leaves(self.each)}
        if len(sizes) > 1:
            raise InputError("lanes", sorted(sizes), "arrays with lane axes of one length")
        return sizes.pop() if sizes else None

    @property
    def value(self) -> T:
        """The `T` whose arrays have a lane axis where `axes` says so; what `jax.vmap` takes."""
        return eqx.combine(self.each, self.shared)

    @property
    def axes(self) -> T:
        """``in_axes`` of `value` for `jax.vmap` and `eqx.filter_vmap`: 0 for a lane axis, None for none."""
        return jax.tree.map(lambda _: 0, self.each)

    def lane(self, k: int) -> T:
        """The `T` of lane k alone."""
        return eqx.combine(jax.tree.map(lambda leaf: leaf[k], self.each), self.shared)

    def take(self, index: np.ndarray) -> Lanes[T]:
        """The lanes at these positions, repeats allowed; their arrays are NumPy's until `place` moves them."""
        return Lanes(jax.tree.map(lambda leaf: np.asarray(leaf)[index], self.each), self.shared)


def per_lane(value: T) -> Lanes[T]:
    """Lanes whose every JAX array has a lane axis, such as what `eqx.filter_vmap` returns."""
    return Lanes(*eqx.partition(value, eqx.is_array))


def for_all(value: T) -> Lanes[T]:
    """Lanes that share everything."""
    return Lanes(*eqx.partition(value, lambda _: False))


def lanes_of(trees: Sequence[T]) -> Lanes[T]:
    """Lanes of separate trees of one form; arrays that are equal in all of them are kept once."""
    leaves = [jax.tree.leaves(tree) for tree in trees]
    form = jax.tree.structure(trees[0])
    each, shared = [], []
    for values in zip(*leaves, strict=True):
        same = all(other is values[0] or np.array_equal(other, values[0]) for other in values[1:])
        shared.append(values[0] if same else None)
        each.append(None if same else jnp.stack(values))
    return Lanes(jax.tree.unflatten(form, each), jax.tree.unflatten(form, shared))


def controller_batch(
    structure: Structure,
    tunings: Tuning | Sequence[Tuning],
    model: StepResponseModel | Sequence[StepResponseModel],
    *,
    summed: bool | None = None,
) -> Lanes[ContinuousController]:
    """Continuous controllers of one structure, one per lane, with the matrices of a common model kept once.

    Args:
        structure: static configuration without integer MVs.
        tunings: a list of tunings, or one whose arrays have a lane axis (`stack_tunings`). With models per lane a single
            tuning stands for all lanes.
        model: shared by all lanes; or one per lane, as a list or with coefficients ``"lane cv mv n"``.
        summed: keep the running sums of the dynamic matrix. By default they are kept where it is shared, and left
            out where every lane would need its own.

    Returns:
        `Lanes`: `.value` and `.axes` for a vmap of your own, or the whole for `closed_loop.simulate_batches`.

    Raises:
        InputError: for no lanes at all, lanes of different counts, or models that differ in more than coefficients.
    """
    stacked = tunings if isinstance(tunings, Tuning) else stack_tunings(_some("tunings", tunings))
    one_model, coefficients = _coefficients(model)
    own_model = coefficients.ndim == 4
    tuned = stacked.cv_weight.ndim == 2
    counts = {np.shape(stacked.cv_weight)[0]} if tuned else set()
    counts |= {coefficients.shape[0]} if own_model else set()
    if len(counts) != 1:
        raise InputError(
            "tunings", f"lane counts {sorted(counts)}", "tunings or models with one lane axis, of one length"
        )
    summed, switching = (not own_model) if summed is None else summed, may_switch(stacked)
    each = (stacked if tuned else None, coefficients if own_model else None)

    def build(given: tuple[Tuning | None, Any]) -> ContinuousController:
        tuning, own = given
        fitted = eqx.tree_at(lambda m: m.coefficients, one_model, coefficients if own is None else own)
        known = dict(summed=summed, switching=switching)
        return ContinuousController(structure, stacked if tuning is None else tuning, fitted, **known)

    return build_lanes(build, each, counts.pop())


def _some(name: str, given: Sequence[T]) -> Sequence[T]:
    if not len(given):
        raise InputError(name, "nothing", "one or more, one per lane")
    return given


def _coefficients(model):
    """A model for names and dt, and the coefficients with or without a lane axis."""
    if isinstance(model, StepResponseModel):
        return model, jnp.asarray(model.coefficients)
    first, *others = _some("model", model)
    for k, other in enumerate(others, start=1):
        same = all(
            getattr(first, key) == getattr(other, key)
            for key in ("dt", "cv_names", "mv_names", "cv_units", "mv_units", "samples")
        )
        if not same:
            raise InputError(
                f"model[{k}]",
                f"{other.mv_names} -> {other.cv_names}, dt = {other.dt} s, {other.samples} coefficients",
                f"{first.mv_names} -> {first.cv_names}, dt = {first.dt} s, {first.samples} coefficients, as model[0]",
            )
    return first, jnp.stack([m.coefficients for m in (first, *others)])


def build_lanes(build: Callable[[Any], T], each: Any, count: int) -> Lanes[T]:
    """Lanes of what `build` returns; an array that does not depend on its argument is computed once and shared.

    Args:
        build: of one lane's arguments; pure.
        each: its arguments, arrays with a lane axis.
        count: number of lanes.
    """
    first = jax.tree.map(lambda leaf: leaf[0], each)
    template = eqx.filter_eval_shape(build, first)
    shapes, statics = eqx.partition(template, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))

    def arrays(given):
        return jax.tree.leaves(eqx.filter(build(given), eqx.is_array))

    varies = _depends(arrays, first)
    pick = lambda leaves, wanted: [v if w is wanted else None for v, w in zip(leaves, varies, strict=True)]  # noqa: E731

    @jax.jit
    def make(each, first):
        batch_size = min(count, BUILT_AT_ONCE)
        own = jax.lax.map(lambda one: pick(arrays(one), True), each, batch_size=batch_size)
        return own, pick(arrays(first), False)

    own, common = (jax.tree.unflatten(jax.tree.structure(shapes), part) for part in make(each, first))
    return Lanes(own, eqx.combine(common, statics))


def _depends(function: Callable[[Any], list], argument) -> list[bool]:
    """Which results depend on the argument: those that its values reach in the traced program."""
    program = jax.make_jaxpr(function)(argument).jaxpr
    return _reached(program, [True] * len(program.invars))


def _reached(program: Any, given: Sequence[bool]) -> list[bool]:
    """Which results of a traced program some of its arguments reach."""
    reached = {v for v, its in zip(program.invars, given, strict=True) if its}
    follows = lambda v: not isinstance(v, Literal) and v in reached  # noqa: E731
    for equation in program.eqns:
        into = [follows(v) for v in equation.invars]
        if not any(into):
            continue
        out = [True] * len(equation.outvars)
        if equation.primitive.name in ("jit", "pjit"):  # a compiled function has results of its own
            out = _reached(equation.params["jaxpr"].jaxpr, into)
        reached |= {v for v, its in zip(equation.outvars, out, strict=True) if its}
    return [follows(v) for v in program.outvars]


# ---------------------------------------------------------------------------------------------------- running


def variant_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """A mesh with the one axis `AXIS` over some devices, by default all of this process."""
    devices = jax.local_devices() if devices is None else devices
    return Mesh(np.array(list(devices)), (AXIS,))


def place(lanes: Lanes[T], mesh: Mesh) -> Lanes[T]:
    """Move lanes to the devices of a mesh, an equal share to each; the shared part goes to all.

    The number of lanes has to be a multiple of the number of devices.
    """
    put = lambda tree, spec: jax.device_put(tree, NamedSharding(mesh, spec))  # noqa: E731
    arrays, rest = eqx.partition(lanes.shared, eqx.is_array)
    return Lanes(put(lanes.each, PartitionSpec(AXIS)), eqx.combine(put(arrays, PartitionSpec()), rest))


@eqx.filter_jit
def map_lanes(function: Callable[..., Any], arguments: Sequence[Lanes], mesh: Mesh):
    """``function(*arguments)`` of every lane; compiled once per function, shapes and static parts, and kept.

    Devices work on their lanes alone and never wait for each other inside the function (a solver loop runs until the
    slowest lane *of its device* is done).

    Args:
        function: of one lane's arguments; returns arrays only.
        arguments: one `Lanes` per argument, on the devices of `mesh` (`place`).
        mesh: from `variant_mesh`.

    Returns:
        What `function` returns, with a lane axis first.
    """
    own, shared = [a.each for a in arguments], [a.shared for a in arguments]
    arrays, rest = eqx.partition(shared, eqx.is_array)

    def share(own, arrays):
        one = lambda lane: function(*map(eqx.combine, lane, arrays, rest))  # noqa: E731
        return jax.vmap(one)(own)

    if mesh.size == 1:
        return share(own, arrays)
    by_lane, everywhere = PartitionSpec(AXIS), PartitionSpec()
    split = jax.shard_map(
        share, mesh=mesh, in_specs=(by_lane, everywhere), out_specs=by_lane, check_vma=False
    )
    return split(own, arrays)
