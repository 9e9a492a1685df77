"""Fit the numbers of a tracker to recordings by gradient: forward mode, any number of recordings, optax."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from trackers.core.chunks import CHUNK, chunks, over_lanes, prepared
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from tuning.curvature import STEP, hessian, newton_step, standard_errors
from tuning.objectives import AbstractObjective
from tuning.parameters import Parameter, chosen, flatten, physical, placed_in

NEWTON_STEPS = 4


@dataclass(frozen=True)
class Step:
    """One step of a fit: the figure, the length of its gradient, and the physical values at which it was taken."""

    value: float
    gradient_norm: float
    values: dict[str, Any]


@dataclass(frozen=True)
class FitResult:
    """A tuned tracker and how it came about; `left_out`: trajectories without usable derivatives."""

    tracker: AbstractTracker
    parameters: list[Parameter]
    values: dict[str, Any]
    standard_errors: dict[str, Any]
    value: float
    start_value: float
    left_out: int
    trace: list[Step] = field(default_factory=list)


class Problem:
    """The objective of a tracker over batches as a function of an unconstrained vector, compiled once per shape."""

    def __init__(
        self,
        tracker: AbstractTracker,
        batches: Sequence[Batch],
        objective: AbstractObjective,
        parameters: list[Parameter],
        chunk: int,
    ):
        self.objective, self.parameters = objective, parameters
        self.dtype = batches[0].dt.dtype
        self.tracker = prepared(tracker, self.dtype)
        self.chunks = [part for batch in batches for part in chunks(batch, chunk)]
        self.valid = np.concatenate([np.asarray(part.valid).any(axis=0) for part in self.chunks])
        self.left_out = 0

    def value_and_gradient(self, vector: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """The figure, its gradient, and the sums that it is made of, without trajectories that aren't finite."""
        found = [over_lanes(term_sums, self.at(vector), part) for part in self.chunks]
        sums, slopes = (np.concatenate([np.asarray(x, float) for x in xs], axis=-1) for xs in zip(*found, strict=True))
        finite = np.isfinite(sums).all(axis=0)
        steady = _steady(slopes) & finite
        self.left_out = int(np.sum(~steady & self.valid))
        total = np.where(finite, sums, 0).sum(axis=-1)
        slope = np.where(steady, slopes, 0).sum(axis=-1)
        value, by_sum = jax.value_and_grad(self.objective.value)(jnp.asarray(total))
        with np.errstate(invalid="ignore"):  # where nothing is scored figure and gradient are NaN
            return float(value), np.asarray(by_sum, float) @ slope, total

    def at(self, vector: np.ndarray) -> Point:
        """What `term_sums` takes, at a vector."""
        return Point(self.tracker, self.objective, self.parameters, jnp.asarray(vector, self.dtype))


def _steady(slopes: np.ndarray) -> np.ndarray:
    """Which trajectories (B,) have derivatives (k, p, B) to go by: finite, and not thousands of times the usual.

    A filter that hesitates between two tracks depends on every number without measure; where all others have
    something to say, such a trajectory has not.
    """
    size = np.sqrt(np.sum(np.where(np.isfinite(slopes), slopes, np.inf) ** 2, axis=(0, 1)))
    moving = size[np.isfinite(size) & (size > 0)]
    return np.isfinite(size) & (size <= 1e3 * np.median(moving)) if len(moving) else np.isfinite(size)


class Point(eqx.Module):
    """A tracker, an objective and the values of its parameters: what the compiled function takes."""

    tracker: AbstractTracker
    objective: AbstractObjective
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    examples: tuple[Any, ...]
    vector: jax.Array

    def __init__(
        self, tracker: AbstractTracker, objective: AbstractObjective, parameters: list[Parameter], vector: jax.Array
    ):
        self.tracker, self.objective, self.vector = tracker, objective, vector
        self.names = tuple(p.names for p in parameters)
        self.labels = tuple(p.label for p in parameters)
        self.examples = tuple(p.example for p in parameters)

    def parameters(self) -> list[Parameter]:
        """The parameters, whose values the vector holds."""
        return [Parameter(*parts) for parts in zip(self.names, self.examples, self.labels, strict=True)]


def term_sums(point: Point, batch: Batch) -> tuple[jax.Array, jax.Array]:
    """The sums per term and trajectory (k, B), and their derivatives (k, p, B), all tangents at once, forward."""

    def sums(v: jax.Array) -> tuple[jax.Array, jax.Array]:
        tracker = placed_in(point.tracker, point.parameters(), v)
        stacked = jnp.stack(tracker.accumulate(batch, point.objective.terms))
        return stacked, stacked

    slopes, values = jax.jacfwd(sums, has_aux=True)(point.vector)
    return values, jnp.moveaxis(slopes, -1, 1)


def fit(
    tracker: AbstractTracker,
    batches: Batch | Sequence[Batch],
    objective: AbstractObjective,
    tune: str | Sequence[str],
    steps: int = 80,
    rate: float = 0.15,
    chunk: int = CHUNK,
    report: Callable[[int, Step], None] = lambda number, step: None,
) -> FitResult:
    """The tracker with the tunables that `tune` names (shell patterns) fitted for the least objective.

    Adam on the unconstrained vector, whose rate falls from `rate` to a hundredth of it over `steps`; a step after
    which the objective isn't finite is taken back and halved; for a likelihood a few Newton steps follow. The best
    point met is returned, never a worse one than the start. Standard errors come from the curvature where the
    objective is a likelihood, else they are NaN; they hold for readings with independent noise. Raises ValueError for
    patterns that name nothing or nothing that can be tied, FloatingPointError where the objective is not finite at the
    start.
    """
    batches = [batches] if isinstance(batches, Batch) else list(batches)
    parameters = chosen(tracker, tune)
    problem = Problem(tracker, batches, objective, parameters, chunk)
    vector = flatten(parameters)
    value, gradient, sums = problem.value_and_gradient(vector)
    if not (np.isfinite(value) and np.all(np.isfinite(gradient))):
        raise FloatingPointError(
            f"the objective is not finite at the start ({value}): no row is scored, or truth is missing"
        )
    # A filter on the brink of losing a track has enormous derivatives; one such step must not drown all others.
    schedule = optax.cosine_decay_schedule(rate, steps, 0.01)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
    state: Any = optimiser.init(jnp.asarray(vector))
    best, start_value = (value, vector, sums), value
    trace: list[Step] = []
    for number in range(steps + 1):
        trace.append(Step(value, float(np.linalg.norm(gradient)), _named(parameters, vector)))
        report(number, trace[-1])
        if number == steps:
            break
        # Adam raises a float to the power of an integer count, which strict promotion would refuse.
        with jax.numpy_dtype_promotion("standard"):
            update, state = optimiser.update(jnp.asarray(gradient), state)
        vector, value, gradient, sums = _advance(problem, vector, np.asarray(update, float), (value, gradient, sums))
        if value < best[0]:
            best = (value, vector, sums)
    value, vector, sums = best
    units = objective.log_likelihood_units(sums)
    errors = [np.full(np.shape(p.example.raw), np.nan) for p in parameters]
    if np.isfinite(units):
        value, vector, curvature = _polished(problem, value, vector)
        errors = standard_errors(parameters, vector, units * curvature)
    return FitResult(
        placed_in(tracker, parameters, vector),
        parameters,
        _named(parameters, vector),
        dict(zip((p.label for p in parameters), errors, strict=True)),
        value,
        start_value,
        problem.left_out,
        trace,
    )


def _advance(problem: Problem, vector: np.ndarray, update: np.ndarray, before: Any) -> tuple[Any, ...]:
    """The next point; halved up to six times while the objective isn't finite, else the point stays."""
    for _ in range(6):
        value, gradient, sums = problem.value_and_gradient(vector + update)
        if np.isfinite(value) and np.all(np.isfinite(gradient)):
            return vector + update, value, gradient, sums
        update = update / 2
    return vector, *before


def _named(parameters: Sequence[Parameter], vector: np.ndarray) -> dict[str, Any]:
    values = physical(parameters, vector)
    return {p.label: np.asarray(v, float) for p, v in zip(parameters, values, strict=True)}


def _polished(problem: Problem, value: float, vector: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """A few Newton steps, as long as they help, and the second derivatives at the end."""

    def slope(v: np.ndarray) -> np.ndarray:
        return problem.value_and_gradient(v)[1]

    for _ in range(NEWTON_STEPS):
        curvature = hessian(slope, vector)
        if not np.all(np.isfinite(curvature)):
            break
        step = newton_step(curvature, slope(vector))
        new = problem.value_and_gradient(vector + step)[0]
        if not new < value:
            break
        value, vector = new, vector + step
        if np.linalg.norm(step) < STEP:
            break
    problem.value_and_gradient(vector)
    return value, vector, curvature
