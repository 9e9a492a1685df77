"""A Kalman filter whose update integrates over the position over the floor, for errors that depend on the place.

    u, v  position x, y in independent unit normals      b  bias of a channel, linear in the state

The prior of the position is taken at Gauss–Hermite points. At each the bias is a normal, so that the reading is the
scalar update of one state by Student's t noise as in `ekf.py`, and the point has the weight of the reading's density.
The update matches mean and covariance of the posterior of u, v and b; the other states follow by their regression. So a
measurement may bend, and its noise change, within the spread of the position, where a linearisation knows one slope.

The log-likelihood is the log of the mean density over the points. The NIS is from the innovation's mean and variance
over them, weighted for Student's t as in `ekf.py`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.filters.ekf import AbstractExtendedKalman, ExtendedKalman, above_resolution, square_roots
from trackwright.trackers.core.filters.filter import Innovation
from trackwright.trackers.core.model.algebra import Scalar, compute_once, full, select, total, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, student_t_log_peak
from trackwright.trackers.core.model.state import component_names, coordinates, retract


class AtPoints(NamedTuple):
    """One channel at q points, (q,) each: innovation without the bias, factor of the bias, scale of t noise of `dof`.

    The unit of the first and the third is the channel's.
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


class QuadratureKalman(AbstractExtendedKalman):
    """The filter of this module, with `points` along each axis, for an `AbstractPlaceSensor`; the EKF for all else.

    The state has a `position` that begins with x and y.
    """

    points: int = eqx.field(static=True, default=5)

    def update(
        self, belief: Gaussian, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[Gaussian, Innovation]:
        """The belief after one reading, channel by channel, and the reading's `Innovation`."""
        if not isinstance(sensor, AbstractPlaceSensor):
            return ExtendedKalman().update(belief, motion, sensor, reading, inputs)
        innovations = []
        for channel, seen in enumerate(reading.seen):
            point, rebuild = coordinates(belief.mean)
            values, rows = linearise(lambda *x, at=rebuild: sensor.biases(motion.view(at(x)), inputs), point)
            first = component_names(belief.mean).index("position.0")
            roots, factor = square_roots(belief.cov, [{first: 1.0}, {first + 1: 1.0}, rows[channel]], len(point))
            u, v, weights = (jnp.asarray(a, point[0].dtype) for a in _gauss_hermite(self.points))
            x, y = point[first] + factor[0, 0] * u, point[first + 1] + factor[1, 0] * u + factor[1, 1] * v
            bias = values[channel] + factor[2, 0] * u + factor[2, 1] * v
            innovation, slope, sigma, dof = sensor.at_points(reading, inputs, x, y)[channel]
            innovation, slope = innovation - slope * bias, slope * factor[2, 2]
            spread = slope**2 + sigma**2
            square = innovation**2 / spread
            density = student_t_log_peak(dof) - 0.5 * ((dof + 1.0) * jnp.log1p(square / dof) + jnp.log(spread))
            log_likelihood = jax.scipy.special.logsumexp(jnp.log(weights) + density)
            posterior = jnp.exp(jnp.log(weights) + density - log_likelihood)
            gain = slope / (slope**2 + sigma**2 * (dof + square) / (dof + 1.0))
            each = [u, v, gain * innovation]
            means = [jnp.sum(posterior * z) for z in each]
            away = [z - mean for z, mean in zip(each, means, strict=True)]
            change = [jnp.sum(posterior * away[i] * away[j]) - float(i == j) for i, j in triangle(3)]
            change[-1] = jnp.sum(posterior * (away[2] ** 2 - gain * slope))
            step = total(root * mean for root, mean in zip(roots, means, strict=True))
            after = Gaussian(retract(belief.mean, step), _changed(belief.cov, roots, change))
            belief = compute_once(select(seen, after, belief))
            middle = jnp.sum(weights * innovation)
            nis = middle**2 / jnp.sum(weights * ((innovation - middle) ** 2 + spread))
            nis = nis * (dof + 1.0) / (dof + nis)
            terms = log_likelihood, nis, jnp.ones_like(nis), jnp.zeros_like(nis)
            innovations.append([jnp.where(seen, term, 0.0) for term in terms])
        sums = Innovation(*(total(x) for x in zip(*innovations, strict=True)))
        return Gaussian(belief.mean, above_resolution(belief.cov, coordinates(belief.mean)[0])), sums


def _gauss_hermite(points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two independent unit normals and the weight, (q,) each, of a square of points."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    u, v = np.meshgrid(nodes, nodes, indexing="ij")
    return u.ravel(), v.ravel(), np.outer(weights, weights).ravel() / weights.sum() ** 2


def _changed(cov: Any, roots: Sequence[Any], change: Sequence[Scalar]) -> Any:
    """P + UDUᵀ with the columns U of `roots` and the upper triangle of D, the change of u, v and b."""
    sides = [total(root * d for root, d in zip(roots, row, strict=True)) for row in full(change, len(roots))]
    if isinstance(cov, tuple):
        pairs = zip(cov, triangle(len(roots[0])), strict=True)
        return tuple(p + total(a[i] * b[j] for a, b in zip(roots, sides, strict=True)) for p, (i, j) in pairs)
    half = total(a[:, None] * b[None] for a, b in zip(roots, sides, strict=True))
    return cov + 0.5 * (half + half.T)
