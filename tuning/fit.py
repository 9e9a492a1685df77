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
from tuning.curvature import STEP, hessian, newton_step, standard_errors
from tuning.descent import Descent, FitState, enough
from tuning.objectives import AbstractObjective
from tuning.optimisers import LBFGS, AbstractOptimiser, Adam
from tuning.parameters import Parameter, chosen, flatten, limits, physical, placed_in
from tuning.problem import Problem
from tuning.starts import coarse_grid

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

    `value`, `start_value`: the objective. `trace`: the steps of the start that won; `starts`: those of all.
    `left_out`: trajectories without usable derivatives. `problem` and `vector`: the objective as a function, and
    where it is least. `interrupted`: the fit was stopped, and has no standard errors.
    """

    tracker: AbstractTracker
    parameters: list[Parameter]
    values: dict[str, Any]
    standard_errors: dict[str, Any]
    value: float
    start_value: float
    left_out: int
    problem: Problem
    vector: np.ndarray
    filter_runs: int
    interrupted: bool = False
    trace: list[Step] = field(default_factory=list)
    starts: list[list[Step]] = field(default_factory=list)


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
    seed: int = 0,
    chunk: int = CHUNK,
    resume: FitState | None = None,
    report: Callable[[FitState], None] = lambda state: None,
) -> FitResult:
    """The tracker with the tunables that `tune` names (shell patterns) fitted for the least objective.

    `frozen`: patterns of tunables that stay as they are. `bounds`: lowest and highest physical value by pattern.
    `optimiser`: default `LBFGS`, or `Adam` for particles and minibatches. `starts`:
    how many of a coarse grid's best points are followed, side by side, the tracker's own among them. `held_out`:
    recordings that decide which point is the best, and when to stop. `minibatch`: trajectories per step. `report` gets
    the state after every step, `resume` takes one up again with the same result to the bit.

    A step after which the objective isn't finite, or that doesn't help, is taken back and shortened; for a likelihood a
    few Newton steps follow. The best point met is returned, never a worse one than the start; an interrupt (Ctrl-C)
    ends the fit there. Standard errors come from the curvature where the objective is a likelihood, else they are NaN;
    they hold for readings with independent noise. Raises ValueError for patterns that name nothing or nothing that can
    be tied and for bounds without room, FloatingPointError where the objective is not finite at the start.
    """
    parameters = chosen(tracker, tune, frozen)
    problem = Problem(
        tracker, _several(batches), objective, parameters, chunk if minibatch is None else min(chunk, minibatch)
    )
    judge = Problem(tracker, _several(held_out), objective, parameters, chunk) if held_out else None
    low, high = limits(parameters, bounds or {})
    optimiser = optimiser or usual(problem, minibatch, steps)
    parts = None if minibatch is None else max(1, minibatch // problem.chunks[0].size)
    descent = Descent(problem, optimiser, steps, low, high, judge, minibatch=parts, seed=seed)
    state = resume if resume is not None else begun(descent, parameters, starts)
    interrupted = False
    try:
        report(state)
        while not descent.over(state):
            state = descent.advance(state)
            report(state)
    except KeyboardInterrupt:
        interrupted = True
    return _finished(tracker, descent, state, interrupted)


def _several(batches: Batch | Sequence[Batch]) -> list[Batch]:
    return [batches] if isinstance(batches, Batch) else list(batches)


def usual(problem: Problem, minibatch: int | None, steps: int) -> AbstractOptimiser:
    """The optimiser that suits the problem."""
    if minibatch is not None or problem.random:
        return Adam(steps)
    return LBFGS()


def begun(descent: Descent, parameters: Sequence[Parameter], starts: int) -> FitState:
    """The state at the tracker's own values and at the best of a coarse grid, `starts` together."""
    vector = flatten(parameters)
    state = descent.begin(vector if starts == 1 else coarse_grid(parameters, vector))
    if not np.isfinite(state.found.values[0]):
        raise FloatingPointError(
            f"the objective is not finite at the start ({state.found.values[0]}): no row is scored, or truth is missing"
        )
    others = 1 + np.argsort(state.best_scores[1:], kind="stable")
    return state.of(np.concatenate([[0], others])[:starts])


def _finished(tracker: AbstractTracker, descent: Descent, state: FitState, interrupted: bool) -> FitResult:
    """The result at the best point met, after a few Newton steps of a likelihood."""
    problem, parameters = descent.problem, descent.problem.parameters
    winner = int(np.argmin(state.best_scores))
    vector = state.best_vectors[winner]
    best = problem.evaluate(vector)
    value, units = float(best.values[0]), problem.objective.log_likelihood_units(best.sums[0])
    errors = [np.full(np.shape(p.example.raw), np.nan) for p in parameters]
    if np.isfinite(units) and not interrupted and not problem.random:
        value, vector, curvature = _polished(descent, value, vector)
        errors = standard_errors(parameters, vector, units * curvature)
    traces = [_trace(parameters, state, k) for k in range(len(state.vectors))]
    return FitResult(
        placed_in(tracker, parameters, vector),
        parameters,
        named(parameters, vector),
        dict(zip((p.label for p in parameters), errors, strict=True)),
        value,
        float(state.past_values[0, 0]),
        problem.left_out,
        problem,
        vector,
        int(state.filter_runs),
        interrupted,
        traces[winner],
        traces,
    )


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


def _polished(descent: Descent, value: float, vector: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """A few Newton steps, as long as they help, and the second derivatives at the end."""
    problem = descent.problem
    here = problem.evaluate(vector)
    for _ in range(NEWTON_STEPS):
        curvature = hessian(lambda v: problem.evaluate(v).gradients, vector)
        if descent.held_out is not None or not np.all(np.isfinite(curvature)):
            break
        step = newton_step(curvature, here.gradients[0])
        new = np.clip(vector + step, descent.low, descent.high)
        there = problem.evaluate(new)
        if not there.values[0] < value:
            break
        gain = value - float(there.values[0])
        value, vector, here = float(there.values[0]), new, there
        if np.linalg.norm(step) < STEP or gain < enough(problem.objective, value, there.sums[0]):
            break
    problem.evaluate(vector)
    return value, vector, curvature
