"""Trees of arrays as one array of each type: a program's call costs some microseconds per array of its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


class Place(NamedTuple):
    """The place of one array of a tree: number of its packed array, start and end there, and its shape."""

    number: int
    start: int
    end: int
    shape: tuple[int, ...]


class Places:
    """A tree whose leaves are `Place`; comparable and picklable, unlike jax's tree structures."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree
        self.each, self.structure = jax.tree_util.tree_flatten(tree, is_leaf=lambda x: isinstance(x, Place))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Places) and (self.each, self.structure) == (other.each, other.structure)

    def __hash__(self) -> int:
        return hash((tuple(self.each), self.structure))

    def __reduce__(self) -> tuple[type[Places], tuple[Any]]:
        return Places, (self.tree,)


class Packed(eqx.Module):
    """A tree of arrays as `arrays`, one of each type, and their `places` there."""

    arrays: tuple[Any, ...]
    places: Places = eqx.field(static=True)

    def unpacked(self) -> Any:
        """The tree, its leaves as NumPy arrays."""
        # Copies, since arrays of jax are read-only.
        arrays = [np.array(x) for x in self.arrays]
        leaves = [arrays[number][start:end].reshape(shape) for number, start, end, shape in self.places.each]
        return jax.tree_util.tree_unflatten(self.places.structure, leaves)


def packed(tree: Any) -> Packed:
    """The tree of arrays, traced or not, as one array of each type."""
    leaves, structure = jax.tree_util.tree_flatten(tree)
    types: dict[Any, list[Any]] = {}
    sizes: dict[Any, int] = {}
    places = []
    for leaf in map(jnp.asarray, leaves):
        of_type = types.setdefault(leaf.dtype, [])
        of_type.append(leaf.ravel())
        start = sizes.get(leaf.dtype, 0)
        sizes[leaf.dtype] = start + leaf.size
        places.append(Place(list(types).index(leaf.dtype), start, start + leaf.size, leaf.shape))
    arrays = tuple(jnp.concatenate(parts) for parts in types.values())
    return Packed(arrays, Places(jax.tree_util.tree_unflatten(structure, places)))


@dataclass(frozen=True)
class PackedResult:
    """A function of a model and a batch whose result is packed."""

    function: Callable[[Any, Any], Any]

    def __call__(self, model: Any, part: Any) -> Packed:
        return packed(self.function(model, part))
