"""Grid search: an objective over a grid of values of one or two parameters, without derivatives.

The assembly-line thesis (2.7 and chapter 3) tunes this way: it varies the dynamic noise over 0 … 100 cm and takes the
value of least RMSE over all recordings, ten runs of the particle filter each. Here a compiled call has many values.

The surface near the optimum of a fit is such a grid, over the two best determined numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.tunable import Covariance
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import TIED, Parameter, component_kinds, physical, select_parameters
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import unidentifiable

POINTS_PER_REPORT = 32
"""Grid points between two progress reports."""


@dataclass(frozen=True)
class Sweep:
    """An objective over a grid: `values` (repeats, n) or (repeats, n, m) at the physical `grids`, one per parameter.

    NaN where a trajectory's objective is not finite. `filter_runs`: number of trajectories filtered.
    """

    parameters: list[Parameter]
    grids: list[Float[np.ndarray, " _"]]
    values: Float[np.ndarray, "repeats n *m"]
    filter_runs: int

    @property
    def mean(self) -> Float[np.ndarray, "n *m"]:
        """The mean over repeats, on the grid."""
        return self.values.mean(axis=0)

    @property
    def spread(self) -> Float[np.ndarray, "n *m"]:
        """The standard deviation over repeats, on the grid; zero for a single repeat."""
        return self.values.std(axis=0, ddof=1) if len(self.values) > 1 else np.zeros(self.values.shape[1:])

    @property
    def best_index(self) -> tuple[int, ...]:
        """The grid index of the least mean."""
        return tuple(int(k) for k in np.unravel_index(np.nanargmin(self.mean), self.mean.shape))

    @property
    def best(self) -> dict[str, float]:
        """The physical values of least mean, by the parameters' labels."""
        points = zip(self.parameters, self.grids, self.best_index, strict=True)
        return {p.label: float(grid[k]) for p, grid, k in points}

    def to_polars(self, objective: str = "objective") -> pl.DataFrame:
        """One row per grid point: swept values, mean objective, and of several runs its spread and each value."""
        mesh = np.meshgrid(*self.grids, indexing="ij")
        columns = {p.label: values for p, values in zip(self.parameters, mesh, strict=True)} | {objective: self.mean}
        if len(self.values) > 1:
            columns |= {"spread": self.spread} | {f"repeat_{k + 1}": values for k, values in enumerate(self.values)}
        return pl.DataFrame({name: values.ravel() for name, values in columns.items()}).fill_nan(None)

    def text(self, objective: str = "objective", unit: str = "") -> str:
        """The best point in lines."""
        at, repeats, lines = self.best_index, len(self.values), list[str]()
        for parameter, grid, k in zip(self.parameters, self.grids, at, strict=True):
            end = "; at the end of the grid: widen it" if len(grid) > 2 and k in (0, len(grid) - 1) else ""
            shown = "" if parameter.example.unit == "1" else f" {parameter.example.unit}"
            lines.append(f"best {parameter.label} = {grid[k]:.6g}{shown}{end}")
        spread = f" ± {self.spread[at]:.2g} over {repeats} repeats" if repeats > 1 else ""
        lines.append(f"{objective} = {self.mean[at]:.6g}{' ' if unit else ''}{unit}{spread}")
        if undefined := int(np.sum(~np.isfinite(self.mean))):
            lines.append(f"undefined: {undefined} of {self.mean.size} grid points, where a trajectory is not finite")
        return "\n".join(lines)


def swept_parameters(tracker: AbstractTracker, patterns: Sequence[str]) -> list[Parameter]:
    """One parameter per pattern, with all its matches tied; raises ValueError as `sweep` does."""
    if not 1 <= len(patterns) <= 2:
        raise ValueError(f"a sweep goes over one or two patterns, found {len(patterns)}")
    parameters = select_parameters(tracker, [p if p.startswith(TIED) else TIED + p for p in patterns], thresholds=True)
    if len(parameters) < len(patterns):
        raise ValueError(f"the patterns {' and '.join(patterns)} match the same tunables")
    return parameters


def grid_vectors(
    parameters: Sequence[Parameter], grids: Sequence[Float[np.ndarray, " _"]]
) -> Float[np.ndarray, "points p"]:
    """The unconstrained vectors (points, p) of all grid points, with the last parameter varying fastest.

    All numbers of a parameter get the same value. Raises ValueError for a value outside the parameter's constraint.
    """
    columns = []
    for parameter, mesh in zip(parameters, np.meshgrid(*grids, indexing="ij"), strict=True):
        try:
            nodes = [parameter.example.with_value(np.full(parameter.shape, value)) for value in mesh.ravel()]
        except ValueError as error:
            raise ValueError(f"{parameter.label}: {error}") from error
        columns.append([np.ravel(node.raw) for node in nodes])
    return np.concatenate([np.asarray(c, float) for c in columns], axis=1)


def sweep(
    tracker: AbstractTracker,
    batches: Batch | Sequence[Batch],
    objective: AbstractObjective,
    over: Mapping[str, np.ndarray],
    repeats: int = 1,
    report: Callable[[int], None] = lambda points: None,
    weights: Sequence[Float[np.ndarray, " B"]] | None = None,
) -> Sweep:
    """The objective on the grid spanned by `over`: one or two patterns of tunables with their values.

    All matches of a pattern are tied. A particle filter runs `repeats` times with other random numbers, any other
    tracker once. `report` gets the number of grid points done since the last call. `weights`: of the trajectories of
    each batch, default 1. Raises ValueError for a pattern without match or whose matches can't be tied, for values
    outside a constraint, and for more than two patterns.
    """
    parameters = swept_parameters(tracker, list(over))
    grids = [np.asarray(values, float) for values in over.values()]
    rows = [batches] if isinstance(batches, Batch) else batches
    problem = Problem(tracker, rows, objective, parameters, weights=weights)
    points = grid_vectors(parameters, grids)
    repeats = repeats if problem.stochastic else 1
    values = np.stack([comparable_values(problem, points, repeat, report) for repeat in range(repeats)])
    runs = len(points) * repeats * problem.n_trajectories
    return Sweep(parameters, grids, values.reshape(repeats, *map(len, grids)), runs)


def comparable_values(
    problem: Problem,
    points: Float[np.ndarray, "S p"],
    realisation: int = 0,
    report: Callable[[int], None] = lambda points: None,
) -> Float[np.ndarray, " S"]:
    """The objective (S,) at unconstrained vectors (S, p), without derivatives, for one realisation of random numbers.

    Trajectories that are finite at none of the vectors are excluded; the objective is NaN where another one is not
    finite, since values over different trajectories are not comparable.
    """
    parts = []
    for first in range(0, len(points), POINTS_PER_REPORT):
        parts.append(problem.terms(points[first : first + POINTS_PER_REPORT], realisation))
        report(len(parts[-1]))
    terms = np.concatenate(parts)
    finite = np.isfinite(terms).all(axis=1)
    return problem.values_of(terms[..., finite.any(axis=0)].sum(axis=-1))


POINTS, FEW = 9, 5
"""Values per axis of a surface, and where each vector is a run of its own; a curve over one number has twice as many.

Odd, so that the optimum is one of them.
"""

FINE = 61
"""Values per axis after interpolation."""

HALF_WIDTHS = (0.15, 2.0)
"""Least and largest half width, in unconstrained numbers: from 15 % to a factor of 7 of a noise level."""


@dataclass(frozen=True)
class Surface:
    """The objective near the optimum over one tuned number, `values` (n,), or two, `values` (n, m).

    `axes`: the numbers' indices in the unconstrained vector; `grids`: their physical values.
    """

    axes: tuple[int, ...]
    grids: tuple[Float[np.ndarray, " _"], ...]
    values: Float[np.ndarray, "n *m"]


def surface_of(result: FitResult) -> Surface | None:
    """The objective over one number, or over the two best determined; None where no value is finite.

    Covers the best start's trace and four standard errors, within `HALF_WIDTHS`; surfaces are interpolated cubically.
    """
    trace, known = _trace_vectors(result), result.uncertainty
    sigmas = np.full(trace.shape[1], np.inf)
    if known is not None:
        sigmas = np.where(known.undetermined | ~np.isfinite(known.sigmas), np.inf, known.sigmas)
    still = unidentifiable(result.evaluation.term_gradients)
    kinds = component_kinds(result.parameters)
    # Entries of a matrix's factor are no numbers of their own.
    free = [k for k, kind in enumerate(kinds) if not (issubclass(kind, Covariance) or still[k])]
    determined = [k for k in free if np.isfinite(sigmas[k])]
    moved = np.abs(trace[-1] - trace[0])
    order = sorted(determined, key=lambda k: sigmas[k]) or sorted(free, key=lambda k: -moved[k])
    axes = tuple(sorted(order[:2]))
    if not axes:
        return None
    count = FEW if result.problem.vectors_per_call == 1 else POINTS
    count = 2 * count - 1 if len(axes) == 1 else count
    wide = np.where(np.isfinite(sigmas), 4 * sigmas, 0.0)
    half_widths = np.clip(np.maximum(wide, 1.15 * np.abs(trace - result.vector).max(axis=0)), *HALF_WIDTHS)
    steps = [half_widths[k] * np.linspace(-1, 1, count) for k in axes]
    shifts = np.stack([m.ravel() for m in np.meshgrid(*steps, indexing="ij")], axis=1)
    vectors = np.repeat(result.vector[None], len(shifts), axis=0)
    vectors[:, list(axes)] += shifts
    values = comparable_values(result.problem, vectors).reshape([count] * len(axes))
    if not np.isfinite(values).any():
        return None
    if len(axes) == 2 and np.isfinite(values).all():
        values = _finer(values)
        steps = [np.linspace(s[0], s[-1], FINE) for s in steps]
    grids = tuple(_physical(result, k, s) for k, s in zip(axes, steps, strict=True))
    return Surface(axes, grids, values)


def _trace_vectors(result: FitResult) -> Float[np.ndarray, "i p"]:
    """The unconstrained vectors (i, p) of the best start's trace."""
    vectors = [
        np.concatenate([np.ravel(p.example.with_value(step.values[p.label]).raw) for p in result.parameters])
        for step in result.trace
    ]
    return np.stack(vectors)


def _physical(result: FitResult, k: int, steps: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The physical values of the number `k` at `steps` from the optimum."""
    vectors = np.repeat(result.vector[None], len(steps), axis=0)
    vectors[:, k] += steps
    flat = jax.vmap(lambda v: jnp.concatenate([jnp.ravel(x) for x in physical(result.parameters, v)]))(vectors)
    return np.asarray(flat, float)[:, k]


def _finer(values: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "fine fine"]:
    """The values (n, n) interpolated cubically to (FINE, FINE), with the same end points (Keys 1981)."""
    scale = (FINE - 1) / (len(values) - 1)
    shift = np.full(2, 0.5 - 0.5 * scale)
    fine = jax.image.scale_and_translate(
        jnp.asarray(values), (FINE, FINE), (0, 1), jnp.full(2, scale), jnp.asarray(shift), "cubic", antialias=False
    )
    return np.asarray(fine, float)
