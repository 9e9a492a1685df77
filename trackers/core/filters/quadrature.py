"""A Kalman filter whose update integrates over the position over the floor, for errors that depend on the place.

    p  position x, y        b  bias of a channel, linear in the state      y  p and b in independent unit normals
    d  one point of p       e  innovation at it without the bias           s  factor of the bias there

The prior of p is taken at Gauss–Hermite points. At each the bias is a normal given p, so that the reading is the scalar
update of one state by Student's t noise as in `ekf.py`, and the point has the weight of the reading's density. The
update matches mean and covariance of the posterior of y; the other states follow by their regression on y. So a
measurement may bend, and its noise change, within the spread of the position, where a linearisation knows one slope.

The log-likelihood is the mixture's, the log of the mean density over the points. The NIS is from the
innovation's mean and variance over the points, weighted for Student's t as in `ekf.py`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.filters.ekf import ExtendedKalman, above_resolution, square_roots
from trackwright.trackers.core.filters.filter import AbstractSmoothableFilter, Innovation
from trackwright.trackers.core.filters.rts import RtsGain
from trackwright.trackers.core.model.algebra import Scalar, compute_once, select, total
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.keys import RawKey
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, student_t_log_peak
from trackwright.trackers.core.model.state import State, component_names, coordinates, retract


class AtPoints(NamedTuple):
    """One channel of a reading, given the position at each of q points, (q,) each.

    `innovation`: the reading less the prediction without the bias. `slope`: the factor of the bias. `sigma`: the scale
    of Student's t noise of `dof` degrees of freedom.
    """

    innovation: Any
    slope: Any
    sigma: Any
    dof: Scalar


class AbstractPlaceSensor(AbstractSensor):
    """A sensor whose channels depend on the position over the floor, and linearly on one bias each."""

    @abstractmethod
    def biases(self, view: Any, inputs: Inputs) -> Sequence[Scalar]:
        """The bias of each channel, linear in the state."""

    @abstractmethod
    def at_points(self, reading: Reading, inputs: Inputs, x: Any, y: Any) -> Sequence[AtPoints]:
        """Each channel of a reading at points x, y (q,), m; masked channels have any finite numbers."""


class QuadratureKalman(AbstractSmoothableFilter[Gaussian]):
    """The filter of this module for sensors that are an `AbstractPlaceSensor`, and the EKF for all else.

    `points`: along each axis. The state has a `position` that begins with x and y.
    """

    points: int = eqx.field(static=True, default=5)
    ekf: ExtendedKalman = ExtendedKalman()

    def init(self, belief: Gaussian, key: RawKey) -> Gaussian:
        return self.ekf.init(belief, key)

    def moments(self, belief: Gaussian) -> tuple[State, AnyCovariance]:
        return self.ekf.moments(belief)

    def predict(self, belief: Gaussian, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> Gaussian:
        return self.ekf.predict(belief, motion, inputs, dt)

    def rts_gain(
        self, belief: Gaussian, motion: AbstractMotion, connected: Scalar, dt: Scalar, inputs: Inputs
    ) -> RtsGain:
        return self.ekf.rts_gain(belief, motion, connected, dt, inputs)

    def rts_step(self, rts_gain: RtsGain, after: Gaussian) -> Gaussian:
        return self.ekf.rts_step(rts_gain, after)

    def update(
        self, belief: Gaussian, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[Gaussian, Innovation]:
        if not isinstance(sensor, AbstractPlaceSensor):
            return self.ekf.update(belief, motion, sensor, reading, inputs)
        first = component_names(belief.mean).index("position.0")
        innovations = []
        for channel, seen in enumerate(reading.seen):
            after, innovation = self._channel(belief, first, motion, sensor, reading, inputs, channel)
            belief = compute_once(select(seen, after, belief))
            innovations.append([jnp.where(seen, x, 0.0) for x in innovation])
        mean, cov = belief
        sums = Innovation(*(total(x) for x in zip(*innovations, strict=True)))
        return Gaussian(mean, above_resolution(cov, coordinates(mean)[0])), sums

    def _channel(
        self,
        belief: Gaussian,
        first: int,
        motion: AbstractMotion,
        sensor: AbstractPlaceSensor,
        reading: Reading,
        inputs: Inputs,
        channel: int,
    ) -> tuple[Gaussian, Innovation]:
        """The belief after one channel, were it seen."""
        point, rebuild = coordinates(belief.mean)
        values, rows = linearise(lambda *x: sensor.biases(motion.view(rebuild(x)), inputs), point)
        roots, factor = square_roots(belief.cov, [{first: 1.0}, {first + 1: 1.0}, rows[channel]], len(point))
        unit, weights = (jnp.asarray(x, point[0].dtype) for x in gauss_hermite(self.points))
        x = point[first] + factor[0, 0] * unit[:, 0]
        y = point[first + 1] + factor[1, 0] * unit[:, 0] + factor[1, 1] * unit[:, 1]
        at = sensor.at_points(reading, inputs, x, y)[channel]
        bias = values[channel] + factor[2, 0] * unit[:, 0] + factor[2, 1] * unit[:, 1]
        slope, variance = at.slope * factor[2, 2], at.sigma**2
        innovation, spread = at.innovation - at.slope * bias, slope**2 + at.sigma**2
        square = innovation**2 / spread
        log_density = student_t_log_peak(at.dof) - 0.5 * ((at.dof + 1.0) * jnp.log1p(square / at.dof) + jnp.log(spread))
        logarithms = jnp.log(weights) + log_density
        log_likelihood = jax.scipy.special.logsumexp(logarithms)
        posterior = jnp.exp(logarithms - log_likelihood)
        gain = slope / (slope**2 + variance * (at.dof + square) / (at.dof + 1.0))
        each = [unit[:, 0], unit[:, 1], gain * innovation]
        means = [jnp.sum(posterior * z) for z in each]
        away = [z - mean for z, mean in zip(each, means, strict=True)]
        change = {(i, j): jnp.sum(posterior * away[i] * away[j]) - float(i == j) for i in range(3) for j in range(i, 3)}
        change[2, 2] = jnp.sum(posterior * (away[2] ** 2 - gain * slope))
        step = total(root * mean for root, mean in zip(roots, means, strict=True))
        middle = jnp.sum(weights * innovation)
        about = jnp.sum(weights * ((innovation - middle) ** 2 + spread))
        nis = middle**2 / about * (at.dof + 1.0) / (at.dof + middle**2 / about)
        one = jnp.ones_like(nis)
        after = Gaussian(retract(belief.mean, step), changed(belief.cov, roots, change))
        return after, Innovation(log_likelihood, nis, one, 0.0 * one)


def gauss_hermite(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (q, 2) of independent unit normals and their weights (q,), with `points` along each axis."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    weights = weights / weights.sum()
    return np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2), np.outer(
        weights, weights
    ).ravel()


def changed(cov: AnyCovariance, roots: Sequence[Any], change: dict[tuple[int, int], Scalar]) -> AnyCovariance:
    """P + UDUᵀ with the columns U of `roots` and the upper triangle of D, the change of the covariance of y."""
    full = [[change[min(i, j), max(i, j)] for j in range(len(roots))] for i in range(len(roots))]
    sides = [total(root * d for root, d in zip(roots, row, strict=True)) for row in full]
    if isinstance(cov, tuple):
        n = len(roots[0])
        pairs = zip(cov, ((i, j) for i in range(n) for j in range(i, n)), strict=True)
        return tuple(p + total(a[i] * b[j] for a, b in zip(roots, sides, strict=True)) for p, (i, j) in pairs)
    half = total(a[:, None] * b[None] for a, b in zip(roots, sides, strict=True))
    matrix: Any = cov + 0.5 * (half + half.T)
    return matrix
