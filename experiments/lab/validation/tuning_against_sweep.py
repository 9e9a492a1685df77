"""Cost of tuning by gradient and by the papers' sweep.

`python -m trackwright.experiments.lab.validation.tuning_against_sweep`:
Nine simulated recordings of the assembly line, three of each situation, and one parameter, σ_a, the noise of the speed.
The sweep follows the thesis (2.7, chapter 3): ten runs of the particle filter at each of 101 values up to 1 m/s per √s,
the first 1 mm/s because zero noise is a different model. The gradient starts at the far end of that range: of the grid
filter, which has the same model, and of the particle filter by its score. The RMSE has several minima, so the grid
filter has two starts: that end, and the better of a tenth and ten times it. One filter run is one recording filtered at
one value, with or without gradient.

Each result is scored with the tracker it was tuned for, particles with random numbers not used by sweep or fit. The
grid's cells, 2.4 cm/s wide, blur the speed: the σ_a of least RMSE is smaller for the grid than for particles. The
maxima of their likelihoods agree.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.text.tables import aligned
from trackwright.experiments.text.terminal import progress
from trackwright.sim.line import SITUATIONS, simulate_line
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.tunable import Scale, replaced, tunables
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.tracks import batches
from trackwright.tuning.fitting import fit
from trackwright.tuning.named_objectives import parse_objective
from trackwright.tuning.objectives import Weighted
from trackwright.tuning.optimisers import LBFGS, Adam
from trackwright.tuning.parameters import select_parameters
from trackwright.tuning.problem import Problem

GOALS = ("rmse", "nll")
SIGMA = "motion.sigma_a"
FIRST, LAST, VALUES = 0.001, 1.0, 101
REPEATS = 10
STARTS, STEPS = 2, 12
ADAM = Adam(STEPS, rate=0.5)
"""For the RMSE, nearly flat over log σ_a, and for particles, whose line search would take three runs per step."""

CLOSE, FEWER = 0.02, 20.0
"""Allowed relative excess over the sweep's best, and required ratio of filter runs."""


class Found(NamedTuple):
    """The σ_a at which a method minimised `goal`, its number of filter runs, and seconds, compiling included.

    `tracker`: particles or grid.
    """

    method: str
    tracker: str
    goal: str
    sigma: float
    runs: int
    seconds: float


class Score(NamedTuple):
    """RMSE, m, and negative log-likelihood per measurement, nats, of a tracker at a value."""

    rmse: float
    nll: float


def main(*, values: int = VALUES, repeats: int = REPEATS, tags: int = 3) -> int:
    """Print the comparison; 1 if a fit is worse than the sweep's best or takes too many filter runs.

    Args:
        values: values of σ_a in the sweep.
        repeats: runs of the particle filter at each value.
        tags: recordings of each situation.
    """
    world = recordings(tags)
    print(f"{3 * tags} recordings of the line, {values} values, {repeats} repeats; σ_a in m/s per √s")
    swept = by_sweep(world, np.r_[FIRST, np.linspace(0, LAST, values)[1:]], repeats)
    fitted = by_gradient(world, LAST)
    every = [*swept, *fitted]
    scores = scored(world, every, range(repeats, 2 * repeats))
    print(table(every, scores), flush=True)
    failures = failed(swept, fitted, scores)
    for line in failures:
        print(f"fails: {line}")
    if not failures:
        print(f"every fit is within {100 * CLOSE:.0f} % of the sweep's best, by at least {FEWER:.0f} times fewer runs")
    return 1 if failures else 0


class World(NamedTuple):
    """The recordings, and a particle filter and a grid filter with the same model."""

    rows: list[Batch]
    particles: AbstractTracker
    grid: AbstractTracker


def recordings(tags: int) -> World:
    """`tags` recordings of every situation, each with its own tag."""
    folders = [
        simulate_line(situation, range(k * tags, (k + 1) * tags)).folder(situation)
        for k, situation in enumerate(SITUATIONS)
    ]
    particles, grid = (build(name, folders).only_batch(folders) for name in ("line-pf", "line-grid"))
    return World([batch for _, batch in batches(particles.trajectories)], particles.tracker, grid.tracker)


def by_sweep(world: World, sigmas: np.ndarray, repeats: int) -> list[Found]:
    """The values of least mean RMSE and of least negative log-likelihood, from one sweep."""
    started = time.perf_counter()
    metrics = _both(world, "particles", sigmas, range(repeats))
    seconds = time.perf_counter() - started
    best = np.argmin(metrics.mean(axis=0), axis=0)
    name = f"sweep of {len(sigmas)} x {repeats}"
    runs = metrics[..., 0].size * sum(batch.size for batch in world.rows)
    return [Found(name, "particles", goal, float(sigmas[k]), runs, seconds)
            for goal, k in zip(GOALS, best, strict=True)]  # fmt: skip


def scored(world: World, every: Sequence[Found], turns: range) -> list[Score]:
    """Both metrics at each result, means over the random numbers of `turns`."""
    return [Score(*map(float, _both(world, f.tracker, np.array([f.sigma]), turns).mean(axis=0)[0])) for f in every]


def _both(world: World, name: str, sigmas: np.ndarray, turns: range) -> np.ndarray:
    """RMSE and negative log-likelihood (turns, n, 2) of a tracker; one turn if it is deterministic."""
    tracker = getattr(world, name)
    goal = Weighted(tuple(parse_objective(text) for text in GOALS), (1.0, 1.0))
    problem = Problem(tracker, world.rows, goal, select_parameters(tracker, SIGMA))
    turns = turns if problem.stochastic else turns[:1]
    metrics = np.empty((len(turns), len(sigmas), len(GOALS)))
    with progress(name, metrics[..., 0].size) as advance:
        for turn, of_turn in zip(turns, metrics, strict=True):
            for row, sigma in zip(of_turn, sigmas, strict=True):
                sums = problem.terms(np.log([[sigma]]), turn)[0].sum(axis=-1)
                row[:] = [float(part.value(own)) for part, own in zip(goal.parts, goal.split(sums), strict=True)]
                advance(1)
    return metrics


def by_gradient(world: World, start: float) -> list[Found]:
    """Fits from `start`: of the grid filter by RMSE and by likelihood, of the particle filter by likelihood."""
    found = []
    for method, name, goal, optimiser, starts in (
        ("gradient", "grid", "rmse", ADAM, STARTS),
        ("gradient", "grid", "nll", LBFGS(), STARTS),
        ("gradient by score", "particles", "nll", ADAM, 1),
    ):
        tracker = getattr(world, name)
        begun = replaced(tracker, {SIGMA: Scale(start, tunables(tracker)[SIGMA].unit)})
        with progress(f"{name}, {goal}", STEPS + 1) as advance:
            started = time.perf_counter()
            result = fit(begun, world.rows, parse_objective(goal), SIGMA, optimiser=optimiser, steps=STEPS,
                         starts=starts, report=lambda state, advance=advance: advance(1))  # type: ignore[misc]  # fmt: skip
            seconds = time.perf_counter() - started
        found.append(Found(method, name, goal, float(result.values[SIGMA]), result.filter_runs, seconds))
    return found


def failed(swept: Sequence[Found], fitted: Sequence[Found], scores: Sequence[Score]) -> list[str]:
    """Messages on fits that are worse than the sweep's best, or take too many filter runs."""
    best = {f.goal: getattr(one, f.goal) for f, one in zip(swept, scores, strict=False)}
    lines = []
    for found, one in zip(fitted, scores[len(swept) :], strict=True):
        value, least = getattr(one, found.goal), best[found.goal]
        if not value <= least + CLOSE * abs(least):
            lines.append(f"{found.method}, {found.tracker}: {found.goal} {value:.4f}, the sweep's best {least:.4f}")
        if not found.runs * FEWER <= swept[0].runs:
            lines.append(f"{found.method}, {found.tracker}: {found.runs} filter runs, the sweep {swept[0].runs}")
    return lines


def table(every: Sequence[Found], scores: Sequence[Score]) -> str:
    """The methods side by side."""
    first = every[0]
    rows = [("method", "tracker", "objective", "σ_a", "RMSE cm", "nll", "runs", "fewer", "seconds", "faster")]
    for (method, tracker, goal, sigma, runs, seconds), (rmse, nll) in zip(every, scores, strict=True):
        figures = f"{sigma:.4f}", f"{100 * rmse:.2f}", f"{nll:.4f}"
        costs = str(runs), f"{first.runs / runs:.1f}", f"{seconds:.1f}", f"{first.seconds / seconds:.1f}"
        rows.append((method, tracker, goal, *figures, *costs))
    return aligned(rows, range(3, 10))


if __name__ == "__main__":
    run_alone(main, "python -m trackwright.experiments.lab.validation.tuning_against_sweep")
