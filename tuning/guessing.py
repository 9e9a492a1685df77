"""First guess of the noise levels from the recordings, as a start of a fit.

The ratio of the motion's noise to the sensors', and their common scale, decide whether a filter works at all. So the
likelihood of some segments of the recordings is evaluated over a coarse grid of both; then every level is changed
alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.model.tunable import Covariance, matching, role_of, tunables
from trackwright.trackers.core.run.chunks import CHUNK
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.track_loss import AbstractTrackLoss
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.tuning.batches import lengths_of
from trackwright.tuning.objectives import AbstractObjective, NegativeLogLikelihood, Truth
from trackwright.tuning.parameters import Parameter, flatten, split, with_parameters
from trackwright.tuning.problem import Problem, has_particles

ROWS, SEGMENTS, SEGMENTS_OF_PARTICLES = 400, 8, 4
"""Rows per segment and segments: long enough for a track to converge, few enough for seconds of work.

A filter with particles or grid cells costs hundreds of times as much as another.
"""

LARGE = 16
"""Components of the process noise from which on segments run one by one: side by side they gain nothing, and compile
twice as long.
"""

DECADE = float(np.log(10.0))
GRIDS = np.linspace(-2.0, 2.0, 5) * DECADE, np.linspace(-0.6, 0.6, 5) * DECADE
"""Logarithms of both groups' factors: first powers of ten up to 100, then a factor of 2 apart in between."""

SINGLE_STEPS = np.array([-1.0, -0.5, -0.25, 0.25, 0.5, 1.0]) * DECADE
"""Logarithms of the factors tried for each level alone."""

ROUNDS = 2
MIN_GAIN_NATS = 2.0
"""Least gain in likelihood of a change."""

TOLERANCE = 100.0
"""Factor on the NIS limit of track loss during the search."""

LOST_PENALTY = 10.0
"""Penalty for a lost track, nats per measurement; otherwise losing the track would increase the likelihood."""


class LikelihoodWithLossPenalty(AbstractObjective):
    """The negative log-likelihood per measured number plus `LOST_PENALTY` times the share of lost rows."""

    size: ClassVar[int] = 4
    needs_truth: ClassVar[bool] = False
    of_position: ClassVar[bool] = True

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        lost = (output.status == Status.LOST) | (output.status == Status.RESTARTED)
        lost = lost | (output.status == Status.NON_FINITE)
        row = output.status != Status.PADDING
        ones = jnp.ones_like(output.nis_dof)
        likelihood = NegativeLogLikelihood().terms(output, truth)
        return *likelihood, jnp.where(lost, ones, 0.0), jnp.where(row, ones, 0.0)

    def value(self, sums: Any) -> Scalar:
        return sums[0] / sums[1] + LOST_PENALTY * sums[2] / sums[3]


def first_guess(
    tracker: AbstractTracker, batches: Batch | Sequence[Batch], frozen: Sequence[str] = ()
) -> AbstractTracker:
    """The tracker with noise levels of the right order of magnitude for the batches.

    Noise levels are the tunables with a `role`. Unchanged: those that match a `frozen` pattern or have no effect, and a
    tracker without noise levels or measurements.
    """
    batches = [batches] if isinstance(batches, Batch) else list(batches)
    parameters = noise_levels(tracker, frozen)
    segments = sample_segments(batches, SEGMENTS_OF_PARTICLES if has_particles(tracker) else SEGMENTS)
    measured = sum(int(np.sum(reading.seen)) for reading in segments.readings.values())
    if not parameters or not measured:
        return tracker
    large = isinstance(tracker, Tracker) and tracker.motion.noise_dimension > LARGE
    chunk = 1 if large else CHUNK
    problem = Problem(tolerant(tracker), [segments], LikelihoodWithLossPenalty(), parameters, chunk)
    search = _Search(problem, flatten(parameters), MIN_GAIN_NATS / measured)
    groups = [group for group in _groups(parameters) if group.any()]
    # Levels of biases alone have no grid.
    for axis in GRIDS if groups else ():
        grid = np.stack(np.meshgrid(*[axis] * len(groups), indexing="ij"), axis=-1).reshape(-1, len(groups))
        search.consider(search.moved(grid @ np.array(groups)))
    search.restore(flatten(parameters))
    for _ in range(ROUNDS):
        search.step_each_level()
    return with_parameters(tracker, parameters, search.vector) if np.isfinite(search.value) else tracker


def _groups(parameters: Sequence[Parameter]) -> tuple[np.ndarray, np.ndarray]:
    """Masks (levels,) of the process noise and of the measurement noise; the noise of biases is in neither."""
    roles = [role_of(p.example) for p in parameters]
    process, measurement = ([float(role == r) for role in roles] for r in ("process noise", "measurement noise"))
    return np.array(process), np.array(measurement)


def noise_levels(tracker: AbstractTracker, frozen: Sequence[str] = ()) -> list[Parameter]:
    """The noise levels to guess, one parameter each; an array of levels is changed as a whole."""
    kept = set(matching(tracker, frozen)) if frozen else set()
    return [
        Parameter((name,), node, name)
        for name, node in tunables(tracker).items()
        if role_of(node) is not None and name not in kept
    ]


def sample_segments(batches: Sequence[Batch], count: int) -> Batch:
    """At most `count` segments of at most `ROWS` rows, evenly spread over all rows of all recordings."""
    rows = min(ROWS, max(len(batch.dt) for batch in batches))
    cuts = [
        (b, trajectory, start)
        for b, batch in enumerate(batches)
        for trajectory, length in enumerate(lengths_of(batch))
        for start in range(0, int(length), rows)
        if start == 0 or length - start >= rows // 2
    ]
    picked = [cuts[k] for k in np.unique(np.linspace(0, len(cuts) - 1, min(count, len(cuts))).astype(int))]

    def cut(b: int, trajectory: int, start: int) -> Batch:
        def part(x: Shaped[AnyArray, "T *shape 1"]) -> Shaped[np.ndarray, "rows *shape"]:
            rows_of_x = np.asarray(x)[start : start + rows, ..., 0]
            return np.pad(rows_of_x, [(0, rows - len(rows_of_x))] + [(0, 0)] * (rows_of_x.ndim - 1))

        whole = batches[b].columns(trajectory, trajectory + 1)
        return jax.tree_util.tree_map(part, whole._replace(key=whole.dt))._replace(key=np.asarray(whole.key)[:, 0])

    return jax.tree_util.tree_map(lambda *x: np.stack(x, axis=-1), *(cut(*segment) for segment in picked))


def tolerant(tracker: AbstractTracker) -> AbstractTracker:
    """The tracker with `TOLERANCE` times the limits of track loss."""

    def relaxed(node: Any) -> Any:
        return node.relaxed(TOLERANCE) if isinstance(node, AbstractTrackLoss) else node

    return jax.tree_util.tree_map(relaxed, tracker, is_leaf=lambda node: isinstance(node, AbstractTrackLoss))


class _Search:
    """The best vector so far, its value, and the least gain of a better one."""

    def __init__(self, problem: Problem, vector: np.ndarray, min_gain: float):
        self.problem, self.vector, self.min_gain = problem, vector, min_gain
        self.value = float(self.values(vector[None])[0])

    def values(self, vectors: np.ndarray) -> np.ndarray:
        """The objective (S,) at vectors (S, p), infinite where it is not finite."""
        values = self.problem.values(vectors)
        return np.where(np.isfinite(values), values, np.inf)

    def consider(self, vectors: np.ndarray) -> None:
        """Take the best of the vectors (S, p) if it gains enough."""
        values = self.values(vectors)
        best = int(np.argmin(values))
        if values[best] < self.value - self.min_gain:
            self.value, self.vector = float(values[best]), vectors[best]

    def restore(self, start: np.ndarray) -> None:
        """Reset each level to its start value where that costs nothing."""
        levels = self.moved(np.eye(len(self.problem.parameters))) != self.vector
        values = self.values(np.where(levels, start, self.vector))
        back = levels[values < self.value + self.min_gain].any(axis=0)
        vector = np.where(back, start, self.vector)
        value = float(self.values(vector[None])[0])
        if value < self.value + len(levels) * self.min_gain:
            self.value, self.vector = value, vector

    def step_each_level(self) -> None:
        """Find each level's best step alone, then take all of them, all halved, or only the best one."""
        levels = np.eye(len(self.problem.parameters))
        values = self.values(self.moved(np.kron(levels, SINGLE_STEPS[:, None]))).reshape(len(levels), len(SINGLE_STEPS))
        least = values.min(axis=1)
        steps = np.where(least < self.value - self.min_gain, SINGLE_STEPS[np.argmin(values, axis=1)], 0.0)
        if steps.any():
            best = levels[int(np.argmin(least))]
            self.consider(self.moved(np.stack([steps, 0.5 * steps, steps * best])))

    def moved(self, logs: np.ndarray) -> np.ndarray:
        """The best vector so far with each level times exp(logs), (S, levels)."""
        parts = []
        for (parameter, here), log in zip(split(self.problem.parameters, self.vector), logs.T, strict=True):
            by = log.reshape(-1, *[1] * here.ndim)
            new = here + by
            if isinstance(parameter.example, Covariance):
                # Its unconstrained form is a Cholesky factor, with logarithms on the diagonal alone.
                new = np.where(np.eye(len(here)) > 0, new, here * np.exp(by))
            parts.append(new.reshape(len(logs), -1))
        return np.concatenate(parts, axis=1)
