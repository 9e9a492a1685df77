"""The forward algorithm of a hidden Markov chain that is now and then drawn anew, in as many steps as it has states.

    π  the states' shares    κ  exp(−rate·dt), the chance that the state was not drawn anew    A = κ I + (1 − κ) 1πᵀ

Huang et al. 2018 have κ = 0: every row of A is the distribution of accelerations, so that the chain has no memory,
its forward filter is the posterior of one step, and its prediction is π, whose mean is zero. With κ > 0 an acceleration
lasts, for 1/rate seconds on average however the rows fall.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from trackers.core.algebra import Scalar


def moved(weights: Any, shares: Any, kept: Scalar) -> Any:
    """The states' probabilities (N,) a step later, wᵀA, in O(N)."""
    return kept * weights + (1.0 - kept) * (jnp.sum(weights) * shares)


def heard(weights: Any, log_likelihoods: Any) -> tuple[Any, Scalar]:
    """The states' probabilities (N,) after an observation of these log-likelihoods (N,), and its log-probability."""
    top = jnp.max(log_likelihoods)
    joint = weights * jnp.exp(log_likelihoods - top)
    whole = jnp.maximum(jnp.sum(joint), jnp.finfo(joint.dtype).tiny)
    return joint / whole, top + jnp.log(whole)
