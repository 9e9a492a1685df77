"""Identifiability: which parameters the recordings can't determine, in words, and those that keep their start."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.tunable import Scale, tunables
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import Parameter, component_kinds, component_names
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import MIN_COMPONENT, Uncertainty, determined, refit, unidentifiable, unused

LARGE_SIGMA = 1.0
"""Standard deviation of an unconstrained number from which on it is hardly determined: a factor of e either way."""


@dataclass(frozen=True)
class IdentifiabilityIssue:
    """An issue in one sentence, and the `names` of the numbers concerned."""

    names: tuple[str, ...]
    text: str


def cautions(tracker: AbstractTracker, parameters: Sequence[Parameter], objective: AbstractObjective) -> Iterator[str]:
    """Warnings before a fit: tied numbers with different values, and a latency that no likelihood determines."""
    nodes = tunables(tracker)
    for parameter in parameters:
        values = [np.asarray(nodes[name].value) for name in parameter.names]
        if not all(np.array_equal(value, values[0]) for value in values):
            listed = ", ".join(f"{float(value):.4g}" for value in values if value.ndim == 0)
            yield f"{parameter.label}: tied numbers all start at the first value{f' of {listed}' if listed else ''}"
        only_sensor = len(tracker.nis_sensors) == 1
        if parameter.label.endswith(".latency") and only_sensor and not objective.needs_truth:
            yield (
                f"{parameter.label}: fixes alone do not determine their latency, since a delayed track fits them as "
                "well; give recordings with truth and objective rmse"
            )


def identifiability_issues(
    uncertainty: Uncertainty, term_gradients: Float[np.ndarray, "*many p n"], held_out: bool = False
) -> list[IdentifiabilityIssue]:
    """The parameters that the recordings don't determine, worst first; empty for a good fit.

    `term_gradients` (…, p, n): as in `Evaluation`; a number whose derivatives are all zero has no effect. `held_out`:
    whether held-out recordings selected the point.
    """
    names, kinds = component_names(uncertainty.parameters), component_kinds(uncertainty.parameters)
    no_effect, ignored = unidentifiable(term_gradients), unused(uncertainty.parameters)
    without = [names[k] for k in np.flatnonzero(no_effect & ~ignored)]
    issues = [IdentifiabilityIssue(tuple(without), f"{_no_effect(without)} on the objective")] if without else []
    gradient = uncertainty.optimum.gradient
    issues += [
        IdentifiabilityIssue((names[k],), _at_bound(names[k], gradient[k]))
        for k in np.flatnonzero(uncertainty.at_bound & ~uncertainty.kept)
    ]
    if kept := [names[k] for k in np.flatnonzero(uncertainty.kept & ~no_effect)]:
        issues.append(IdentifiabilityIssue(tuple(kept), _kept(kept)))
    if not uncertainty.at_optimum:
        return [*issues, IdentifiabilityIssue((), _not_at_optimum(uncertainty.distance_to_optimum, held_out))]
    free = np.flatnonzero(~no_effect & ~ignored & ~uncertainty.at_bound)
    if not len(free) or not np.all(np.isfinite(uncertainty.optimum.hessian)):
        return issues
    for component, directions in _groups(uncertainty, free).items():
        group, group_kinds = [names[k] for k in component], [kinds[k] for k in component]
        if len(directions) == len(group) > 1:
            text = _none_determined(group, min(deviation for _, deviation in directions))
            issues.append(IdentifiabilityIssue(tuple(group), text))
        else:
            issues += [
                IdentifiabilityIssue(tuple(group), _sentence(group, group_kinds, *direction))
                for direction in directions
            ]
    return issues


def flat_components(uncertainty: Uncertainty) -> list[int]:
    """The numbers along which the objective is flat at the point, each by itself, those with least effect first."""
    free = np.flatnonzero(~unused(uncertainty.parameters) & ~uncertainty.at_bound)
    if not len(free) or not np.all(np.isfinite(uncertainty.optimum.hessian)):
        return []
    groups = _groups(uncertainty, free)
    flat = {
        k: min(s for _, s in directions)
        for group, directions in groups.items()
        if len(directions) == len(group)
        for k in group
    }
    return sorted(flat, key=lambda k: -flat[k])


def _groups(
    uncertainty: Uncertainty, free: Int[np.ndarray, " free"]
) -> dict[tuple[int, ...], list[tuple[Float[np.ndarray, " _"], float]]]:
    """The poorly determined directions by the numbers that take part, each with its standard deviation."""
    cov = uncertainty.observed if np.all(np.isfinite(uncertainty.observed)) else uncertainty.sandwich
    cov, point = cov[np.ix_(free, free)], uncertainty.optimum
    missing, inverse, _ = determined(point.hessian[np.ix_(free, free)] - np.diag(point.prior[free]))
    if point.prior.any():
        cov = inverse / point.nats_per_unit  # what the recordings tell without the prior
    loose = np.zeros((len(free), 0))
    sigmas: list[float] = []
    if np.all(np.isfinite(cov)):
        variances, directions = np.linalg.eigh(cov)
        wide = variances > LARGE_SIGMA**2
        loose, sigmas = directions[:, wide][:, ::-1], np.sqrt(variances[wide])[::-1].tolist()
    groups: dict[tuple[int, ...], list[tuple[np.ndarray, float]]] = {}
    for direction, sigma in zip([*missing.T, *loose.T], [math.inf] * missing.shape[1] + sigmas, strict=True):
        part = np.abs(direction) > MIN_COMPONENT
        groups.setdefault(tuple(free[part].tolist()), []).append((direction[part], sigma))
    return groups


def _not_at_optimum(distance: float, held_out: bool) -> str:
    off = f"{distance:.2g} standard deviations away" if distance < 100 else "far away"
    why = "held-out recordings selected them" if held_out else "the fit ended early, as where objectives are not smooth"
    return f"the numbers are not at the optimum of the recordings tuned on ({off}), and have no intervals: {why}"


def _at_bound(name: str, gradient: float) -> str:
    return f"{name} is at its bound: the optimum is {'lower' if gradient > 0 else 'higher'}"


def _kept(names: list[str]) -> str:
    kept = "keeps its starting value" if len(names) == 1 else "keep their starting values"
    return f"{listed(names)} {kept}: the objective does not determine {'it' if len(names) == 1 else 'them'}"


def _degree(sigma: float) -> str:
    return "not determined" if math.isinf(sigma) else "hardly determined"


def _none_determined(names: list[str], sigma: float) -> str:
    """For n numbers with n poorly determined directions; `sigma`: of the best determined."""
    together = "together" if len(names) == 2 else "in any combination"
    return f"{', '.join(names[:-1])} and {names[-1]} are {_degree(sigma)}, neither one by one nor {together}"


def _sentence(names: list[str], kinds: Sequence[type], direction: Float[np.ndarray, " part"], sigma: float) -> str:
    degree = _degree(sigma)
    if len(names) == 1:
        if math.isinf(sigma):
            return f"{names[0]} is {degree}: near this value the objective does not depend on it"
        if kinds[0] is Scale:
            factor = f"{math.exp(min(sigma, 20.0)):.2g}"
            return f"{names[0]} is {degree}: it may as well be {factor} times larger or smaller"
        return f"{names[0]} is {degree}"
    if len(names) == 2 and all(kind is Scale for kind in kinds):
        return (
            f"{names[0]} and {names[1]} are {degree} one by one: the data determine only {_invariant(names, direction)}"
        )
    size = direction / np.abs(direction).max()
    moves = ", ".join(f"{name} {_change(kind, s)}" for name, kind, s in zip(names, kinds, size, strict=True))
    together = f"{', '.join(names[:-1])} and {names[-1]}"
    return f"{together} are {degree} one by one: changed together ({moves}) they have no effect"


def _no_effect(names: list[str]) -> str:
    """One or several numbers without effect, at most four of them by name."""
    if len(names) == 1:
        return f"{names[0]} has no effect"
    shown, rest = (names[:-1], names[-1]) if len(names) <= 4 else (names[:3], f"{len(names) - 3} others")
    return f"{', '.join(shown)} and {rest} have no effect"


def _invariant(names: list[str], direction: Float[np.ndarray, " 2"]) -> str:
    """The product that is constant along the direction: one name times a power of the other, at most 1."""
    first = int(np.argmin(np.abs(direction)))
    power = -float(direction[first] / direction[1 - first])
    size = abs(power)
    other = names[1 - first] if size > 0.95 else f"{names[1 - first]}^{size:.2g}"
    return f"{names[first]} {'×' if power > 0 else '/'} {other}"


def _change(kind: type, size: float) -> str:
    return f"{100 * (math.exp(0.1 * size) - 1):+.0f} %" if kind is Scale else f"{0.1 * size:+.2g} units"


PART = 0.05
"""Part of what a fit gained that a flat number may have gained, where the objective is no likelihood."""

NATS = 1.92
"""Rise of a likelihood, nats, within which a value is in the 95 % interval of a profile (Wilks 1938)."""

ROUNDS = 8
"""Steps of the other numbers with one at its starting value."""


class Kept(NamedTuple):
    """A vector (p,), which of its numbers (p,) are at their starting values, and the number of vectors evaluated."""

    vector: Float[np.ndarray, " p"]
    at_start: Bool[np.ndarray, " p"]
    vectors: int


def kept_at_start(problem: Problem, uncertainty: Uncertainty, start: Float[np.ndarray, " p"], gain: float) -> Kept:
    """The optimum with its flat numbers at their values of `start` (p,), and the others fitted again.

    Flat are numbers along which the objective has no curvature at the optimum, or hardly any. One keeps its starting
    value where that costs less than `NATS` of a likelihood, or `PART` of the `gain` of the fit of another objective.
    """
    vector, kept, vectors = uncertainty.optimum.vector, np.zeros(len(start), bool), 0
    nats = uncertainty.optimum.nats_per_unit
    limit = uncertainty.optimum.value + (NATS / nats if np.isfinite(nats) else PART * gain)
    for component in flat_components(uncertainty):
        if problem.stochastic or vector[component] == start[component]:
            continue
        fixed = kept | (np.arange(len(start)) == component)
        trial, used = np.where(fixed, start, vector)[None], uncertainty.optimum.used[None].astype(float)
        refitted = refit(problem, trial, uncertainty.optimum.hessian, ~(uncertainty.at_bound | fixed), used, ROUNDS)
        vectors += ROUNDS + 1
        if refitted.values[0] <= limit:
            vector, kept = refitted.vectors[0], fixed
    return Kept(vector, kept, vectors)
