"""95 % intervals of tuned numbers: by curvature and scatter, by profile likelihood, or by bootstrap.

And the values that are fitted to all recordings but one, or to all of one but a block of time (cross-validation).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import chdtri

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.trajectories import Trajectory
from trackwright.tuning.data import FitData
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import Parameter, by_label, physical, physical_vector
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import MIN_TRAJECTORIES as SCATTERED
from trackwright.tuning.uncertainty import Optimum, Uncertainty, determined, refit

HALF_WIDTH = 3.5
"""Half width of a profile in standard deviations, where the likelihood of a normal shape has fallen by 6 nats."""

MAX_HALF_WIDTH = float(np.log(1e3))
"""Largest half width in unconstrained coordinates, and that of an undetermined number."""

MIN_TRAJECTORIES = 5
"""Fewest trajectories for the bootstrap."""

ROUNDS = 4
"""Steps of the other numbers at every point of a profile, starting from the quadratic model's optimum."""


@dataclass(frozen=True)
class Profile:
    """The objective minimised over all other numbers, at G values of one number.

    `raw`, `values` (G,): unconstrained and physical values. `rise` (G,): above the optimum, nats. `low`, `high`: the
    physical interval of the given level, where the rise is below half the chi-square quantile of one degree of freedom
    (Wilks 1938), stretched where trajectories have weights; infinite (or the end of the possible range) where the
    profile doesn't rise so far.
    """

    raw: Float[np.ndarray, " G"]
    values: Float[np.ndarray, " G"]
    rise: Float[np.ndarray, " G"]
    low: float
    high: float


def profile(
    problem: Problem,
    optimum: Optimum,
    component: int,
    level: float = 0.95,
    points: int = 15,
    at_bound: Bool[np.ndarray, " p"] | None = None,
) -> Profile:
    """The profile likelihood of the unconstrained number `component`, all points at once.

    `at_bound` (p,): other numbers that keep their values. Raises ValueError for an objective that is no likelihood.
    """
    if not np.isfinite(optimum.nats_per_unit):
        raise ValueError("a profile is of a likelihood; use the bootstrap for another objective")
    p = len(optimum.vector)
    others = np.arange(p) != component
    if at_bound is not None:
        others &= ~at_bound
    along = optimum.hessian[component]
    _, inner, _ = determined(optimum.hessian, others)
    curvature = optimum.nats_per_unit * (optimum.hessian[component, component] - along @ inner @ along)
    stretch = _stretch(optimum, others, component)
    half_width = min(HALF_WIDTH * np.sqrt(stretch / curvature), MAX_HALF_WIDTH) if curvature > 0 else MAX_HALF_WIDTH
    # An odd number of points has the optimum itself among them.
    offsets = np.linspace(-half_width, half_width, points + 1 - points % 2)
    vectors = np.tile(optimum.vector, (len(offsets), 1))
    vectors[:, component] += offsets
    vectors -= offsets[:, None] * (inner @ along)
    refitted = refit(problem, vectors, optimum.hessian, others, optimum.used.astype(float), ROUNDS)
    rise = optimum.nats_per_unit * (refitted.values - min(optimum.value, np.nanmin(refitted.values)))
    ends = _crossings(offsets, rise, 0.5 * stretch * float(chdtri(1, 1 - level)))
    edge = [_physical(problem.parameters, optimum.vector, component, x) for x in ends]
    raw = optimum.vector[component] + offsets
    values = np.array([_physical(problem.parameters, optimum.vector, component, x) for x in offsets])
    return Profile(raw, values, rise, *edge)


def _stretch(optimum: Optimum, others: Bool[np.ndarray, " p"], component: int) -> float:
    """The factor of the chi-square quantile where trajectories have weights (Rotnitzky & Jewell 1990); 1 without."""
    free = others.copy()
    free[component] = True
    _, inverse, _ = determined(optimum.hessian, free)
    unweighted, weighted = inverse[component, component], optimum.weighted(inverse)[component, component]
    return float(weighted / unweighted) if optimum.squared is not None and unweighted > 0 and weighted > 0 else 1.0


def bootstrap(
    problem: Problem,
    optimum: Optimum,
    replicates: int = 100,
    rounds: int = 3,
    seed: int = 0,
    at_bound: Bool[np.ndarray, " p"] | None = None,
) -> Float[np.ndarray, "{replicates} p"]:
    """Vectors (replicates, p) fitted to trajectories resampled with replacement (Efron 1979), for any objective.

    All by a few steps from the optimum, with the numbers `at_bound` (p,) fixed. Raises ValueError for fewer than five
    trajectories.
    """
    count = int(optimum.used.sum())
    if count < MIN_TRAJECTORIES:
        raise ValueError(f"{count} trajectories are too few to resample; cut recordings into segments, or add some")
    rng = np.random.default_rng(seed)
    weights = np.zeros((replicates, len(optimum.used)))
    weights[:, optimum.used] = rng.multinomial(count, np.full(count, 1.0 / count), size=replicates)
    start = np.tile(optimum.vector, (replicates, 1))
    free = None if at_bound is None else ~at_bound
    return refit(problem, start, optimum.hessian, free, weights, rounds).vectors


def percentile_intervals(
    parameters: list[Parameter], vectors: Float[np.ndarray, "S p"]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Lowest and highest physical value of the central 95 % of replicates (S, p), by label."""
    physical_values = [physical(parameters, v) for v in vectors]
    intervals = {}
    for k, p in enumerate(parameters):
        low, high = np.percentile(np.stack([np.asarray(v[k], float) for v in physical_values]), (2.5, 97.5), axis=0)
        intervals[p.label] = (low, high)
    return intervals


def _crossings(offsets: Float[np.ndarray, " G"], rise: Float[np.ndarray, " G"], height: float) -> tuple[float, float]:
    """The offsets at which a profile first rises to `height` on either side of its minimum; infinite without any.

    Interpolated linearly in the root of the rise, which is exact for a quadratic.
    """
    root = np.sqrt(np.maximum(np.where(np.isfinite(rise), rise, np.inf), 0.0))
    least, wanted = int(np.argmin(root)), np.sqrt(height)

    def side(order: Int[np.ndarray, " side"], sign: float) -> float:
        for a, b in pairwise(order):
            if root[b] >= wanted:
                if not np.isfinite(root[b]):
                    return float(offsets[b])
                return float(offsets[a] + (wanted - root[a]) / (root[b] - root[a]) * (offsets[b] - offsets[a]))
        return sign * np.inf

    indices = np.arange(len(offsets))
    return side(indices[: least + 1][::-1], -1.0), side(indices[least:], 1.0)


def _physical(parameters: list[Parameter], vector: Float[np.ndarray, " p"], component: int, offset: float) -> float:
    """The physical value of one number at an `offset` from a vector in unconstrained coordinates."""
    moved = np.array(vector, float)
    moved[component] += offset
    return float(physical_vector(parameters, moved)[component])


Interval = tuple[np.ndarray, np.ndarray]
"""Lowest and highest value."""


def intervals_of(result: FitResult, kind: str = "curvature") -> dict[str, Interval]:
    """The intervals by label; empty for a fit that was interrupted or is not at its optimum.

    `curvature`: the wider of a likelihood's curvature and the scatter of trajectories or blocks of rows. `profile`:
    where the profile likelihood has fallen by 1.92 nats. `bootstrap`: percentiles of fits to resampled trajectories.
    NaN for numbers at a bound. Raises UnusableInput where the kind does not apply.
    """
    uncertainty = result.uncertainty
    if uncertainty is None or not uncertainty.at_optimum:
        return {}
    try:
        if kind == "bootstrap":
            return _bootstrap_intervals(result, uncertainty)
        if kind == "profile":
            return _profile_intervals(result, uncertainty)
    except ValueError as error:
        raise UnusableInput(f"intervals by {kind}: {error}") from error
    return dict(uncertainty.intervals())


def without_intervals(uncertainty: Uncertainty | None, intervals: Mapping[str, Interval]) -> list[str]:
    """Why a fit at its optimum has no interval of a number that is not at a bound, in words; empty for other fits."""
    known = any(np.isfinite(ends).any() for ends in intervals.values())
    if uncertainty is None or not uncertainty.at_optimum or known or uncertainty.at_bound.all():
        return []
    if not np.isfinite(uncertainty.optimum.hessian).all():
        return ["no 95 % intervals: the objective has no finite curvature at these values; tune fewer numbers"]
    if np.isnan(uncertainty.observed).any() and np.isnan(uncertainty.sandwich).any():
        return [
            "no 95 % intervals: for an objective that is not a likelihood they come from the scatter over trajectories "
            f"and take {SCATTERED}; found {uncertainty.clusters}; give --intervals bootstrap ({MIN_TRAJECTORIES} or "
            "more), shorter --piece-rows, or --objective nll"
        ]
    return []


def require_possible(kind: str, objective: AbstractObjective, trajectories: int) -> None:
    """Raise UnusableInput, before any work, for a kind of interval that does not apply to so many trajectories."""
    if kind == "profile" and not objective.is_likelihood:
        raise UnusableInput(
            "intervals by profile: a profile is of a likelihood; use the objective nll, or the bootstrap"
        )
    if kind == "bootstrap" and trajectories < MIN_TRAJECTORIES:
        raise UnusableInput(
            f"intervals by bootstrap: found {trajectories} segments of recordings, expected {MIN_TRAJECTORIES} or more "
            "to draw from; cut the recordings into shorter segments, or give more of them"
        )


def _bootstrap_intervals(result: FitResult, uncertainty: Uncertainty) -> dict[str, Interval]:
    at_bound = uncertainty.at_bound
    vectors = bootstrap(result.problem, uncertainty.optimum, at_bound=at_bound)
    return percentile_intervals(result.parameters, np.where(at_bound, np.nan, vectors))


def _profile_intervals(result: FitResult, uncertainty: Uncertainty) -> dict[str, Interval]:
    """Profile intervals of single numbers; a matrix keeps those by curvature, since its entries are no parameters."""
    intervals, start = dict(uncertainty.intervals()), 0
    for parameter in result.parameters:
        if len(parameter.shape) < 2:
            ends = np.array([_ends(result, uncertainty, start + k) for k in range(parameter.size)])
            intervals[parameter.label] = ends[:, 0].reshape(parameter.shape), ends[:, 1].reshape(parameter.shape)
        start += parameter.size
    return intervals


def _ends(result: FitResult, uncertainty: Uncertainty, component: int) -> tuple[float, float]:
    if uncertainty.at_bound[component]:
        return np.nan, np.nan
    curve = profile(result.problem, uncertainty.optimum, component, at_bound=uncertainty.at_bound)
    return curve.low, curve.high


MOST_FOLDS = 10
"""Fits at most: of more recordings several are left out at once."""


LEFT_OUT_ROUNDS = 8
"""Steps of each fit from the optimum of all recordings."""


def _model(result: FitResult) -> Uncertainty | None:
    """The model of the objective from which a few steps fit a part of the recordings; None without one."""
    known = None if result.problem.stochastic else result.uncertainty
    return known if known is None or np.all(np.isfinite(known.optimum.hessian)) else None


def left_out_values(result: FitResult) -> dict[str, dict[str, np.ndarray]]:
    """For each recording, the values by label that are fitted to the others, all at once.

    Numbers at a bound, and those that keep their starting values, stay there. Empty for one recording, for an
    interrupted fit, and for particle filters, whose gradients are too noisy for a few steps.
    """
    uncertainty, names = _model(result), list(dict.fromkeys(name for name in result.recordings if name))
    if uncertainty is None or len(names) < 2:
        return {}
    folds = [names[k::MOST_FOLDS] for k in range(min(len(names), MOST_FOLDS))]
    recordings = np.asarray(result.recordings)
    weights = np.stack([uncertainty.optimum.used & ~np.isin(recordings, fold) for fold in folds]).astype(float)
    starts = np.tile(result.vector, (len(folds), 1))
    vectors = refit(
        result.problem, starts, uncertainty.optimum.hessian, ~uncertainty.at_bound, weights, LEFT_OUT_ROUNDS
    ).vectors
    values = [by_label(result.parameters, np.clip(vector, *result.limits)) for vector in vectors]
    return {
        name: of_fold
        for fold, of_fold, others in zip(folds, values, weights, strict=True)
        for name in fold
        if others.any()
    }


BLOCKS = 4
"""Blocks of time of a single recording."""


def left_out_blocks(result: FitResult, data: FitData) -> list[tuple[float, float, dict[str, np.ndarray]]]:
    """Blocks of time with as many true positions each: start, stop, and the values by label fitted without its truth.

    `data`: what was fitted to. With the compiled programs of the fit, since only truth is hidden. Empty as
    `left_out_values`, and where the objective needs no truth.
    """
    uncertainty, quantity = _model(result), next(iter(data.training[0].recording.truth))
    if uncertainty is None or not (data.objective.needs_truth and data.stacked):
        return []
    known = [t.recording.times[t.recording.truth[quantity][1]] for t in data.training]
    edges = np.quantile(np.concatenate(known), np.linspace(0, 1, BLOCKS + 1))
    edges[[0, -1]] = -np.inf, np.inf
    blocks, fitted, free = list[tuple[float, float, dict[str, np.ndarray]]](), result.problem, ~uncertainty.at_bound

    def hidden(trajectory: Trajectory) -> Trajectory:
        recording = trajectory.recording
        values, seen = recording.truth[quantity]
        rest = seen & ((recording.times < start) | (recording.times >= stop))
        return replace(trajectory, recording=replace(recording, truth={quantity: (values, rest)}))

    for start, stop in pairwise(edges.tolist()):
        part = replace(data, training=[hidden(trajectory) for trajectory in data.training])
        problem = Problem(fitted.tracker, part.batches(), fitted.objective, fitted.parameters, weights=part.weights())
        problem.moving = fitted.moving
        refitted = refit(problem, result.vector[None], uncertainty.optimum.hessian, free, None, LEFT_OUT_ROUNDS)
        vector = np.clip(refitted.vectors[0], *result.limits)
        blocks.append((start, stop, by_label(result.parameters, vector)))
    return blocks
