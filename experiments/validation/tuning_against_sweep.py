"""What tuning costs by gradient and by the papers' sweep: `python -m experiments.validation.tuning_against_sweep`.

Nine recordings of the assembly line, three of each of its situations, and σ_a, the noise of the speed. The thesis
(2.7, chapter 3) tries 0 … 100 cm, ten runs of the particle filter each; here 101 values up to 1 m/s per √s, of which
the first is 1 mm since a noise that is absent is another model. Against it the gradient from the far end of that range:
of the grid filter, whose model is the same, and of the particles themselves by their score. An error has several
minima, so the grid filter follows two starts: that end, and the better of a tenth and ten times it. A filter run is one
recording filtered at one value, with or without its gradient.

What is found is judged with the tracker that it was tuned for, particles by random numbers that neither sweep nor fit
has seen. Where σ_a is small against the grid's cells, 2.4 cm/s wide, these blur the speed and a thousand particles do
not: of the least error the grid's σ_a is too small for particles, while their likelihoods are greatest at one value.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.cli.console import progress
from experiments.reports.tables import aligned
from sim.line import SITUATIONS, simulate_line
from trackers.catalogue import spec_of
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from trackers.core.tunable import Scale, replaced, tunables
from trackers.recordings.tracks import batches
from tuning import fit
from tuning.named_objectives import parse_objective
from tuning.objectives import Weighted
from tuning.optimisers import LBFGS, Adam
from tuning.parameters import select_parameters
from tuning.problem import Problem

GOALS = ("rmse", "nll")
SIGMA = "motion.sigma_a"
FIRST, LAST, VALUES = 0.001, 1.0, 101
REPEATS = 10
STARTS, STEPS = 2, 12
ADAM = Adam(STEPS, rate=0.5)
"""For an error, nearly flat over the logarithm of a noise, and for particles, whose every step takes three looks."""

CLOSE, FEWER = 0.02, 20.0
"""How near to the sweep's best a fit has to come, and by how much fewer filter runs."""


@dataclass(frozen=True)
class Found:
    """What a method found for the least of `goal`, from how many filter runs and seconds, compiling included.

    `tracker`: particles or grid, whose σ_a it is.
    """

    method: str
    tracker: str
    goal: str
    sigma: float
    runs: int
    seconds: float


@dataclass(frozen=True)
class Judged:
    """RMSE, m, and negative log-likelihood per number read, nats, of a tracker at a value."""

    rmse: float
    nll: float


def main(values: int = VALUES, repeats: int = REPEATS, tags: int = 3) -> int:
    """Print the comparison; 0 where every fit is close enough by few enough filter runs, else 1."""
    world = recordings(tags)
    print(f"{3 * tags} recordings of the line, {values} values, {repeats} repeats; σ_a in m/s per √s")
    swept = by_sweep(world, np.r_[FIRST, np.linspace(0, LAST, values)[1:]], repeats)
    fitted = by_gradient(world, LAST)
    every = [*swept, *fitted]
    figures = judged(world, every, range(repeats, 2 * repeats))
    print(table(every, figures), flush=True)
    failures = failed(swept, fitted, figures)
    for line in failures:
        print(f"fails: {line}")
    if not failures:
        print(f"every fit is within {100 * CLOSE:.0f} % of the sweep's best, by at least {FEWER:.0f} times fewer runs")
    return 1 if failures else 0


@dataclass(frozen=True)
class World:
    """The recordings' rows, and the trackers of one model: by particles, and on a grid."""

    rows: list[Batch]
    particles: AbstractTracker
    grid: AbstractTracker


def recordings(tags: int) -> World:
    """`tags` recordings of every situation, all of different tags."""
    folders = [
        simulate_line(situation, range(k * tags, (k + 1) * tags)).folder(situation)
        for k, situation in enumerate(SITUATIONS)
    ]
    (particles,), (grid,) = (spec_of(name).batches(folders, name, False) for name in ("line-pf", "line-grid"))
    return World([batch for _, batch in batches(particles.trajectories)], particles.tracker, grid.tracker)


def by_sweep(world: World, sigmas: np.ndarray, repeats: int) -> list[Found]:
    """The values of least mean RMSE and negative log-likelihood, from one sweep for both."""
    started = time.perf_counter()
    problem, figures = _both(world, "particles", sigmas, range(repeats))
    seconds = time.perf_counter() - started
    best = np.argmin(figures.mean(axis=0), axis=0)
    name = f"sweep of {len(sigmas)} x {repeats}"
    return [Found(name, "particles", goal, float(sigmas[k]), problem.filter_runs, seconds)
            for goal, k in zip(GOALS, best, strict=True)]  # fmt: skip


def judged(world: World, every: Sequence[Found], turns: range) -> list[Judged]:
    """Both figures of what was found, means over turns of the random numbers."""
    return [Judged(*map(float, _both(world, f.tracker, np.array([f.sigma]), turns)[1].mean(axis=0)[0])) for f in every]


def _both(world: World, name: str, sigmas: np.ndarray, turns: range) -> tuple[Problem, np.ndarray]:
    """RMSE and negative log-likelihood of a tracker (turns, n, 2); of one that draws nothing, one turn."""
    tracker = getattr(world, name)
    goal = Weighted(tuple(parse_objective(text) for text in GOALS), (1.0, 1.0))
    problem = Problem(tracker, world.rows, goal, select_parameters(tracker, SIGMA))
    turns = turns if problem.stochastic else turns[:1]
    figures = np.empty((len(turns), len(sigmas), len(GOALS)))
    with progress(name, figures[..., 0].size) as advance:
        for turn, of_turn in zip(turns, figures, strict=True):
            for row, sigma in zip(of_turn, sigmas, strict=True):
                sums = problem.terms(np.log([[sigma]]), turn)[0].sum(axis=-1)
                row[:] = [float(part.value(own)) for part, own in zip(goal.parts, goal.split(sums), strict=True)]
                advance(1)
    return problem, figures


def by_gradient(world: World, start: float) -> list[Found]:
    """Fits of both trackers from `start`: the grid filter's of either figure, the particles' of their likelihood."""
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


def failed(swept: Sequence[Found], fitted: Sequence[Found], figures: Sequence[Judged]) -> list[str]:
    """What a fit does not keep: near the sweep's best in what it made small, and far fewer filter runs."""
    best = {f.goal: getattr(one, f.goal) for f, one in zip(swept, figures, strict=False)}
    lines = []
    for found, one in zip(fitted, figures[len(swept) :], strict=True):
        value, least = getattr(one, found.goal), best[found.goal]
        if not value <= least + CLOSE * abs(least):
            lines.append(f"{found.method}, {found.tracker}: {found.goal} {value:.4f}, the sweep's best {least:.4f}")
        if not found.runs * FEWER <= swept[0].runs:
            lines.append(f"{found.method}, {found.tracker}: {found.runs} filter runs, the sweep {swept[0].runs}")
    return lines


def table(every: Sequence[Found], figures: Sequence[Judged]) -> str:
    """The methods side by side."""
    first = every[0]
    rows: list[tuple[str, ...]] = [
        ("method", "tracker", "objective", "σ_a", "RMSE cm", "nll", "runs", "fewer", "seconds", "faster")
    ]
    for found, one in zip(every, figures, strict=True):
        rows.append(
            (found.method, found.tracker, found.goal, f"{found.sigma:.4f}", f"{100 * one.rmse:.2f}", f"{one.nll:.4f}",
             str(found.runs), f"{first.runs / found.runs:.1f}", f"{found.seconds:.1f}",
             f"{first.seconds / found.seconds:.1f}")
        )  # fmt: skip
    return aligned(rows, range(3, 10))


if __name__ == "__main__":
    sys.exit(main())
