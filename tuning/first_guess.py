"""Noise levels to start a fit from, found in the recordings themselves, so that a user need not know any.

What makes a filter wrong by orders of magnitude is the ratio of its motion's noise to its sensors', and their common
scale. So the likelihood of some pieces of the recordings is computed over a coarse grid of both; then every level is
moved alone. Where the sensor reads places, differences of readings give both in closed form first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar
from trackers.core.estimates import Status
from trackers.core.recording import Batch
from trackers.core.scan import Output
from trackers.core.tracker import AbstractTracker
from trackers.core.tunable import Covariance, Scale, matching, replaced, tunables
from tuning.differences import levels_of_places
from tuning.objectives import AbstractObjective, NegativeLogLikelihood, Truth
from tuning.parameters import Parameter, flatten, with_parameters
from tuning.problem import Problem

ROWS, PIECES, PARTICLE_PIECES = 400, 16, 4
"""Of the pieces that are looked at: long enough for a track to settle, few enough for seconds of work.

A filter whose belief has an axis of particles or cells does hundreds of times the work of another.
"""

DECADE = float(np.log(10.0))
GRIDS = np.linspace(-2.0, 2.0, 5) * DECADE, np.linspace(-0.6, 0.6, 5) * DECADE
"""Of both groups' factors: from a hundredth to a hundredfold by tens, then between these, a factor of 2 apart."""

ALONE = np.array([-1.0, -0.5, -0.25, 0.25, 0.5, 1.0]) * DECADE
"""Of each level alone."""

ROUNDS = 2
WORTH = 2.0
"""Nats that a move has to gain: less tells nothing."""

TOLERANCE = 100.0
"""Times the usual NIS with which a track is followed all the same."""

LOSS = 10.0
"""Nats per number read that it costs to have lost all rows: a lost track escapes the readings it cannot explain."""


class Steady(AbstractObjective):
    """The negative log-likelihood per number read, and `LOSS` times the share of rows on which a track was lost."""

    @property
    def size(self) -> int:
        return 4

    @property
    def needs_truth(self) -> bool:
        return False

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        lost = (output.status == Status.LOST) | (output.status == Status.RESTARTED)
        lost = lost | (output.status == Status.NON_FINITE)
        row = output.status != Status.PADDING
        one = jnp.ones_like(output.nis_dof)
        likelihood = NegativeLogLikelihood().terms(output, truth)
        return *likelihood, jnp.where(lost, one, 0.0), jnp.where(row, one, 0.0)

    def value(self, sums: Any) -> Scalar:
        return sums[0] / sums[1] + LOSS * sums[2] / sums[3]


def first_guess(
    tracker: AbstractTracker, batches: Batch | Sequence[Batch], frozen: Sequence[str] = ()
) -> AbstractTracker:
    """The tracker with noise levels of the right order for the batches; a level that changes nothing stays as it is.

    Noise levels are the tunables called `sigma_…` or `covariance` of motions, sensors and filters; those that match a
    `frozen` pattern stay. A tracker without any, or whose readings say nothing of them, comes back as it is.
    """
    batches = [batches] if isinstance(batches, Batch) else list(batches)
    parameters = noise_levels(tracker, frozen)
    has_particles = bool(getattr(getattr(tracker, "filter", None), "has_particle_axis", False))
    some = looked_at(batches, PARTICLE_PIECES if has_particles else PIECES)
    read = sum(int(np.sum(reading.seen)) for reading in some.readings.values())
    if not parameters or not read:
        return tracker
    problem = Problem(_tolerant(tracker), [some], Steady(), parameters)
    search = _Search(problem, flatten(parameters), WORTH / read)
    search.consider(_closed_forms(parameters, some))
    groups = [group for group in _groups(parameters) if group.any()]
    for axis in GRIDS:
        grid = np.stack(np.meshgrid(*[axis] * len(groups), indexing="ij"), axis=-1).reshape(-1, len(groups))
        search.consider(search.moved(grid @ np.array(groups)))
    search.restore(flatten(parameters))
    for _ in range(ROUNDS):
        search.each_alone()
    return with_parameters(tracker, parameters, search.vector) if np.isfinite(search.value) else tracker


def _groups(parameters: Sequence[Parameter]) -> tuple[np.ndarray, np.ndarray]:
    """Which levels (levels,) are noise of the motion, and which of what is read; how biases wander is neither."""
    wander = [any(word in p.names[0].split(".")[-1] for word in ("bias", "walk")) for p in parameters]
    motion = np.array(["motion" in p.names[0].split(".") for p in parameters])
    return (motion & ~np.array(wander)).astype(float), (~motion).astype(float)


def noise_levels(tracker: AbstractTracker, frozen: Sequence[str] = ()) -> list[Parameter]:
    """The noise levels that are looked for, one parameter each; arrays of levels move as one."""
    kept = set(matching(tracker, frozen)) if frozen else set()
    found = []
    for name, node in tunables(tracker).items():
        *path, last = name.split(".")
        level = isinstance(node, (Scale, Covariance)) and (last.startswith("sigma") or last == "covariance")
        if level and name not in kept and {"motion", "sensors", "filter"} & set(path):
            found.append(Parameter((name,), node, name))
    return found


def looked_at(batches: Sequence[Batch], pieces: int) -> Batch:
    """At most so many pieces of at most `ROWS` rows, evenly over all rows of all recordings."""
    rows = min(ROWS, max(len(batch.dt) for batch in batches))
    whole = [
        (b, trajectory, start)
        for b, batch in enumerate(batches)
        for trajectory, length in enumerate(np.asarray(batch.valid).sum(axis=0))
        for start in range(0, int(length), rows)
        if start == 0 or length - start >= rows // 2
    ]
    picked = [whole[k] for k in np.unique(np.linspace(0, len(whole) - 1, min(pieces, len(whole))).astype(int))]

    def cut(b: int, trajectory: int, start: int) -> Batch:
        def part(x: Any) -> np.ndarray:
            piece = np.asarray(x)[start : start + rows, ..., trajectory]
            return np.pad(piece, [(0, rows - len(piece))] + [(0, 0)] * (piece.ndim - 1))

        key = np.asarray(batches[b].key)[:, trajectory]
        return jax.tree_util.tree_map(part, batches[b]._replace(key=None))._replace(key=key)

    return jax.tree_util.tree_map(lambda *x: np.stack(x, axis=-1), *(cut(*place) for place in picked))


def _tolerant(tracker: AbstractTracker) -> AbstractTracker:
    """The tracker that gives up a track only when it is hopeless.

    With noise levels far off, one that gives up by its usual limit would look for a new start on every other row.
    """
    limits = {name: node for name, node in tunables(tracker).items() if name.split(".")[-2:] == ["loss", "limit"]}
    return replaced(tracker, {k: node.with_value(TOLERANCE * np.asarray(node.value)) for k, node in limits.items()})


class _Search:
    """The best vector so far, its value, and what a better one has to gain."""

    def __init__(self, problem: Problem, vector: np.ndarray, worth: float):
        self.problem, self.vector, self.worth = problem, vector, worth
        self.value = float(self.values(vector[None])[0])

    def values(self, vectors: np.ndarray) -> np.ndarray:
        """The objective (S,) at vectors (S, p), infinite where it isn't finite."""
        found = self.problem.values(vectors)
        return np.where(np.isfinite(found), found, np.inf)

    def consider(self, vectors: np.ndarray) -> None:
        """Take the best of the vectors (S, p), where it is worth it."""
        if len(vectors):
            found = self.values(vectors)
            best = int(np.argmin(found))
            if found[best] < self.value - self.worth:
                self.value, self.vector = float(found[best]), vectors[best]

    def restore(self, start: np.ndarray) -> None:
        """Give back to each level its value at the start, where that costs nothing."""
        own = self.moved(np.eye(len(self.problem.parameters))) != self.vector
        found = self.values(np.where(own, start, self.vector))
        back = own[found < self.value + self.worth].any(axis=0)
        vector = np.where(back, start, self.vector)
        value = float(self.values(vector[None])[0])
        if value < self.value + len(own) * self.worth:
            self.value, self.vector = value, vector

    def each_alone(self) -> None:
        """Change each level by what is best for it alone, then all together, or only the best of them."""
        every = np.eye(len(self.problem.parameters))
        found = self.values(self.moved(np.kron(every, ALONE[:, None]))).reshape(len(every), len(ALONE))
        least = found.min(axis=1)
        steps = np.where(least < self.value - self.worth, ALONE[np.argmin(found, axis=1)], 0.0)
        if steps.any():
            best = every[int(np.argmin(least))]
            self.consider(self.moved(np.stack([steps, 0.5 * steps, steps * best])))

    def moved(self, logs: np.ndarray) -> np.ndarray:
        """The best vector so far with each level times exp(logs), (S, levels)."""
        parts, start = [], 0
        for k, parameter in enumerate(self.problem.parameters):
            raw = np.asarray(parameter.example.raw, float)
            here = self.vector[start : start + raw.size].reshape(raw.shape)
            start += raw.size
            by = logs[:, k].reshape(-1, *[1] * raw.ndim)
            new = here + by
            if isinstance(parameter.example, Covariance):
                # Its unconstrained form is a Cholesky factor, with logarithms on the diagonal alone.
                new = np.where(np.eye(len(raw)) > 0, new, here * np.exp(by))
            parts.append(new.reshape(len(logs), -1))
        return np.concatenate(parts, axis=1)


def _closed_forms(parameters: Sequence[Parameter], some: Batch) -> np.ndarray:
    """A vector (1, p) with levels from differences of places read, where a sensor reads places; else none (0, p)."""
    found, vector = levels_of_places(some), flatten(parameters)
    if found is None:
        return np.zeros((0, len(vector)))
    parts = []
    for parameter in parameters:
        kind: Any = parameter.example
        level = found.level(parameter.names[0], kind.unit)
        if level is not None and isinstance(kind, Covariance):
            value = np.asarray(kind.value, float)
            kind = kind.with_value(value * (level**2 / np.mean(np.diagonal(value)[:2])))
        elif level is not None:
            kind = kind.with_value(np.full(np.shape(kind.raw), level))
        parts.append(np.ravel(np.asarray(kind.raw, float)))
    return np.concatenate(parts)[None]
