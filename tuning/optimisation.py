"""Starts of a fit, optimised side by side: each step accepted or shortened, then Newton steps; a state for a file.

An optimiser proposes the next steps of S starts, the first axis of all arrays; `MultiStart` accepts, shortens or
rejects them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.model.tunable import Covariance, Scale, role_of
from trackwright.tuning.parameters import Parameter, split
from trackwright.tuning.problem import Evaluation, Problem, weighted_sum
from trackwright.tuning.uncertainty import Optimum, determined, optimum

Vectors = Float[np.ndarray, "S p"]

MAX_STEP = 2.0  # longest step in unconstrained coordinates: a noise level changes by a factor of seven at most


class AbstractOptimiser(eqx.Module):
    """Proposes steps; `monotone`: whether a step that increases the objective is rejected."""

    monotone: eqx.AbstractClassVar[bool]

    @abstractmethod
    def init(self, vectors: Vectors) -> Any:
        """The optimiser's state for starts at vectors (S, p): a tree of arrays (S, …)."""

    @abstractmethod
    def propose(self, state: Any, vectors: Vectors, gradients: Vectors) -> tuple[Vectors, Any]:
        """The steps (S, p) from vectors (S, p) with gradients (S, p), and the optimiser's next state."""


class Adam(AbstractOptimiser):
    """Adam (Kingma and Ba 2015); its rate falls from `rate` to a hundredth of it over `steps` along a cosine.

    For noisy objectives, as of particle filters.
    """

    steps: int = 60
    rate: float = 0.15
    monotone: ClassVar[bool] = False

    @property
    def transformation(self) -> optax.GradientTransformation:
        # A filter about to lose a track has enormous derivatives; one such step must not dominate all others.
        rate = optax.cosine_decay_schedule(self.rate, self.steps, 0.01)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))

    def init(self, vectors: Vectors) -> Any:
        return _initial(self, jnp.asarray(vectors))

    def propose(self, state: Any, vectors: Vectors, gradients: Vectors) -> tuple[Vectors, Any]:
        return _updated(self, gradients, state, vectors)


class LBFGS(AbstractOptimiser):
    """Limited-memory BFGS (Liu and Nocedal 1989) of optax with backtracking by halves."""

    monotone: ClassVar[bool] = True

    @property
    def transformation(self) -> optax.GradientTransformation:
        return optax.scale_by_lbfgs()

    def init(self, vectors: Vectors) -> Any:
        return _initial(self, jnp.asarray(vectors))

    def propose(self, state: Any, vectors: Vectors, gradients: Vectors) -> tuple[Vectors, Any]:
        first = np.asarray(state.count) == 0
        steps, state = _updated(self, gradients, state, vectors)
        # Later steps take their scale from the first, which backtracking can only shorten. Length 1, a factor of e in
        # a noise level, is long enough.
        length = np.linalg.norm(gradients, axis=1, keepdims=True)
        steepest = -gradients / np.where(length > 0, length, 1.0)
        uphill = np.sum(steps * gradients, axis=1) <= 0
        steps = np.where((first | uphill)[:, None], steepest, -steps)
        return steps / np.maximum(1.0, np.linalg.norm(steps, axis=1, keepdims=True) / MAX_STEP), state


def _updated(optimiser: Adam | LBFGS, gradients: Vectors, state: Any, vectors: Vectors) -> tuple[Vectors, Any]:
    """The updates (S, p) of an optimiser's transformation and its next state, one start after another.

    Not under `vmap`: XLA (jaxlib 0.10, multi-output fusion) aborts on the scatters of L-BFGS there.
    """
    updates = []
    for k, (gradient, vector) in enumerate(zip(gradients, vectors, strict=True)):
        of_start = jax.tree_util.tree_map(lambda leaf: jnp.asarray(np.asarray(leaf)[k]), state)  # noqa: B023
        # Adam raises a float to the power of an integer count, which strict promotion would refuse.
        with jax.numpy_dtype_promotion("standard"):
            updates.append(_update(optimiser, jnp.asarray(gradient), of_start, jnp.asarray(vector)))
    steps, states = zip(*updates, strict=True)
    return np.stack(steps).astype(float), jax.tree_util.tree_map(lambda *x: np.stack(x), *states)


@eqx.filter_jit
def _initial(optimiser: Adam | LBFGS, vectors: jax.Array) -> Any:
    return jax.vmap(optimiser.transformation.init)(vectors)


@eqx.filter_jit
def _update(optimiser: Adam | LBFGS, gradient: jax.Array, state: Any, vector: jax.Array) -> tuple[jax.Array, Any]:
    # Built while this is traced: a transformation as the argument would be compiled anew for every new object.
    return optimiser.transformation.update(gradient, state, vector)  # type: ignore[return-value]


MAX_ATTEMPTS = 7  # attempts at a step, each shorter than the one before; a start that none of them helps has converged
SHORTEST, LONGEST = 0.1, 0.5  # length of an attempt relative to the one before
ANOTHER_ATTEMPT = 10.0  # expected gain of a second and later attempt, relative to the least gain of a step
SAME_START = 0.2  # unconstrained distance of two starts below which the worse one ends: 20 % of a noise level
PATIENCE = 15  # steps without the least gain after which a start of an optimiser that also takes steps up ends
MIN_GAIN_NATS = 0.01  # gain in likelihood, a step, below which a start ends: far below any relevant change


class FitState(NamedTuple):
    """S starts of p parameters after `number` steps; arrays only, so that a file can hold it.

    `values` (S,), `gradients` (S, p), `terms` (S, k, n), `used` (S, n): the objective at `vectors` (S, p), as in
    `Evaluation`. `best_scores`, `best_vectors`: each start's best point by the held-out objective, or by the objective
    over all finite trajectories. `stale`: steps since the last gain. `active`: starts that continue. `past_values`,
    `past_norms` (steps, S), `past_vectors` (steps, S, p): the optimiser trace.
    """

    number: Int[np.ndarray, ""]
    vectors: Float[np.ndarray, "S p"]
    values: Float[np.ndarray, " S"]
    gradients: Float[np.ndarray, "S p"]
    terms: Float[np.ndarray, "S k n"]
    used: Bool[np.ndarray, "S n"]
    optimiser_state: Any
    best_scores: Float[np.ndarray, " S"]
    best_vectors: Float[np.ndarray, "S p"]
    stale: Int[np.ndarray, " S"]
    active: Bool[np.ndarray, " S"]
    past_values: Float[np.ndarray, "steps S"]
    past_norms: Float[np.ndarray, "steps S"]
    past_vectors: Float[np.ndarray, "steps S p"]
    filter_runs: Int[np.ndarray, ""]


@dataclass(frozen=True)
class MultiStart:
    """Advances all starts of a fit one step at a time.

    `low`, `high` (p,): bounds of the unconstrained vector. `held_out`: its objective scores the points; a start without
    a better score in `max_stale` steps ends, as one does without `held_out` after `PATIENCE` where the objective stays
    the same from step to step.
    """

    problem: Problem
    optimiser: AbstractOptimiser
    max_steps: int
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    held_out: Problem | None = None
    max_stale: int = 8

    def init(self, vectors: Float[np.ndarray, "*S p"]) -> FitState:
        """The state at the starts (S, p); starts with a non-finite objective are inactive."""
        vectors = np.clip(np.atleast_2d(vectors), self.low, self.high)
        evaluation = self.problem.evaluate(vectors)
        finite = evaluation.finite
        scores = np.where(finite, self._scores(vectors, evaluation.terms), np.inf)
        state = FitState(
            number=np.array(0),
            vectors=vectors,
            **_here(evaluation),
            optimiser_state=self.optimiser.init(vectors),
            best_scores=scores,
            best_vectors=vectors,
            stale=np.zeros(len(vectors), int),
            active=finite,
            past_values=np.zeros((0, len(vectors))),
            past_norms=np.zeros((0, len(vectors))),
            past_vectors=np.zeros((0, *vectors.shape)),
            filter_runs=np.array(0),
        )
        return self._with_trace(state)

    def finished(self, state: FitState) -> FitState:
        """The state at which every start has ended."""
        while not self.done(state):
            state = self.step(state)
        return state

    def step(self, state: FitState) -> FitState:
        """The state after one more step; a start that has converged, or whose step fails at any length, ends there."""
        number = int(state.number) + 1
        if self.problem.stochastic:
            # With other random numbers the objective at the present points has changed.
            state = state._replace(**_here(self.problem.evaluate(state.vectors, realisation=number)))
        steps, optimiser_state = self.optimiser.propose(state.optimiser_state, state.vectors, state.gradients)
        vectors, gain = state.vectors.copy(), np.zeros(len(state.vectors))
        after = {name: x.copy() for name, x in _here(state).items()}
        pending, lengths = state.active.copy(), np.ones(len(state.vectors))
        least = self._min_gains(state.values, state.terms, state.used)
        for attempt in range(MAX_ATTEMPTS):
            trial = np.clip(state.vectors + lengths[:, None] * np.asarray(steps), self.low, self.high)
            slopes = np.sum((trial - state.vectors) * state.gradients, axis=1)
            # A gain is at most about the slope's; near the optimum a failed step is due to rounding.
            promised = -slopes >= least * (ANOTHER_ATTEMPT if attempt else 1.0)
            worth = pending & promised if self.optimiser.monotone else pending
            if not worth.any():
                break
            index = np.flatnonzero(worth)
            trial = trial[index]
            evaluated = self.problem.evaluate(trial, realisation=number)
            # Which trajectories count differs from point to point; values are compared over the same ones.
            common = state.used[index] & evaluated.used
            gains = self.problem.values_over(common, state.vectors[index], state.terms[index])
            gains -= self.problem.values_over(common, trial, evaluated.terms)
            accepted = evaluated.finite & np.isfinite(gains)
            if self.optimiser.monotone:
                accepted &= gains >= 0
            moved = index[accepted]
            vectors[moved], gain[moved] = trial[accepted], gains[accepted]
            for name, new in _here(evaluated).items():
                after[name][moved] = new[accepted]
            pending[moved] = False
            lengths[index] *= _shorter(slopes[index], gains)
        moved = state.active & ~pending
        values, gradients, terms, used = after.values()
        scores = np.where(moved, self._scores(vectors, terms), np.inf)
        better = scores < state.best_scores
        much = scores + (least if self.held_out is None else 0.0) < state.best_scores
        stale = np.where(much, 0, state.stale + moved)
        converged = self.optimiser.monotone & (gain < self._min_gains(values, terms, used))
        best_scores = np.where(better, scores, state.best_scores)
        best_vectors = np.where(better[:, None], vectors, state.best_vectors)
        patient = self.problem.stochastic or self.optimiser.monotone
        patience = self.max_stale if self.held_out is not None else np.inf if patient else PATIENCE
        ended = converged | (stale >= patience) | self._duplicates(vectors, gradients, best_vectors, best_scores)
        return self._with_trace(
            state._replace(
                number=np.array(number),
                vectors=vectors,
                **after,
                optimiser_state=optimiser_state,
                best_scores=best_scores,
                best_vectors=best_vectors,
                stale=stale,
                active=moved & ~ended,
            )
        )

    def done(self, state: FitState) -> bool:
        """Whether no start continues."""
        return bool(state.number >= self.max_steps or not state.active.any())

    def at_bound(self, vector: Float[np.ndarray, " p"], gradient: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
        """Whether each number (p,) is at a bound, with the objective falling beyond it."""
        return ((vector <= self.low) & (gradient > 0)) | ((vector >= self.high) & (gradient < 0))

    def _scores(self, vectors: Float[np.ndarray, "S p"], terms: Float[np.ndarray, "S k n"]) -> Float[np.ndarray, " S"]:
        """The scores (S,) that select the best point: `Problem.values` of the held-out or of all trajectories."""
        if self.held_out is not None:
            return self.held_out.values(vectors)
        return self.problem.values(vectors) if self.problem.stochastic else self.problem.finite_values(vectors, terms)

    @property
    def filter_runs(self) -> int:
        """The trajectories filtered so far, once per vector."""
        return self.problem.filter_runs + (0 if self.held_out is None else self.held_out.filter_runs)

    def _duplicates(
        self, vectors: Vectors, gradients: Vectors, best_vectors: Vectors, best_scores: Float[np.ndarray, " S"]
    ) -> Bool[np.ndarray, " S"]:
        """The starts (S,) that have come near the best point of a better one; numbers without effect are left out."""
        if self.problem.stochastic:
            return np.zeros(len(vectors), bool)
        scale = np.any(gradients != 0, axis=0)
        distances = np.linalg.norm((vectors[:, None] - best_vectors[None]) * scale, axis=2)
        order = np.argsort(np.argsort(best_scores, kind="stable"))
        duplicates: Bool[np.ndarray, " S"] = np.any((distances < SAME_START) & (order[None] < order[:, None]), axis=1)
        return duplicates

    def _min_gains(
        self, values: Float[np.ndarray, " S"], terms: Float[np.ndarray, "S k n"], used: Bool[np.ndarray, "S n"]
    ) -> Float[np.ndarray, " S"]:
        """The least gain (S,) that is worth another step."""
        nats = [self.problem.objective.nats_per_unit(s) for s in weighted_sum(terms, used)]
        return np.array([min_gain(v, n) for v, n in zip(values, nats, strict=True)])

    def _with_trace(self, state: FitState) -> FitState:
        """The state with its present point appended to the trace, by its value over all finite trajectories."""
        values = self.problem.finite_values(state.vectors, state.terms)
        norms = np.linalg.norm(state.gradients, axis=1)
        return state._replace(
            past_values=np.concatenate([state.past_values, values[None]]),
            past_norms=np.concatenate([state.past_norms, norms[None]]),
            past_vectors=np.concatenate([state.past_vectors, state.vectors[None]]),
            filter_runs=np.array(self.filter_runs),
        )


def _here(found: Evaluation | FitState) -> dict[str, np.ndarray]:
    """The fields of the objective at the vectors, which evaluations and states share."""
    return {name: getattr(found, name) for name in ("values", "gradients", "terms", "used")}


def _shorter(slopes: Float[np.ndarray, " S"], gains: Float[np.ndarray, " S"]) -> Float[np.ndarray, " S"]:
    """The factors on the lengths of failed steps: to the minimum of the parabola through slope and value."""
    excess = -slopes - gains
    with np.errstate(divide="ignore", invalid="ignore"):
        lowest = np.where(np.isfinite(excess) & (excess > 0), -slopes / (2.0 * excess), LONGEST)
    return np.clip(lowest, SHORTEST, LONGEST)


def min_gain(value: float, nats_per_unit: float) -> float:
    """The least gain worth a step: 0.01 nats of a likelihood, else 1e-5 of the value.

    At least the resolution of single precision.
    """
    return max(MIN_GAIN_NATS / nats_per_unit, 1e-7 * abs(value)) if np.isfinite(nats_per_unit) else 1e-5 * abs(value)


GRID_STEP = np.log(10.0)  # unconstrained distance of points of the coarse grid of starts: a factor of ten


def initial_state(driver: MultiStart, vector: Float[np.ndarray, " p"], starts: int) -> FitState:
    """The state at `starts` starts: the vector (p,), and the best of a coarse grid about it.

    Starts with the same value differ in numbers without effect: one of them is taken.
    """
    vectors = vector[None]
    if starts > 1:
        vectors = np.clip(coarse_grid(driver.problem.parameters, vector), driver.low, driver.high)
        scores = (driver.held_out or driver.problem).values(vectors)
        best = [k for k in np.argsort(scores[1:], kind="stable") + 1 if np.isfinite(scores[k])]
        chosen = {float(scores[k]): k for k in reversed([0, *best])}
        vectors = vectors[[0, *(k for k in best if chosen[float(scores[k])] == k)][:starts]]
    state = driver.init(vectors)
    if not state.active[0]:
        raise FloatingPointError(
            f"the objective is not finite at the start ({state.values[0]}): no row is scored, or truth is missing"
        )
    return state


def coarse_grid(parameters: Sequence[Parameter], vector: Float[np.ndarray, " p"]) -> Float[np.ndarray, "S p"]:
    """Starts (S, p): the vector itself first, then with process noise and all other scales a tenth or tenfold.

    Scales are noise levels, times and rates; offsets and fractions stay. Nine starts where both groups are tuned, three
    for one, one for none.
    """
    motion, others = np.zeros_like(vector), np.zeros_like(vector)
    for parameter, raised in split(parameters, np.arange(len(vector))):
        if isinstance(parameter.example, Covariance):
            raised = np.diagonal(raised)  # the logarithms of a Cholesky factor's diagonal
        if isinstance(parameter.example, Scale | Covariance):
            part = motion if role_of(parameter.example) in ("process noise", "bias noise") else others
            part[np.ravel(raised)] = 1.0
    first, second = ((0.0, -GRID_STEP, GRID_STEP) if part.any() else (0.0,) for part in (motion, others))
    return np.stack([vector + a * motion + b * others for a in first for b in second])


NEWTON_STEPS = 4


def newton(driver: MultiStart, vector: Float[np.ndarray, " p"]) -> Optimum:
    """The optimum at a vector (p,) or after a few Newton steps from there, while they help.

    For smooth likelihoods only, and not where held-out recordings select the point.
    """
    problem, best = driver.problem, optimum(driver.problem, vector)
    if not np.isfinite(best.nats_per_unit) or driver.held_out is not None or problem.stochastic:
        return best
    for _ in range(NEWTON_STEPS):
        _, inverse, _ = determined(best.hessian, ~driver.at_bound(best.vector, best.gradient))
        step = -inverse @ best.gradient
        # The gain that the quadratic model predicts.
        if not -best.gradient @ step / 2 >= min_gain(best.value, best.nats_per_unit / problem.discount):
            break
        step = step / max(1.0, float(np.linalg.norm(step)))
        vector = np.clip(best.vector + step, driver.low, driver.high)
        trial = problem.evaluate(vector)
        before = problem.finite_values(best.vector, best.evaluation.terms)
        if not (trial.finite[0] and problem.finite_values(vector, trial.terms)[0] < before[0]):
            break
        best = optimum(problem, vector)
    return best
