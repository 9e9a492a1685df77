"""The figure of a sweep: a curve over one number, contours over two."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.plots.style import BLUE, drawing, literal
from experiments.plots.surface import contours, curve, named
from tuning.sweep import Sweep


def sweep_figure(path: Path | str, swept: Sweep, objective: str, paths: Sequence[np.ndarray] = ()) -> Path:
    """Writes the objective over the grid with its least value marked, and its spread where there are repeats.

    `objective`: its name with its unit. `paths`: ways of a fit, (i, p) for the p numbers swept. Returns the path;
    raises UnusableInput where it can't be written.
    """
    mean, at = swept.mean, swept.best_index
    best = [grid[k] for grid, k in zip(swept.grids, at, strict=True)]
    labels = [named(p.label, p.example.unit) for p in swept.parameters]
    shown = ", ".join(f"{p.label} = {x:.4g}" for p, x in zip(swept.parameters, best, strict=True))
    with drawing(path, 7.0, 4.6, f"Sweep: {objective}") as figure:
        axes = figure.subplots()
        if len(labels) == 1:
            repeated = len(swept.values) > 1
            curve(axes, swept.grids[0], mean, swept.spread if repeated else None, (float(best[0]), float(mean[at])))
            for way in paths:
                # A fit may have had another objective: only where it was is drawn, not what it found there.
                level = np.interp(way[:, 0], swept.grids[0], mean)
                axes.plot(
                    way[:, 0], level, ".-", color=BLUE, markersize=4, linewidth=0.6, label="steps of the gradient"
                )
            axes.set(ylabel=literal(objective), xlim=(swept.grids[0].min(), swept.grids[0].max()))
            if repeated or paths:
                axes.legend(loc="best")
        else:
            contours(axes, swept.grids, mean, paths, (float(best[0]), float(best[1])))
            axes.set(xlim=swept.grids[0][[0, -1]], ylim=swept.grids[1][[0, -1]], ylabel=labels[1])
        axes.set_xlabel(labels[0])
        # Over contours a legend stands between them and the title.
        above = 22 if len(labels) == 2 and paths else 6
        axes.set_title(literal(f"least {mean[at]:.5g} at {shown}"), fontsize=9, pad=above)
    return Path(path)
