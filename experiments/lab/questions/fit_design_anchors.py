"""Search layouts of four anchors: `python -m experiments.lab.questions.fit_design_anchors` writes design_anchors.toml.

By gradient from 48 random starts, and exhaustively on a grid: twelve positions along the walls at the limits of both
height bands, 76,176 layouts.
"""

from __future__ import annotations

from itertools import combinations

import jax
import numpy as np

from experiments.lab.questions._designs import TAG_POINTS, default_hall, design_of, hall, write_designs
from tuning.design.search import SearchResult, descend, exhaust

STARTS, STEPS, RATE = 48, 150, 0.05
ROUND = 12


def main() -> None:
    """Run both searches and write the designs."""
    with jax.enable_x64(True):
        layout = hall()
        objective = layout.objective(TAG_POINTS)
        starts = np.random.default_rng(0).random((STARTS, *layout.shape))
        choices = np.array([(k / ROUND, z) for k in range(ROUND) for z in (0.0, 1.0)])
        pairs = list(combinations(range(len(choices)), 2))
        searched = {
            "default": SearchResult(default_hall(), 0.0, 0),
            "grid": exhaust(objective, choices, (low + high for low in pairs for high in pairs)),
            "gradient": descend(objective, layout.project, starts, STEPS, RATE),
        }
        write_designs("anchors", {k: design_of(layout, found, TAG_POINTS) for k, found in searched.items()})


if __name__ == "__main__":
    main()
