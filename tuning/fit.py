"""Fit the numbers of a tracker to recordings by gradient: forward mode, any number of recordings, many starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from trackers.core.chunks import CHUNK
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from tuning.objectives import AbstractObjective
from tuning.optimisation import Descent, FitState, enough, restored
from tuning.optimisers import LBFGS, AbstractOptimiser, Adam, GaussNewton
from tuning.parameters import Parameter, flatten, limits, physical, select_parameters, with_parameters
from tuning.priors import Prior
from tuning.problem import Problem
from tuning.starts import coarse_grid
from tuning.uncertainty import Optimum, Uncertainty, assessed, determined, optimum, without_effect

NEWTON_STEPS = 4


@dataclass(frozen=True)
class Step:
    """One step of a fit: the figure, the length of its gradient, and the physical values at which it was taken."""

    value: float
    gradient_norm: float
    values: dict[str, Any]


@dataclass(frozen=True)
class FitResult:
    """A tuned tracker and how it came about.

    `values`: physical, by label. `value`, `start_value`: the objective. `n_excluded`: trajectories without usable
    derivatives. `problem` and `vector`: the objective as a function, and where it is least. `uncertainty`: None where
    the fit was interrupted. `trace`: the steps of the start that won, the last one to the `vector`; `starts`: those of
    all. `before`: the tracker that the fit began with, tied numbers equal and bounded ones within their bounds.
    """

    tracker: AbstractTracker
    parameters: list[Parameter]
    values: dict[str, Any]
    value: float
    start_value: float
    n_excluded: int
    problem: Problem
    vector: np.ndarray
    filter_runs: int
    uncertainty: Uncertainty | None
    before: AbstractTracker
    trace: list[Step] = field(default_factory=list)
    starts: list[list[Step]] = field(default_factory=list)

    @property
    def standard_errors(self) -> dict[str, Any]:
        """Of the physical values by label, as `Uncertainty` has them; NaN where the fit was interrupted."""
        if self.uncertainty is None:
            return {p.label: np.full(np.shape(p.example.raw), np.nan) for p in self.parameters}
        return self.uncertainty.standard_errors()


def fit(
    tracker: AbstractTracker,
    batches: Batch | Sequence[Batch],
    objective: AbstractObjective,
    tune: str | Sequence[str],
    *,
    frozen: Sequence[str] = (),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    optimiser: AbstractOptimiser | None = None,
    steps: int = 60,
    starts: int = 1,
    held_out: Batch | Sequence[Batch] = (),
    minibatch: int | None = None,
    priors: Sequence[Prior] = (),
    guesses: Sequence[AbstractTracker] = (),
    seed: int = 0,
    chunk: int = CHUNK,
    resume: Sequence[np.ndarray] | None = None,
    report: Callable[[FitState], None] = lambda state: None,
) -> FitResult:
    """The tracker with the tunables that `tune` names (shell patterns) fitted for the least objective.

    `frozen`: patterns of tunables that stay as they are. `bounds`: lowest and highest physical value by pattern.
    `optimiser`: default `LBFGS` for likelihoods, `Adam` for particles, minibatches and other objectives. `starts`:
    how many points are followed, side by side: the tracker's own, and the best of the `guesses` and of a coarse grid.
    `held_out`: recordings that decide which point is the best, and when to stop. `minibatch`: trajectories per step.
    `priors`: beside a likelihood. `report` gets the state after every step; `resume` takes up again what
    `tuning.optimisation.stored` made of one, with the same result to the bit.

    A step after which the objective isn't finite, or that doesn't help, is taken back and shortened; for a likelihood a
    few Newton steps follow. The best point met is returned, never a worse one than the start; an interrupt (Ctrl-C)
    ends the fit there. Raises ValueError for patterns that name nothing or nothing that can be tied, for bounds without
    room, priors and Gauss-Newton without a likelihood; FloatingPointError where the objective is not finite at first.
    """
    parameters = select_parameters(tracker, tune, frozen)
    if priors and not objective.is_likelihood:
        raise ValueError("priors are weighed against a likelihood; with another objective give bounds")
    if isinstance(optimiser, GaussNewton) and not objective.is_likelihood:
        raise ValueError("Gauss-Newton takes its steps from the innovations of a likelihood; use another optimiser")
    trajectories = chunk if minibatch is None else min(chunk, minibatch)
    problem = Problem(tracker, _several(batches), objective, parameters, trajectories, priors)
    judge = Problem(tracker, _several(held_out), objective, parameters, chunk) if held_out else None
    low, high = limits(parameters, bounds or {})
    # An error has steps where a track is nearly lost, at which a line search ends; Adam goes over them.
    steady = objective.is_likelihood and minibatch is None and not problem.random
    optimiser = optimiser or (LBFGS() if steady else Adam(steps))
    parts = None if minibatch is None else max(1, minibatch // problem.chunks[0].size)
    descent = Descent(problem, optimiser, steps, low, high, judge, minibatch=parts, seed=seed)
    if resume is not None:
        state = restored(optimiser, resume)
    else:
        others = [flatten(select_parameters(guess, tune, frozen)) for guess in guesses]
        state = begun(descent, np.stack([flatten(parameters), *others]), starts)
    try:
        report(state)
        while not descent.over(state):
            state = descent.advance(state)
            report(state)
    except KeyboardInterrupt:
        return _finished(tracker, descent, state, interrupted=True)
    return _finished(tracker, descent, state, interrupted=False)


def _several(batches: Batch | Sequence[Batch]) -> list[Batch]:
    return [batches] if isinstance(batches, Batch) else list(batches)


def begun(descent: Descent, vectors: np.ndarray, starts: int) -> FitState:
    """The state at the first of the vectors and at the best of the others and of a coarse grid, `starts` together."""
    if starts > 1:
        vectors = np.concatenate([vectors, coarse_grid(descent.problem.parameters, vectors[0])[1:]])
    state = descent.begin(vectors)
    if not state.active[0]:
        raise FloatingPointError(
            f"the objective is not finite at the start ({state.found.values[0]}): no row is scored, or truth is missing"
        )
    others = 1 + np.argsort(state.best_scores[1:], kind="stable")
    return state.of(np.concatenate([[0], others])[:starts])


def _finished(tracker: AbstractTracker, descent: Descent, state: FitState, interrupted: bool) -> FitResult:
    """The result at the best point met, after a few Newton steps of a likelihood."""
    problem, parameters = descent.problem, descent.problem.parameters
    winner, own = int(np.argmin(state.best_scores)), state.past_vectors[0, 0]
    effort = problem.filter_runs
    vector, sure = _kept_where_idle(problem, state, winner), None
    if not interrupted:
        found = _polished(descent, optimum(problem, vector))
        vector = found.vector
        sure = assessed(problem, found, descent.resting(vector, found.gradient))
    # Of all trajectories, as at the start; an optimum's own figure leaves out those without usable derivatives.
    last = problem.evaluate(vector)
    value, n_excluded = float(last.values[0]), problem.n_excluded
    # The steps of minibatches saw parts of the trajectories only.
    start_value = state.past_values[0, 0] if descent.minibatch is None else problem.evaluate(own).values[0]
    traces = [_trace(parameters, state, k) for k in range(len(state.vectors))]
    if not np.array_equal(vector, state.best_vectors[winner]):
        traces[winner].append(Step(value, float(np.linalg.norm(last.gradients)), named(parameters, vector)))
    return FitResult(
        tracker=with_parameters(tracker, parameters, vector),
        parameters=parameters,
        values=named(parameters, vector),
        value=value,
        start_value=float(start_value),
        n_excluded=n_excluded,
        problem=problem,
        vector=vector,
        filter_runs=int(state.filter_runs) + problem.filter_runs - effort,
        uncertainty=sure,
        before=with_parameters(tracker, parameters, own),
        trace=traces[winner],
        starts=traces,
    )


def _kept_where_idle(problem: Problem, state: FitState, winner: int) -> np.ndarray:
    """The winner's best point, with the tracker's own numbers where these have no effect and it began with others.

    Other recordings, in which they have one, then find what the user gave.
    """
    vector, (own, began) = state.best_vectors[winner], state.past_vectors[0, [0, winner]]
    if np.array_equal(own, began):
        return vector
    found = problem.evaluate(vector)
    idle = without_effect(found.slopes) & (found.gradients[0] == 0) & (own != began)
    if not idle.any():
        return vector
    kept = np.where(idle, own, vector)
    return kept if problem.evaluate(kept).values[0] <= found.values[0] else vector


def named(parameters: Sequence[Parameter], vector: np.ndarray) -> dict[str, Any]:
    """The physical values by the parameters' labels."""
    values = physical(parameters, vector)
    return {p.label: np.asarray(v, float) for p, v in zip(parameters, values, strict=True)}


def _trace(parameters: Sequence[Parameter], state: FitState, start: int) -> list[Step]:
    """The steps of a start, as long as it moved."""
    vectors = state.past_vectors[:, start]
    moved = np.flatnonzero(np.any(np.diff(vectors, axis=0) != 0, axis=1))
    last = moved[-1] + 2 if len(moved) else 1
    values = jax.vmap(lambda v: physical(parameters, v))(vectors[:last])
    return [
        Step(
            float(state.past_values[k, start]),
            float(state.past_norms[k, start]),
            {p.label: np.asarray(v[k], float) for p, v in zip(parameters, values, strict=True)},
        )
        for k in range(last)
    ]


def _polished(descent: Descent, found: Optimum) -> Optimum:
    """A few Newton steps of a likelihood, as long as they help.

    Not where its values have noise, or other recordings decide.
    """
    problem = descent.problem
    if not np.isfinite(found.units) or descent.held_out is not None or problem.random:
        return found
    for _ in range(NEWTON_STEPS):
        _, inverse, _ = determined(found.hessian, ~descent.resting(found.vector, found.gradient))
        step = -inverse @ found.gradient
        # What the quadratic model has still to give is most often less than anyone would notice.
        if not -found.gradient @ step / 2 >= enough(found.value, found.units):
            break
        step = step / max(1.0, float(np.linalg.norm(step)))
        vector = np.clip(found.vector + step, descent.low, descent.high)
        if not np.diff(problem.evaluate(np.stack([found.vector, vector])).values)[0] < 0:
            break
        found = optimum(problem, vector)
    return found
