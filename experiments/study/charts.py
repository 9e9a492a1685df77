"""Drawings of a study: a figure over the cells or along the grid with intervals, and the distribution of errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, PercentFormatter

from experiments.figure_style import LINES, literal
from experiments.study.declaration import Cell, short
from experiments.study.results import Results
from experiments.study.tally import KINDS
from experiments.study.wording import heading, unit_of
from experiments.tuning_report.drawings import HEIGHT, WIDTH, drawn, plain

MARKS = "osD^vP"
SHOWN_CELLS, LINES_SHOWN, ROWS_SHOWN = 6, 8, 40
"""The most cells whose distributions are drawn, lines of a drawing, and rows of one."""


def figure_chart(results: Results, figure: str) -> str | None:
    """A figure with its intervals: along the grid where that is one row of numbers, else cell by cell.

    None where there would be more lines or rows than a drawing has room for.
    """
    study = results.study
    along = _axis(results)
    if along is None:
        return _bars(results, figure) if len(study.cells) * len(study.trackers) <= ROWS_SHOWN else None
    if len(study.worlds) * len(study.trackers) > LINES_SHOWN:
        return None
    found = {(c.index, t): results.at(figure, c, t) for c in study.cells for t in study.trackers}
    unit = unit_of(figure, [v.value for v in found.values()])

    def draw(figure_: Figure) -> None:
        axes = figure_.subplots()
        number = 0
        for world in study.worlds:
            for tracker in study.trackers:
                cells = [c for c in study.cells if c.world == world]
                x = [float(c.point[along]) for c in cells]
                values = np.array([found[c.index, tracker].times(unit.factor) for c in cells])
                colour, mark = LINES[number % len(LINES)], MARKS[number % len(MARKS)]
                number += 1
                if np.isnan(values[:, 0]).all():
                    continue
                name = tracker if len(study.worlds) == 1 else f"{world}: {tracker}"
                axes.plot(x, values[:, 0], color=colour, marker=mark, markersize=4, label=literal(name))
                axes.fill_between(x, values[:, 1], values[:, 2], color=colour, alpha=0.18, linewidth=0)
        low, high = min(study.grid[along]), max(study.grid[along])
        if low > 0 and high / low >= 8:
            axes.set_xscale("log")
            axes.set_xticks(sorted(study.grid[along]), [f"{v:g}" for v in sorted(study.grid[along])])
            axes.xaxis.set_minor_locator(NullLocator())
        axes.set(xlabel=literal(short(along)), ylim=(0, None))
        axes.set_title(_title(figure, unit.name))
        axes.legend(loc="best")
        plain(axes)

    return drawn(draw)


def _bars(results: Results, figure: str) -> str:
    """Points with intervals, a row for every cell and tracker."""
    study = results.study
    rows = [(c, t) for c in study.cells for t in study.trackers]
    found = [results.at(figure, c, t) for c, t in rows]
    unit = unit_of(figure, [v.value for v in found])
    values = np.array([v.times(unit.factor) for v in found])

    def draw(figure_: Figure) -> None:
        axes = figure_.subplots()
        trackers = list(study.trackers)
        for k, (_, tracker) in enumerate(rows):
            colour = LINES[trackers.index(tracker) % len(LINES)]
            mark = MARKS[trackers.index(tracker) % len(MARKS)]
            axes.plot(values[k, 1:], [k, k], color=colour, linewidth=3, alpha=0.35, solid_capstyle="butt")
            axes.plot(values[k, 0], k, color=colour, marker=mark, markersize=5)
        axes.set_yticks(range(len(rows)), [literal(_row_name(results, c, t)) for c, t in rows])
        axes.invert_yaxis()
        axes.set_xlim(left=0)
        axes.set_title(_title(figure, unit.name))
        plain(axes, "x")

    return drawn(draw, WIDTH, max(1.3, 0.75 + 0.24 * len(rows)))


def distribution_chart(results: Results, cell: Cell) -> str:
    """The share of estimates whose error is at most so large, of every tracker in a cell."""
    study = results.study

    def draw(figure_: Figure) -> None:
        axes = figure_.subplots()
        kind = _kind(results, cell)
        unit = unit_of(f"median_{kind}", [results.at(f"median_{kind}", cell, t).value for t in study.trackers])
        end = 0.0
        for number, tracker in enumerate(study.trackers):
            if kind not in results.kept[cell.index, tracker].histograms:
                continue
            edges, share = results.cdf(cell.world, tracker, kind, **cell.point)
            end = max(end, float(edges[np.searchsorted(share, 0.98)]) * unit.factor)
            axes.plot(edges * unit.factor, share, color=LINES[number % len(LINES)], label=literal(tracker))
        axes.set(xlim=(0, end), ylim=(0, 1), xlabel=f"error, {unit.name}")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_title(literal(f"Share of estimates with less error: {cell.label}"))
        axes.legend(loc="lower right")
        plain(axes, "both")

    return drawn(draw, WIDTH, HEIGHT)


def _kind(results: Results, cell: Cell) -> str:
    """The kind of errors that the study's figures are about: of the first that names one, else what there is."""
    there = {k for t in results.study.trackers for k in results.kept[cell.index, t].histograms}
    # The longer suffixes first: `3d_m` ends in `m` too.
    kinds = sorted(there, key=len, reverse=True)
    asked = (k for f in results.study.figures for k in kinds if f.endswith(f"_{k}"))
    return next(asked, next(k for k in KINDS if k in there))


def _axis(results: Results) -> str | None:
    """The one name of the grid, where its values are numbers and more than two."""
    grid = results.study.grid
    if len(grid) != 1:
        return None
    name, values = next(iter(grid.items()))
    numbers: Sequence[object] = [v for v in values if isinstance(v, (int, float)) and not isinstance(v, bool)]
    return name if len(numbers) == len(values) > 2 else None


def _row_name(results: Results, cell: Cell, tracker: str) -> str:
    return tracker if len(results.study.cells) == 1 else f"{cell.label}: {tracker}"


def _title(figure: str, unit: str) -> str:
    words = heading(figure)
    return literal(words[0].upper() + words[1:] + (f", {unit}" if unit else ""))
