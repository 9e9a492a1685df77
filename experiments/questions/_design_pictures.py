"""Maps of layouts side by side: where things stand, and the bound over the place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.plots.style import write_svg


def maps(
    folder: Path,
    name: str,
    fields: Mapping[str, np.ndarray],
    x: np.ndarray,
    y: np.ndarray,
    also: Callable[[Axes, str], object],
    what: str,
    stacked: bool = False,
) -> str:
    """The SVG file with a panel for each of the `fields` (len(x), len(y)), m, all in one scale of colours, in cm.

    `also` draws what stands there into a panel, by its layout; `what` says what that is. `x`, `y` m.
    """
    every = 100 * np.stack(list(fields.values()))

    def draw(figure: Figure) -> None:
        shape = (len(fields), 1) if stacked else (1, len(fields))
        panels: Sequence[Axes] = figure.subplots(*shape, sharex=True, sharey=True).ravel()
        for axes, (layout, field) in zip(panels, fields.items(), strict=True):
            levels = np.linspace(every.min(), every.max(), 13)
            shades = axes.contourf(x, y, 100 * field.T, levels=levels, cmap="viridis_r")
            also(axes, layout)
            mean = 100 * float(np.sqrt(np.mean(field**2)))
            axes.set_title(f"{layout}: {mean:.1f} cm on the map")
            axes.set_aspect("equal")
            axes.grid(visible=False)
            axes.set(xlabel="" if stacked and axes is not panels[-1] else "x, m")
            axes.set(ylabel="y, m" if stacked or axes is panels[0] else "")
            axes.xaxis.set_major_locator(MaxNLocator(7 if stacked else 3))
            axes.yaxis.set_major_locator(MaxNLocator(3))
        bar = figure.colorbar(shades, ax=list(panels), label="bound, cm", shrink=0.9)
        bar.ax.yaxis.set_major_formatter("{x:.1f}")
        figure.suptitle(what, x=0.01, ha="left", fontsize=9)

    return write_svg(folder, name, draw, 7.0, 6.0 if stacked else 3.0)
