"""Median along an axis with missing values (NaN)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp


def nan_median(values: Any) -> Any:
    """The median over the first axis of the values that are not NaN; NaN where there are none.

    Equation (1) of Huang et al. 2018: of 2n + 1 values the (n + 1)-th in order, where the paper's text has the n-th; of
    an even number the mean of the two in the middle.
    """
    ordered = jnp.sort(values, axis=0)  # NaN comes last
    count = jnp.sum(jnp.isfinite(values), axis=0)
    pick = [jnp.clip(k, 0, values.shape[0] - 1) for k in ((count - 1) // 2, count // 2)]
    low, high = (jnp.take_along_axis(ordered, k[None], axis=0)[0] for k in pick)
    return jnp.where(count > 0, 0.5 * (low + high), jnp.nan)
