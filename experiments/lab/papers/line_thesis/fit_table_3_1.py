"""Fit of the world of Table 3.1: `python -m experiments.lab.papers.line_thesis.fit_table_3_1`.

Neither errors, rate nor speeds of the nine recordings are printed. Eleven parameters are fitted to eighteen printed
errors: the white noise of each recording to its measurement error, the common level of the slow errors to the average
of the Kalman column, and the mean speed to its nine errors. These hardly depend on the speed. A speed is allowed if
its sum of squared residuals is at most that of nine single draws of the fitted world; the middle one is taken. The
file lists the particle filter's average at each allowed speed. The time constant of the slow errors and the rate are
chosen. The particle filter's nine errors are not used.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from experiments.lab.papers.fitting import Fitted, unsaved, write_fitted
from experiments.lab.papers.line_thesis._assembly_line import (
    KALMAN,
    PARTICLE,
    PRINTED,
    RAW,
    RECORDINGS,
    SIGMA,
    SWEPT,
    error,
    least,
    noise_of,
    worlds,
)
from experiments.monte_carlo import Results, Study, TrackerConfig

TAU, RATE_HZ = 1.5, 5.0
SPEEDS = (0.3, 0.45, 0.6)
RUNS, ROUNDS, SEED, START = 16, 2, 7, 0.2

MEASURED = np.array([PRINTED[name][0] for name in RECORDINGS]) / 100
FILTERED = np.array([PRINTED[name][1] for name in RECORDINGS]) / 100


def swept(numbers: Mapping[str, float], trackers: Mapping[str, TrackerConfig], runs: int) -> Results:
    """The sweep of the dynamic noise over all nine recordings."""
    study = Study(
        "fit-table-3-1", "", worlds(numbers), trackers, runs, {SIGMA: SWEPT}, SEED, {"error_m": error}, ("mean_m",)
    )
    return unsaved(study)


class Column(NamedTuple):
    """A column of the table, m: means over draws (9,), scatter of one draw (9,), and the dynamic noise."""

    means: np.ndarray
    scatter: np.ndarray
    sigma: float


def column(results: Results, tracker: str) -> Column:
    """The column of a tracker at its best dynamic noise of a sweep."""
    best = least(results, tracker)
    draws = np.array([results.numbers("error_m", name, tracker, **{SIGMA: best}) for name in RECORDINGS])
    return Column(draws.mean(axis=1), draws.std(axis=1, ddof=1), best)


class Fit(NamedTuple):
    """The fit at one mean speed: parameters, and the sum of squared relative residuals of the Kalman column.

    `squares`: of the fit; `expected`: of nine single draws of the fitted world.
    """

    numbers: dict[str, float]
    squares: float
    expected: float


def fit_at(speed: float, runs: int = RUNS, rounds: int = ROUNDS) -> Fit:
    """The parameters that reproduce the measurement errors and the Kalman filter's average at a mean speed, m/s."""
    # The mean distance of normal errors is √(π/2) σ; the fitted truth absorbs a few per cent of it.
    total, slow = 1.03 * MEASURED / np.sqrt(np.pi / 2), START
    for turn in range(rounds + 1):
        white = np.sqrt(np.maximum(total**2 - slow**2, 0.02**2))
        numbers = {"slow": float(slow), "tau": TAU, "speed": speed, "rate_hz": RATE_HZ}
        numbers |= dict(zip(map(noise_of, RECORDINGS), white.tolist(), strict=True))
        results = swept(numbers, {"Kalman": KALMAN, "raw": RAW}, runs)
        raw, kalman = column(results, "raw"), column(results, "Kalman")
        squares = float(((kalman.means / FILTERED - 1) ** 2).sum())
        expected = float(((kalman.scatter / kalman.means) ** 2).sum())
        print(
            f"{speed:.2f} m/s, round {turn}: slow errors {slow:.3f} m, Kalman filter "
            f"{100 * kalman.means.mean():.2f} cm, sum of squares {squares:.4f}, of single draws {expected:.4f}",
            flush=True,
        )
        if turn < rounds:
            total = total * MEASURED / raw.means
            # Part of the filter's error is due to the motion: the level changes by more than the error.
            slow *= float(FILTERED.mean() / kalman.means.mean()) ** 1.3
    return Fit(numbers, squares, expected)


def main() -> int:
    """Fit at every speed and write the middle one of those that the Kalman column allows."""
    fits = [fit_at(speed) for speed in SPEEDS]
    allowed = [fit for fit in fits if fit.squares <= fit.expected] or [min(fits, key=lambda fit: fit.squares)]
    numbers = allowed[len(allowed) // 2].numbers
    averages = {}
    for fit in allowed:
        both = swept(fit.numbers, {"particle": PARTICLE, "Kalman": KALMAN}, RUNS)
        found = column(both, "particle")
        averages[fit.numbers["speed"]] = 100 * found.means.mean()
        print(
            f"{fit.numbers['speed']:.2f} m/s: particle filter {100 * found.means.mean():.2f} cm at {found.sigma}",
            flush=True,
        )
        if fit.numbers is numbers:
            sigmas = {tracker: least(both, tracker) for tracker in ("particle", "Kalman")}
    ours = "no printed figure: the thesis's sweep over all nine recordings"
    told = {
        "sigma_kalman": Fitted(sigmas["Kalman"], "m/s/sqrt(s)", ours),
        "sigma_particle": Fitted(sigmas["particle"], "m/s/sqrt(s)", ours),
        "slow": Fitted(numbers["slow"], "m", "Table 3.1, average of Kalman"),
        "speed": Fitted(numbers["speed"], "m/s", "Table 3.1, Kalman, nine figures: the middle one of those allowed"),
        "tau": Fitted(TAU, "s", "chosen"),
        "rate_hz": Fitted(RATE_HZ, "Hz", "chosen"),
    }
    for name in RECORDINGS:
        told[noise_of(name)] = Fitted(numbers[noise_of(name)], "m", f"Table 3.1, Measurement, {name}")
    free = (
        "7 of 18 printed figures, of Measurement and Kalman; the particle filter's 9 have no part in the fit. Speeds "
        "that the Kalman column allows, and the particle filter's average at each: "
        + ", ".join(f"{speed} m/s {average:.1f} cm" for speed, average in averages.items())
    )
    print(f"wrote {write_fitted('line_thesis/table_3_1', free, told)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
