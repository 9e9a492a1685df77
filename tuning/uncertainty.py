"""Uncertainty of a fit, from the curvature at the optimum and from the scatter of the trajectories' gradients.

    f  the objective        H  its Hessian with respect to the unconstrained vector        u  nats per unit of f
    ψ_n  derivative of the gradient of f with respect to the weight of trajectory n (its influence)

Posterior: (uH)⁻¹ with f the likelihood and the prior, and u the nats of the effective rows (Pauli, Racugno and Ventura
2011). Sandwich: H⁻¹ J H⁻¹ with J the scatter of the ψ_n over many trajectories, valid for any objective and a wrong
model (Huber 1967). Where all ψ_n vanish, as at a point of symmetry, J vanishes too; so the reported interval is the
wider of the two. For a particle filter J takes the place of the Hessian of the likelihood (Berndt, Hall, Hall and
Hausman 1974).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri, stdtrit

from trackwright.trackers.core.model.tunable import Covariance
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import Parameter, physical, physical_errors
from trackwright.tuning.problem import Evaluation, Problem, value_and_gradient

MIN_CURVATURE = 1e-5  # curvature of a direction, relative to the largest, below which it is undetermined: rounding
MIN_TRAJECTORIES = 20  # trajectories from which on there is a scatter
MIN_COMPONENT = 0.1  # component of a unit direction from which on a parameter belongs to the direction
MAX_DISTANCE = 1.0  # standard deviations between a point and the optimum beyond which the point has no interval
MIN_SLOPE_NATS = 1.0  # change of a likelihood, nats per factor of e, from which on it depends on a parameter
LARGE_SIGMA = 1.0  # deviation of an unconstrained number from which it is hardly determined: a factor of e either way
Interval = tuple[np.ndarray, np.ndarray]  # lowest and highest value
Mask = Bool[np.ndarray, " p"]  # which of p numbers
Square = Float[np.ndarray, "p p"]

By = Literal["curvature", "scatter", "either"]  # source of an interval: posterior, sandwich, or the wider of the two


@dataclass(frozen=True)
class Uncertainty:
    """Covariances of the fitted parameters, and which parameters have none.

    `observed`, `sandwich`: covariances (p, p) of the unconstrained vector along the determined directions; NaN where
    there is none. `undetermined` (p,): parameters with a part in an undetermined direction. `at_bound` (p,): parameters
    at a bound with the objective falling beyond it, or `kept` (p,) at their starting values; the others' covariances
    are conditional on them. `clusters`: trajectories behind the sandwich. `distance_to_optimum`: to the one of
    the quadratic model, in standard deviations; infinite where the model has none.
    """

    parameters: list[Parameter]
    optimum: Optimum
    observed: Float[np.ndarray, "p p"]
    sandwich: Float[np.ndarray, "p p"]
    undetermined: Bool[np.ndarray, " p"]
    at_bound: Bool[np.ndarray, " p"]
    clusters: int
    distance_to_optimum: float
    kept: Bool[np.ndarray, " p"]

    @property
    def sigmas(self) -> Float[np.ndarray, " p"]:
        """Standard deviations (p,) of the unconstrained vector, the larger of the two kinds."""
        return _larger_sigmas(self.observed, self.sandwich)

    @property
    def at_optimum(self) -> bool:
        """Whether the point is near enough to the optimum for intervals."""
        return self.distance_to_optimum <= MAX_DISTANCE

    def standard_errors(self, by: By = "either") -> dict[str, np.ndarray]:
        """Standard errors of the physical values, by label; NaN for undetermined parameters and those at a bound."""
        if by == "either":
            both = [self.standard_errors("curvature"), self.standard_errors("scatter")]
            return {label: np.fmax(*(errors[label] for errors in both)) for label in both[0]}
        cov = self.observed if by == "curvature" else self.sandwich
        missing = self.undetermined | self.at_bound | np.isnan(np.diagonal(cov)) | (not self.at_optimum)
        errors = physical_errors(self.parameters, self.optimum.vector, np.nan_to_num(cov), missing)
        return {p.label: e for e, p in zip(errors, self.parameters, strict=True)}

    def intervals(self, level: float = 0.95, by: By = "either") -> dict[str, Interval]:
        """Lowest and highest physical value by label; symmetric in the logarithm of a Scale, the odds of a Fraction.

        Unbounded for undetermined parameters; NaN for those at a bound, and where the point is not the optimum. Entries
        of a matrix by the delta method. Intervals of the sandwich use Student's t with clusters - 1 degrees of freedom
        (Cameron & Miller 2015, section 6).
        """
        if by == "either":
            one, other = self.intervals(level, "curvature"), self.intervals(level, "scatter")
            return {k: (np.fmin(low, other[k][0]), np.fmax(high, other[k][1])) for k, (low, high) in one.items()}
        cov = self.observed if by == "curvature" else self.sandwich
        probability, vector = 0.5 + level / 2, self.optimum.vector
        z = float(ndtri(probability) if by == "curvature" else stdtrit(max(self.clusters - 1, 1), probability))
        half_width = np.where(self.undetermined, np.inf, z * np.sqrt(np.maximum(np.diagonal(cov), 0.0)))
        half_width = np.where(self.at_bound | (not self.at_optimum), np.nan, half_width)
        low, high = (physical(self.parameters, vector + sign * half_width) for sign in (-1.0, 1.0))
        errors, intervals = self.standard_errors(by), dict[str, Interval]()
        for k, p in enumerate(self.parameters):
            intervals[p.label] = np.asarray(low[k], float), np.asarray(high[k], float)
            if isinstance(p.example, Covariance):
                value = np.asarray(physical(self.parameters, vector)[k])
                intervals[p.label] = value - z * errors[p.label], value + z * errors[p.label]
        return intervals


def uncertainty_at(
    problem: Problem, optimum: Optimum, at_bound: Mask | None = None, kept: Mask | None = None
) -> Uncertainty:
    """The uncertainty of an optimum with the parameters `at_bound` (p,), and those `kept` (p,) at their start, fixed.

    The likelihood of a particle filter is not smooth: J takes the place of its Hessian.
    """
    none = np.zeros(len(optimum.vector), bool)
    kept = none if kept is None else kept
    at_bound = (none if at_bound is None else at_bound) | kept
    scatter, clusters = _scatter(optimum)
    if problem.stochastic:
        optimum = _by_scatter(problem, optimum)
    missing, inverse, undetermined = determined(optimum.hessian, ~at_bound)
    undetermined &= ~unused(problem.parameters)
    # NaN for an objective that is no likelihood
    observed = inverse / optimum.nats_per_unit
    sandwich = inverse @ scatter @ inverse
    # The gradient of a particle filter is noisy and does not locate the optimum.
    step, sigmas, distance = np.abs(inverse @ optimum.gradient), _larger_sigmas(observed, sandwich), 0.0
    if not problem.stochastic:
        distance = float(np.max(step[sigmas > 0] / sigmas[sigmas > 0], initial=0.0))
        # A slope along a direction without curvature: the fit ended before it converged.
        if np.any(np.abs(missing.T @ optimum.gradient) * optimum.nats_per_unit > MIN_SLOPE_NATS):
            distance = np.inf
    return Uncertainty(
        problem.parameters, optimum, observed, sandwich, undetermined, at_bound, clusters, distance, kept
    )


def _larger_sigmas(one: Float[np.ndarray, "p p"], other: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " p"]:
    """The larger standard deviations (p,) of two covariances, one of which may be NaN."""
    return np.sqrt(np.maximum(np.fmax(np.diagonal(one), np.diagonal(other)), 0.0))


def _scatter(optimum: Optimum) -> tuple[Float[np.ndarray, "p p"], int]:
    """J over the trajectories and their number; NaN for few of them."""
    clusters, p = optimum.influence.shape
    if clusters < MIN_TRAJECTORIES:
        return np.full((p, p), np.nan), clusters
    return optimum.influence.T @ optimum.influence * (clusters / (clusters - 1)), clusters


def _by_scatter(problem: Problem, optimum: Optimum) -> Optimum:
    """The optimum with the scatter of the trajectories in place of the likelihood's Hessian."""
    clusters = len(optimum.influence)
    weighted = optimum.influence.T / problem.weights[optimum.used] @ optimum.influence
    scatter = weighted * optimum.nats_per_unit / problem.discount * (clusters / (clusters - 1))
    return optimum._replace(hessian=scatter + np.diag(optimum.prior))


def unused(parameters: Sequence[Parameter]) -> Bool[np.ndarray, " p"]:
    """Which unconstrained numbers (p,) are unused: those above the diagonal of a covariance's factor."""
    parts = []
    for p in parameters:
        shape = np.shape(p.example.raw)
        parts.append(np.triu(np.ones(shape), 1) > 0 if isinstance(p.example, Covariance) else np.zeros(shape, bool))
    return np.concatenate([np.ravel(x) for x in parts])


def unidentifiable(term_gradients: Float[np.ndarray, "*many p n"]) -> Bool[np.ndarray, " p"]:
    """Which of p numbers have no effect: derivatives (…, p, n) with some finite entries, all of them zero."""
    each = np.moveaxis(term_gradients, -2, 0).reshape(term_gradients.shape[-2], -1)
    finite = np.isfinite(each)
    return np.all((each == 0) | ~finite, axis=1) & finite.any(axis=1)


def determined(hessian: Square, free: Mask | None = None) -> tuple[Float[np.ndarray, "p m"], Square, Mask]:
    """The undetermined directions (p, m), the inverse Hessian along all others, and the parameters (p,) in the former.

    Undetermined: without positive curvature, up to rounding; all directions where the Hessian isn't finite. Only the
    `free` (p,) parameters take part, default all.
    """
    p = len(hessian)
    free = np.ones(p, bool) if free is None else free
    missing, inverse = np.eye(p)[:, free], np.zeros((p, p))
    inner = hessian[np.ix_(free, free)]
    if not np.all(np.isfinite(inner)):
        inverse[np.ix_(free, free)] = np.nan
    elif free.any():
        eigenvalues, directions = np.linalg.eigh(inner)
        known = eigenvalues > MIN_CURVATURE * max(float(eigenvalues.max()), 0.0)
        inverse[np.ix_(free, free)] = (directions[:, known] / eigenvalues[known]) @ directions[:, known].T
        missing = missing @ directions[:, ~known]
    parts: np.ndarray = np.any(np.abs(missing) > MIN_COMPONENT, axis=1)
    return missing, inverse, parts


STEP = 0.02  # step of the central differences in unconstrained coordinates: 2 % of a noise level


class Optimum(NamedTuple):
    """Quadratic model of the objective: vector (p,), value, gradient (p,), H (p, p), ψ (n, p), u (NaN: no likelihood).

    `used`: which of all trajectories are the n that count. `evaluation`: at the vector itself. `prior` (p,): the
    prior's part of the diagonal of H.
    """

    vector: Float[np.ndarray, " p"]
    value: float
    gradient: Float[np.ndarray, " p"]
    hessian: Float[np.ndarray, "p p"]
    influence: Float[np.ndarray, "n p"]
    nats_per_unit: float
    used: Bool[np.ndarray, " all"]
    evaluation: Evaluation
    prior: Float[np.ndarray, " p"]


def optimum(problem: Problem, vector: Float[np.ndarray, " p"]) -> Optimum:
    """The quadratic model of the objective at a vector (p,), by central differences of gradients.

    Only trajectories usable at all of the vectors count, so that all differences are of the same function.
    """
    vector = np.asarray(vector, float)
    shifts = STEP * np.eye(len(vector))
    vectors = np.concatenate([vector[None], vector + shifts, vector - shifts])
    evaluation = problem.evaluate(vectors)
    used = np.asarray(evaluation.used.all(axis=0))
    terms, term_gradients = evaluation.terms[..., used], evaluation.term_gradients[..., used]
    sums = terms.sum(axis=-1)
    values, by_sum = (np.asarray(x, float) for x in value_and_gradient(problem.objective, jnp.asarray(sums)))
    gradients = np.einsum("sk,skp->sp", by_sum, term_gradients.sum(axis=-1))
    pull = problem.prior_penalty(vectors, sums)
    values, gradients = values + pull.values, gradients + pull.gradients
    ahead, behind = np.split(gradients[1:], 2)
    rows = (ahead - behind) / (2 * STEP)
    # Without a single usable trajectory there is no likelihood.
    nats = problem.nats_per_unit(sums[0]) if used.any() else np.nan
    psi = influence(problem.objective, terms[0], term_gradients[0])
    hessian, precision = 0.5 * (rows + rows.T), problem.prior.weights(vector)[0]
    prior = precision / nats if precision.any() else precision
    return Optimum(vector, float(values[0]), gradients[0], hessian, psi, nats, used, evaluation.at(0), prior)


def influence(
    objective: AbstractObjective, terms: Float[np.ndarray, "k n"], term_gradients: Float[np.ndarray, "k p n"]
) -> Float[np.ndarray, "n p"]:
    """The derivative of the gradient with respect to each trajectory's weight (n, p).

    From terms (k, n) and their derivatives (k, p, n); exact, since the objective is a function of weighted sums.
    """
    first, second = (np.asarray(x, float) for x in _derivatives(objective, jnp.asarray(terms.sum(axis=-1))))
    total = term_gradients.sum(axis=-1)
    return np.einsum("k,kpn->np", first, term_gradients) + np.einsum("kn,kl,lp->np", terms, second, total)


@eqx.filter_jit
def _derivatives(
    objective: AbstractObjective, sums: Float[jax.Array, " k"]
) -> tuple[Float[jax.Array, " k"], Float[jax.Array, "k k"]]:
    """First and second derivatives of the objective with respect to the sums."""
    return jax.grad(objective.value)(sums), jax.hessian(objective.value)(sums)


def refit(
    problem: Problem, vectors: Float[np.ndarray, "S p"], hessian: Float[np.ndarray, "p p"],
    free: Bool[np.ndarray, " p"] | None = None, weights: Float[np.ndarray, "*S n"] | None = None, rounds: int = 3,
) -> tuple[Float[np.ndarray, "S p"], Float[np.ndarray, " S"]]:  # fmt: skip
    """Vectors (S, p) improved by quasi-Newton steps (BFGS on the inverse Hessian) all at once, and the objective there.

    Each for its own `weights` (S, n) of trajectories, over the `free` (p,) numbers, starting with the same `hessian`. A
    step has length 1 at most, and is rejected and halved where the objective rises.
    """
    free = np.ones(vectors.shape[1], bool) if free is None else free
    inverse = determined(hessian, free)[1][np.ix_(free, free)]
    inverses = np.tile(inverse, (len(vectors), 1, 1))
    here = vectors.copy()
    count = problem.valid if weights is None else np.atleast_2d(weights)
    evaluated = problem.evaluate(here, weights)
    terms, used, gradients = evaluated.terms.copy(), evaluated.used.copy(), evaluated.gradients[:, free].copy()
    scale = np.ones(len(here))
    for _ in range(rounds if free.any() else 0):
        step = -np.einsum("spq,sq->sp", inverses, gradients)
        step *= (scale / np.maximum(1.0, np.linalg.norm(step, axis=1)))[:, None]
        trial = here.copy()
        trial[:, free] += step
        evaluated = problem.evaluate(trial, weights)
        common = used & evaluated.used
        before = problem.values_over(common * count, here, terms)
        after = problem.values_over(common * count, trial, evaluated.terms)
        with np.errstate(invalid="ignore"):
            better = (after < before) & evaluated.finite
        updated = _updated(inverses, step, evaluated.gradients[:, free] - gradients)
        inverses = np.where(better[:, None, None], updated, inverses)
        here = np.where(better[:, None], trial, here)
        terms[better], used[better] = evaluated.terms[better], evaluated.used[better]
        gradients = np.where(better[:, None], evaluated.gradients[:, free], gradients)
        scale = np.where(better, np.minimum(1.0, 2.0 * scale), 0.5 * scale)
    return here, problem.values_over(np.broadcast_to(count, used.shape), here, terms)


def _updated(
    inverses: Float[np.ndarray, "S p p"], steps: Float[np.ndarray, "S p"], changes: Float[np.ndarray, "S p"]
) -> Float[np.ndarray, "S p p"]:
    """The BFGS update of inverses (S, p, p) by steps and gradient changes (S, p), of positive curvature."""
    along = np.einsum("sp,sp->s", steps, changes)
    size = np.linalg.norm(steps, axis=1) * np.linalg.norm(np.nan_to_num(changes), axis=1)
    sound = along > 1e-8 * size
    rho = np.where(sound, 1.0 / np.where(sound, along, 1.0), 0.0)
    left = np.eye(steps.shape[1]) - rho[:, None, None] * steps[:, :, None] * changes[:, None, :]
    new = left @ inverses @ left.transpose(0, 2, 1) + rho[:, None, None] * steps[:, :, None] * steps[:, None, :]
    return np.where(sound[:, None, None], new, inverses)


PART = 0.05  # part of what a fit gained that a flat number may have gained, where the objective is no likelihood
NATS = 1.92  # rise of a likelihood, nats, within which a value is in the 95 % interval of a profile (Wilks 1938)
HALF_DECADES = np.log(10.0) / 2.0 * np.array([*range(-6, 0), *range(1, 7)])
ROUNDS = 8  # steps of the other numbers with one at its starting value


def flat_components(uncertainty: Uncertainty) -> list[int]:
    """The numbers along which the objective is flat at the point, each by itself, those with least effect first."""
    groups = loose_groups(uncertainty, ~unused(uncertainty.parameters) & ~uncertainty.at_bound)
    flat = {k: min(sigmas) for group, sigmas in groups.items() if len(sigmas) == len(group) for k in group}
    return sorted(flat, key=lambda k: -flat[k])


def loose_groups(uncertainty: Uncertainty, free: Bool[np.ndarray, " p"]) -> dict[tuple[int, ...], list[float]]:
    """The numbers among `free` (p,) with a part in a poorly determined direction, and the directions' deviations.

    Groups of numbers by index; the recordings alone count, without the prior.
    """
    indices, point = np.flatnonzero(free), uncertainty.optimum
    if not len(indices) or not np.all(np.isfinite(point.hessian)):
        return {}
    inside = np.ix_(indices, indices)
    cov = (uncertainty.observed if np.all(np.isfinite(uncertainty.observed)) else uncertainty.sandwich)[inside]
    missing, inverse, _ = determined(point.hessian[inside] - np.diag(point.prior[indices]))
    if point.prior.any():
        cov = inverse / point.nats_per_unit
    directions = [(direction, np.inf) for direction in missing.T]
    if np.all(np.isfinite(cov)):
        variances, vectors = np.linalg.eigh(cov)
        wide = zip(vectors.T[::-1], variances[::-1], strict=True)
        directions += [(vector, variance**0.5) for vector, variance in wide if variance > LARGE_SIGMA**2]
    groups: dict[tuple[int, ...], list[float]] = {}
    for direction, sigma in directions:
        part = np.abs(direction) > MIN_COMPONENT
        groups.setdefault(tuple(indices[part].tolist()), []).append(float(sigma))
    return groups


def far_better(
    problem: Problem, uncertainty: Uncertainty, low: Float[np.ndarray, " p"], high: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " p"] | None:
    """The best point (p,) with a flat number up to a thousand times another, better by `NATS`; None where none is."""
    # A noise level that is far too small, or hidden by another that is too large, has no slope where it is.
    at, best = uncertainty.optimum.vector, None
    least = uncertainty.optimum.value - NATS / uncertainty.optimum.nats_per_unit
    for component in flat_components(uncertainty) if np.isfinite(least) and not problem.stochastic else ():
        for number in np.unique(np.clip(at[component] + HALF_DECADES, low[component], high[component])):
            trial = np.where(np.arange(len(at)) == component, number, at)
            value = float(problem.finite_values(trial, problem.evaluate(trial).terms)[0])
            if value < least:
                best, least = trial, value
    return best


def kept_at_start(
    problem: Problem, uncertainty: Uncertainty, start: Float[np.ndarray, " p"], gain: float
) -> tuple[Float[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
    """The optimum with its flat numbers at their values of `start` (p,), and the others fitted again; which (p,) are.

    Flat are numbers along which the objective has no curvature at the optimum, or hardly any. One keeps its starting
    value where that costs less than `NATS` of a likelihood, or `PART` of the `gain` of the fit of another objective.
    """
    vector, kept = uncertainty.optimum.vector, np.zeros(len(start), bool)
    nats = uncertainty.optimum.nats_per_unit
    limit = uncertainty.optimum.value + (NATS / nats if np.isfinite(nats) else PART * gain)
    for component in flat_components(uncertainty):
        if problem.stochastic or vector[component] == start[component]:
            continue
        fixed = kept | (np.arange(len(start)) == component)
        trial, used = np.where(fixed, start, vector)[None], uncertainty.optimum.used[None].astype(float)
        free = ~(uncertainty.at_bound | fixed)
        vectors, values = refit(problem, trial, uncertainty.optimum.hessian, free, used, ROUNDS)
        if values[0] <= limit:
            vector, kept = vectors[0], fixed
    return vector, kept
