"""Figures over many runs: how large the error is, what the filter says of it, and what no filter can beat."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.plots.style import BLUE, SKY, VERMILION, drawing, legend_above, length_unit


def rmse_over_time(
    path: Path | str,
    times: np.ndarray,
    rmse: np.ndarray,
    sigmas: np.ndarray,
    bounds: np.ndarray | None,
    runs: int,
    title: str = "Root mean square error over time",
) -> Path:
    """Writes the RMSE of each axis over `runs` runs with the reported σ and the bound; returns the path.

    `times` (t,) s; `rmse`, `sigmas`, `bounds` (t, d) m; an axis without figures is left out.
    """
    columns = [k for k in range(rmse.shape[1]) if np.isfinite(rmse[:, k]).any()]
    unit, scale = length_unit(float(np.nanmedian(rmse[:, columns])))
    with drawing(path, 8.0, 1.0 + 1.7 * len(columns), f"{title} ({runs} runs)") as figure:
        panels = figure.subplots(len(columns), 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in zip(columns, panels, strict=True):
            axes.plot(times, scale * rmse[:, k], color=BLUE, linewidth=1.0, label="RMSE")
            axes.plot(times, scale * sigmas[:, k], color=SKY, linewidth=1.4, label="reported σ")
            if bounds is not None:
                line = {"color": VERMILION, "linewidth": 1.1, "linestyle": (0, (5, 2))}
                axes.plot(times, scale * bounds[:, k], label="Cramér–Rao bound of this model", **line)
            top = float(np.nanquantile(scale * rmse[:, k], 0.98))
            axes.set(ylim=(0, 1.6 * top), ylabel=f"{'xyz'[k]} ({unit})")
            axes.margins(x=0.01)
        panels[-1].set_xlabel("time (s)")
        legend_above(panels[0])
    return Path(path)
