"""Multi-start optimisation: many starts side by side, each step accepted or shortened; a state that a file can hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from tuning.optimisers import AbstractOptimiser
from tuning.problem import Evaluation, Problem

MAX_HALVINGS = 7
"""Attempts at a step, each half as long as the one before; a start that none of them helps has converged."""

MIN_GAIN_NATS = 0.01
"""Least gain in likelihood per step for a start to continue: far below any relevant change of a parameter."""


class FitState(NamedTuple):
    """S starts of p parameters after `number` steps; arrays only, so that a file can hold it.

    `values` (S,), `gradients` (S, p), `sums` (S, k): the objective at `vectors` (S, p). `best_scores`, `best_vectors`:
    each start's best point by the held-out objective, or by the objective itself. `stale`: steps since then. `active`:
    starts that continue. `past_values`, `past_norms` (steps, S), `past_vectors` (steps, S, p): the optimiser trace.
    """

    number: np.ndarray
    vectors: np.ndarray
    values: np.ndarray
    gradients: np.ndarray
    sums: np.ndarray
    optimiser_state: Any
    best_scores: np.ndarray
    best_vectors: np.ndarray
    stale: np.ndarray
    active: np.ndarray
    past_values: np.ndarray
    past_norms: np.ndarray
    past_vectors: np.ndarray
    filter_runs: np.ndarray

    def select(self, which: np.ndarray) -> FitState:
        """The state of some of the starts."""
        past = {name: getattr(self, name)[:, which] for name in self._fields if name.startswith("past_")}
        others = {name: getattr(self, name) for name in self._fields if name not in {"number", "filter_runs", *past}}
        return self._replace(**past, **jax.tree_util.tree_map(lambda leaf: leaf[which], others))


@dataclass(frozen=True)
class MultiStart:
    """Advances all starts of a fit one step at a time.

    `low`, `high` (p,): bounds of the unconstrained vector. `held_out`: its objective scores the points; a start without
    a better score in `max_stale` steps ends. `minibatch`: chunks per step, drawn from `seed` and the step's number.
    """

    problem: Problem
    optimiser: AbstractOptimiser
    max_steps: int
    low: np.ndarray
    high: np.ndarray
    held_out: Problem | None = None
    max_stale: int = 8
    minibatch: int | None = None
    seed: int = 0

    def init(self, vectors: np.ndarray) -> FitState:
        """The state at the starts (S, p); starts with a non-finite objective are inactive."""
        vectors = np.clip(np.atleast_2d(vectors), self.low, self.high)
        evaluation = self._evaluate(vectors, 0)
        finite = evaluation.finite
        scores = np.where(finite, self._scores(vectors, evaluation.values), np.inf)
        state = FitState(
            number=np.array(0),
            vectors=vectors,
            values=evaluation.values,
            gradients=evaluation.gradients,
            sums=evaluation.sums,
            optimiser_state=self.optimiser.init(vectors),
            best_scores=scores,
            best_vectors=vectors,
            stale=np.zeros(len(vectors), int),
            active=finite,
            past_values=np.zeros((0, len(vectors))),
            past_norms=np.zeros((0, len(vectors))),
            past_vectors=np.zeros((0, *vectors.shape)),
            filter_runs=np.array(self._filter_runs()),
        )
        return _with_trace(state)

    def step(self, state: FitState) -> FitState:
        """The state after one more step; a start that has converged, or whose step fails at any length, ends there."""
        number = int(state.number) + 1
        runs = self._filter_runs()
        before = state.values, state.gradients, state.sums
        if self._noisy:
            # Another minibatch, or other random numbers: the objective at the present points has changed.
            before = self._evaluate(state.vectors, number)[:3]
        steps, optimiser_state = self.optimiser.propose(state.optimiser_state, state.vectors, before[1])
        vectors, after = state.vectors.copy(), tuple(x.copy() for x in before)
        pending = state.active.copy()
        for halving in range(MAX_HALVINGS):
            if not pending.any():
                break
            index = np.flatnonzero(pending)
            trial = np.clip(state.vectors + np.asarray(steps / 2.0**halving), self.low, self.high)[index]
            evaluation = self._evaluate(trial, number)
            accepted = evaluation.finite
            if self.optimiser.monotone:
                accepted &= evaluation.values <= before[0][index]
            moved = index[accepted]
            vectors[moved] = trial[accepted]
            for old, new in zip(after, evaluation[:3], strict=True):
                old[moved] = new[accepted]
            pending[moved] = False
        moved = state.active & ~pending
        values, gradients, sums = after
        scores = np.where(moved, self._scores(vectors, values), np.inf)
        better = scores < state.best_scores
        stale = np.where(better, 0, state.stale + moved)
        converged = self.optimiser.monotone & (before[0] - values < self._min_gains(values, sums))
        improving = stale < self.max_stale if self.held_out is not None else True
        return _with_trace(
            state._replace(
                number=np.array(number),
                vectors=vectors,
                values=values,
                gradients=gradients,
                sums=sums,
                optimiser_state=optimiser_state,
                best_scores=np.where(better, scores, state.best_scores),
                best_vectors=np.where(better[:, None], vectors, state.best_vectors),
                stale=stale,
                active=moved & ~converged & improving,
                filter_runs=state.filter_runs + self._filter_runs() - runs,
            )
        )

    def done(self, state: FitState) -> bool:
        """Whether no start continues."""
        return bool(state.number >= self.max_steps or not state.active.any())

    def at_bound(self, vector: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Whether each number (p,) is at a bound, with the objective falling beyond it."""
        return ((vector <= self.low) & (gradient > 0)) | ((vector >= self.high) & (gradient < 0))

    def _evaluate(self, vectors: np.ndarray, number: int) -> Evaluation:
        subset = None
        if self.minibatch is not None:
            draw = np.random.default_rng((self.seed, number))
            subset = sorted(draw.permutation(len(self.problem.chunks))[: self.minibatch].tolist())
        return self.problem.evaluate(vectors, subset=subset, realisation=number)

    def _scores(self, vectors: np.ndarray, values: np.ndarray) -> np.ndarray:
        """The scores (S,) that select the best point: held-out, of all trajectories, or the values themselves."""
        if self.held_out is not None:
            return self.held_out.values(vectors)
        return self.problem.values(vectors) if self._noisy else values

    def _min_gains(self, values: np.ndarray, sums: np.ndarray) -> np.ndarray:
        """The least gain (S,) that is worth another step."""
        nats = [self.problem.objective.nats_per_unit(s) for s in sums]
        return np.array([min_gain(v, n) for v, n in zip(values, nats, strict=True)])

    @property
    def _noisy(self) -> bool:
        """Whether the objective changes from step to step."""
        return self.minibatch is not None or self.problem.stochastic

    def _filter_runs(self) -> int:
        return self.problem.filter_runs + (0 if self.held_out is None else self.held_out.filter_runs)


def min_gain(value: float, nats_per_unit: float) -> float:
    """The least gain worth a step: 0.01 nats of a likelihood, else 1e-5 of the value.

    At least the resolution of single precision.
    """
    return max(MIN_GAIN_NATS / nats_per_unit, 1e-7 * abs(value)) if np.isfinite(nats_per_unit) else 1e-5 * abs(value)


def to_arrays(state: FitState) -> list[np.ndarray]:
    """The arrays of a state, for a file."""
    return [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(state)]


def from_arrays(optimiser: AbstractOptimiser, arrays: Sequence[np.ndarray]) -> FitState:
    """The state of a fit with this optimiser from the arrays of `to_arrays`; raises ValueError where they don't fit."""
    number, vectors = arrays[:2]
    template = FitState(*[number] * len(FitState._fields))._replace(optimiser_state=optimiser.init(vectors))
    leaves, structure = jax.tree_util.tree_flatten(template)
    if len(leaves) != len(arrays):
        raise ValueError(f"the state of a fit with this optimiser has {len(leaves)} arrays, found {len(arrays)}")
    return FitState(*jax.tree_util.tree_unflatten(structure, list(arrays)))


def _with_trace(state: FitState) -> FitState:
    """The state with its present point appended to the trace."""
    norms = np.linalg.norm(state.gradients, axis=1)
    return state._replace(
        past_values=np.concatenate([state.past_values, state.values[None]]),
        past_norms=np.concatenate([state.past_norms, norms[None]]),
        past_vectors=np.concatenate([state.past_vectors, state.vectors[None]]),
    )
