"""Charts of a calibration: measured against true values of each station or anchor, and errors over the floor."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from trackwright.experiments.pages.charts.style import (
    BEFORE,
    BLACK,
    BLUE,
    GREY,
    NARROW,
    VERMILION,
    Chart,
    legend_above,
    literal,
)

POINTS = 500
"""The most rows drawn of a source, before and after each: evenly spaced ones."""

DEGREES = float(np.rad2deg(1.0))

SQUARE = 0.5
"""Side of the squares of the floor, m, whose median errors are drawn."""


class Panel(NamedTuple):
    """The readings of a station's angle, rad, or of an anchor, m, and their fit.

    `true`, `measured` and `corrected` (N,), true plus the error after calibration; `positions` (N, 2) m. `at`,
    `fitted`, `sigma` (k,): the fit at true values, with its standard deviation. `is_angle`: angles are drawn in
    degrees, and of ranges the errors.
    """

    name: str
    quantity: str
    is_angle: bool
    true: np.ndarray
    measured: np.ndarray
    corrected: np.ndarray
    positions: np.ndarray
    at: np.ndarray
    fitted: np.ndarray
    sigma: np.ndarray


def reading_chart(panel: Panel, kind: str) -> Chart:
    """Readings before and after calibration against true values, with the fit and its 95 % interval."""

    def draw(axes: Axes) -> None:
        _readings(axes, panel)
        axes.set_title(axes.get_title("left"), pad=30)
        legend_above(axes, 3)

    return Chart(f"{kind}-{panel.name}-{panel.quantity}", f"{panel.name}: {panel.quantity}", draw)


def _readings(axes: Axes, panel: Panel) -> None:
    part = slice(None, None, -(-len(panel.true) // POINTS))
    factor, unit = (DEGREES, "°") if panel.is_angle else (1.0, "m")
    true, at = factor * panel.true[part], factor * panel.at
    # Errors of a few centimetres of ranges of metres are visible only by themselves.
    points, curve = (np.zeros(len(true)), np.zeros(len(at))) if panel.is_angle else (true, at)
    values = [factor * x[part] - points for x in (panel.measured, panel.corrected)]
    for y, colour, label in zip(values, (BEFORE, BLUE), ("as measured", "calibrated"), strict=True):
        axes.plot(true, y, ".", color=colour, markersize=3.5, label=label)
    axes.plot(at, at - curve, color=BLACK, linewidth=0.9, linestyle=(0, (4, 2)), label="no error")
    axes.plot(at, factor * panel.fitted - curve, color=VERMILION, linewidth=1.4, label="fit")
    low, high = (factor * (panel.fitted + sign * 1.96 * panel.sigma) - curve for sign in (-1, 1))
    axes.fill_between(at, low, high, color=VERMILION, alpha=0.25, linewidth=0, label="its 95 % interval")
    bottom, top = np.quantile(np.concatenate(values), (0.005, 0.995))
    margin = 0.08 * max(top - bottom, 1e-6)
    axes.set(ylim=(bottom - margin, top + margin), xlabel=f"true {panel.quantity} ({unit})")
    axes.set_ylabel(f"{'measured' if panel.is_angle else 'error of'} {panel.quantity} ({unit})")
    axes.set_title(literal(f"{panel.name}: {panel.quantity}"))


def floor_charts(panels: Sequence[Panel], kind: str) -> list[Chart]:
    """Median errors after calibration over the floor, in squares, a chart for each panel, all with one scale."""
    squares = np.floor(np.concatenate([panel.positions for panel in panels]) / SQUARE).astype(int)
    edges = [np.arange(x.min(), x.max() + 2) * SQUARE for x in squares.T]
    medians = [_medians(panel, edges) for panel in panels]
    largest = float(np.nanquantile(np.abs(np.concatenate([m.ravel() for m in medians])), 0.97)) or 1.0

    def draw(axes: Axes, panel: Panel, values: np.ndarray) -> None:
        mesh = axes.pcolormesh(*edges, values.T, cmap="RdBu_r", norm=Normalize(-largest, largest))
        axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
        axes.set_title(literal(f"{panel.name}: {panel.quantity}"))
        bar = axes.figure.colorbar(mesh, ax=axes, shrink=0.8, extend="both")
        bar.set_label(f"median error ({'°' if panel.is_angle else 'm'})", color=GREY)

    return [
        Chart(f"{kind}-floor-{panel.name}-{panel.quantity}", f"{panel.name}: {panel.quantity}",
              partial(draw, panel=panel, values=values), NARROW, None)
        for panel, values in zip(panels, medians, strict=True)
    ]  # fmt: skip


def _medians(panel: Panel, edges: Sequence[np.ndarray]) -> np.ndarray:
    """The median errors in the squares, NaN where there is no reading."""
    medians = np.full([len(e) - 1 for e in edges], np.nan)
    cells = np.floor(panel.positions / SQUARE - [e[0] / SQUARE for e in edges] + 1e-9).astype(int)
    error = panel.corrected - panel.true
    for cell in np.unique(cells, axis=0):
        medians[tuple(cell)] = np.median(error[(cells == cell).all(axis=1)])
    return (DEGREES if panel.is_angle else 1.0) * medians
