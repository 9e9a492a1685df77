"""Charts of a calibration: measured against true values of each station or anchor, and errors over the floor.

Those with a path write one PNG, whole or not at all, and raise UnusableInput where it can't be written.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from trackwright.experiments.pages.charts.style import (
    BEFORE,
    BLACK,
    BLUE,
    GREY,
    VERMILION,
    Chart,
    figure_file,
    legend_above,
    literal,
    svg_address,
    write_panels,
)

POINTS, PAGE_POINTS = 1500, 500
"""The most rows drawn of a source, before and after each, in a file and on a page: evenly spaced ones."""

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


def measured_against_true(path: Path, panels: Sequence[Panel], columns: int, title: str) -> None:
    """Readings before and after calibration against true values, with the fit and its 95 % interval."""
    size = 3.3 * columns + 0.4, 2.7 * -(-len(panels) // columns) + 0.9
    drawings = [partial(_readings, panel=panel, most=POINTS) for panel in panels]
    write_panels(path, drawings, size, title, columns, legend=5)


def reading_chart(panel: Panel) -> Chart:
    """A panel of `measured_against_true` for a page."""

    def draw(axes: Axes) -> None:
        _readings(axes, panel, PAGE_POINTS)
        axes.set_title(axes.get_title("left"), pad=30)
        legend_above(axes, 3)

    return Chart("readings", f"{panel.name}: {panel.quantity}", draw)


def _readings(axes: Axes, panel: Panel, most: int) -> None:
    part = slice(None, None, -(-len(panel.true) // most))
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


def errors_over_floor(path: Path, panels: Sequence[Panel], columns: int, title: str) -> None:
    """Median errors after calibration over the floor, in squares."""
    with figure_file(path, *_floor_size(panels, columns), title) as figure:
        _draw_floor(figure, panels, columns)


def floor_image(panels: Sequence[Panel], columns: int) -> str:
    """The address of the figure of `errors_over_floor` as an image."""
    return svg_address(lambda figure: _draw_floor(figure, panels, columns), *_floor_size(panels, columns))


def _floor_size(panels: Sequence[Panel], columns: int) -> tuple[float, float]:
    """Width and height in inches."""
    width, height = np.ptp(np.concatenate([panel.positions for panel in panels]), axis=0)
    tall = 3.3 * float(np.clip(height / max(width, 1e-3), 0.35, 1.5))
    return 3.3 * columns + 1.0, (tall + 0.5) * -(-len(panels) // columns) + 0.6


def _draw_floor(figure: Figure, panels: Sequence[Panel], columns: int) -> None:
    squares = np.floor(np.concatenate([panel.positions for panel in panels]) / SQUARE).astype(int)
    edges = [np.arange(x.min(), x.max() + 2) * SQUARE for x in squares.T]
    medians = [_medians(panel, edges) for panel in panels]
    largest = float(np.nanquantile(np.abs(np.concatenate([m.ravel() for m in medians])), 0.97)) or 1.0
    grid = figure.subplots(-(-len(panels) // columns), columns, squeeze=False, sharex=True, sharey=True)
    norm, mesh = Normalize(-largest, largest), None
    for axes, panel, values in zip(grid.flat, panels, medians, strict=False):
        mesh = axes.pcolormesh(*edges, values.T, cmap="RdBu_r", norm=norm)
        axes.set_aspect("equal")
        axes.set_title(literal(f"{panel.name}: {panel.quantity}"))
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("x (m)")
    for axes in grid[:, 0]:
        axes.set_ylabel("y (m)")
    assert mesh is not None
    bar = figure.colorbar(mesh, ax=grid, shrink=0.6, extend="both")
    bar.set_label(f"median error after calibration ({'°' if panels[0].is_angle else 'm'})", color=GREY)


def _medians(panel: Panel, edges: Sequence[np.ndarray]) -> np.ndarray:
    """The median errors in the squares, NaN where there is no reading."""
    medians = np.full([len(e) - 1 for e in edges], np.nan)
    cells = np.floor(panel.positions / SQUARE - [e[0] / SQUARE for e in edges] + 1e-9).astype(int)
    error = panel.corrected - panel.true
    for cell in np.unique(cells, axis=0):
        medians[tuple(cell)] = np.median(error[(cells == cell).all(axis=1)])
    return (DEGREES if panel.is_angle else 1.0) * medians
