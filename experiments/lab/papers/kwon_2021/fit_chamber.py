"""Fit of the chamber of Kwon et al. 2021, Table 2: `python -m experiments.lab.papers.kwon_2021.fit_chamber`.

The spread of the anchors' biases is fitted to the largest deviation in x, the anchors' height to that in z. Reproduces
`fitted/chamber.toml` to its four digits.
"""

from __future__ import annotations

import numpy as np

from experiments.lab.papers.fitting import Fitted, means, solved, write_fitted
from experiments.lab.papers.kwon_2021.chamber import PRINTED_MM, TRACKER, study_with

RUNS = 100
START = {"sigma_bias": 0.05, "height": 2.45}


def ratios(numbers: dict[str, float]) -> np.ndarray:
    """Simulated over printed deviations in x and z."""
    mine = means(study_with(numbers, RUNS, seed=0), RUNS, TRACKER).values()
    return np.array([1e3 * np.mean([m[f"largest_{axis}_m"] for m in mine]) / PRINTED_MM[axis] for axis in "xz"])


def main() -> None:
    """Fit and write the file."""
    found = solved(ratios, START, rounds=3)
    numbers = {name: Fitted(found[name], "m", axis) for name, axis in (("sigma_bias", "x"), ("height", "z"))}
    print(f"wrote {write_fitted('kwon_2021/chamber', '1 of 3 printed figures: y', numbers)}")


if __name__ == "__main__":
    main()
