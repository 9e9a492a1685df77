"""How sure a fit is of its numbers: by the curvature at the optimum, and by how much single trajectories disagree.

    f  the objective        H  its second derivatives by the unconstrained vector        u  nats per unit of f
    ψ_n  the part of trajectory n in the gradient of f, exact for any function of sums (its influence)

Observed information: (uH)⁻¹, right for a likelihood whose model is true. Sandwich: H⁻¹ J H⁻¹ with J the scatter of the
ψ_n, right for any objective and a wrong model too (Huber 1967), by trajectories where there are many; where there are
few, of a likelihood, J is that of blocks of rows, and errors that last longer than a block make it too small. Where
every ψ_n vanishes, as at a point of symmetry, so does J: what a user is told is the wider of the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.tunable import Covariance
from tuning.objectives import AbstractObjective
from tuning.parameters import Parameter, physical, physical_errors
from tuning.problem import figures
from tuning.row_information import row_information

STEP = 0.02
"""Step of the central differences in unconstrained coordinates: 2 % of a noise level."""

DETERMINED = 1e-5
"""Least curvature, as a part of the largest, of a direction that the data determine; less is rounding."""

TRAJECTORIES = 20
"""From so many trajectories on their scatter says how sure a fit is; with fewer, that of blocks of rows."""

BLOCKS = 50
"""Blocks of rows, all recordings together: few enough to be long, enough to know a variance to a fifth."""

PART = 0.1
"""Part of a unit vector from which on a parameter belongs to a direction."""

SETTLED = 1.0
"""Standard deviations from where the objective is least, beyond which a point has no interval to speak of."""

FALLS = 1.0
"""Nats that a likelihood falls by a change of e in a number, from which on it depends on that number."""

By = Literal["curvature", "scatter", "either"]
"""What says how sure a number is: the observed information, the sandwich, or the one that is less sure."""


class Optimum(NamedTuple):
    """The objective about an optimum: vector (p,), value, gradient (p,), H (p, p), ψ (n, p) and u, NaN for no nats.

    `used`: the n trajectories that count, among all.
    """

    vector: np.ndarray
    value: float
    gradient: np.ndarray
    hessian: np.ndarray
    influence: np.ndarray
    units: float
    used: np.ndarray


@dataclass(frozen=True)
class Uncertainty:
    """How sure a fit is.

    `observed`, `sandwich`: covariances (p, p) of the unconstrained vector, along the directions that are determined;
    NaN where there is none. `undetermined`: (p,) what has a part in a direction that is not. `held`: (p,) what rests on
    a bound that the objective would have it cross; the others are as sure as they are with it there. `clusters`: how
    many trajectories or blocks the sandwich is from. `optimum`: what it was made of. `distance_to_optimum`: how many standard
    deviations the point is from where the objective is least by its quadratic model; infinite where that has none.
    """

    parameters: list[Parameter]
    optimum: Optimum
    observed: np.ndarray
    sandwich: np.ndarray
    undetermined: np.ndarray
    held: np.ndarray
    clusters: int
    distance_to_optimum: float

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations (p,) of the unconstrained vector, the larger of curvature's and scatter's."""
        return _larger(self.observed, self.sandwich)

    @property
    def settled(self) -> bool:
        """Whether the point is where the objective is least, near enough for an interval round it."""
        return self.distance_to_optimum <= SETTLED

    def standard_errors(self, by: By = "either") -> dict[str, np.ndarray]:
        """Of the physical values, by label; NaN for what is not determined, or rests on a bound."""
        if by == "either":
            one, other = self.standard_errors("curvature"), self.standard_errors("scatter")
            return {label: np.fmax(one[label], other[label]) for label in one}
        cov = self.observed if by == "curvature" else self.sandwich
        errors = physical_errors(self.parameters, self.optimum.vector, np.nan_to_num(cov))
        bad = self._parts(self.undetermined | self.held | np.isnan(np.diagonal(cov)) | (not self.settled))
        return {p.label: np.where(b, np.nan, e) for p, e, b in zip(self.parameters, errors, bad, strict=True)}

    def intervals(self, level: float = 0.95, by: By = "either") -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Lowest and highest physical value by label: of a Scale by its logarithm, of a Fraction by its odds.

        What is not determined may be anything; NaN for what rests on a bound, and where the point is not the optimum.
        Of a matrix, entry by entry by the delta method. A sandwich of few clusters is itself not well known: its
        intervals are those of Student's t (Cameron & Miller 2015, section 6).
        """
        if by == "either":
            one, other = self.intervals(level, "curvature"), self.intervals(level, "scatter")
            return {k: (np.fmin(one[k][0], other[k][0]), np.fmax(one[k][1], other[k][1])) for k in one}
        cov = self.observed if by == "curvature" else self.sandwich
        z, vector = NormalDist().inv_cdf(0.5 + level / 2), self.optimum.vector
        if by == "scatter":
            z = students(z, max(self.clusters - 1, 1))
        sigma = np.sqrt(np.maximum(np.diagonal(cov), 0.0))
        reach = np.where(self.undetermined, np.inf, z * sigma)
        reach = np.where(self.held | (not self.settled), np.nan, reach)
        values = physical(self.parameters, vector)
        low, high = (physical(self.parameters, vector + sign * reach) for sign in (-1.0, 1.0))
        errors = self.standard_errors(by)
        found = {}
        for p, middle, a, b in zip(self.parameters, values, low, high, strict=True):
            if isinstance(p.example, Covariance):
                a, b = (np.asarray(middle) + sign * z * errors[p.label] for sign in (-1.0, 1.0))
            found[p.label] = (np.asarray(a, float), np.asarray(b, float))
        return found

    def _parts(self, flags: np.ndarray) -> list[np.ndarray]:
        parts, start = [], 0
        for p in self.parameters:
            shape = np.shape(p.example.raw)
            parts.append(flags[start : start + int(np.prod(shape, dtype=int))].reshape(shape))
            start += parts[-1].size
        return parts


def students(z: float, freedom: int) -> float:
    """The quantile of Student's t where the standard normal one is z (Abramowitz & Stegun 1964, 26.7.5)."""
    first, second = (z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96
    return z + first / freedom + second / freedom**2 + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384 / freedom**3


def uncertainty(problem: Any, vector: np.ndarray) -> Uncertainty:
    """How sure the optimum `vector` of a `tuning.problem.Problem` is, in 2p + 1 evaluations."""
    return assessed(problem, optimum(problem, vector))


def assessed(problem: Any, found: Optimum, held: np.ndarray | None = None) -> Uncertainty:
    """How sure an optimum is, whose numbers `held` (p,) rest on their bounds.

    Of particles, whose likelihood is not smooth, the scatter of the trajectories stands for the second derivatives.
    """
    held = np.zeros(len(found.vector), bool) if held is None else held
    scatter, clusters = _scatter(problem, found)
    if problem.random:
        found = found._replace(hessian=found.units * scatter)
    missing, inverse, undetermined = determined(found.hessian, ~held)
    undetermined &= ~unused(problem.parameters)
    observed = inverse / found.units if np.isfinite(found.units) else np.full(inverse.shape, np.nan)
    sandwich = inverse @ scatter @ inverse
    # The gradient of particles has noise, which says nothing of where the objective is least.
    distance_to_optimum = 0.0 if problem.random else _astray(inverse @ found.gradient, _larger(observed, sandwich))
    # Where an objective without curvature still falls nothing is open: the fit ended before it came to rest.
    if not problem.random and np.any(np.abs(missing.T @ found.gradient) * found.units > FALLS):
        distance_to_optimum = np.inf
    return Uncertainty(problem.parameters, found, observed, sandwich, undetermined, held, clusters, distance_to_optimum)


def _larger(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The larger standard deviations (p,) of two covariances, of which one may be NaN."""
    return np.sqrt(np.maximum(np.fmax(np.diagonal(one), np.diagonal(other)), 0.0))


def _astray(step: np.ndarray, sigma: np.ndarray) -> float:
    """The longest of steps (p,) in standard deviations (p,); 0 where there are none."""
    known = sigma > 0
    return float(np.max(np.abs(step[known]) / sigma[known], initial=0.0))


def _scatter(problem: Any, found: Optimum) -> tuple[np.ndarray, int]:
    """J, and of how many clusters: trajectories, or for few of them and a likelihood blocks of rows."""
    clusters = len(found.influence)
    if clusters >= TRAJECTORIES:
        return found.influence.T @ found.influence * (clusters / (clusters - 1)), clusters
    p = len(found.vector)
    if problem.random or not found.units > 0:
        return np.full((p, p), np.nan), clusters
    rows = np.concatenate([np.asarray(part.valid).sum(axis=0) for part in problem.chunks])
    block = max(1, -(-int(rows.sum()) // BLOCKS))
    said = row_information(problem.tracker, problem.chunks, problem.parameters, found.vector[None], block)
    information = np.where(found.used, said.information[0], 0.0).sum(axis=-1)
    return information / found.units**2, int(np.sum(-(-rows[found.used] // block)))


def optimum(problem: Any, vector: np.ndarray) -> Optimum:
    """Value, gradient, second derivatives and influences at a vector, by central differences of gradients.

    Only trajectories that are usable at all of the vectors count, so that differences are of one and the same function.
    """
    vector = np.asarray(vector, float)
    p = len(vector)
    shifts = STEP * np.eye(p)
    vectors = np.concatenate([vector[None], vector + shifts, vector - shifts])
    evaluated = problem.evaluate(vectors)
    used = evaluated.used.all(axis=0)
    terms, slopes = evaluated.terms[..., used], evaluated.slopes[..., used]
    values, by_sum = (np.asarray(x, float) for x in figures(problem.objective, jnp.asarray(terms.sum(axis=-1))))
    gradients = np.einsum("sk,skp->sp", by_sum, slopes.sum(axis=-1))
    said = problem.against(vectors, terms.sum(axis=-1))
    values, gradients = values + said.values, gradients + said.gradients
    rows = (gradients[1 : p + 1] - gradients[p + 1 :]) / (2 * STEP)
    # Without a single usable trajectory there is no likelihood to speak of.
    units = problem.objective.log_likelihood_units(terms[0].sum(axis=-1)) if used.any() else np.nan
    psi = influence(problem.objective, terms[0], slopes[0])
    return Optimum(vector, float(values[0]), gradients[0], 0.5 * (rows + rows.T), psi, units, used)


def influence(objective: AbstractObjective, terms: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """What each trajectory adds to the gradient (n, p), if it counted a little more: terms (k, n), slopes (k, p, n).

    The derivative of the gradient by the trajectory's weight, which moves the sums that the figure is made of, too.
    """
    first, second = (np.asarray(x, float) for x in _by_sums(objective, jnp.asarray(terms.sum(axis=-1))))
    return np.einsum("k,kpn->np", first, slopes) + np.einsum("kn,kl,lp->np", terms, second, slopes.sum(axis=-1))


def unused(parameters: Sequence[Parameter]) -> np.ndarray:
    """Which unconstrained numbers (p,) make nothing: those above the diagonal of a covariance's factor."""
    parts = []
    for p in parameters:
        shape = np.shape(p.example.raw)
        parts.append(np.triu(np.ones(shape), 1) > 0 if isinstance(p.example, Covariance) else np.zeros(shape, bool))
    return np.concatenate([np.ravel(x) for x in parts])


def without_effect(slopes: np.ndarray) -> np.ndarray:
    """Which of p numbers change nothing: derivatives (…, p, n) all zero where they are finite, and some are."""
    each = np.moveaxis(slopes, -2, 0).reshape(slopes.shape[-2], -1)
    finite = np.isfinite(each)
    return np.all((each == 0) | ~finite, axis=1) & finite.any(axis=1)


@eqx.filter_jit
def _by_sums(objective: AbstractObjective, sums: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The first and second derivatives of the figure by the sums."""
    return jax.grad(objective.value)(sums), jax.hessian(objective.value)(sums)


def determined(hessian: np.ndarray, free: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The directions that are not determined (p, m), the inverse along all others, and who has a part in the former.

    Not determined: without positive curvature, up to rounding; everything where the curvature isn't finite. Of the
    numbers that are `free` (p,), default all; the others have no part in anything.
    """
    p = len(hessian)
    free = np.ones(p, bool) if free is None else free
    missing, inverse = np.eye(p)[:, free], np.zeros((p, p))
    inner = hessian[np.ix_(free, free)]
    if not np.all(np.isfinite(inner)):
        inverse[np.ix_(free, free)] = np.nan
    elif free.any():
        eigenvalues, directions = np.linalg.eigh(inner)
        known = eigenvalues > DETERMINED * max(float(eigenvalues.max()), 0.0)
        inverse[np.ix_(free, free)] = (directions[:, known] / eigenvalues[known]) @ directions[:, known].T
        missing = missing @ directions[:, ~known]
    parts: np.ndarray = np.any(np.abs(missing) > PART, axis=1)
    return missing, inverse, parts
