"""Search layouts of eight antennas: `python -m experiments.lab.questions.fit_design_array` writes design_array.toml.

By gradient from 64 random starts, and on a grid of 10 × 7 positions. The grid has 9·10⁹ layouts; from eight random
ones, each antenna in turn is moved to the best free position.
"""

from __future__ import annotations

import jax
import numpy as np

from experiments.lab.questions._designs import TOOL_POINTS, design_of, stand, write_designs
from trackers.aoa.layout import DEFAULT_ANTENNAS
from tuning.design.search import SearchResult, descend, exchange

STARTS, STEPS, RATE = 64, 150, 0.05
COLUMNS, ROWS, ROUNDS = 10, 7, 8


def main() -> None:
    """Run both searches and write the designs."""
    with jax.enable_x64(True):
        layout, rng = stand(), np.random.default_rng(0)
        objective = layout.objective(TOOL_POINTS)
        starts = rng.random((STARTS, *layout.shape))
        x, y = np.meshgrid(np.linspace(0, 1, COLUMNS), np.linspace(0, 1, ROWS), indexing="ij")
        choices = np.stack([x.ravel(), y.ravel()], axis=1)
        layouts = [rng.choice(len(choices), layout.shape[0], replace=False) for _ in range(ROUNDS)]
        searched = {
            "default": SearchResult(layout.theta(DEFAULT_ANTENNAS), 0.0, 0),
            "grid": exchange(objective, choices, layouts),
            "gradient": descend(objective, layout.project, starts, STEPS, RATE),
        }
        write_designs("array", {k: design_of(layout, found, TOOL_POINTS) for k, found in searched.items()})


if __name__ == "__main__":
    main()
