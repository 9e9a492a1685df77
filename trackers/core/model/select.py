"""Selection between two trees of arrays, per trajectory, without a copy where all trajectories agree."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from trackwright.trackers.core.model.algebra import Scalar


def select(condition: Scalar, yes: Any, no: Any) -> Any:
    """The tree `yes` where the condition holds, else `no`."""
    return jax.tree_util.tree_map(lambda a, b: jnp.where(condition, a, b), yes, no)


@custom_vmap
def where_mostly(condition: Scalar, yes: Any, no: Any) -> Any:
    """`select` for large trees and a condition that usually holds in all trajectories: nothing is copied then."""
    return select(condition, yes, no)


@where_mostly.def_vmap
def _in_trajectories(size: int, batched: Any, condition: Any, yes: Any, no: Any) -> tuple[Any, Any]:
    def spread(x: Any, has: bool) -> Any:
        return x if has else jnp.broadcast_to(x[None], (size, *x.shape))

    condition, yes, no = jax.tree_util.tree_map(spread, (condition, yes, no), tuple(batched))
    chosen = jax.lax.cond(jnp.all(condition), lambda: yes, lambda: jax.vmap(select)(condition, yes, no))
    return chosen, jax.tree_util.tree_map(lambda _: True, chosen)
