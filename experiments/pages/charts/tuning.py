"""Charts of a fit: floor plans and errors before and after, the objective along the steps and over parameters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from trackwright.experiments.pages.charts.distributions import (
    Curve,
    draw_autocorrelation,
    draw_distributions,
    draw_nis,
    draw_probabilities,
)
from trackwright.experiments.pages.charts.floor import draw_plan, track_paths, true_path
from trackwright.experiments.pages.charts.style import (
    BEFORE,
    BLUE,
    INK,
    NARROW,
    SKY,
    VERMILION,
    WIDTH,
    Chart,
    broken_at_gaps,
    legend_above,
    literal,
    logarithmic,
    plain,
)
from trackwright.experiments.pages.reports.before_after import ErrorTrack, TrackChange
from trackwright.experiments.pages.scored_tracks import root_mean_square
from trackwright.experiments.text.wording import number
from trackwright.trackers.core.wording import counted
from trackwright.tuning.diagnostics import Innovations
from trackwright.tuning.sweeping import Surface, Sweep

PALE = "#c3ccd6"
POINTS = 250
ELLIPSES, PLAN_POINTS = 12, 1000
"""The most ellipses of a side in a floor plan, and about the most points of a path."""

SHOWN, MOST = 6, 24
"""The most trajectories whose errors are drawn over time, and whose RMSE is drawn."""


BEST: dict[str, Any] = {"color": VERMILION, "markersize": 8, "markeredgecolor": "white", "clip_on": False, "zorder": 5}
"""The mark of the best point."""


class OptimiserTrace(NamedTuple):
    """The steps from one start: the objective (i,) and the physical values (i, p) of the parameters."""

    objective: np.ndarray
    values: np.ndarray


def plan_chart(change: TrackChange) -> Chart:
    """Paths before and after, 95 % ellipses of the same moments on both, truth, anchors, stations and walls."""
    words = [change.rmse and f"RMSE {change.rmse}", "held out" if change.held_out else "tuned on", change.why]

    def draw(axes: Axes) -> None:
        looks = [(k, colour, f"95 % ellipses {k}") for k, colour in (("before", BEFORE), ("after", BLUE))]
        paths = track_paths([change.before, change.after], change.track, looks, ELLIPSES, PLAN_POINTS)
        draw_plan(axes, paths, true_path(change.after, change.track), change.after.folder.rig)
        legend_above(axes, 3)
        axes.set_title(literal(change.name), pad=30)

    return Chart("plan", f"Floor plan of {change.name}", draw, WIDTH, None, f"{'; '.join(filter(None, words))}.")


def innovation_charts(before: Innovations, after: Innovations) -> list[Chart]:
    """NIS against its distribution, its probabilities, and its autocorrelation."""

    def histograms(axes: Axes) -> None:
        draw_nis(axes, after, before)
        axes.set_title("NIS of all rows")
        plain(axes, "")

    size = NARROW, NARROW * 0.92
    probabilities = partial(draw_probabilities, before=before, after=after)
    lags = partial(draw_autocorrelation, before=before, after=after)
    return [
        Chart(
            "nis",
            "NIS against its distribution",
            histograms,
            *size,
            "An overconfident filter has more large values than the vermilion line.",
        ),
        Chart(
            "probabilities",
            "Probabilities of NIS",
            probabilities,
            *size,
            "The same values as probabilities, uniform for a consistent filter. Bars that rise to the right: reported "
            "covariances too small; to the left: too large.",
        ),
        Chart(
            "autocorrelation",
            "Autocorrelation of NIS",
            lags,
            *size,
            "Points above the band: errors are correlated in time, contrary to the model's white noise. Computed from "
            "NIS transformed to standard normal values, since the signs of innovations are not stored.",
        ),
    ]


def rmse_chart(errors: Sequence[ErrorTrack], unit: str) -> Chart:
    """RMSE of every trajectory before and after, the largest on top."""
    rows = sorted((root_mean_square(e.before), root_mean_square(e.after), _short(e.name)) for e in errors)[-MOST:]
    old, new, names = (np.array(column) for column in zip(*rows, strict=True))
    places, worse = np.arange(len(rows)), new > old

    def draw(axes: Axes) -> None:
        for k in places:
            colour = VERMILION if worse[k] else BLUE
            axes.plot([old[k], new[k]], [k, k], color=colour, linewidth=1.6, alpha=0.6, zorder=1)
        axes.plot(old, places, "o", markerfacecolor="white", color=BEFORE, markersize=6, label="before")
        for which, colour, label in ((~worse, BLUE, "after"), (worse, VERMILION, "after, larger")):
            if which.any():
                axes.plot(new[which], places[which], "o", color=colour, markersize=6, label=label)
        axes.set_yticks(places, [literal(name) for name in names])
        axes.set(xlabel=f"RMSE ({unit})", ylim=(-0.6, len(rows) - 0.4), xlim=(0, 1.06 * max(old.max(), new.max())))
        legend_above(axes, 3)
        plain(axes, "x")

    caption = "RMSE of each trajectory; vermilion where it increased."
    caption += f" The {MOST} largest are shown." if len(errors) > MOST else ""
    return Chart("rmse", "RMSE of trajectories", draw, WIDTH, max(2.0, 1.0 + 0.24 * len(rows)), caption)


def distribution_chart(errors: Sequence[ErrorTrack], unit: str) -> Chart:
    """Distribution functions of the errors of all rows, before and after."""
    curves = []
    for name in ("before", "after"):
        curve = Curve.of(name, np.concatenate([getattr(track, name) for track in errors]))
        curves.append(curve._replace(name=f"{name}: 95 % within {curve.quantiles([95.0])[0]:.3g} {unit}"))

    def draw(axes: Axes) -> None:
        end = 1.05 * max(float(curve.quantiles([99.0])[0]) for curve in curves)
        looks = {"color": BEFORE, "linewidth": 1.3}, {"color": BLUE, "linewidth": 1.9}
        draw_distributions(axes, curves, f"error ({unit})", end, (95.0,), looks)
        axes.legend(loc="lower right")
        axes.set_title("Distribution of errors of all rows")
        plain(axes)

    return Chart("distribution", "Distribution of errors", draw, caption="All rows pooled.")


def error_charts(errors: Sequence[ErrorTrack], unit: str) -> list[Chart]:
    """The errors over time, for the trajectories whose RMSE changed most."""
    changes = [abs(root_mean_square(e.after) - root_mean_square(e.before)) for e in errors]
    chosen = [errors[k] for k in np.argsort(np.negative(changes), kind="stable")[:SHOWN]]
    top = 1.05 * float(np.nanquantile(np.concatenate([x for e in chosen for x in (e.before, e.after)]), 0.998)) or 1.0

    def draw(axes: Axes, track: ErrorTrack) -> None:
        at, old, new = broken_at_gaps(*_smooth(track))
        axes.plot(at, old, color=BEFORE, linewidth=0.9, label="before")
        axes.plot(at, new, color=BLUE, linewidth=1.2, label="after")
        axes.set_title(literal(_short(track.name)))
        axes.set(ylim=(0, top), xlabel="time since the start (s)", ylabel=f"error ({unit})")
        axes.margins(x=0.01)
        axes.legend(loc="lower right", bbox_to_anchor=(1.01, 1.0), ncols=2)
        plain(axes)

    return [Chart("errors", f"Error of {e.name} over time", partial(draw, track=e), height=2.1) for e in chosen]


def _smooth(track: ErrorTrack) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times and errors; of long trajectories the root mean squares of at most `POINTS` blocks of rows."""
    rows = -(-len(track.times) // POINTS)
    starts = np.arange(0, len(track.times), rows)
    count = np.add.reduceat(np.ones(len(track.times)), starts)
    old, new = (np.sqrt(np.add.reduceat(values**2, starts) / count) for values in (track.before, track.after))
    return np.add.reduceat(track.times, starts) / count, old, new


def _short(name: str) -> str:
    return name if len(name) <= 34 else name[:16] + "…" + name[-17:]


def objective_chart(traces: Sequence[OptimiserTrace], title: str, selected: int | None = None) -> Chart:
    """The objective at every step of every start, the best first; `selected`: the one chosen, by default the last."""

    def draw(axes: Axes) -> None:
        _draw_steps(axes, [t.objective for t in traces])
        shown = np.concatenate([t.objective for t in traces])
        shown = shown[np.isfinite(shown)]
        best, longest = float(shown.min()), max(len(t.objective) for t in traces)
        # A start with a far larger objective must not flatten all others.
        usual = best + 6 * float(np.quantile(shown, 0.75) - best) or np.inf
        top = max(float(np.nanmax(traces[0].objective)), min(float(shown.max()), usual))
        margin = 0.06 * (top - best) or 0.1 * abs(best) or 1.0
        axes.set(xlabel="step", ylim=(best - margin, top + margin))
        axes.set_title(literal(title))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        step = int(np.flatnonzero(np.isfinite(traces[0].objective))[-1]) if selected is None else selected
        value = float(traces[0].objective[step])
        axes.plot([step], [value], "o", color=BLUE, markersize=6, markeredgecolor="white", zorder=3)
        axes.annotate(
            number(value), (step, value), xytext=(0, 7), textcoords="offset points",
            ha="right" if step > 0.5 * longest else "left", color=BLUE, fontsize=9, fontweight="bold",
        )  # fmt: skip
        if len(traces) > 1:
            axes.legend(*(x[::-1] for x in axes.get_legend_handles_labels()), loc="upper right")
        plain(axes)

    return Chart("tuning", "Objective", draw, caption=f"Objective at every step, from {counted(len(traces), 'start')}.")


def parameter_chart(traces: Sequence[OptimiserTrace], k: int, name: str, unit: str) -> Chart:
    """Parameter `k` at every step of every start, on a logarithmic axis where it is positive."""

    def draw(axes: Axes) -> None:
        _draw_steps(axes, [t.values[:, k] for t in traces])
        axes.set_title(named(name, unit))
        scale_axis(axes, np.concatenate([t.values[:, k] for t in traces]), "y")
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set_xlabel("step")
        plain(axes)

    return Chart(f"tuning-{name}", name, draw, NARROW, 0.62 * NARROW)


def _draw_steps(axes: Axes, traces: Sequence[np.ndarray]) -> None:
    for k, values in reversed(list(enumerate(traces))):
        label = {0: "best start", 1: "other starts"}.get(k)
        axes.plot(values, color=BLUE if k == 0 else PALE, linewidth=1.8 if k == 0 else 1.1, label=label)


def selected_step(best: OptimiserTrace, after: Sequence[float]) -> int:
    """The step of the best start nearest to the selected point."""
    size = np.maximum(np.abs(after), np.finfo(float).tiny)
    return int(np.argmin((np.abs(best.values - after) / size).max(axis=1)))


def surface_chart(
    surface: Surface, names: Sequence[str], labels: Sequence[str], best: Sequence[float], objective: str,
    traces: Sequence[OptimiserTrace],
) -> Chart:  # fmt: skip
    """The objective over one parameter as a curve, over two as contours with the steps of all starts."""
    paths = [t.values[:, list(surface.axes)] for t in traces]

    def draw(axes: Axes) -> None:
        draw_objective(axes, labels, surface.grids, surface.values, best, objective, paths)

    over = f" over {' and '.join(names)}"
    what = "Contours of the objective" if len(names) == 2 else "Objective"
    caption = f"{what}{over}, with the optimiser's steps; other parameters at their tuned values."
    return Chart("surface", f"Objective{over}", draw, WIDTH, 3.6, caption)


def sweep_plot(path: Path | str, swept: Sweep, objective: str) -> Path:
    """Writes the objective over the grid, its minimum marked, with its spread over repeats; returns the path.

    `objective`: its name and unit. Raises UnusableInput where the file can't be written.
    """
    mean, at = swept.mean, swept.best_index
    best = [float(grid[k]) for grid, k in zip(swept.grids, at, strict=True)]
    labels = [named(p.label, p.example.unit) for p in swept.parameters]
    spread = swept.spread if len(swept.values) > 1 else None
    shown = ", ".join(f"{p.label} = {x:.4g}" for p, x in zip(swept.parameters, best, strict=True))

    def draw(axes: Axes) -> None:
        draw_objective(axes, labels, swept.grids, mean, best, objective, (), spread)
        axes.set_title(literal(f"minimum {mean[at]:.5g} at {shown}"), fontsize=9)

    return Chart("sweep", f"Sweep: {objective}", draw, 7.0, 4.6).write(path)


def named(name: str, unit: str) -> str:
    """Name and unit of a parameter, for an axis."""
    return literal(name + (f" ({unit})" if unit not in ("", "1") else ""))


def draw_objective(
    axes: Axes,
    labels: Sequence[str],
    grids: Sequence[np.ndarray],
    values: np.ndarray,
    best: Sequence[float],
    name: str,
    paths: Sequence[np.ndarray] = (),
    spread: np.ndarray | None = None,
) -> None:
    """The objective `name` over one parameter (n,) as a curve, or over two (n, m) as contours.

    `best`: the point that is marked. `paths`: optimiser traces (i, p), the best one first; along a curve they are drawn
    at its values, since a fit may have had another objective. `spread` (n,): over repeats. Levels of contours are
    equidistant in the square root of the excess over the minimum: evenly spaced for a quadratic.
    """
    curve, height = len(labels) == 1, float(np.nanmin(values))
    if curve:
        (grid,) = grids
        if spread is not None:
            label = "± standard deviation over repeats"
            axes.fill_between(grid, values - spread, values + spread, color=SKY, alpha=0.35, linewidth=0, label=label)
        axes.plot(grid, values, color=INK, linewidth=1.4, marker="o" if len(grid) <= 40 else "", markersize=3.5)
        paths = [np.column_stack([path, np.interp(path[:, 0], grid, values, np.nan, np.nan)]) for path in paths]
        axes.set_ylabel(literal(name))
    else:
        above = values[np.isfinite(values)] - height
        top = float(np.quantile(above, 0.97)) or float(above.max()) or 1.0
        levels = height + np.linspace(0, np.sqrt(top), 12) ** 2
        shown = np.where(np.isfinite(values), values, np.nan).T
        filled = axes.contourf(*grids, shown, levels=levels, cmap="Blues_r", extend="max", alpha=0.75)
        bar = axes.figure.colorbar(filled, ax=axes, ticks=levels[::3], format="%.4g", pad=0.02, aspect=30)
        bar.set_label(literal(name), fontsize=8)
        bar.outline.set_visible(False)  # type: ignore[operator]
        axes.contour(*grids, shown, levels=levels, colors="white", linewidths=0.6, linestyles="solid")
        axes.grid(visible=False)
        scale_axis(axes, grids[1], "y", tight=True)
        axes.set_ylabel(labels[1])
    for k, path in reversed(list(enumerate(paths))):
        colour, size, width, alpha = (VERMILION, 4.5, 1.2, 1.0) if k == 0 else (INK, 2.5, 0.6, 0.5)
        label = {0: "best start" if len(paths) > 1 else "optimiser steps", 1: "other starts"}.get(k, "_")
        axes.plot(*path.T, ".-", color=colour, markersize=size, linewidth=width, alpha=alpha, label=label)
    axes.plot(*best, *([height] if curve else []), "o", **BEST)
    handles, texts = axes.get_legend_handles_labels()
    if texts:
        place = {"loc": "best"} if curve else {"loc": "lower left", "bbox_to_anchor": (-0.01, 1.0), "ncols": 3}
        axes.legend(handles[::-1], texts[::-1], **place)
    scale_axis(axes, grids[0], "x", tight=not curve)
    axes.set_xlabel(labels[0])


def scale_axis(axes: Axes, values: np.ndarray, which: str, tight: bool = False) -> None:
    """Scales the axis x or y: logarithmic where all values are positive and the largest is five times the least."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low > 0 and high > 5 * low:
        logarithmic(axes, which)
        factor = 1.0 if tight else (high / low) ** 0.06
        axes.set(**{f"{which}lim": (low / factor, high * factor)})
        return
    (axes.xaxis if which == "x" else axes.yaxis).set_major_locator(MaxNLocator(5))
    margin = 0.0 if tight and high > low else 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    axes.set(**{f"{which}lim": (low - margin, high + margin)})
