"""The steps of a fit: many starts side by side, each step judged; a state that a file can hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from tuning.optimisers import AbstractOptimiser
from tuning.problem import Evaluations, Problem

ATTEMPTS = 7
"""How often a step is shortened before a start counts as arrived."""

NATS = 0.01
"""What a likelihood has to gain by a step, for a start to go on: far less than any number's uncertainty is worth."""


class FitState(NamedTuple):
    """Where S starts of p numbers are after `number` steps; arrays only, so that it can be kept in a file.

    `found`: what the objective is at `vectors`; of it, the trajectories' parts are left out. `best…`: the best point of
    each start, by the score that counts: the held-out objective where there is one. `stale`: steps without a better
    score; `active`: starts that go on. `past_…`: values (steps, S), gradient norms and vectors of all steps.
    """

    number: np.ndarray
    vectors: np.ndarray
    found: Evaluations
    memory: Any
    best_scores: np.ndarray
    best_vectors: np.ndarray
    stale: np.ndarray
    active: np.ndarray
    past_values: np.ndarray
    past_norms: np.ndarray
    past_vectors: np.ndarray
    filter_runs: np.ndarray

    def of(self, which: np.ndarray) -> FitState:
        """The state of some of the starts."""

        def some(x: Any) -> Any:
            return jax.tree_util.tree_map(lambda leaf: leaf[which], x)

        past = {name: getattr(self, name)[:, which] for name in ("past_values", "past_norms", "past_vectors")}
        starts = ("vectors", "found", "memory", "best_scores", "best_vectors", "stale", "active")
        return self._replace(**{name: some(getattr(self, name)) for name in starts}, **past)


@dataclass(frozen=True)
class Descent:
    """What a fit's steps need beside its state.

    `low`, `high` (p,): bounds of the unconstrained vector. `held_out`: whose objective scores the points, and ends a
    start that does not improve it in `max_gap` steps. `minibatch`: chunks per step, drawn anew for each from `seed`.
    """

    problem: Problem
    optimiser: AbstractOptimiser
    steps: int
    low: np.ndarray
    high: np.ndarray
    held_out: Problem | None = None
    max_gap: int = 8
    minibatch: int | None = None
    seed: int = 0

    def begin(self, vectors: np.ndarray) -> FitState:
        """The state at the starts (S, p); starts whose objective is not finite do not go on."""
        vectors = np.clip(np.atleast_2d(vectors), self.low, self.high)
        found = self._evaluate(vectors, 0)
        finite = np.isfinite(found.values) & np.isfinite(found.gradients).all(axis=1)
        scores = np.where(finite, self._scores(vectors, found), np.inf)
        state = FitState(
            number=np.array(0),
            vectors=vectors,
            found=_light(found),
            memory=self.optimiser.begin(vectors),
            best_scores=scores,
            best_vectors=vectors,
            stale=np.zeros(len(vectors), int),
            active=finite,
            past_values=np.zeros((0, len(vectors))),
            past_norms=np.zeros((0, len(vectors))),
            past_vectors=np.zeros((0, *vectors.shape)),
            filter_runs=np.array(self._runs()),
        )
        return _noted(state)

    def advance(self, state: FitState) -> FitState:
        """The state one step on; a start that no shortened step helps, or that has come to rest, stays and ends."""
        number, before = int(state.number) + 1, state.found
        runs = self._runs()
        if self._noisy:
            # Another part of the data, or other random numbers: the points have to be looked at again first.
            before = self._evaluate(state.vectors, number)
        direction, memory = self.optimiser.direction(state.memory, state.vectors, before)
        vectors, found = state.vectors.copy(), Evaluations(*(x.copy() for x in _light(before)))
        waiting, attempts = state.active.copy(), np.zeros(len(vectors), int)
        for attempt in range(ATTEMPTS):
            if not waiting.any():
                break
            index = np.flatnonzero(waiting)
            tried = np.clip(state.vectors + self.optimiser.step(direction, attempt), self.low, self.high)[index]
            there = self._evaluate(tried, number)
            good = np.isfinite(there.values) & np.isfinite(there.gradients).all(axis=1)
            if self.optimiser.descends:
                good &= there.values <= before.values[index]
            moved = index[good]
            vectors[moved] = tried[good]
            for old, new in zip(found, _light(there), strict=True):
                old[moved] = new[good]
            waiting[moved] = False
            attempts[waiting] = attempt + 1
        moved = state.active & ~waiting
        scores = np.where(moved, self._scores(vectors, found), np.inf)
        better = scores < state.best_scores
        stale = np.where(better, 0, state.stale + moved)
        resting = self.optimiser.descends & (before.values - found.values < self._enough(found))
        patient = stale < self.max_gap if self.held_out is not None else True
        return _noted(
            state._replace(
                number=np.array(number),
                vectors=vectors,
                found=found,
                memory=self.optimiser.judged(memory, attempts),
                best_scores=np.where(better, scores, state.best_scores),
                best_vectors=np.where(better[:, None], vectors, state.best_vectors),
                stale=stale,
                active=moved & ~resting & patient,
                filter_runs=state.filter_runs + self._runs() - runs,
            )
        )

    def over(self, state: FitState) -> bool:
        """Whether nothing is left to do."""
        return bool(state.number >= self.steps or not state.active.any())

    def resting(self, vector: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Which numbers (p,) rest on a bound that the objective would have them cross."""
        return ((vector <= self.low) & (gradient > 0)) | ((vector >= self.high) & (gradient < 0))

    def _evaluate(self, vectors: np.ndarray, number: int) -> Evaluations:
        parts = None
        if self.minibatch is not None:
            draw = np.random.default_rng((self.seed, number))
            parts = sorted(draw.permutation(len(self.problem.chunks))[: self.minibatch].tolist())
        return self.problem.evaluate(vectors, parts=parts, curvature=self.optimiser.curved, turn=number)

    def _scores(self, vectors: np.ndarray, found: Evaluations) -> np.ndarray:
        """What decides which point is the best: the objective, of held-out recordings where there are some."""
        if self.held_out is not None:
            return self.held_out.values(vectors)
        return self.problem.values(vectors) if self._noisy else found.values

    def _enough(self, found: Evaluations) -> np.ndarray:
        """The least gain (S,) that is worth another step."""
        units = [self.problem.objective.log_likelihood_units(s) for s in found.sums]
        return np.array([enough(v, u) for v, u in zip(found.values, units, strict=True)])

    @property
    def _noisy(self) -> bool:
        """Whether the objective is another at every step."""
        return self.minibatch is not None or self.problem.random

    def _runs(self) -> int:
        return self.problem.filter_runs + (0 if self.held_out is None else self.held_out.filter_runs)


def enough(value: float, units: float) -> float:
    """The least gain worth a step: a hundredth of a nat, or a hundred-thousandth of a figure that is no likelihood.

    No less than what single precision can tell apart.
    """
    return max(NATS / units, 1e-7 * abs(value)) if np.isfinite(units) else 1e-5 * abs(value)


def stored(state: FitState) -> list[np.ndarray]:
    """The arrays of a state, for a file."""
    return [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(state)]


def restored(optimiser: AbstractOptimiser, arrays: Sequence[np.ndarray]) -> FitState:
    """The state of a fit with this optimiser that `stored` gave the arrays of; ValueError where they are not its."""
    number, vectors = arrays[:2]
    empty = FitState(
        number, vectors, Evaluations(*[number] * len(Evaluations._fields)), optimiser.begin(vectors), *[number] * 8
    )
    leaves, structure = jax.tree_util.tree_flatten(empty)
    if len(leaves) != len(arrays):
        raise ValueError(f"a fit's state has {len(leaves)} arrays here, found {len(arrays)}")
    return FitState(*jax.tree_util.tree_unflatten(structure, list(arrays)))


def _light(found: Evaluations) -> Evaluations:
    """Without the trajectories' parts."""
    return found._replace(terms=found.terms[..., :0], slopes=found.slopes[..., :0], used=found.used[..., :0])


def _noted(state: FitState) -> FitState:
    """With the present point at the end of its past."""
    norms = np.linalg.norm(state.found.gradients, axis=1)
    return state._replace(
        past_values=np.concatenate([state.past_values, state.found.values[None]]),
        past_norms=np.concatenate([state.past_norms, norms[None]]),
        past_vectors=np.concatenate([state.past_vectors, state.vectors[None]]),
    )
