"""How sure a fit is of its numbers: by the curvature at the optimum, and by how much single trajectories disagree.

    f  the objective        H  its second derivatives by the unconstrained vector        u  nats per unit of f
    ψ_n  the part of trajectory n in the gradient of f, exact for any function of sums (its influence)

Observed information: (uH)⁻¹, right for a likelihood whose model is true. Sandwich: H⁻¹ J H⁻¹ with J the scatter of the
ψ_n, right for any objective and a wrong model too (Huber 1967), by trajectories where there are many; where there are
few, of a likelihood, J is that of blocks of rows, and errors that last longer than a block make it too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.tunable import Covariance
from tuning.objectives import AbstractObjective
from tuning.parameters import Parameter, physical, physical_errors
from tuning.problem import figures
from tuning.row_scores import row_information

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
    NaN where there is none. `undetermined`: (p,) what has a part in a direction that is not. `clusters`: how many
    trajectories or blocks the sandwich is from. `optimum`: what it was made of.
    """

    parameters: list[Parameter]
    optimum: Optimum
    observed: np.ndarray
    sandwich: np.ndarray
    undetermined: np.ndarray
    clusters: int

    def standard_errors(self, sandwich: bool = False) -> dict[str, np.ndarray]:
        """Of the physical values, by label; NaN for what is not determined."""
        cov = self.sandwich if sandwich else self.observed
        errors = physical_errors(self.parameters, self.optimum.vector, np.nan_to_num(cov))
        bad = self._parts(self.undetermined | np.isnan(np.diagonal(cov)))
        return {p.label: np.where(b, np.nan, e) for p, e, b in zip(self.parameters, errors, bad, strict=True)}

    def intervals(self, level: float = 0.95, sandwich: bool = False) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Lowest and highest physical value by label: of a Scale by its logarithm, of a Fraction by its odds.

        What is not determined may be anything. Of a matrix, entry by entry by the delta method. A sandwich of few
        clusters is itself not well known: its intervals are those of Student's t (Cameron & Miller 2015, section 6).
        """
        cov = self.sandwich if sandwich else self.observed
        z, vector = NormalDist().inv_cdf(0.5 + level / 2), self.optimum.vector
        if sandwich:
            z = students(z, max(self.clusters - 1, 1))
        sigma = np.sqrt(np.maximum(np.diagonal(cov), 0.0))
        reach = np.where(self.undetermined, np.inf, z * sigma)
        values = physical(self.parameters, vector)
        low, high = (physical(self.parameters, vector + sign * reach) for sign in (-1.0, 1.0))
        errors = self.standard_errors(sandwich)
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


def assessed(problem: Any, found: Optimum) -> Uncertainty:
    """How sure an optimum is.

    Of particles, whose likelihood is not smooth, the scatter of the trajectories stands for the second derivatives.
    """
    scatter, clusters = _scatter(problem, found)
    if problem.random:
        found = found._replace(hessian=found.units * scatter)
    _, inverse, undetermined = determined(found.hessian)
    undetermined &= ~unused(problem.parameters)
    observed = inverse / found.units if np.isfinite(found.units) else np.full(inverse.shape, np.nan)
    return Uncertainty(problem.parameters, found, observed, inverse @ scatter @ inverse, undetermined, clusters)


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


@eqx.filter_jit
def _by_sums(objective: AbstractObjective, sums: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The first and second derivatives of the figure by the sums."""
    return jax.grad(objective.value)(sums), jax.hessian(objective.value)(sums)


def determined(hessian: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The directions that are not determined (p, m), the inverse along all others, and who has a part in the former.

    Not determined: without positive curvature, up to rounding; everything where the curvature isn't finite.
    """
    p = len(hessian)
    if not np.all(np.isfinite(hessian)):
        return np.eye(p), np.full((p, p), np.nan), np.ones(p, bool)
    eigenvalues, directions = np.linalg.eigh(hessian)
    known = eigenvalues > DETERMINED * max(float(eigenvalues.max()), 0.0)
    inverse = (directions[:, known] / eigenvalues[known]) @ directions[:, known].T
    missing = directions[:, ~known]
    return missing, inverse, (np.abs(missing) > PART).any(axis=1)
