"""Fit of the workshop's world to the raw fixes of Huang et al. 2018.

`python -m experiments.lab.papers.huang_2018.fit_workshop`. Drift, share and size of outliers are fitted to mean,
maximum and variance of the raw distances to the route. Q and speed limit of MH-K, not printed either, are then taken
from a grid, by its mean and maximum.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from experiments.lab.papers.fitting import Fitted, means, solved, write_fitted
from experiments.lab.papers.huang_2018.workshop import PRINTED, study_with

RUNS = 100
SIGMAS_A = (0.02, 0.03, 0.04, 0.05, 0.07, 0.1)
SPEED_LIMITS = (0.55, 0.6, 0.8, 1.0, 2.0, 4.0)
"""m/s; the vehicle's speed is 0.5 m/s, and a closer limit would slow its estimates."""

START = {"drift": 0.05, "share": 0.45, "size": 0.16, "sigma_a": 0.05, "speed_limit": 0.6}


def ratios(numbers: dict[str, float], tracker: str, metrics: tuple[str, ...]) -> np.ndarray:
    """Simulated over printed metrics of a tracker."""
    found = means(study_with(numbers, RUNS, seed=0), RUNS, tracker)["workshop", tracker]
    return np.array([found[p.measure] * p.factor / getattr(p, tracker) for p in map(PRINTED.__getitem__, metrics)])


def main() -> None:
    """Fit and write the file."""
    of_world = ("drift", "share", "size")
    raw = ("mean error", "largest error", "variance")
    start = {name: START[name] for name in of_world}
    numbers = START | solved(lambda x: ratios(START | x, "raw", raw), start)
    tried = {}
    for sigma_a, limit in product(SIGMAS_A, SPEED_LIMITS):
        own = numbers | {"sigma_a": sigma_a, "speed_limit": limit}
        tried[sigma_a, limit] = float(np.sum(np.log(ratios(own, "mhk", raw[:2])) ** 2))
    sigma_a, limit = min(tried, key=tried.__getitem__)
    all_raw, both = "mean, maximum and variance of the raw fixes", "mean and maximum of MH-K, from a grid"
    path = write_fitted(
        "huang_2018/workshop",
        "4 of 9 printed figures are predictions: variance, under 10 cm, under 15 cm and improved of MH-K",
        {
            **{name: Fitted(numbers[name], unit, all_raw) for name, unit in zip(of_world, "m1m", strict=True)},
            "sigma_a": Fitted(sigma_a, "m/s^2/sqrt(Hz)", both),
            "speed_limit": Fitted(limit, "m/s", both),
        },
    )
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
