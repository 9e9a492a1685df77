"""Fit of the tag at rest of Kwon et al. 2021, Table 4: `python -m experiments.lab.papers.kwon_2021.fit_table_4`.

Five parameters are fitted to five spreads. Raw x and y: noise of the time stamps, and distance of the two anchors on
one side. Moving average in y: size of the anchors' slow errors. Geometric means of x and y: Q of the Kalman filter,
and time constant of the slow errors for the proposed filter.
"""

from __future__ import annotations

import numpy as np

from experiments.lab.papers.fitting import Fitted, means, solved, write_fitted
from experiments.lab.papers.kwon_2021.table_4 import PRINTED, WINDOW, study_with

RUNS = 48
START = {"sigma_stamp": 2.7e-11, "base": 6.0, "slow": 5.4e-3, "tau": 0.55, "sigma_a": 0.028}


def ratios(numbers: dict[str, float]) -> np.ndarray:
    """Simulated over printed spreads: raw x, raw y, moving average y, and means of x and y of Kalman and proposed."""
    found = means(study_with(numbers, RUNS, seed=0), RUNS)
    over = {
        (name, axis): 1e3 * found["still", name][f"spread_{axis}_m"] / number
        for name, printed in PRINTED.items()
        for axis, number in zip("xy", printed, strict=True)
    }
    pairs = [np.sqrt(over[name, "x"] * over[name, "y"]) for name in ("Kalman", "proposed")]
    return np.array([over["raw", "x"], over["raw", "y"], over["moving average", "y"], *pairs])


def main() -> None:
    """Fit and write the file."""
    to = {
        "sigma_stamp": ("s", "raw x"),
        "base": ("m", "raw y"),
        "slow": ("m", "moving average y"),
        "tau": ("s", "proposed x and y, their geometric mean"),
        "sigma_a": ("m/s^2/sqrt(Hz)", "Kalman x and y, their geometric mean"),
    }
    path = write_fitted(
        "kwon_2021/table_4",
        f"2 of 8 printed figures: beside these five numbers the window's length, {WINDOW}, was chosen",
        {name: Fitted(value, *to[name]) for name, value in solved(ratios, START, rounds=2).items()},
    )
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
