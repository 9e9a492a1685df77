"""Fit of station positions: `python -m experiments.lab.papers.will_2020.fit_figure_8` writes `fitted/figure_8.toml`.

Paper A prints no station positions. Their distance from the centre line, which determines the accuracy of the height,
is fitted to one number, the 3.18 cm of the cascade on the helix with the array of Table 1. Run it after `fit_table_1`,
whose errors hardly depend on it. Reproduces `fitted/figure_8.toml` to its four digits.
"""

from __future__ import annotations

import sys

import numpy as np

from experiments.lab.papers.fitting import Fitted, fitted, solved, unsaved, write_fitted
from experiments.lab.papers.will_2020._work_stand import cascade, recorded
from experiments.monte_carlo import Study, World

PRINTED_CM = 3.18
"""Paper A, section 4.2: 3-D RMSE."""

START, RUNS, SEED = 0.29, 64, 1


def error_cm(radius: float, runs: int = RUNS, seed: int = SEED) -> float:
    """The cascade's 3-D RMSE, cm, with stations at `radius`, m, from the centre line."""
    study = Study(
        "fit-figure-8", "", {"stand": World(recorded, {"radius": radius})}, {"cascade": cascade()}, runs, seed=seed,
        metrics=("rmse_3d_m",),
    )  # fmt: skip
    return 100 * unsaved(study).value("rmse_3d_m", "stand", "cascade").value


def main() -> int:
    """Fit the radius and write it."""
    solution = solved(lambda numbers: np.array([error_cm(numbers["radius"]) / PRINTED_CM]), {"radius": START}, rounds=3)
    radius = float(f"{solution['radius']:.4g}")
    found = error_cm(radius)
    print(f"stations {radius:.3f} m from the centre line: {found:.3f} cm, printed {PRINTED_CM} cm")
    told = {
        "radius": Fitted(radius, "m", "section 4.2, 3.18 cm"),
        "error": Fitted(found, "cm", f"what the radius gives, {RUNS} trajectories"),
    }
    print(f"wrote {write_fitted('will_2020/figure_8', 'none: one number against one printed figure', told)}")
    return 0


def radius() -> float:
    """The fitted distance of the stations from the centre line, m."""
    return fitted("will_2020/figure_8")["radius"]


if __name__ == "__main__":
    sys.exit(main())
