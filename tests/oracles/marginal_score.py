"""The score of a particle filter's likelihood over all pairs of particles (Poyiadjis, Doucet and Singh 2011, alg. 2).

    T'(x') = Σ w p(x'|x) (T(x) + ∇log p(x'|x)) / Σ w p(x'|x) + ∇log g(x')        score = Σ w' T'(x')

T of a particle is averaged over all possible ancestors instead of following one, so that the score's variance grows
with the number of rows, not with its square; the cost is N² densities per row.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.filters.particle.filter import (
    AbstractParticleFilter,
    Particles,
    normal_log_density,
    particle_residuals,
)
from trackwright.trackers.core.filters.particle.resampling import LOG_ZERO
from trackwright.trackers.core.model.algebra import Scalar, Vector, total, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import Reading, Row
from trackwright.trackers.core.model.state import State, component_names, dimension, local
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.scan import initial_carry
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.tuning.parameters import flatten, select_parameters, with_parameters

PAIRS = 2**18
"""Pairs of particles in all trajectories that run together; more would fill the memory of a small computer."""


Model = Callable[[Float[Array, " p"]], Tracker]
"""The tracker with the parameters of an unconstrained vector."""


class Carry(NamedTuple):
    """Carry of the scan: the belief, T of every particle (p, N), and log L."""

    belief: Particles
    scores: Float[Array, "p N"]
    value: Scalar


def marginal_scores(
    tracker: Tracker, batch: Batch, tune: str | Sequence[str]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n p"]]:
    """log L and its gradient with respect to the tunables matching the patterns, by the tracker's own particles.

    A track starts at its first row and is never lost. The motion's step has to be affine in its noise; raises
    ValueError where this does not reach every component of the state (system B: position follows from speed).
    """
    assert isinstance(tracker.filter, AbstractParticleFilter)
    parameters = select_parameters(tracker, tune)
    model = as_dtype(tracker, batch.dt.dtype)
    vector = jnp.asarray(flatten(parameters), batch.dt.dtype)

    n_workers = max(1, PAIRS // tracker.filter.bootstrap.n_particles**2)

    def one(trajectory: Batch) -> tuple[Float[Array, ""], Float[Array, " p"]]:
        return _of_trajectory(lambda v: freeze(with_parameters(model, parameters, v)), vector, trajectory)

    trajectories = jax.tree_util.tree_map(lambda x: jnp.moveaxis(jnp.asarray(x), -1, 0), batch)
    run = jax.jit(lambda trajectories: jax.lax.map(one, trajectories, batch_size=n_workers))
    values, scores = run(trajectories)
    return np.asarray(values), np.asarray(scores)


def _of_trajectory(
    model: Model, vector: Float[Array, " p"], trajectory: Batch
) -> tuple[Float[Array, ""], Float[Array, " p"]]:
    tracker = model(vector)
    number = jnp.arange(len(trajectory.dt), dtype=jnp.uint32)
    rows = Row(trajectory.dt, trajectory.valid, trajectory.readings, trajectory.inputs, None, number)
    row = jax.tree_util.tree_map(lambda x: x[0], rows)._replace(key=trajectory.key)
    candidate = jax.lax.stop_gradient(tracker.start.candidate(tracker.sensors, row))
    belief = initial_carry(tracker, candidate, row).belief

    def density(v: Float[Array, " p"]) -> Float[Array, " N"]:
        return normal_log_density(model(v).start.belief(candidate, row), belief.states)

    def step(carried: Carry, row: Row) -> tuple[Carry, None]:
        continued = _row(model, vector, carried, row._replace(key=trajectory.key))
        return jax.tree_util.tree_map(lambda a, b: jnp.where(row.valid, a, b), continued, carried), None

    begin = Carry(belief, jax.jacfwd(density)(vector).T, 0.0 * row.dt)
    last, _ = jax.lax.scan(step, begin, jax.tree_util.tree_map(lambda x: x[1:], rows))
    return last.value, jnp.sum(jnp.exp(last.belief.log_weights)[None, :] * last.scores, axis=-1)


def _row(model: Model, vector: Float[Array, " p"], carried: Carry, row: Row) -> Carry:
    """One row of a track that has started."""
    tracker = model(vector)
    before = carried.belief
    moved = belief = tracker.filter.predict(before, tracker.motion, row.inputs, row.dt)

    def moves(v: Float[Array, " p"]) -> Float[Array, "N N"]:
        return _pairs(model(v), before.states, moved.states, row)

    logits = before.log_weights[None, :] + moves(vector)
    shares = jax.nn.softmax(logits, axis=1)
    jacobian = jax.jacfwd(moves)(vector)
    scores = jnp.einsum("ij,pj->pi", shares, carried.scores, precision="highest")
    scores = scores + jnp.where(row.dt > 0, jnp.einsum("ij,ijp->pi", shares, jacobian, precision="highest"), 0.0)
    value = carried.value
    for name in tracker.sensors:
        reading = row.readings[name]

        def densities(v: Float[Array, " p"], name: str = name, reading: Reading = reading) -> Float[Array, " N"]:
            placed = model(v)
            return particle_residuals(
                moved.states, placed.motion, placed.sensors[name], reading, row.inputs
            ).log_density

        scores = scores + jax.jacfwd(densities)(vector).T
        belief, info = tracker.filter.update(belief, tracker.motion, tracker.sensors[name], reading, row.inputs)
        value = value + info.log_likelihood
    return Carry(belief, scores, value)


def _pairs(tracker: Tracker, before: State, after: State, row: Row) -> Float[Array, "N N"]:
    """log p (N, N), up to a constant, of every state after (rows) given every state before; for dt = 0 it stays."""
    particle_filter, motion = tracker.filter, tracker.motion
    assert isinstance(particle_filter, AbstractParticleFilter)
    potential = particle_filter.bootstrap.potential

    def densities(old: State) -> Float[Array, " N"]:
        moved = normal_log_density(_transition(motion, old, row.inputs, jnp.where(row.dt > 0, row.dt, 1.0)), after)
        if potential is not None:
            view = jax.vmap(motion.view, in_axes=-1, out_axes=-1)(after)
            moved = moved + jax.vmap(potential.log_weight, in_axes=(None, -1))(motion.view(old), view)
        leaves = zip(jax.tree_util.tree_leaves(old), jax.tree_util.tree_leaves(after), strict=True)
        same = jnp.all(jnp.stack([a == b for a, b in leaves]), axis=0)
        return jnp.where(row.dt > 0, moved, jnp.where(same, 0.0, LOG_ZERO))

    return jax.vmap(densities, in_axes=-1, out_axes=-1)(before)


def _transition(motion: AbstractMotion, before: State, inputs: Inputs, dt: Scalar) -> Gaussian:
    """The next state: the step without noise, and GGᵀ."""
    zeros = [jnp.zeros_like(dt)] * motion.noise_dimension
    predicted = motion.step(before, inputs, dt, Vector.of(zeros))
    _, G = linearise(lambda *w: local(predicted, motion.step(before, inputs, dt, Vector.of(w))), zeros)
    n = dimension(predicted)
    still = [k for k, row in zip(component_names(predicted), G, strict=True) if not row]
    if still or motion.noise_dimension < n:
        what = f"{', '.join(still)} has none" if still else f"it has {motion.noise_dimension} for {n} components"
        raise ValueError(
            f"the motion {type(motion).__name__} has no density of the next state given this one, which a marginal "
            f"score needs: its noise does not reach every component of the state ({what}); use the ParticleFilter's "
            "own derivative"
        )
    return Gaussian(predicted, tuple(total(g * G[j][k] for k, g in G[i].items() if k in G[j]) for i, j in triangle(n)))
