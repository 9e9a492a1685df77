"""Fit the parameters of a tracker to recordings by gradient: forward mode, any number of recordings, many starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.model.tunable import known
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.tracks import Trajectory
from trackwright.tuning.checkpoint import from_arrays
from trackwright.tuning.data import Arrays, FitData, fit_arrays
from trackwright.tuning.fit_warnings import Issue, finished_cautions, identifiability_issues
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.optimisation import LBFGS, AbstractOptimiser, Adam, FitState, MultiStart, initial_state, newton
from trackwright.tuning.parameters import (
    Parameter,
    Prior,
    PriorKind,
    by_label,
    flatten,
    limits,
    select_parameters,
    tuned_by_default,
    with_parameters,
)
from trackwright.tuning.problem import Evaluation, Problem
from trackwright.tuning.uncertainty import (
    Interval,
    Uncertainty,
    far_better,
    kept_at_start,
    optimum,
    refit,
    uncertainty_at,
    unidentifiable,
)
from trackwright.tuning.weight import discount, tempered_anew, weighed_anew

AnyTracker = TypeVar("AnyTracker", bound="AbstractTracker | NamedTracker")


@dataclass(frozen=True)
class Step:
    """One step of a fit: objective, norm of its gradient, and the physical values by label."""

    value: float
    gradient_norm: float
    values: dict[str, np.ndarray]


@dataclass(frozen=True, repr=False)
class FitResult(Generic[AnyTracker]):
    """A tuned tracker, its uncertainty and the optimiser trace.

    `problem`, `vector`, `evaluation`: the objective as a function, its best point, and its value and gradient there.
    `value`, `start_value`: the objective at the best point and at the start. `uncertainty`: None where the fit was
    interrupted. `trace`: the steps of the best start, ending at `vector`; `starts`: of all starts. `before`: the
    tracker at the first start, tied numbers made equal and bounded ones clipped. `limits`: lowest and highest vector.
    `converged`: whether the best start ended before the last step, or its optimiser takes all. `selected`: whether
    held-out recordings chose `vector`. `recordings`: the one of each trajectory of `problem`.
    """

    tracker: AnyTracker
    value: float
    start_value: float
    start_vector: Float[np.ndarray, " p"]
    problem: Problem
    vector: Float[np.ndarray, " p"]
    evaluation: Evaluation
    filter_runs: int
    uncertainty: Uncertainty | None
    before: AbstractTracker
    limits: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]
    converged: bool
    selected: bool = False
    trace: list[Step] = field(default_factory=list)
    starts: list[list[Step]] = field(default_factory=list)
    recordings: list[str] = field(default_factory=list)

    def __repr__(self) -> str:
        lines = [f"<FitResult: objective {self.start_value:.5g} -> {self.value:.5g}, {self.filter_runs} filter runs"]
        errors = self.standard_errors
        for p in self.parameters:
            value, error = np.asarray(self.values[p.label]), np.asarray(errors[p.label])
            shown = f"{value:.4g}" if value.ndim == 0 else np.array2string(value, precision=4)
            shown += f" ± {error:.2g}" if value.ndim == 0 and np.isfinite(error) else ""
            lines.append(f"  {p.label} {shown} {p.example.unit}")
        texts = [*(issue.text for issue in self.issues), *self.cautions]
        return "\n".join([*lines, *(f"  caution: {text}" for text in texts)]) + ">"

    @property
    def parameters(self) -> list[Parameter]:
        """The tuned parameters."""
        return self.problem.parameters

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """The physical values by label."""
        return by_label(self.parameters, self.vector)

    @property
    def n_excluded(self) -> int:
        """The number of trajectories without usable gradients at the best point."""
        return int(self.problem.valid.sum() - self.evaluation.used.sum())

    @cached_property
    def cautions(self) -> list[str]:
        """Caveats on the result. For a likelihood this runs the filter once more."""
        ends = self.start_vector, self.vector
        return finished_cautions(self.problem, *ends, self.uncertainty, self.converged, self.selected)

    @property
    def issues(self) -> list[Issue]:
        """The numbers that the recordings don't determine; none of an interrupted fit."""
        if self.uncertainty is None:
            return []
        return identifiability_issues(self.uncertainty, self.evaluation.term_gradients, self.selected)

    @property
    def intervals(self) -> dict[str, Interval]:
        """95 % intervals by label: the wider of the posterior's and of the scatter of trajectories.

        Empty for a fit that was interrupted or is not at its optimum; NaN for numbers at a bound.
        """
        return {} if self.uncertainty is None or not self.uncertainty.at_optimum else self.uncertainty.intervals()

    @property
    def standard_errors(self) -> dict[str, np.ndarray]:
        """Standard errors of the physical values by label; NaN where the fit was interrupted."""
        if self.uncertainty is None:
            return {p.label: np.full(np.shape(p.example.raw), np.nan) for p in self.parameters}
        return self.uncertainty.standard_errors()


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How a fit is done.

    `frozen`: patterns of tunables to keep. `bounds`: lowest and highest physical value by pattern. `optimiser`: None
    for `LBFGS` for likelihoods, else `Adam`, as for particle filters. `steps`: the most of each start. `starts`: the
    tracker's own values, then the best of a coarse grid. `held_out`: recordings that select the best point and end the
    fit, as `fit` takes them. `dimensions`: 3 to judge an estimated height too; None for 3 with `state-nll`, where truth
    and estimates have heights and anchors are not level, and 2 else. `prior`: of a likelihood, `nll` or `state-nll`: by
    the spread between sites, or flat. Each recording, in arrays each trajectory, has the same weight.
    """

    frozen: Sequence[str] = ()
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    optimiser: AbstractOptimiser | None = None
    steps: int = 60
    starts: int = 1
    held_out: Arrays | RecordingFolder | Sequence[RecordingFolder] = ()
    dimensions: int | None = None
    prior: PriorKind = "sites"


@dataclass(frozen=True, kw_only=True)
class Progress:
    """What a fit tells as it goes, and the state that it goes on from; the result is the same, to the bit.

    `resume`: arrays of a state (`tuning.checkpoint.to_arrays`). `report` is called with the state after every step,
    `stage` with the name of each stage.
    """

    resume: Sequence[np.ndarray] | None = None
    report: Callable[[FitState], object] = lambda state: None
    stage: Callable[[str], object] = lambda name: None


DEFAULTS, UNTOLD = FitOptions(), Progress()


def fit(
    tracker: AnyTracker, recordings: Arrays | FitData | RecordingFolder | Sequence[RecordingFolder],
    objective: str | AbstractObjective | None = None, tune: str | Sequence[str] | None = None,
    options: FitOptions = DEFAULTS, progress: Progress = UNTOLD,
) -> FitResult[AnyTracker]:  # fmt: skip
    """The tracker with the tunables matching `tune` fitted to minimise the objective.

    `tracker`, `recordings`: a tracker by name with recording folders, or a tracker with recordings in arrays: one,
    several, or batches. `objective`: an object, or its name as on the command line (`nll`, `rmse`, `state-nll`, ...);
    default `state-nll` where there is truth, else `nll`. `tune`: shell patterns; by default
    `parameters.tuned_by_default`. `options`: how it is done; `progress`: what it tells, and from where it goes on.

    A step to a non-finite objective, or with `LBFGS` to a higher one, is shortened; a likelihood ends with a few Newton
    steps. The result is the best point met, never worse than the start; an interrupt (Ctrl-C) ends the fit there.
    `FitResult.cautions` speak against it. Raises ValueError for patterns that match nothing or can't be tied and for
    empty bounds; FloatingPointError where the objective is not finite at the first start.
    """
    data = fit_arrays(tracker, recordings, objective, options.held_out, options.dimensions)
    model, objective = data.tracker, data.objective
    tune = tuned_by_default(model, objective.needs_truth) if tune is None else tune
    parameters = select_parameters(model, tune, options.frozen)
    model = known(model, [name for parameter in parameters for name in parameter.names])
    problem = Problem(model, data.rows.batches, objective, parameters, weights=data.rows.weights)
    names = data.rows.recordings_of(problem)
    likelihood, number = objective.is_likelihood and not problem.stochastic, len({*names, ""}) - 1
    if likelihood:
        problem.discount = discount(problem, flatten(parameters), number)
        problem.prior = Prior.of(parameters, options.prior)
    scoring = None
    if data.rows_apart.batches:
        scoring = Problem(model, data.rows_apart.batches, objective, parameters, weights=data.rows_apart.weights)
    low, high = limits(parameters, options.bounds)
    if (hidden := _hidden(parameters, objective)).any():
        low, high = (np.where(hidden, flatten(parameters), ends) for ends in (low, high))
    # Errors are discontinuous where a track is nearly lost, and a line search ends there; Adam steps over. A density
    # jumps little.
    optimiser = options.optimiser or (LBFGS() if likelihood else Adam(options.steps))
    driver = MultiStart(problem, optimiser, options.steps, low, high, scoring)
    if progress.resume is not None:
        state = from_arrays(optimiser, progress.resume)
        problem.filter_runs = int(state.filter_runs)
    else:
        state = initial_state(driver, flatten(parameters), options.starts)
    interrupted = False
    try:
        progress.report(state)
        while not driver.done(state):
            state = driver.step(state)
            progress.report(state)
    except KeyboardInterrupt:
        interrupted = True
    progress.stage("the best values so far" if interrupted else "intervals")
    flat = not problem.prior.precision.any()
    if not (interrupted or flat or scoring):
        state = weighed_anew(driver, tempered_anew(driver, state), names)
    elif flat and likelihood and not interrupted:
        # It scales intervals alone. At levels that are far off errors are correlated that are not at the fitted ones.
        problem.discount = discount(problem, state.best_vectors[np.argmin(state.best_scores)], number)
    result = _result(model, driver, state, interrupted)
    result = replace(result, recordings=names)
    if isinstance(tracker, NamedTracker):
        values = {name: result.values[p.label] for p in parameters for name in p.names}
        result = replace(result, tracker=tracker.with_values(values, "the fit"))
    return result


def _hidden(parameters: Sequence[Parameter], objective: AbstractObjective) -> Bool[np.ndarray, " p"]:
    """The numbers (p,) of vertical noise beside others, where the objective judges the position over the floor."""
    axes = [getattr(p.example, "axis", None) for p in parameters for _ in range(p.size)]
    vertical = np.array([axis == "vertical" for axis in axes])
    return vertical & (objective.horizontal and not vertical.all())


def _result(tracker: AbstractTracker, driver: MultiStart, state: FitState, interrupted: bool) -> FitResult[Any]:
    """The result at the best point met, after a few Newton steps of a likelihood."""
    problem, parameters = driver.problem, driver.problem.parameters
    winner, start = int(np.argmin(state.best_scores)), state.past_vectors[0, 0]
    vector, uncertainty = _best_vector(problem, state, winner), None
    if interrupted:
        last = problem.evaluate(vector)
    else:
        while True:
            best = newton(driver, vector)
            bound, hidden = driver.at_bound(best.vector, best.gradient), driver.low == driver.high
            uncertainty = uncertainty_at(problem, best, bound, hidden)
            # A point that others select is no optimum, and its curvature shows nothing.
            optimal = driver.held_out is None and not best.prior.any()
            other = far_better(problem, uncertainty, driver.low, driver.high) if optimal else None
            if other is None:
                break
            vector = driver.finished(initial_state(driver, other, 1)).best_vectors[0]
        if optimal:
            gain = float(state.past_values[0, 0]) - best.value
            kept, at_start = kept_at_start(problem, uncertainty, start, gain)
            if at_start.any():
                best = optimum(problem, kept)
                uncertainty = uncertainty_at(problem, best, bound, at_start | hidden)
        vector, last = best.vector, best.evaluation
    value = float(problem.finite_values(vector, last.terms)[0])
    traces = [_trace(parameters, state, k) for k in range(len(state.vectors))]
    if not np.array_equal(vector, state.best_vectors[winner]):
        traces[winner].append(Step(value, float(np.linalg.norm(last.gradients)), by_label(parameters, vector)))
    return FitResult(
        tracker=with_parameters(tracker, parameters, vector),
        value=value,
        start_value=float(state.past_values[0, 0]),
        start_vector=start,
        problem=problem,
        vector=vector,
        evaluation=last,
        filter_runs=driver.filter_runs,
        uncertainty=uncertainty,
        before=with_parameters(tracker, parameters, start),
        limits=(driver.low, driver.high),
        converged=not (driver.optimiser.monotone and state.number >= driver.max_steps and state.active[winner]),
        selected=driver.held_out is not None,
        trace=traces[winner],
        starts=traces,
    )


def _best_vector(problem: Problem, state: FitState, winner: int) -> Float[np.ndarray, " p"]:
    """The winner's best point, with the tracker's own values for parameters that have no effect on these recordings.

    Other recordings may depend on them.
    """
    vector, (start, first) = state.best_vectors[winner], state.past_vectors[0, [0, winner]]
    if np.array_equal(start, first):
        return vector
    evaluation = problem.evaluate(vector)
    no_effect = unidentifiable(evaluation.term_gradients) & (start != first)
    if not no_effect.any():
        return vector
    restored = np.where(no_effect, start, vector)
    other = problem.finite_values(restored, problem.evaluate(restored).terms)
    as_good = other[0] <= problem.finite_values(vector, evaluation.terms)[0]
    return restored if as_good else vector


def _trace(parameters: Sequence[Parameter], state: FitState, start: int) -> list[Step]:
    """The steps of a start up to its last move."""
    vectors = state.past_vectors[:, start]
    moved = np.flatnonzero(np.any(np.diff(vectors, axis=0) != 0, axis=1))
    last = moved[-1] + 2 if len(moved) else 1
    # Vector by vector: programs for every number of steps would take longer to compile.
    steps = zip(state.past_values[:last, start], state.past_norms[:last, start], vectors[:last], strict=True)
    return [Step(float(value), float(norm), by_label(parameters, vector)) for value, norm, vector in steps]


MOST_FOLDS = 10  # fits at most: of more recordings several are left out at once
LEFT_OUT_ROUNDS = 8  # steps of each fit from the optimum of all recordings


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
    hessian, free = uncertainty.optimum.hessian, ~uncertainty.at_bound
    vectors, _ = refit(result.problem, starts, hessian, free, weights, LEFT_OUT_ROUNDS)
    values = [by_label(result.parameters, np.clip(vector, *result.limits)) for vector in vectors]
    fitted = zip(folds, values, weights, strict=True)
    return {name: of_fold for fold, of_fold, others in fitted for name in fold if others.any()}


BLOCKS = 4  # blocks of time of a single recording


def left_out_blocks(result: FitResult, data: FitData) -> list[tuple[float, float, dict[str, np.ndarray]]]:
    """Blocks of time with as many true positions each: start, stop, and the values by label fitted without its truth.

    `data`: what was fitted to. With the compiled programs of the fit, since only truth is hidden. Empty as
    `left_out_values`, and where the objective needs no truth.
    """
    uncertainty, quantity = _model(result), next(iter(data.training[0].recording.truth))
    if uncertainty is None or not data.objective.needs_truth:
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
        rows = replace(data, training=[hidden(trajectory) for trajectory in data.training]).rows
        problem = Problem(fitted.tracker, rows.batches, fitted.objective, fitted.parameters, weights=rows.weights)
        problem.prior, problem.discount = fitted.prior, fitted.discount
        vectors, _ = refit(problem, result.vector[None], uncertainty.optimum.hessian, free, None, LEFT_OUT_ROUNDS)
        vector = np.clip(vectors[0], *result.limits)
        blocks.append((start, stop, by_label(result.parameters, vector)))
    return blocks
