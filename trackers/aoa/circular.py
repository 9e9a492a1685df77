"""The circular mean of a few angles by polynomials, at a dozen multiplications per angle."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp

from trackwright.trackers.core.model.algebra import Scalar, compute_once, total

# Least-squares polynomials in t², t = angle/π, on [−1, 1]: sin πt = t(1 − t²)·Σ SINE t²ᵏ (error 3e-9) and
# cos πt = Σ COSINE t²ᵏ (error 1e-8); XLA's own sin and cos cost ten times as much on a CPU.
SINE = (
    3.141592645271753,
    -2.026119481251057,
    0.5240362466319017,
    -0.07518748136549892,
    0.006860405614362804,
    -0.0003860171874991249,
)
COSINE = (
    0.9999999890398765,
    -4.93480112425251,
    4.0586948357568255,
    -1.335158409305255,
    0.23502977020497642,
    -0.025358950345296026,
    0.0015938995965745699,
)
# atan x ≈ x·Σ ARC x²ᵏ on [0, 1], error 2e-6 rad (Abramowitz and Stegun 1964, 4.4.49, refitted).
ARC = (0.99997726, -0.33262347, 0.19354346, -0.11643287, 0.05265332, -0.01172120)


def polynomial(coefficients: Sequence[float], x: Scalar) -> Scalar:
    """Σ cₖ xᵏ by Horner's rule."""
    result: Scalar = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        result = c + x * result
    return result


def circular_mean(angles: Sequence[Scalar], seen: Sequence[Scalar], count: Scalar) -> Scalar:
    """The direction of Σ exp(iθ) over the angles seen, rad, in (−π, π], to 1e-5 rad.

    It only decides which differences wrap, for which this accuracy suffices. `count`: the number seen, at least 1.
    """
    turns = [a * (1.0 / jnp.pi) for a in angles]
    turns = [t - 2.0 * jnp.round(0.5 * t) for t in turns]
    squares = [t * t for t in turns]
    # The divisions do not change the angle, but XLA never duplicates one, so that all antennas share both sums.
    sine = total(s * t * (1.0 - q) * polynomial(SINE, q) for s, t, q in zip(seen, turns, squares, strict=True)) / count
    cosine = total(s * polynomial(COSINE, q) for s, q in zip(seen, squares, strict=True)) / count
    return compute_once(arctangent(sine, cosine))


def arctangent(sine: Scalar, cosine: Scalar) -> Scalar:
    """The angle of the point (cosine, sine), rad, to 1e-5; 0 at the origin."""
    a, b = jnp.abs(sine), jnp.abs(cosine)
    large = jnp.maximum(a, b)
    ratio = jnp.minimum(a, b) / jnp.where(large > 0, large, 1.0)
    angle = ratio * polynomial(ARC, ratio * ratio)
    angle = jnp.where(a > b, jnp.pi / 2 - angle, angle)
    angle = jnp.where(cosine < 0, jnp.pi - angle, angle)
    return jnp.where(sine < 0, -angle, angle)
