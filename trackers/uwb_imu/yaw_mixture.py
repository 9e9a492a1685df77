"""Gaussian sum filter over the initial yaw (Alspach and Sorenson 1972)."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.filters.filter import AbstractSmoothableFilter, Innovation
from trackwright.trackers.core.model.algebra import Scalar, total
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian, matched
from trackwright.trackers.core.model.inputs import AnyArray, Inputs, RawKey
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.core.model.state import Heading, Rotation, State, local, retract


class YawMixture(NamedTuple):
    """A Gaussian sum: beliefs with a first axis of K components, and their log-weights (K,)."""

    beliefs: Gaussian
    log_weights: AnyArray


class YawRtsGains(NamedTuple):
    """The RTS gains of each component, and the filtered weights, kept where the next row is not `connected`."""

    each: Any
    log_weights: AnyArray
    connected: Scalar


class YawMixtureFilter(AbstractSmoothableFilter[YawMixture]):
    """A Gaussian sum filter of `count` components, whose initial yaws divide the circle evenly.

    An EKF linearised at a yaw far from the truth diverges; one of the components is near enough. Each is the extended
    Kalman filter `kalman`; the state's `attitude` is a `Rotation` or a `Heading`.
    """

    kalman: ExtendedKalman = ExtendedKalman()
    count: int = eqx.field(static=True, default=3)

    def init(self, belief: Gaussian, key: RawKey) -> YawMixture:
        """The belief at each of the yaws, with equal weights."""
        angles = np.arange(self.count) * (2 * np.pi / self.count)
        one = jnp.ones_like(belief.cov[0])
        beliefs = [belief._replace(mean=with_yaw_added(belief.mean, one * a)) for a in angles]
        stacked = jax.tree_util.tree_map(lambda *x: jnp.stack(x), *beliefs)
        return YawMixture(stacked, jnp.stack([one * -np.log(self.count)] * self.count))

    def predict(self, belief: YawMixture, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> YawMixture:
        """Every component's belief `dt` seconds later."""
        each = jax.vmap(lambda b: self.kalman.predict(b, motion, inputs, dt))
        return belief._replace(beliefs=each(belief.beliefs))

    def update(
        self, belief: YawMixture, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[YawMixture, Innovation]:
        """Every component updated and re-weighted by its likelihood; NIS and wrap flag of the likeliest component."""
        each = jax.vmap(lambda b: self.kalman.update(b, motion, sensor, reading, inputs))
        beliefs, innovations = each(belief.beliefs)
        joint = belief.log_weights + innovations.log_likelihood
        top = jax.lax.stop_gradient(jnp.max(joint, axis=0))
        log_likelihood = top + jnp.log(jnp.sum(jnp.exp(joint - top), axis=0))
        best = _one_hot_maximum(belief.log_weights)
        nis, nis_dof, wrapped = (
            _weighted_sum(best, x) for x in (innovations.nis, innovations.nis_dof, innovations.wrapped)
        )
        return YawMixture(beliefs, joint - log_likelihood), Innovation(log_likelihood, nis, nis_dof, wrapped)

    def moments(self, belief: YawMixture) -> tuple[State, AnyCovariance]:
        """Mean and covariance of the mixture, in the tangent space at the mean of the likeliest component."""
        weights = [jnp.exp(belief.log_weights[k]) for k in range(self.count)]
        best = _one_hot_maximum(belief.log_weights)
        components = [jax.tree_util.tree_map(lambda x, k=k: x[k], belief.beliefs) for k in range(self.count)]
        centre = jax.tree_util.tree_map(lambda x: _weighted_sum(best, x), belief.beliefs.mean)
        steps = [local(centre, part.mean) for part in components]
        n = len(steps[0])
        mean = [total(w * step[i] for w, step in zip(weights, steps, strict=True)) for i in range(n)]
        deviations = [[s - m for s, m in zip(step, mean, strict=True)] for step in steps]
        cov = matched(weights, [part.cov for part in components], deviations)
        return retract(centre, mean), cov

    def rts_gain(
        self, belief: YawMixture, motion: AbstractMotion, connected: Scalar, dt: Scalar, inputs: Inputs
    ) -> YawRtsGains:
        """The RTS gains to the next row, component by component."""
        each = jax.vmap(lambda b: self.kalman.rts_gain(b, motion, connected, dt, inputs))
        return YawRtsGains(each(belief.beliefs), belief.log_weights, connected)

    def rts_step(self, rts_gain: YawRtsGains, after: YawMixture) -> YawMixture:
        """Every component smoothed, with the weights of the later rows."""
        log_weights = jnp.where(rts_gain.connected, after.log_weights, rts_gain.log_weights)
        return YawMixture(jax.vmap(self.kalman.rts_step)(rts_gain.each, after.beliefs), log_weights)


def with_yaw_added(state: State, angle: Scalar) -> State:
    """The state with its attitude rotated about the vertical by `angle`, rad."""
    if isinstance(state.attitude, Heading):
        return state._replace(attitude=Heading(state.attitude.angle + angle))
    zero = jnp.zeros_like(angle)
    return state._replace(attitude=Rotation.exp((zero, zero, angle)) @ state.attitude)


def _one_hot_maximum(log_weights: AnyArray) -> Any:
    """1 for the first of the largest weights, 0 for the others."""
    return jax.nn.one_hot(jnp.argmax(log_weights, axis=0), log_weights.shape[0], dtype=log_weights.dtype)


def _weighted_sum(weights: Any, values: Any) -> Any:
    return jnp.sum(weights * values, axis=0)
