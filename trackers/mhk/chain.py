"""Forward algorithm of a hidden Markov model whose state is kept or drawn anew, in O(N) per epoch.

    π  stationary distribution    κ = exp(−rate·dt)  probability of keeping the state    A = κ I + (1 − κ) 1πᵀ

In Huang et al. 2018 κ = 0: all rows of A are the distribution of accelerations, so the chain has no memory, its
filtered distribution depends on the last observation alone, and its prediction is π, with mean zero. With κ > 0 an
acceleration lasts 1/rate seconds on average, whatever the sampling interval.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from trackwright.trackers.core.model.algebra import Scalar


def predicted(weights: Any, stationary: Any, kappa: Scalar) -> Any:
    """The predicted state probabilities wᵀA, (N,), from the filtered ones and the stationary distribution."""
    return kappa * weights + (1.0 - kappa) * (jnp.sum(weights) * stationary)


def updated(weights: Any, log_likelihoods: Any) -> tuple[Any, Scalar]:
    """The filtered state probabilities (N,) given the states' log-likelihoods (N,), and the log-evidence."""
    top = jnp.max(log_likelihoods)
    joint = weights * jnp.exp(log_likelihoods - top)
    # Before a track starts all weights are zero; a quotient by the smallest number would have no derivative there.
    evidence = jnp.sum(joint)
    evidence = jnp.where(evidence > 0, evidence, 1.0)
    return joint / evidence, top + jnp.log(evidence)
