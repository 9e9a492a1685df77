"""The bootstrap particle filter over named states, one trajectory and one step (Gordon, Salmond and Smith 1993).

Weights are kept as logarithms and resampling stands at the start of a step, so that estimates are taken before it.
Sums along the particles are small triangular matrix products and counts are whole numbers: `jnp.cumsum` and a binary
search per offspring cost more than all the rest, and floating cumulative sums need not rise.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, Vector, cholesky, inverse_or_zero, shared, total, triangle
from trackers.core.ekf import Gaussian, Innovation
from trackers.core.motion import AbstractMotion
from trackers.core.sensor import AbstractSensor, Reading, Residual
from trackers.core.state import State, dimension, local, retract

NOTHING = -1e30
"""The log-weight of a particle of weight zero: finite, so that a belief with some of them is one."""


class Particles(NamedTuple):
    """A belief: states whose leaves end with an axis of N particles, their log-weights (N,), and a raw key (2,)."""

    states: State
    log_weights: Any
    key: Any


class AbstractReport(eqx.Module):
    """What a filter shows of a state, where that is another quantity: a place on the floor for one on a line."""

    @property
    @abstractmethod
    def variances(self) -> tuple[Scalar, ...]:
        """What is added to the variance of each shown component: the inaccuracy of the map itself."""

    @abstractmethod
    def shown(self, state: State) -> State:
        """The shown quantity of one state."""


class ParticleFilter(eqx.Module):
    """`n_particles` weighted states; fewer than `fraction`·N effective ones are drawn again, systematically.

    Equations (1.22)–(1.30) of the assembly-line thesis, with E for the mean in (1.29); see `docs/papers.md`. Of a state
    with a `report`, estimates are the shown quantity of the weighted mean and its spread about that.
    """

    n_particles: int = eqx.field(static=True, default=1000)
    fraction: float = eqx.field(static=True, default=0.5)
    report: AbstractReport | None = None

    def init(self, belief: Gaussian, key: Any) -> Particles:
        """Particles drawn from a normal belief, all of weight 1/N (1.22); `key` (2,): raw random key."""
        n = dimension(belief.mean)
        key, use = jax.random.split(jax.random.wrap_key_data(key))
        pairs = dict(zip(triangle(n), belief.cov, strict=True))
        L = cholesky(pairs, range(n), 16 * float(jnp.finfo(belief.cov[0].dtype).eps))
        normals = jax.random.normal(use, (n, self.n_particles), belief.cov[0].dtype)
        steps = [total(L[i, j] * normals[j] for j in range(i + 1)) for i in range(n)]
        states = jax.vmap(lambda step: retract(belief.mean, list(step)), in_axes=-1, out_axes=-1)(jnp.stack(steps))
        even = jnp.full(self.n_particles, -math.log(self.n_particles), normals.dtype)
        return Particles(states, even, jax.random.key_data(key))

    def predict(self, belief: Particles, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Particles:
        """The belief `dt` seconds later (1.23), drawn again before where too few particles carry the weight."""
        dtype = belief.log_weights.dtype
        key, noise, place = jax.random.split(jax.random.wrap_key_data(belief.key), 3)
        few = effective_sample_size(belief.log_weights) < self.fraction * self.n_particles
        ancestors = systematic(belief.log_weights, jax.random.uniform(place, (), dtype))
        ancestors = jnp.where(few, ancestors, jnp.arange(self.n_particles, dtype=ancestors.dtype))
        states = jax.tree_util.tree_map(lambda x: jnp.take(x, ancestors, axis=-1), belief.states)
        even = even_weights(jnp.take(belief.log_weights, ancestors))
        w = jax.random.normal(noise, (motion.noise_dimension, self.n_particles), dtype)

        def step(state: State, w: Any) -> State:
            return motion.step(state, inputs, dt, Vector.of(w))

        moved = jax.vmap(step, in_axes=-1, out_axes=-1)(states, w)
        return Particles(moved, jnp.where(few, even, belief.log_weights), jax.random.key_data(key))

    def update(
        self, belief: Particles, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Any
    ) -> tuple[Particles, Innovation]:
        """The belief after one reading (1.24)–(1.27), and what the reading said.

        The log-likelihood is that of the reading given all before: the logarithm of the sum of the weights after less
        that before. The NIS is that of the whitened residual's mean in the spread that particles and noise give it.
        """

        def weigh(state: State) -> tuple[list[Scalar], Scalar, Scalar, Scalar, Scalar]:
            result = sensor.residual(reading, list(sensor.measure(motion.view(state), inputs)))
            wrapped = jnp.where(result.wrapped, 1.0, 0.0).astype(belief.log_weights.dtype)
            return list(result.whitened), log_density(result), result.count, wrapped, weights_of_tail(result)

        whitened, densities, count, wrapped, tail = jax.vmap(weigh, in_axes=-1, out_axes=-1)(belief.states)
        weighted = jnp.maximum(belief.log_weights + densities, NOTHING)
        before, after = log_sum(belief.log_weights), log_sum(weighted)
        # With no weight left there is no belief: not finite, so that the tracker starts again.
        after = jnp.where(after > 0.5 * NOTHING, after, jnp.nan)
        weights = jnp.exp(belief.log_weights - before)
        nis = normalised_square(whitened, weights, tail[0])
        kept = jnp.where(weighted > 0.5 * NOTHING, weighted - after, NOTHING + 0 * after)
        innovation = Innovation(after - before, nis, jnp.max(count), jnp.sum(weights * wrapped))
        return belief._replace(log_weights=kept), innovation

    def moments(self, belief: Particles) -> tuple[State, tuple[Scalar, ...]]:
        """The weighted mean (1.28) and the covariance's upper triangle, of the shown quantity where there is one."""
        weights = shared(jnp.exp(belief.log_weights - log_sum(belief.log_weights)))
        return weighted_moments(belief.states, weights, self.report)


def weighted_moments(
    states: State, weights: Any, report: AbstractReport | None = None
) -> tuple[State, tuple[Scalar, ...]]:
    """Mean and covariance (upper triangle) of states whose leaves end with an axis along `weights`, which add to 1.

    With a `report`: what it shows of the mean state, and the spread of what it shows of each state about that.
    """
    first = jax.tree_util.tree_map(lambda x: x[..., 0], states)
    apart = jax.vmap(lambda s: local(first, s), in_axes=-1, out_axes=-1)
    mean = retract(first, [jnp.sum(weights * step) for step in apart(states)])
    if report is None:
        shown, added = jax.vmap(lambda s: local(mean, s), in_axes=-1, out_axes=-1)(states), None
    else:
        mean, added = report.shown(mean), report.variances
        shown = jax.vmap(lambda s: local(mean, report.shown(s)), in_axes=-1, out_axes=-1)(states)
    n = len(shown)
    scaled = [weights * x for x in shown]
    cov = [jnp.sum(scaled[i] * shown[j]) for i, j in triangle(n)]
    if added is not None:
        cov = [c + added[i] if i == j else c for c, (i, j) in zip(cov, triangle(n), strict=True)]
    return mean, tuple(cov)


def log_density(result: Residual) -> Scalar:
    """The log density of a reading, from its whitened residual."""
    if result.tail is None:
        return result.log_scale - 0.5 * total(r * r for r in result.whitened)
    tail = result.tail
    return result.log_scale - 0.5 * (tail + 1.0) * total(jnp.log1p(r * r / tail) for r in result.whitened)


def weights_of_tail(result: Residual) -> Scalar:
    """The degrees of freedom of the residual's tail, as a number per state; infinite for normal noise."""
    zero = 0 * result.log_scale
    return zero + (jnp.inf if result.tail is None else result.tail)


def log_sum(log_weights: Any) -> Scalar:
    """The logarithm of the sum of the weights."""
    top = jnp.max(log_weights)
    return top + jnp.log(jnp.sum(jnp.exp(log_weights - top)))


def effective_sample_size(log_weights: Any) -> Scalar:
    """M/(1 + CV²) = (Σw)²/Σw² (1.29), (1.30), with CV² = var(w)/E(w)²; the weights need not add to 1."""
    weights = jnp.exp(log_weights - jnp.max(log_weights))
    return jnp.sum(weights) ** 2 / jnp.sum(weights * weights)


def even_weights(log_weights: Any) -> Any:
    """Equal log-weights that add to 1 for what was drawn, but nothing for a copy of a particle of weight zero."""
    alive = log_weights > 0.5 * NOTHING
    count = jnp.sum(jnp.where(alive, jnp.ones_like(log_weights), 0.0))
    return jnp.where(alive, -jnp.log(count), NOTHING)


def systematic(log_weights: Any, u: Scalar) -> Any:
    """The ancestors (N,) of N offspring at the places (k + u)/N of the cumulative weights, rising (Kitagawa 1996).

    Weights are first made whole numbers that add to less than the largest below which the number format has all of
    them. Their cumulative sums are then exact and rise, and no particle of weight zero has offspring; a weight is off
    by at most 2⁻²⁴ of the sum in single precision.
    """
    n = log_weights.shape[-1]
    dtype = log_weights.dtype
    weights = jnp.exp(log_weights - jnp.max(log_weights))
    quanta = float(2 ** (jnp.finfo(dtype).nmant + 1) - 4 * n)
    ends = running_sum(jnp.floor(weights * (quanta / jnp.sum(weights))))
    whole = ends[-1]
    # The number of offspring up to and including each particle; rounding is the same for equal sums and keeps order.
    offspring = jnp.clip(jnp.ceil(ends * (n / whole) - u), 0, n)
    offspring = jnp.where(ends == whole, n, offspring.astype(jnp.int32))
    # Offspring k descends from the first particle up to which there are more than k: as many end at k or before.
    ending = jnp.zeros(n, dtype).at[offspring].add(jnp.ones(n, dtype), mode="drop")
    return running_sum(ending).astype(jnp.int32)


def running_sum(x: Any) -> Any:
    """The cumulative sums of (N,) numbers by products with triangular matrices of about √N rows."""
    n = x.shape[-1]
    columns = max(1, math.isqrt(n - 1) + 1)
    rows = -(-n // columns)
    table = jnp.pad(x, (0, rows * columns - n)).reshape(rows, columns)
    upper, below = (np.triu(np.ones((columns, columns))), np.tril(np.ones((rows, rows)), -1))
    # On accelerators the default precision of a product would not keep whole numbers whole.
    inside = jnp.matmul(table, jnp.asarray(upper, x.dtype), precision="highest")
    before = jnp.matmul(jnp.asarray(below, x.dtype), inside[:, -1], precision="highest")
    return (inside + before[:, None]).reshape(-1)[:n]


def normalised_square(whitened: list[Any], weights: Any, tail: Scalar) -> Scalar:
    """r̄ᵀ(I + C)⁻¹r̄, with r̄ and C the particles' mean and covariance of the whitened residual.

    Of a heavy tail each decorrelated part is weighted by what Student's t expects of so large a one.
    """
    m = len(whitened)
    mean = [jnp.sum(weights * r) for r in whitened]
    apart = [r - a for r, a in zip(whitened, mean, strict=True)]
    cov = {(i, j): jnp.sum(weights * apart[i] * apart[j]) + (1.0 if i == j else 0.0) for i, j in triangle(m)}
    L = cholesky(cov, range(m), 0.0)
    parts: list[Scalar] = []
    for i in range(m):
        parts.append((mean[i] - total(L[i, j] * parts[j] for j in range(i))) * inverse_or_zero(L[i, i]))
    squares = [p * p for p in parts]
    heavy = jnp.isfinite(tail)
    safe = jnp.where(heavy, tail, 1.0)
    return total(jnp.where(heavy, s * (safe + 1.0) / (safe + s), s) for s in squares)
