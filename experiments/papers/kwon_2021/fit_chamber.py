"""Fit of the chamber of Kwon et al. 2021, Table 2: `python -m experiments.papers.kwon_2021.fit_chamber`.

The spread of the anchors' biases is fitted to the largest deviation in x, the anchors' height to that in z. Reproduces
`fitted/chamber.toml` to its four digits.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.papers.fitting import Fitted, means, solved, write_fitted
from experiments.papers.kwon_2021.chamber import PRINTED_MM, TRACKER, study_with

RUNS = 100
START = {"sigma_bias": 0.05, "height": 2.45}


def ratios(values: np.ndarray) -> np.ndarray:
    """Simulated over printed deviations in x and z."""
    whole = study_with(dict(zip(START, values.tolist(), strict=True)), RUNS, seed=0)
    mine = means(replace(whole, trackers={TRACKER: whole.trackers[TRACKER]}), RUNS).values()
    return np.array([1e3 * np.mean([m[f"largest_{axis}_m"] for m in mine]) / PRINTED_MM[axis] for axis in "xz"])


def main() -> None:
    """Fit and write the file."""
    bias, height = solved(ratios, list(START.values()), rounds=3)
    numbers = {"sigma_bias": Fitted(bias, "m", "x"), "height": Fitted(height, "m", "z")}
    print(f"wrote {write_fitted('kwon_2021/chamber', '1 of 3 printed figures: y', numbers)}")


if __name__ == "__main__":
    main()
