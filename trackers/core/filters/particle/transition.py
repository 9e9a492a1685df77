"""Transition densities p(x' | x) of motions whose process noise has full rank."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.interpreters import partial_eval

from trackwright.trackers.core.model.algebra import Scalar, Vector, cholesky, solve_lower, total, triangle
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import LOG_2PI
from trackwright.trackers.core.model.state import State, component_names, dimension, local


def check_transition_density(motion: AbstractMotion, state: State, inputs: Inputs) -> None:
    """Raises ValueError, with the reason, unless the motion has a normal transition density.

    Needed: a step that is affine in the noise, and noise of full rank in the state.
    """
    n, name = dimension(state), type(motion).__name__
    dt = jnp.ones_like(jax.tree_util.tree_leaves(state)[0])
    zeros = [jnp.zeros_like(dt)] * motion.noise_dimension

    def step(*w: Scalar) -> list[Scalar]:
        return local(state, motion.step(state, inputs, dt, Vector.of(w)))

    still = [k for k, row in zip(component_names(state), linearise(step, zeros)[1], strict=True) if not row]
    if still or motion.noise_dimension < n:
        what = f"{', '.join(still)} has none" if still else f"it has {motion.noise_dimension} for {n} components"
        raise ValueError(
            f"the motion {name} has no density of the next state given this one, which a marginal score needs: its "
            f"noise does not reach every component of the state ({what}); use the ParticleFilter's own derivative"
        )
    columns = jax.make_jaxpr(jax.jacfwd(lambda w: jnp.stack(step(*w))))(jnp.stack(zeros))
    _, used = partial_eval.dce_jaxpr(columns.jaxpr, [True] * len(columns.jaxpr.outvars))
    if any(used):
        raise ValueError(
            f"the motion {name} is not affine in its noise, so that its next state has no normal density, which a "
            "marginal score needs; use the ParticleFilter's own derivative"
        )


def transition_log_density(motion: AbstractMotion, before: State, after: State, inputs: Inputs, dt: Scalar) -> Scalar:
    """log p(after | before) of a motion that passes `check_transition_density`: N(after; step without noise, GGᵀ)."""
    zeros = [jnp.zeros_like(dt)] * motion.noise_dimension
    predicted = motion.step(before, inputs, dt, Vector.of(zeros))
    n = dimension(predicted)
    _, G = linearise(lambda *w: local(predicted, motion.step(before, inputs, dt, Vector.of(w))), zeros)
    cov = {(i, j): total(g * G[j][k] for k, g in G[i].items() if k in G[j]) for i, j in triangle(n)}
    cov = {pair: c + jnp.zeros_like(dt) for pair, c in cov.items()}
    L = cholesky(cov, range(n), 0.0)
    whitened = solve_lower(L, local(predicted, after))
    scale = total(jnp.log(jnp.where(L[i, i] > 0, L[i, i], 1.0)) for i in range(n))
    return -scale - 0.5 * total(x * x for x in whitened) - 0.5 * n * LOG_2PI
