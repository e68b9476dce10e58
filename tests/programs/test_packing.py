"""Trees of arrays as one array, and back."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.programs.lanes import Lanes
from jaxmpc.programs.packing import Packing, flattened, rebuilt
from jaxmpc.relaxed.newton import WarmStart

SHAPES = ((4,), (7,), (2, 4), (2,), (6,), (4,), (2,))  # of moves and prices


def tree():
    rng = np.random.default_rng(0)
    start = WarmStart(*(rng.normal(size=(3, *shape)) for shape in SHAPES))
    return start, {"status": np.array([0, 3, 1], dtype=np.int32), "good": np.array([True, False, True])}


def assert_same(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_a_tree_comes_back_as_it_was_on_the_host_and_from_a_compiled_call():
    packing, given = Packing.of(tree()), tree()
    assert_same(packing.unpack(packing.pack(given)), given)
    twice = jax.jit(lambda packed: packing.pack(jax.tree.map(lambda v: v, packing.unpack(packed))))
    assert_same(packing.unpack(np.asarray(twice(packing.pack(given)))), given)


def test_parts_on_the_host_are_views():
    packing = Packing.of(tree())
    packed = packing.pack(tree())
    start, _ = packing.unpack(packed)
    packed[1, 0] = 123.0
    assert start.x[1, 0] == 123.0


def test_packings_of_equal_shapes_are_one_static_argument():
    shapes = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, tree()))
    assert Packing.of(tree()) == Packing.of(shapes)
    assert hash(Packing.of(tree())) == hash(Packing.of(shapes))
    assert Packing.of(tree()) != Packing.of(tree()[0])


def test_a_module_taken_apart_is_the_same_module_and_its_form_a_static_argument():
    each = WarmStart(*(np.full(shape, 1.0) for shape in SHAPES))
    other = jax.tree.map(lambda v: 2.0 * v, each)
    (leaves, form), (others, same) = (flattened(Lanes(own, (None, "shared"))) for own in (each, other))
    assert form == same  # arrays are not part of it
    assert hash(form) == hash(same)
    assert_same(rebuilt(form, leaves).each, each)
    assert_same(rebuilt(form, others).each, other)
    assert rebuilt(form, leaves).shared == (None, "shared")
    assert form != flattened(Lanes(each, (None, "another")))[1]
    assert form != leaves
