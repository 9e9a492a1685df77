"""The papers' way to tune: an objective over a grid of values of one or two numbers, each tried as it is.

The assembly-line thesis (2.7 and chapter 3) varies the dynamic noise over 0 … 100 cm and takes the value of least
RMSE over all its recordings, ten runs of the particle filter each. Here many values run in one compiled call, forward
only: a sweep needs no derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.chunks import CHUNK, chunks, over_lanes, prepared
from trackers.core.particles import ParticleFilter
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker, Tracker, is_heavy
from tuning.fit import Point
from tuning.objectives import AbstractObjective
from tuning.parameters import TIED, Parameter, chosen, placed_in

AT_ONCE = 32
"""Values in one compiled call."""

LANES = 256
"""Trajectories times values that run side by side inside a call; of filters with an axis of their own one value."""


@dataclass(frozen=True)
class Sweep:
    """An objective over a grid: `values` (repeats, n) or (repeats, n, m) at `grids`, physical, one for each parameter.

    NaN where a trajectory gave no finite figure. `filter_runs`: trajectories filtered for it.
    """

    parameters: list[Parameter]
    grids: list[np.ndarray]
    values: np.ndarray
    filter_runs: int

    @property
    def mean(self) -> np.ndarray:
        """The mean over repeats, on the grid."""
        return self.values.mean(axis=0)

    @property
    def spread(self) -> np.ndarray:
        """The standard deviation over repeats, on the grid; zero where there is one."""
        return self.values.std(axis=0, ddof=1) if len(self.values) > 1 else np.zeros(self.values.shape[1:])

    @property
    def best_index(self) -> tuple[int, ...]:
        """Where on the grid the mean is least."""
        return tuple(int(k) for k in np.unravel_index(np.nanargmin(self.mean), self.mean.shape))

    @property
    def best(self) -> dict[str, float]:
        """The physical values of least mean, by the parameters' labels."""
        places = zip(self.parameters, self.grids, self.best_index, strict=True)
        return {p.label: float(grid[k]) for p, grid, k in places}


def is_random(tracker: AbstractTracker) -> bool:
    """Whether another random key gives another result, so that a sweep gains by repeats."""
    return isinstance(getattr(tracker, "filter", None), ParticleFilter)


def grid_vectors(parameters: Sequence[Parameter], grids: Sequence[np.ndarray]) -> np.ndarray:
    """The unconstrained vectors (points, p) of all points of the grid, the last parameter's values fastest.

    A parameter of several numbers takes a value in all of them. Raises ValueError for a value outside its constraint.
    """
    columns = []
    for parameter, mesh in zip(parameters, np.meshgrid(*grids, indexing="ij"), strict=True):
        shape = np.shape(parameter.example.raw)
        try:
            held = [parameter.example.holding(np.full(shape, value)) for value in mesh.ravel()]
        except ValueError as error:
            raise ValueError(f"{parameter.label}: {error}") from error
        columns.append([np.ravel(node.raw) for node in held])
    return np.concatenate([np.asarray(c, float) for c in columns], axis=1)


def sweep(
    tracker: AbstractTracker,
    batches: Batch | Sequence[Batch],
    objective: AbstractObjective,
    over: Mapping[str, np.ndarray],
    repeats: int = 1,
    chunk: int = CHUNK,
    report: Callable[[int], None] = lambda points: None,
) -> Sweep:
    """The objective at every point of the grid that `over` spans: one or two patterns of tunables, and their values.

    What a pattern names is kept equal. A tracker that draws random numbers runs `repeats` times with other keys, one
    that doesn't runs once. `report` counts points of the grid done, a repeat being a fresh set of them. Raises
    ValueError for a pattern that names nothing or what can't be kept equal, for values outside a constraint, and for
    other than one or two patterns.
    """
    if not 1 <= len(over) <= 2:
        raise ValueError(f"a sweep goes over one or two patterns, found {len(over)}")
    tied = [p if p.startswith(TIED) else TIED + p for p in over]
    parameters = chosen(tracker, tied)
    if len(parameters) < len(over):
        raise ValueError(f"the patterns {' and '.join(over)} name the same tunables")
    grids = [np.asarray(values, float) for values in over.values()]
    points = grid_vectors(parameters, grids)
    parts = [p for b in ([batches] if isinstance(batches, Batch) else batches) for p in chunks(b, chunk)]
    repeats = repeats if is_random(tracker) else 1
    values = np.stack(
        [forward_values(tracker, [_drawing(p, k) for p in parts], objective, parameters, points, report)
         for k in range(repeats)]
    )  # fmt: skip
    trajectories = sum(int(np.asarray(p.valid).any(axis=0).sum()) for p in parts)
    return Sweep(parameters, grids, values.reshape(repeats, *map(len, grids)), repeats * len(points) * trajectories)


def forward_values(
    tracker: AbstractTracker,
    parts: Sequence[Batch],
    objective: AbstractObjective,
    parameters: Sequence[Parameter],
    vectors: np.ndarray,
    report: Callable[[int], None] = lambda points: None,
) -> np.ndarray:
    """The objective (S,) at unconstrained vectors (S, p), without derivatives; `parts` as `chunks` makes them.

    A trajectory that is finite at none of the vectors is left out; one that is finite at some makes the others NaN,
    since figures over different trajectories can't be compared.
    """
    dtype = parts[0].dt.dtype
    model = prepared(tracker, dtype)
    found = []
    for first in range(0, len(vectors), AT_ONCE):
        some = vectors[first : first + AT_ONCE]
        filled = np.concatenate([some, np.repeat(some[-1:], min(AT_ONCE, len(vectors)) - len(some), axis=0)])
        point = Point(model, objective, list(parameters), jnp.asarray(filled, dtype))
        sums = [np.asarray(over_lanes(forward_sums, point, part), float) for part in parts]
        found.append(np.concatenate(sums, axis=-1)[: len(some)])
        report(len(some))
    every = np.concatenate(found)
    finite = np.isfinite(every).all(axis=1)
    total = every[..., finite.any(axis=0)].sum(axis=-1)
    with np.errstate(invalid="ignore"):
        return np.array([float(objective.value(jnp.asarray(row))) for row in total])


def forward_sums(point: Point, batch: Batch) -> jax.Array:
    """The sums per vector, term and trajectory (S, k, B) at a point of several vectors (S, p)."""

    def sums(vector: jax.Array) -> jax.Array:
        tracker = placed_in(point.tracker, point.parameters(), vector)
        return jnp.stack(tracker.accumulate(batch, point.objective.terms))

    # Under vmap a heavy filter would compute both sides of its conditions, at every row.
    heavy = isinstance(point.tracker, Tracker) and is_heavy(point.tracker)
    side_by_side = 1 if heavy else min(max(1, LANES // batch.size), len(point.vector))
    return jax.lax.map(sums, point.vector, batch_size=side_by_side)


def _drawing(part: Batch, repeat: int) -> Batch:
    """The trajectories with keys that no other repeat has; the first are their own."""
    return part._replace(key=part.key.at[0].add(np.uint32(repeat)))
