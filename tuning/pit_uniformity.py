"""Consistency as an objective: Neyman's smooth test of the distribution of NIS or NEES.

    u  the probability integral transform of a value, (0, 1)       πₖ  Legendre polynomials, normalised over (0, 1)

If the model is true, u is uniform and the mean of every πₖ(u) is zero (Neyman 1937); the objective is the sum of the
squares of the first four means. A correct mean NIS made of small values and outliers does not pass.

For Student's t with ν degrees of freedom the NIS of a channel is q = (ν + 1) s/(ν + s) of the squared residual s, so
that q/(ν + 1) is Beta(½, ν/2). The sum over the m channels of a row has no closed form; it is approximated by
m(ν + 1)·Beta(a, b) with the same mean and variance: a + b = (m(ν + 3) − 2)/2, b = νa. That is exact for one channel and
for ν → ∞; for two and three channels the error of u is at most 0.036 at ν = 1, 0.020 at ν = 3, the default of ranges,
0.019 at ν = 4, and 0.005 at ν = 30.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf, gammaln

from trackwright.trackers.core.model.algebra import Scalar, total
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.tuning.diagnostics import student_t_dof_of
from trackwright.tuning.objectives import AbstractObjective, Truth, normalised_error

ORDERS = 4
"""Polynomials: location, spread, asymmetry and weight of the ends (Rayner & Best 1989, chapter 4)."""

SERIES = 16
"""Terms of the chi-square series, exact up to twice as many degrees of freedom."""

NODES, WEIGHTS = (np.polynomial.legendre.leggauss(32)[k] for k in (0, 1))


class PITUniformity(AbstractObjective):
    """The deviation of NIS (`kind` "nis", no truth) or NEES ("nees") from its distribution: 0 at best, 24 at worst.

    For a true model about 4/rows. `quantity`, `dimensions`: of the NEES. The NIS of an IMM filter is the mean of its
    modes', which has this distribution only where one mode dominates.
    """

    kind: Literal["nis", "nees"] = eqx.field(static=True)
    quantity: str = eqx.field(static=True, default="position")
    dimensions: int = eqx.field(static=True, default=2)
    student_t_dof: Scalar | None = None
    has_tracker: bool = eqx.field(static=True, default=False)
    size: ClassVar[int] = ORDERS + 1

    @property
    def needs_truth(self) -> bool:
        return self.kind == "nees"

    @property
    def of_position(self) -> bool:
        return self.kind == "nis" or self.quantity == "position"

    def for_tracker(self, tracker: AbstractTracker) -> PITUniformity:
        """With the degrees of freedom of the noise behind a NIS; raises ValueError for one of unknown distribution.

        A fit that tunes them keeps those of its start here.
        """
        nu = student_t_dof_of(tracker) if self.kind == "nis" else None
        return PITUniformity(self.kind, self.quantity, self.dimensions, nu, True)

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        if self.kind == "nees":
            error = normalised_error(output, truth, self.quantity, self.dimensions)
            scored = error.scored
            u = chi_square_cdf(jnp.where(scored, error.nees, 1.0), self.dimensions + 0 * error.nees)
        else:
            if not self.has_tracker:
                raise ValueError("the distribution of the NIS depends on the sensors' noise: use for_tracker(tracker)")
            scored = output.nis_dof > 0
            nis_dof, nis = jnp.where(scored, output.nis_dof, 1.0), jnp.where(scored, output.nis, 1.0)
            nu = self.student_t_dof
            u = chi_square_cdf(nis, nis_dof) if nu is None else student_t_nis_cdf(nis, nis_dof, nu)
        return *(jnp.where(scored, p, 0.0) for p in legendre(u)), jnp.where(scored, jnp.ones_like(u), 0.0)

    def value(self, sums: Any) -> Scalar:
        return total((sums[k] / sums[ORDERS]) ** 2 for k in range(ORDERS))


def legendre(u: Scalar) -> list[Scalar]:
    """The first four Legendre polynomials of u in (0, 1), each with mean square 1 over it."""
    x = 2.0 * u - 1.0
    square = x * x
    return [
        3**0.5 * x,
        5**0.5 * 0.5 * (3.0 * square - 1.0),
        7**0.5 * 0.5 * x * (5.0 * square - 3.0),
        3.0 * 0.125 * ((35.0 * square - 30.0) * square + 3.0),
    ]


def chi_square_cdf(x: Scalar, dof: Scalar) -> Scalar:
    """The distribution function of chi-square with `dof` = 1, 2, … degrees of freedom; differentiable in x.

    By its finite series (Abramowitz & Stegun 1964, 26.4.4 and 26.4.5), in the compiled scan: no iteration that lasts as
    long as the slowest trajectory's. Beyond 2·`SERIES` degrees of freedom by Wilson and Hilferty's cube root (1931).
    """
    half = 0.5 * x
    odd = dof - 2.0 * jnp.floor(0.5 * dof)
    count = 0.5 * (dof - odd)
    root = jnp.sqrt(jnp.where(half > 0, half, 1.0))
    term = jnp.where(odd > 0, root * (2.0 / np.pi**0.5), 1.0)
    rest = 0.0 * term
    for k in range(SERIES):
        rest = rest + jnp.where(k < count, term, 0.0)
        term = term * half / (k + 1.0 + 0.5 * odd)
    series = jnp.where(odd > 0, erf(root), 1.0) - jnp.exp(-half) * rest
    spread = 2.0 / (9.0 * dof)
    cube = jnp.cbrt(jnp.maximum(x, 1e-30) / dof)
    large = 0.5 * (1.0 + erf((cube - 1.0 + spread) / jnp.sqrt(2.0 * spread)))
    below = jnp.where(dof <= 2 * SERIES, series, large)
    return jnp.where(half > 0, below, 0.0)


def student_t_nis_cdf(q: Scalar, nis_dof: Scalar, nu: Scalar) -> Scalar:
    """The distribution function of a row's NIS of `nis_dof` channels with Student's t noise; see the module's head.

    The incomplete beta function as an integral of powers of sine and cosine, by Gauss–Legendre quadrature:
    differentiable in all arguments.
    """
    a_plus_b = 0.5 * (nis_dof * (nu + 3.0) - 2.0)
    a = a_plus_b / (nu + 1.0)
    b = nu * a
    share = jnp.clip(q / (nis_dof * (nu + 1.0)), 1e-12, 1.0 - 1e-6)
    # The density beyond `limit` integrates to less than 1e-5; the nodes are placed within.
    limit = jnp.arctan(jnp.sqrt((40.0 + 4.0 * nis_dof) * (1.0 + 1e3 / nu**2) / nu))
    angle = jnp.minimum(jnp.arcsin(jnp.sqrt(share)), limit)
    integral = total(
        0.5 * w * jnp.exp((2.0 * a - 1.0) * jnp.log(jnp.sin(s)) + (2.0 * b - 1.0) * jnp.log(jnp.cos(s)))
        for w, s in ((w, 0.5 * (1.0 + node) * angle) for node, w in zip(NODES.tolist(), WEIGHTS.tolist(), strict=True))
    )
    return 2.0 * angle * integral * jnp.exp(gammaln(a_plus_b) - gammaln(a) - gammaln(b))
