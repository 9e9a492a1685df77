"""Fit of the hall of Kwon et al. 2021, Table 1: `python -m experiments.lab.papers.kwon_2021.fit_line_of_sight`.

The spread of the range errors is fitted to the geometric mean of the error spans in x and y with line of sight, the
detour round the obstacle to the span in x without it. Reproduces `fitted/line_of_sight.toml` to 0.3 %.
"""

from __future__ import annotations

import numpy as np

from experiments.lab.papers.fitting import Fitted, means, solved, write_fitted
from experiments.lab.papers.kwon_2021.line_of_sight import PRINTED_MM, TRACKER, study_with

RUNS = 60
START = {"sigma_echo": 0.07, "detour": 0.3}


def ratios(numbers: dict[str, float]) -> np.ndarray:
    """Simulated over printed spans, with line of sight and hidden."""
    found = means(study_with(numbers, RUNS, seed=0), RUNS, TRACKER)
    over = {
        (world, axis): 1e3 * found[world, TRACKER][f"span_{axis}_m"] / (high - low)
        for world, axes in PRINTED_MM.items()
        for axis, (low, high) in axes.items()
    }
    return np.array([np.sqrt(over["in sight", "x"] * over["in sight", "y"]), over["hidden", "x"]])


def main() -> None:
    """Fit and write the file."""
    found = solved(ratios, START, rounds=3)
    numbers = {
        "sigma_echo": Fitted(found["sigma_echo"], "m", "in sight, geometric mean of x and y"),
        "detour": Fitted(found["detour"], "m", "hidden, x"),
    }
    print(f"wrote {write_fitted('kwon_2021/line_of_sight', '2 of 4 printed figures', numbers)}")


if __name__ == "__main__":
    main()
