"""The median of a window in which some values are missing."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp


def middle(last: Any) -> Any:
    """The median over the first axis of what isn't NaN: of an even number the mean of the middle two; NaN for none.

    Equation (1) of Huang et al. 2018; the (n + 1)-th of 2n + 1 values, where the paper's text has the n-th.
    """
    ordered = jnp.sort(last, axis=0)  # NaN comes last
    count = jnp.sum(jnp.isfinite(last), axis=0)
    pick = [jnp.clip(k, 0, last.shape[0] - 1) for k in ((count - 1) // 2, count // 2)]
    low, high = (jnp.take_along_axis(ordered, k[None], axis=0)[0] for k in pick)
    return jnp.where(count > 0, 0.5 * (low + high), jnp.nan)
