"""Charts of a fit: floor plans and errors before and after, the objective along the steps and over parameters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.pages.charts import style
from trackwright.experiments.pages.charts.distributions import Curve, distribution
from trackwright.experiments.pages.charts.floor import plan, track_paths, true_path
from trackwright.experiments.pages.charts.style import Chart, Field, Line, band, broken_at_gaps, is_logarithmic
from trackwright.experiments.pages.reports.before_after import ErrorTrack, TrackChange
from trackwright.experiments.pages.scored_tracks import root_mean_square
from trackwright.experiments.text.wording import fixed, length_unit, number
from trackwright.trackers.core.wording import counted
from trackwright.tuning.sweeping import Sweep

ELLIPSES, POINTS, LAGS = 12, 1000, 30
"""The most ellipses of a side in a floor plan, about the most points of a path or line, and lags of NIS, rows."""

SHOWN, MOST = 6, 24
"""The most trajectories whose errors are drawn over time, and whose RMSE is drawn."""


class OptimiserTrace(NamedTuple):
    """The steps from one start: the objective (i,) and the physical values (i, p) of the parameters."""

    objective: np.ndarray
    values: np.ndarray


def plan_chart(change: TrackChange) -> Chart:
    """Paths before and after, 95 % ellipses of the same moments on both, truth, anchors, stations and walls."""
    unit = length_unit(float(np.max(change.rmse)))
    rmse = " → ".join(fixed(unit.factor * x, unit.digits) for x in change.rmse) + f" {unit.name}"
    words = [
        f"RMSE {rmse}" * bool(np.isfinite(change.rmse).any()),
        "held out" if change.held_out else "tuned on",
        change.why,
    ]
    looks = [(k, colour, f"95 % ellipses {k}") for k, colour in (("before", style.BEFORE), ("after", style.BLUE))]
    paths = track_paths([change.before, change.after], change.track, looks, ELLIPSES, POINTS)
    look: dict[str, Any] = {"width": 5.0, "caption": f"{'; '.join(filter(None, words))}."}
    truths, rig = true_path(change.after, change.track), change.after.folder.rig
    return plan("plan", f"Floor plan of {change.errors.name}", paths, truths, rig, **look)


def rmse_chart(errors: Sequence[ErrorTrack], unit: str) -> Chart:
    """RMSE of every trajectory before and after, the largest on top."""
    rows = sorted((root_mean_square(e.before), root_mean_square(e.after), _short(e.name)) for e in errors)[-MOST:]
    old, new, names = (np.array(column) for column in zip(*rows, strict=True))
    places, worse = np.arange(len(rows)), new > old
    parts = [Line(old, places, "before", style.BEFORE, 0.0, marker="circle-open", size=6)]
    for which, colour, label in ((~worse, style.BLUE, "after"), (worse, style.VERMILION, "after, larger")):
        if which.any():
            along = np.stack([old, new, np.full(len(rows), np.nan)], 1)[which].ravel()
            parts.append(Line(along, np.repeat(places[which], 3), "", colour, 1.6, opacity=0.6))
            parts.append(Line(new[which], places[which], label, colour, 0.0, marker="circle", size=6))
    caption = "RMSE of each trajectory; vermilion where it increased."
    caption += f" The {MOST} largest are shown." if len(errors) > MOST else ""
    look: dict[str, Any] = {"yticks": dict(enumerate(names)), "height": max(2.0, 1.0 + 0.24 * len(rows))}
    ends, title = ((0, None), (-0.6, len(rows) - 0.4)), "RMSE of trajectories"
    return Chart("rmse", title, f"RMSE ({unit})", "", parts, *ends, caption=caption, **look)


def distribution_chart(errors: Sequence[ErrorTrack], unit: str) -> Chart:
    """Distribution functions of the errors of all rows, before and after."""
    curves = []
    for side in ("before", "after"):
        curve = Curve.of(side, np.concatenate([getattr(track, side) for track in errors]))
        curves.append(curve._replace(name=f"{side}: 95 % within {curve.quantiles([95.0])[0]:.3g} {unit}"))
    end = 1.05 * max(float(curve.quantiles([99.0])[0]) for curve in curves)
    looks = {"colour": style.BEFORE}, {"colour": style.BLUE}
    title, quantity = "Distribution of errors of all rows", f"error ({unit})"
    return distribution("distribution", title, curves, quantity, end, (95.0,), looks)


def error_charts(errors: Sequence[ErrorTrack], unit: str) -> list[Chart]:
    """The errors over time, for the trajectories whose RMSE changed most; of long ones root mean squares of blocks."""
    changes, charts = [abs(root_mean_square(e.after) - root_mean_square(e.before)) for e in errors], []
    for track in (errors[k] for k in np.argsort(np.negative(changes), kind="stable")[:SHOWN]):
        starts = np.arange(0, len(track.times), -(-len(track.times) // POINTS))
        of_blocks = np.stack([track.times, track.before**2, track.after**2])
        means = np.add.reduceat(of_blocks, starts, axis=1) / np.diff([*starts, len(track.times)])
        at, old, new = broken_at_gaps(means[0], *np.sqrt(means[1:]))
        parts = [Line(at, old, "before", style.BEFORE, 0.9), Line(at, new, "after", style.BLUE, 1.2)]
        labels = f"Error of {_short(track.name)} over time", "time since the start (s)", f"error ({unit})"
        charts.append(Chart("errors", *labels, parts, ylim=(0, None), robust=True, height=2.1))
    return charts


def _short(name: str) -> str:
    return name if len(name) <= 34 else name[:16] + "…" + name[-17:]


def objective_chart(traces: Sequence[OptimiserTrace], title: str, selected: int | None = None) -> Chart:
    """The objective at every step of every start, the best first; `selected`: the one chosen, by default the last."""
    # A start with a far larger objective must not flatten all others.
    least, top = min(float(np.nanmin(t.objective)) for t in traces), float(np.nanmax(traces[0].objective))
    margin = 0.06 * (top - least) or 0.1 * abs(least) or 1.0
    step = int(np.flatnonzero(np.isfinite(traces[0].objective))[-1]) if selected is None else selected
    value = float(traces[0].objective[step])
    parts = [
        *_steps([t.objective for t in traces]),
        Line([step], [value], f"selected: {number(value)}", width=0, marker="circle"),
    ]
    look: dict[str, Any] = {"ylim": (least - margin, top + margin)}
    return Chart("tuning", f"Objective from {counted(len(traces), 'start')}", "step", title, parts, **look)


def parameter_chart(traces: Sequence[OptimiserTrace], k: int, name: str, unit: str) -> Chart:
    """Parameter `k` at every step of every start, on a logarithmic axis where it is positive."""
    values = [t.values[:, k] for t in traces]
    look: dict[str, Any] = {
        "log": "y" * is_logarithmic(np.concatenate(values)),
        "width": style.NARROW,
        "height": 0.62 * style.NARROW,
    }
    return Chart(f"tuning-{name}", named(name, unit), "step", "", _steps(values), **look)


def _steps(traces: Sequence[np.ndarray]) -> list[Line]:
    words = {0: "best start", 1: "other starts"} if len(traces) > 1 else {}
    lines = [(k, np.arange(len(values)), values) for k, values in enumerate(traces)][::-1]
    return [Line(x, y, words.get(k, ""), style.PALE if k else style.BLUE, 1.1 if k else 1.8) for k, x, y in lines]


def selected_step(best: OptimiserTrace, after: Sequence[float]) -> int:
    """The step of the best start nearest to the selected point."""
    size = np.maximum(np.abs(after), np.finfo(float).tiny)
    return int(np.argmin((np.abs(best.values - after) / size).max(axis=1)))


def sweep_plot(path: Path | str, swept: Sweep, objective: str) -> Path:
    """Writes the objective over the grid, its minimum marked, with its spread over repeats; returns the path.

    `objective`: its name and unit. Raises UnusableInput where the file can't be written.
    """
    from trackwright.experiments.pages.charts.drawing import write

    mean, at, path = swept.mean, swept.best_index, Path(path)
    best = [float(grid[k]) for grid, k in zip(swept.grids, at, strict=True)]
    shown = ", ".join(f"{p.label} = {x:.4g}" for p, x in zip(swept.parameters, best, strict=True))
    labels = [named(p.label, p.example.unit) for p in swept.parameters]
    spread = swept.spread if len(swept.values) > 1 else None
    title = f"{objective}: minimum {mean[at]:.5g} at {shown}"
    return write(_objective(path.stem, title, labels, swept.grids, mean, best, objective, spread), path)


def named(name: str, unit: str) -> str:
    """Name and unit of a parameter, for an axis."""
    return name + (f" ({unit})" if unit not in ("", "1") else "")


def _objective(
    name: str, title: str, labels: Sequence[str], grids: Sequence[np.ndarray], values: np.ndarray,
    best: Sequence[float], objective: str, spread: np.ndarray | None = None,
) -> Chart:  # fmt: skip
    """The objective over one parameter (n,) as a curve, or over two (n, m) as contours; `best`: the marked point.

    `spread` (n,): over repeats. Levels of contours are equidistant in the square root of the excess over the minimum:
    evenly spaced for a quadratic.
    """
    least, parts = float(np.nanmin(values)), list[Line | Field]()
    log = "".join(axis for axis, grid in zip("xy", grids, strict=False) if is_logarithmic(grid))
    xlim, ylim = [(float(grid[0]), float(grid[-1])) for grid in grids] if len(grids) == 2 else [(None, None)] * 2
    if len(labels) == 1:
        (grid,) = grids
        if spread is not None:
            parts.append(band(grid, values - spread, values + spread, "± standard deviation over repeats"))
        parts.append(Line(grid, values, "", style.INK, 1.4, marker="circle" * (len(grid) <= 40), size=3.5))
        best, labels = [*best, least], [*labels, objective]
    else:
        excess = np.sqrt(np.maximum(values - least, 0.0))
        levels = np.linspace(0, float(np.nanquantile(excess, 0.97)) or 1.0, 12)
        ticks = {float(level): f"{least + level**2:.4g}" for level in levels}
        parts.append(Field(grids[0], grids[1], excess.T, objective, "Blues", 0.0, float(levels[-1]), ticks))
    parts.append(Line([best[0]], [best[1]], "minimum", style.VERMILION, 0.0, marker="circle", size=8))
    return Chart(name, title, labels[0], labels[1], parts, xlim, ylim, log=log, height=3.6)
