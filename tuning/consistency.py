"""Consistency by the shape of the NIS or NEES distribution: Neyman's smooth test, as a figure to be made small.

    u  the probability that a value is at most as large, (0, 1)       πₖ  Legendre polynomials, normalised over (0, 1)

If the model is true, u is uniform and the mean of every πₖ(u) is zero (Neyman 1937); the figure is the sum of the
squares of the first four means. A mean NIS that is right by luck, of small values and outliers, isn't right here.

Of Student's t with ν degrees of freedom the filter counts q = (ν + 1) s/(ν + s) of a square s, so that q/(ν + 1) is
Beta(½, ν/2). The sum over the m channels of a row has no closed form; here it is m(ν + 1)·Beta(a, b) with the same mean
and variance: a + b = (m(ν + 3) − 2)/2, b = νa. That is exact for one channel and for ν → ∞; for two and three channels
u is off by at most 0.019 at ν = 4, 0.005 at ν = 30.
"""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf, gammaln

from trackers.core.algebra import Scalar, total
from trackers.core.scan import Output
from trackers.core.sensor import AbstractSensor
from trackers.core.tracker import Tracker
from tuning.objectives import AbstractObjective, Truth, judged_error

ORDERS = 4
"""Polynomials: location, spread, asymmetry and weight of the ends (Rayner & Best 1989, chapter 4)."""

SERIES = 16
"""Terms of the distribution of chi-square, exact up to twice as many degrees of freedom."""

NODES, WEIGHTS = (np.polynomial.legendre.leggauss(32)[k] for k in (0, 1))


class Consistency(AbstractObjective):
    """How far NIS (`kind` "nis", no truth) or NEES ("nees") are from their distribution: 0 at best, 24 at worst.

    Even of a true model the figure is above zero, by about 4/rows. `quantity`, `dimensions`: whose NEES. The NIS of a
    filter with several modes is the mean of theirs, and has this distribution only where one of them rules.
    """

    kind: Literal["nis", "nees"] = eqx.field(static=True)
    quantity: str = eqx.field(static=True, default="position")
    dimensions: int = eqx.field(static=True, default=2)
    student_t_dof: Any = None
    knows: bool = eqx.field(static=True, default=False)

    @property
    def size(self) -> int:
        return ORDERS + 1

    @property
    def needs_truth(self) -> bool:
        return self.kind == "nees"

    def informed(self, tracker: Any) -> Consistency:
        """The objective with ν of the tracker's sensor; raises ValueError where the distribution of the NIS is unknown.

        A fit that also tunes ν keeps the initial ν here.
        """
        return Consistency(self.kind, self.quantity, self.dimensions, student_t_dof_of(tracker), True)

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        if self.kind == "nees":
            judged = judged_error(output, truth, self.quantity, self.dimensions)
            counts = judged.counts
            u = chi_square_below(jnp.where(counts, judged.nees, 1.0), self.dimensions + 0 * judged.nees)
        else:
            if not self.knows:
                raise ValueError("the shape of the NIS depends on the sensors' noise: use informed(tracker)")
            counts = output.nis_dof > 0
            nis_dof, nis = jnp.where(counts, output.nis_dof, 1.0), jnp.where(counts, output.nis, 1.0)
            nu = self.student_t_dof
            u = chi_square_below(nis, nis_dof) if nu is None else student_t_below(nis, nis_dof, nu)
        return *(jnp.where(counts, p, 0.0) for p in legendre(u)), jnp.where(counts, jnp.ones_like(u), 0.0)

    def value(self, sums: Any) -> Scalar:
        return total((sums[k] / sums[ORDERS]) ** 2 for k in range(ORDERS))


def student_t_dof_of(tracker: Any) -> Scalar | None:
    """The degrees of freedom of the noise that makes the tracker's NIS; None where it is normal, or there is no NIS.

    Raises ValueError for several sensors, one of them with Student's t: the distribution of their sum is unknown.
    """
    while not isinstance(tracker, Tracker):
        if not hasattr(tracker, "fusion"):
            return None
        tracker = tracker.fusion
    sensors: list[AbstractSensor] = list(tracker.sensors.values())
    found = [dof for dof in (getattr(sensor, "dof", None) for sensor in sensors) if dof is not None]
    if found and len(sensors) > 1:
        what = f"{len(sensors)} sensors, {len(found)} of them with Student's t"
        raise ValueError(f"the NIS of {what}, has no known distribution; expected one sensor, or normal noise")
    return found[0].value if found else None


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


def chi_square_below(x: Scalar, dof: Scalar) -> Scalar:
    """The probability that chi-square with `dof` = 1, 2, … degrees of freedom is at most x > 0; differentiable in x.

    By its finite series (Abramowitz & Stegun 1964, 26.4.4 and 26.4.5): no loop that waits for the slowest trajectory.
    Beyond 2·`SERIES` degrees of freedom by the cube root of Wilson and Hilferty (1931).
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


def student_t_below(q: Scalar, nis_dof: Scalar, nu: Scalar) -> Scalar:
    """The probability that the NIS of `nis_dof` Student's t channels (ν = `nu`) is at most q; see the module's head.

    The incomplete beta function as an integral of powers of sine and cosine, by Gauss and Legendre's rule, so that it
    has derivatives in everything.
    """
    both = 0.5 * (nis_dof * (nu + 3.0) - 2.0)
    a = both / (nu + 1.0)
    b = nu * a
    share = jnp.clip(q / (nis_dof * (nu + 1.0)), 1e-12, 1.0 - 1e-6)
    # Further out there is less than 1e-5; the nodes are wanted where the probability is.
    reach = jnp.arctan(jnp.sqrt((40.0 + 4.0 * nis_dof) * (1.0 + 1e3 / nu**2) / nu))
    angle = jnp.minimum(jnp.arcsin(jnp.sqrt(share)), reach)
    integral = total(
        0.5 * w * jnp.exp((2.0 * a - 1.0) * jnp.log(jnp.sin(s)) + (2.0 * b - 1.0) * jnp.log(jnp.cos(s)))
        for w, s in ((w, 0.5 * (1.0 + node) * angle) for node, w in zip(NODES.tolist(), WEIGHTS.tolist(), strict=True))
    )
    return 2.0 * angle * integral * jnp.exp(gammaln(both) - gammaln(a) - gammaln(b))
