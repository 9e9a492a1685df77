"""Warnings about a fit: what its recordings do not determine, levels that collapsed, errors that last."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.tunable import Scale, tunables
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import Parameter, component_names, split
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import MIN_TRAJECTORIES, Interval, Uncertainty, loose_groups, unidentifiable, unused
from trackwright.tuning.weight import rows_and_inflation

Point = Float[np.ndarray, " p"]  # unconstrained numbers
COLLAPSED = 1e-3  # part of its starting value below which a noise level has collapsed
MOVED = 1e-6  # change in unconstrained coordinates below which a fit has not moved
INFLATION = 2.0  # rows with the information of one from which on errors are named as correlated


class Issue(NamedTuple):
    """Numbers that the recordings do not determine: their `names`, and a sentence."""

    names: tuple[str, ...]
    text: str


def cautions(tracker: AbstractTracker, parameters: Sequence[Parameter], objective: AbstractObjective) -> Iterator[str]:
    """Warnings before a fit: tied numbers with different values, and a latency that no likelihood determines."""
    nodes = tunables(tracker)
    for parameter in parameters:
        values = [np.asarray(nodes[name].value) for name in parameter.names]
        if not all(np.array_equal(value, values[0]) for value in values):
            yield f"{parameter.label}: tied numbers with different values all start at the first"
        if parameter.label.endswith(".latency") and len(tracker.nis_sensors) == 1 and not objective.needs_truth:
            fix = "give recordings with truth and objective rmse"
            yield f"{parameter.label}: fixes alone do not determine their latency; {fix}"


def identifiability_issues(
    uncertainty: Uncertainty, term_gradients: Float[np.ndarray, "*many p n"], held_out: bool = False
) -> list[Issue]:
    """The numbers that the recordings don't determine; empty for a good fit.

    `term_gradients` (…, p, n): as in `Evaluation`; a number whose derivatives are all zero has no effect. `held_out`:
    whether held-out recordings selected the point.
    """
    names, ignored, issues = component_names(uncertainty.parameters), unused(uncertainty.parameters), list[Issue]()
    no_effect, bound = unidentifiable(term_gradients), uncertainty.at_bound & ~uncertainty.kept
    falls = uncertainty.optimum.gradient > 0

    def add(which: Bool[np.ndarray, " p"], text: str) -> None:
        if which.any():
            found = tuple(names[k] for k in np.flatnonzero(which))
            issues.append(Issue(found, f"{listed(found)}: {text}"))

    add(no_effect & ~ignored, "no effect on the objective")
    add(bound & falls, "at the bound, the optimum is lower")
    add(bound & ~falls, "at the bound, the optimum is higher")
    add(uncertainty.kept & ~no_effect, "kept at the starting value, which the objective does not determine")
    if not uncertainty.at_optimum:
        off = uncertainty.distance_to_optimum
        away = f"{off:.2g} standard deviations" if off < 100 else "far"
        why = "held-out recordings selected them" if held_out else "the fit ended early"
        text = f"the values are {away} away from the optimum of the recordings tuned on, without intervals: {why}"
        return [*issues, Issue((), text)]
    owners = [p for p in uncertainty.parameters for _ in range(p.size)]
    for group, sigmas in loose_groups(uncertainty, ~no_effect & ~ignored & ~uncertainty.at_bound).items():
        found, worst = tuple(names[k] for k in group), max(sigmas)
        text = "not determined" if math.isinf(worst) else "hardly determined"
        if len(group) > 1:
            text += " one by one" if len(sigmas) < len(group) else ", neither one by one nor together"
        elif math.isfinite(worst) and isinstance(owners[group[0]].example, Scale):
            text += f", by a factor of {math.exp(min(worst, 20.0)):.2g} either way"
        issues.append(Issue(found, f"{listed(found)}: {text}"))
    return issues


def finished_cautions(
    problem: Problem, start: Point, end: Point, uncertainty: Uncertainty | None, converged: bool, selected: bool
) -> list[str]:
    """Clauses on a finished fit, as in `FitResult.cautions`. For a likelihood this runs the filter once more."""
    texts = []
    if np.max(np.abs(end - start), initial=0.0) < MOVED:
        where = " on the held-out recordings" if selected else ""
        texts.append(f"the fit did not move from its starting values: no other point is better{where}")
    ends = zip(split(problem.parameters, start), split(problem.parameters, end), strict=True)
    for (parameter, first), (_, last) in ends:
        fell = isinstance(parameter.example, Scale) and np.min(last - first) < math.log(COLLAPSED)
        if fell and not _determined(uncertainty, parameter):
            low = f"{float(np.exp(last.min())):.3g} {parameter.example.unit}"
            texts.append(f"{parameter.label} collapsed to {low}, less than {COLLAPSED:g} of its start: give bounds")
    if uncertainty is not None and np.isnan(uncertainty.optimum.nats_per_unit) and not (converged or selected):
        texts.append("the fit took all its steps before it came to rest")
    if problem.objective.is_likelihood:
        rows, inflation = rows_and_inflation(problem, end)
        if inflation >= INFLATION:
            what = "errors" if problem.objective.needs_truth else "innovations"
            about = f"{rows} rows carry the information of about {rows / inflation:.0f}"
            texts.append(f"{what} are correlated over time: {about}")
    return texts


def _determined(uncertainty: Uncertainty | None, parameter: Parameter) -> bool:
    """Whether a noise level has a standard error below its value."""
    if uncertainty is None:
        return False
    sigmas = np.where(uncertainty.undetermined | uncertainty.at_bound, np.inf, uncertainty.sigmas)
    return any(p.label == parameter.label and np.all(x < 1.0) for p, x in split(uncertainty.parameters, sigmas))


def without_intervals(uncertainty: Uncertainty | None, intervals: Mapping[str, Interval]) -> list[str]:
    """Why a fit at its optimum has no interval of a number that is not at a bound; empty for other fits."""
    known = any(np.isfinite(ends).any() for ends in intervals.values())
    if uncertainty is None or not uncertainty.at_optimum or known or uncertainty.at_bound.all():
        return []
    if not np.isfinite(uncertainty.optimum.hessian).all():
        return ["no 95 % intervals: the objective has no finite curvature at these values; tune fewer numbers"]
    if np.isnan(uncertainty.observed).any() and np.isnan(uncertainty.sandwich).any():
        found = f"takes {MIN_TRAJECTORIES} trajectories, found {uncertainty.clusters}"
        return [f"no 95 % intervals: this objective is no likelihood and {found}; give more or --objective nll"]
    return []
