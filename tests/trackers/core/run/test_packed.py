"""Packed trees hold the arrays of the tree, whatever their types and shapes."""

from __future__ import annotations

import pickle
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.run.chunks import PackedResult, packed


class _Pair(NamedTuple):
    left: object
    right: object


def _tree(scale, rows):
    floats = scale * jnp.arange(2.0 * rows).reshape(rows, 2)
    return _Pair({"a": floats, "b": floats[:, :0]}, (jnp.int8(3), _Pair(floats > 1, (None, scale * jnp.ones((2, 1))))))


def _assert_same(unpacked, tree):
    assert jax.tree_util.tree_structure(unpacked) == jax.tree_util.tree_structure(tree)
    for one, other in zip(jax.tree_util.tree_leaves(unpacked), jax.tree_util.tree_leaves(tree), strict=True):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        np.testing.assert_array_equal(one, other)
        assert one.flags.writeable


def test_a_packed_tree_unpacks_to_its_arrays():
    tree = _tree(0.1, 3)
    result = packed(tree)
    assert len(result.arrays) == 3
    _assert_same(result.unpacked(), tree)


def test_a_compiled_function_returns_its_result_packed():
    result = eqx.filter_jit(PackedResult(_tree))(jnp.asarray(0.1), 3)
    _assert_same(result.unpacked(), _tree(jnp.asarray(0.1), 3))


def test_places_are_those_of_their_shapes_and_survive_pickling():
    places = packed(_tree(0.1, 3)).places
    again = pickle.loads(pickle.dumps(places))
    assert again == places == packed(_tree(0.2, 3)).places
    assert hash(again) == hash(places)
    assert places != packed(_tree(0.1, 4)).places
