"""A filter for a yaw that nobody knows at the start: as many filters as yaws to try, weighed by what they foretell."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, full, total, triangle
from trackers.core.ekf import ExtendedKalman, Gaussian, Innovation
from trackers.core.motion import AbstractMotion
from trackers.core.sensor import AbstractSensor, Reading
from trackers.core.state import Heading, Rotation, State, local, retract


class Yaws(NamedTuple):
    """A Gaussian sum: beliefs with a first axis of K yaws, and the log of their weights (K,)."""

    beliefs: Gaussian
    log_weights: Any


class YawGains(NamedTuple):
    """What ties each yaw's belief to its next one, and the filtered weights, which stand where no row follows."""

    each: Any
    log_weights: Any
    joined: Scalar


class YawBank(eqx.Module):
    """A Gaussian sum filter (Alspach & Sorenson 1972) over K yaws, evenly round the circle from the start's.

    A filter linearised at a yaw half a turn off goes the wrong way; one of several starts near enough. Each is the
    extended Kalman filter `kalman`; a state's `attitude` is a `Rotation` or a `Heading`.
    """

    kalman: ExtendedKalman = ExtendedKalman()
    count: int = eqx.field(static=True, default=3)

    def init(self, belief: Gaussian, key: Any) -> Yaws:
        """The belief at each of the yaws, all equally likely."""
        angles = np.arange(self.count) * (2 * np.pi / self.count)
        one = jnp.ones_like(belief.cov[0])
        beliefs = [belief._replace(mean=turned(belief.mean, one * a)) for a in angles]
        piled = jax.tree_util.tree_map(lambda *x: jnp.stack(x), *beliefs)
        return Yaws(piled, jnp.stack([one * -np.log(self.count)] * self.count))

    def predict(self, belief: Yaws, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Yaws:
        """Every yaw's belief `dt` seconds later."""
        each = jax.vmap(lambda b: self.kalman.predict(b, motion, inputs, dt))
        return belief._replace(beliefs=each(belief.beliefs))

    def update(
        self, belief: Yaws, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Any
    ) -> tuple[Yaws, Innovation]:
        """Every yaw's belief after one reading, weighed by what it had foretold; NIS and wraps are the likeliest's."""
        each = jax.vmap(lambda b: self.kalman.update(b, motion, sensor, reading, inputs))
        beliefs, said = each(belief.beliefs)
        joint = belief.log_weights + said.log_likelihood
        top = jnp.max(joint, axis=0)
        log_likelihood = top + jnp.log(jnp.sum(jnp.exp(joint - top), axis=0))
        best = _chosen(belief.log_weights)
        nis, nis_dof, wrapped = (_dotted(best, x) for x in (said.nis, said.nis_dof, said.wrapped))
        return Yaws(beliefs, joint - log_likelihood), Innovation(log_likelihood, nis, nis_dof, wrapped)

    def moments(self, belief: Yaws) -> tuple[State, tuple[Scalar, ...]]:
        """Mean and covariance of the sum, about the likeliest yaw's mean."""
        weights = [jnp.exp(belief.log_weights[k]) for k in range(self.count)]
        best = _chosen(belief.log_weights)
        parts = [jax.tree_util.tree_map(lambda x, k=k: x[k], belief.beliefs) for k in range(self.count)]
        centre = jax.tree_util.tree_map(lambda x: _dotted(best, x), belief.beliefs.mean)
        steps = [local(centre, part.mean) for part in parts]
        n = len(steps[0])
        mean = [total(w * step[i] for w, step in zip(weights, steps, strict=True)) for i in range(n)]
        covs = [full(part.cov, n) for part in parts]
        cov = tuple(
            total(
                w * (P[i][j] + (step[i] - mean[i]) * (step[j] - mean[j]))
                for w, P, step in zip(weights, covs, steps, strict=True)
            )
            for i, j in triangle(n)
        )
        return retract(centre, mean), cov

    def rts_gain(self, belief: Yaws, motion: AbstractMotion, joined: Scalar, dt: Scalar, inputs: Any) -> YawGains:
        """What ties a row's belief to the next row's: each yaw to itself, since none becomes another."""
        each = jax.vmap(lambda b: self.kalman.rts_gain(b, motion, joined, dt, inputs))
        return YawGains(each(belief.beliefs), belief.log_weights, joined)

    def rts_step(self, rts_gain: YawGains, after: Yaws) -> Yaws:
        """Every yaw smoothed by itself, weighed by what it had foretold of all rows to come."""
        log_weights = jnp.where(rts_gain.joined, after.log_weights, rts_gain.log_weights)
        return Yaws(jax.vmap(self.kalman.rts_step)(rts_gain.each, after.beliefs), log_weights)


def turned(state: State, angle: Scalar) -> State:
    """The state with its attitude turned about the vertical by an angle, rad."""
    if isinstance(state.attitude, Heading):
        return state._replace(attitude=Heading(state.attitude.angle + angle))
    zero = jnp.zeros_like(angle)
    return state._replace(attitude=Rotation.exp((zero, zero, angle)) @ state.attitude)


def _chosen(log_weights: Any) -> Any:
    """1 for the first of the largest weights, 0 for the others."""
    return jax.nn.one_hot(jnp.argmax(log_weights, axis=0), log_weights.shape[0], dtype=log_weights.dtype)


def _dotted(weights: Any, values: Any) -> Any:
    return jnp.sum(weights * values, axis=0)
