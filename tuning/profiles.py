"""Uncertainty without a quadratic model: profile likelihoods of single numbers, and fits to resampled recordings."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from trackers.core.metrics import chi_square_quantile
from tuning.parameters import Parameter, physical, physical_vector
from tuning.uncertainty import Optimum, determined

REACH = 3.5
"""Standard deviations to either side that a profile covers; a likelihood of normal shape has risen by 6 nats there."""

WIDEST = float(np.log(1e3))
"""Furthest that a profile goes to either side in unconstrained coordinates, and how far where nothing is determined."""

FEWEST = 5
"""Trajectories without which resampling says little."""

ROUNDS = 4
"""Steps of the other numbers at every point of a profile, from where the quadratic model has them."""


@dataclass(frozen=True)
class Profile:
    """The least objective for each of G values of one number.

    `raw`, `values` (G,): unconstrained and physical values. `rise` (G,): above the optimum, nats. `low`, `high`: the
    physical interval of the given level, where the rise stays below half the chi-square quantile of one degree of
    freedom (Wilks 1938); infinite (or the end of what is possible) where the profile doesn't rise so far.
    """

    raw: np.ndarray
    values: np.ndarray
    rise: np.ndarray
    low: float
    high: float


def profile(
    problem: Any,
    found: Optimum,
    component: int,
    level: float = 0.95,
    points: int = 15,
    held: np.ndarray | None = None,
) -> Profile:
    """The profile likelihood of the unconstrained number `component`, the others re-optimised, all points at once.

    `found`: the optimum, as `tuning.uncertainty` has it; `held` (p,): the others that stay, resting on their bounds.
    Raises ValueError for an objective that is no likelihood.
    """
    if not np.isfinite(found.units):
        raise ValueError("a profile is of a likelihood; for another objective resample the recordings (bootstrap)")
    p = len(found.vector)
    others = np.arange(p) != component
    if held is not None:
        others &= ~held
    along = found.hessian[component]
    _, inner, _ = determined(found.hessian, others)
    curvature = found.units * (found.hessian[component, component] - along @ inner @ along)
    reach = min(REACH / np.sqrt(curvature), WIDEST) if curvature > 0 else WIDEST
    # An odd number of points has the optimum itself among them.
    offsets = np.linspace(-reach, reach, points + 1 - points % 2)
    vectors = np.tile(found.vector, (len(offsets), 1))
    vectors[:, component] += offsets
    vectors -= offsets[:, None] * (inner @ along)
    refitted = refit(problem, vectors, found.hessian, others, rounds=ROUNDS)
    rise = found.units * (refitted.values - min(found.value, np.nanmin(refitted.values)))
    ends = _crossings(offsets, rise, 0.5 * chi_square_quantile(level, 1))
    edge = [_physical(problem.parameters, found.vector, component, x) for x in ends]
    raw = found.vector[component] + offsets
    values = np.array([_physical(problem.parameters, found.vector, component, x) for x in offsets])
    return Profile(raw, values, rise, *edge)


class Refitted(NamedTuple):
    """Vectors (S, p) after some steps, and the objective (S,) there."""

    vectors: np.ndarray
    values: np.ndarray


def refit(
    problem: Any,
    vectors: np.ndarray,
    hessian: np.ndarray,
    free: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    rounds: int = 3,
) -> Refitted:
    """Better vectors (S, p), each for its own weights (S, n) of trajectories, by quasi-Newton steps all at once.

    Along the numbers that are `free` (p,); `hessian`: the second derivatives that all begin with. A step is at most 1
    long and taken back and halved where it makes nothing better; what it teaches of the second derivatives (Broyden,
    Fletcher, Goldfarb & Shanno, on the inverse) is kept.
    """
    free = np.ones(vectors.shape[1], bool) if free is None else free
    inverse = determined(hessian, free)[1][np.ix_(free, free)]
    inverses = np.tile(inverse, (len(vectors), 1, 1))
    here = vectors.copy()
    evaluated = problem.evaluate(here, weights)
    values, slopes = evaluated.values.copy(), evaluated.gradients[:, free].copy()
    scale = np.ones(len(here))
    for _ in range(rounds if free.any() else 0):
        step = -np.einsum("spq,sq->sp", inverses, slopes)
        step *= (scale / np.maximum(1.0, np.linalg.norm(step, axis=1)))[:, None]
        trial = here.copy()
        trial[:, free] += step
        evaluated = problem.evaluate(trial, weights)
        with np.errstate(invalid="ignore"):
            better = (evaluated.values < values) & np.isfinite(evaluated.gradients).all(axis=1)
        inverses = np.where(
            better[:, None, None], _updated(inverses, step, evaluated.gradients[:, free] - slopes), inverses
        )
        here = np.where(better[:, None], trial, here)
        values = np.where(better, evaluated.values, values)
        slopes = np.where(better[:, None], evaluated.gradients[:, free], slopes)
        scale = np.where(better, np.minimum(1.0, 2.0 * scale), 0.5 * scale)
    return Refitted(here, values)


def bootstrap(
    problem: Any,
    found: Optimum,
    replicates: int = 100,
    rounds: int = 3,
    seed: int = 0,
    held: np.ndarray | None = None,
) -> np.ndarray:
    """Vectors (replicates, p) fitted to trajectories drawn anew with replacement (Efron 1979), for any objective.

    Each from the optimum by a few steps, all together, but for the numbers `held` (p,). Raises ValueError for fewer
    than five trajectories, of which resampling says little.
    """
    count = int(found.used.sum())
    if count < FEWEST:
        raise ValueError(f"{count} trajectories are too few to resample; cut recordings into pieces, or take more")
    rng = np.random.default_rng(seed)
    weights = np.zeros((replicates, len(found.used)))
    weights[:, found.used] = rng.multinomial(count, np.full(count, 1.0 / count), size=replicates)
    start = np.tile(found.vector, (replicates, 1))
    free = None if held is None else ~held
    return refit(problem, start, found.hessian, free, weights, rounds).vectors


def percentile_intervals(
    parameters: list[Parameter], vectors: np.ndarray, level: float = 0.95
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Lowest and highest physical value by label of the middle `level` of replicates (S, p)."""
    every = [physical(parameters, v) for v in vectors]
    tails = 50 * (1 - level), 50 * (1 + level)
    found = {}
    for k, p in enumerate(parameters):
        low, high = np.percentile(np.stack([np.asarray(v[k], float) for v in every]), tails, axis=0)
        found[p.label] = (low, high)
    return found


def _updated(inverses: np.ndarray, steps: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """The BFGS update of inverses (S, p, p) by steps and changes of gradients (S, p), but where it would spoil them."""
    along = np.einsum("sp,sp->s", steps, changes)
    size = np.linalg.norm(steps, axis=1) * np.linalg.norm(np.nan_to_num(changes), axis=1)
    sound = along > 1e-8 * size
    rho = np.where(sound, 1.0 / np.where(sound, along, 1.0), 0.0)
    left = np.eye(steps.shape[1]) - rho[:, None, None] * steps[:, :, None] * changes[:, None, :]
    new = left @ inverses @ left.transpose(0, 2, 1) + rho[:, None, None] * steps[:, :, None] * steps[:, None, :]
    return np.where(sound[:, None, None], new, inverses)


def _crossings(offsets: np.ndarray, rise: np.ndarray, height: float) -> tuple[float, float]:
    """Where a profile first rises to `height` on either side of its least point; infinite where it does not.

    Linear in the signed root of the rise, which of a quadratic is a straight line.
    """
    root = np.sqrt(np.maximum(np.where(np.isfinite(rise), rise, np.inf), 0.0))
    least, wanted = int(np.argmin(root)), np.sqrt(height)

    def side(order: np.ndarray, sign: float) -> float:
        for a, b in pairwise(order):
            if root[b] >= wanted:
                if not np.isfinite(root[b]):
                    return float(offsets[b])
                return float(offsets[a] + (wanted - root[a]) / (root[b] - root[a]) * (offsets[b] - offsets[a]))
        return sign * np.inf

    indices = np.arange(len(offsets))
    return side(indices[: least + 1][::-1], -1.0), side(indices[least:], 1.0)


def _physical(parameters: list[Parameter], vector: np.ndarray, component: int, offset: float) -> float:
    """The physical value of one number, `offset` away from a vector in unconstrained coordinates."""
    moved = np.array(vector, float)
    moved[component] += offset
    return float(physical_vector(parameters, moved)[component])
