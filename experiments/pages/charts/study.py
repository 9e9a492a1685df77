"""Charts of a study: metrics with intervals over its conditions or along its grid, and distributions of errors."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from trackwright.experiments.monte_carlo.declaration import WORLD, Condition, short
from trackwright.experiments.monte_carlo.results import Results
from trackwright.experiments.pages.charts.distributions import Curve, draw_distributions
from trackwright.experiments.pages.charts.style import HEIGHT, INK, LINES, Chart, literal, logarithmic, plain
from trackwright.experiments.text.expectations import Value
from trackwright.experiments.text.wording import Unit, heading, unit_of
from trackwright.trackers.evaluation.metrics import ERROR_KINDS, METRICS

MARKS, DASHES = "osD^vPX", ("-", "--", "-.", ":")
"""Their counts differ from that of the colours: combinations of the three repeat late, and trackers look different."""

SHOWN_CONDITIONS, LINES_SHOWN, ROWS_SHOWN, NAMES_INSIDE = 6, 8, 40, 4
"""The most conditions with distributions, lines in a chart, rows in a chart, and names in a legend inside the axes."""

UNITS = ("rad/s", "m/s²", "m/s", "rad", "Hz", "m", "s")
"""Units of worlds' parameters in their docstrings; longer ones first."""

DECADES = 30.0
"""Ratio of the largest to the smallest value from which an axis is logarithmic."""


def metric_chart(
    results: Results,
    metric: str,
    by_condition: Mapping[tuple[int, str], Value],
    unit: Unit,
    bounds: Mapping[tuple[int, str], Value] | None = None,
) -> Chart | None:
    """A metric with its intervals: along the grid where that is one list of numbers, else by condition.

    None where a chart has no room for all lines or rows, and where all values are zero or missing. `bounds`: Cramér–Rao
    bounds on the metric, drawn as lines, or as strokes in rows.
    """
    study, along = results.study, _axis(results)
    values = {k: np.array(v.times(unit.factor)) for k, v in by_condition.items() if np.isfinite(v.value)}
    lines = len(study.worlds) * len(study.trackers)
    room = len(values) <= ROWS_SHOWN if along is None else lines <= LINES_SHOWN
    if not room or not any(v[0] for v in values.values()):
        return None
    limits = {k: v.value * unit.factor for k, v in (bounds or {}).items() if np.isfinite(v.value)}
    right = METRICS[metric].right if metric in METRICS else None
    words = heading(metric)
    title = words[0].upper() + words[1:] + (f", {unit.name}" if unit.name else "")
    drawn = _Drawn(results, values, limits, title, None if right is None else right * unit.factor)
    if along is None:
        return Chart(metric, title, drawn.rows, height=max(1.3, 0.75 + 0.24 * len(values)))
    return Chart(metric, title, partial(drawn.lines, along=along), height=_height(lines))


class _Drawn(NamedTuple):
    """What a chart of a metric shows: values with intervals, bounds, and the `target` of the metric, if any."""

    results: Results
    values: Mapping[tuple[int, str], np.ndarray]
    limits: Mapping[tuple[int, str], float]
    title: str
    target: float | None

    def scale(self, axes: Axes, which: str) -> None:
        """From zero, or logarithmic where all values and intervals are positive and span more than `DECADES`."""
        pooled = np.concatenate(list(self.values.values()))
        low, high = np.nanmin(pooled), np.nanmax(pooled)
        if low > 0 and high >= DECADES * low:
            logarithmic(axes, which)
        elif which == "x":
            axes.set_xlim(0, 1.04 * max(self.target or 0.0, float(high)))
        else:
            axes.set_ylim(0, None)

    def lines(self, axes: Axes, along: str) -> None:
        """A line with its band for every world and tracker, over the grid, its bound, and the target."""
        study = self.results.study
        for number, (world, tracker) in enumerate((w, t) for w in study.worlds for t in study.trackers):
            there = [c for c in study.conditions if c.world == world and (c.index, tracker) in self.values]
            if not there:
                continue
            middle, low, high = np.array([self.values[c.index, tracker] for c in there]).T
            look, x = _look(number), [float(c.point[along]) for c in there]
            name = tracker if len(study.worlds) == 1 else f"{world}: {tracker}"
            axes.plot(x, middle, **look, marker=MARKS[number % len(MARKS)], markersize=4, label=literal(name))
            axes.fill_between(x, low, high, color=look["color"], alpha=0.18, linewidth=0)
            bound = np.array([self.limits.get((c.index, tracker), np.nan) for c in there])
            if np.isfinite(bound).any():
                label = literal(f"{name}: Cramér–Rao bound")
                axes.plot(x, bound, color=look["color"], linestyle=":", linewidth=1.3, label=label)
        grid = sorted(study.grid[along])
        if grid[0] > 0 and grid[-1] / grid[0] >= 8:
            axes.set_xscale("log")
            axes.set_xticks(grid, [f"{v:g}" for v in grid])
            axes.xaxis.set_minor_locator(NullLocator())
        if self.target is not None:
            axes.axhline(self.target, color=INK, linewidth=0.9, linestyle="--", label=f"{self.target:g} expected")
        axes.set_xlabel(literal(short(along) + _unit_of(self.results, along)))
        self.scale(axes, "y")
        axes.set_title(literal(self.title))
        _legend(axes)
        plain(axes)

    def rows(self, axes: Axes) -> None:
        """Points with intervals, a row for every condition and tracker, strokes for bounds, a line at the target."""
        study, names = self.results.study, list[str]()
        for condition in study.conditions:
            for number, tracker in enumerate(study.trackers):
                key, k = (condition.index, tracker), len(names)
                if key not in self.values:
                    continue
                colour, (middle, low, high) = LINES[number % len(LINES)], self.values[key]
                axes.plot([low, high], [k, k], color=colour, linewidth=3, alpha=0.35, solid_capstyle="butt")
                mark = MARKS[number % len(MARKS)]
                axes.plot(middle, k, color=colour, marker=mark, markersize=5, clip_on=False, zorder=3)
                if key in self.limits:
                    axes.plot(self.limits[key], k, "|", color=INK, markersize=9, markeredgewidth=1.6)
                parts = [condition.label] * (len(study.conditions) > 1) + [tracker] * (len(study.trackers) > 1)
                names.append(literal(": ".join(parts) or condition.label))
        if self.target is not None:
            axes.axvline(self.target, color=INK, linewidth=0.9, linestyle="--", zorder=0)
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.4, -0.6)
        self.scale(axes, "x")
        line = f" (line: {self.target:g})" if self.target is not None else ""
        axes.set_title(literal(self.title + (" (strokes: Cramér–Rao bound)" if self.limits else "") + line))
        plain(axes, "x")


def distribution_charts(results: Results, lengths: Unit | None) -> list[Chart]:
    """Distribution functions of every tracker's errors, for the first conditions.

    `lengths`: the page's unit of lengths, or None.
    """
    study, made = results.study, []
    for number, condition in enumerate(study.conditions[:SHOWN_CONDITIONS], 1):
        kind = _kind(results, condition)
        medians = [results.at(f"median_{kind}", condition, tracker).value for tracker in study.trackers]
        unit = lengths if lengths and kind.endswith("m") else unit_of(f"median_{kind}", medians)
        title = f"Distribution of errors: {condition.label}"
        draw = partial(_distributions, results=results, condition=condition, kind=kind, unit=unit, title=title)
        made.append(Chart(f"errors-{number}", title, draw, height=_height(len(study.trackers))))
    return made


def _distributions(axes: Axes, results: Results, condition: Condition, kind: str, unit: Unit, title: str) -> None:
    """The distribution of the errors of each tracker with errors of this kind, up to 98 % of the largest."""
    curves, looks = [], []
    for number, tracker in enumerate(results.study.trackers):
        if kind in results.totals[condition.index, tracker].histograms:
            edges, share = results.cdf(condition.world, tracker, kind, **condition.point)
            curves.append(Curve(tracker, edges * unit.factor, 100 * share))
            looks.append(_look(number))
    end = max(float(curve.errors[np.searchsorted(curve.shares, 98.0)]) for curve in curves)
    quantity = f"{f'error {ERROR_KINDS[kind]}'.strip()}, {unit.name}"
    draw_distributions(axes, curves, quantity, end, looks=looks)
    axes.set_title(literal(title))
    _legend(axes)
    plain(axes, "both")


def _unit_of(results: Results, along: str) -> str:
    """The unit of a world's parameter on the grid, ` (rad)`, as its docstring has it at the end of a phrase."""
    for name in along.split(","):
        key = name.strip().removeprefix(WORLD)
        for world in results.study.worlds.values():
            # Worlds by name are partial functions of those with the docstring.
            make = world.make.args[0] if isinstance(world.make, partial) else world.make
            about = re.search(rf"^ +{re.escape(key)}: ([^\n]*)", inspect.getdoc(make) or "", re.M)
            unit = re.search(rf", ({'|'.join(UNITS)})\b", about[1]) if about else None
            if unit:
                return f" ({unit[1]})"
    return ""


def _look(number: int) -> dict[str, Any]:
    """Colour and dashes of a line."""
    return {"color": LINES[number % len(LINES)], "linestyle": DASHES[number % len(DASHES)]}


def _legend(axes: Axes) -> None:
    """A legend inside the axes for few names, else below them, where it hides nothing."""
    if len(axes.get_legend_handles_labels()[1]) > NAMES_INSIDE:
        axes.figure.legend(loc="outside lower center", ncols=2, handlelength=2.4)
    else:
        axes.legend(loc="best", handlelength=2.4)


def _height(names: int) -> float:
    return HEIGHT + (0.17 * -(-names // 2) + 0.1 if names > NAMES_INSIDE else 0.0)


def _kind(results: Results, condition: Condition) -> str:
    """The kind of error of the first metric that has one, else the first kind that exists."""
    there = {k for t in results.study.trackers for k in results.totals[condition.index, t].histograms}
    # The longer suffixes first: `3d_m` ends in `m` too.
    kinds = sorted(there, key=len, reverse=True)
    asked = (k for f in results.study.metrics for k in kinds if f.endswith(f"_{k}"))
    return next(asked, next(k for k in ERROR_KINDS if k in there))


def _axis(results: Results) -> str | None:
    """The name of the grid's only axis, where that has more than two values, all numbers; else None."""
    grid = results.study.grid
    if len(grid) != 1:
        return None
    name, values = next(iter(grid.items()))
    numbers: Sequence[object] = [v for v in values if isinstance(v, (int, float)) and not isinstance(v, bool)]
    return name if len(numbers) == len(values) > 2 else None
