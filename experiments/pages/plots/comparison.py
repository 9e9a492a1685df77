"""Figures of a comparison of runs: distributions of their errors, boxes and violins, and floor plans side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trackwright.experiments.pages.plots.style import (
    BLACK,
    LINES,
    WIDTH,
    broken_at_gaps,
    figure_file,
    legend_above,
    literal,
    plain,
    svg_address,
)
from trackwright.experiments.pages.plots.tracks import TRUTH, draw_rig
from trackwright.experiments.pages.reports.comparison import Contrast
from trackwright.experiments.pages.reports.runs import StudyRun, TrackRun
from trackwright.experiments.pages.scored_tracks import drawn_of
from trackwright.experiments.text.wording import Unit, heading, length_unit, unit_of
from trackwright.trackers.recordings.columns import float_column

MOST_PLANS = 3
"""Recordings with floor plans: of more the worst, the median and the best by the RMSE of the first run."""

MOST_TAGS = 4
"""Tags of a floor plan."""

MOST_POINTS = 2000
"""Points of a distribution function, and errors of a violin."""


def plot_comparison(
    page: Path, runs: Sequence[StudyRun] | Sequence[TrackRun], contrasts: Sequence[Contrast], kind: str = "png"
) -> list[Path]:
    """Writes the figures beside the page, with its name before theirs; returns their paths.

    `kind`: the ending of the files, png or pdf.
    """
    tracks = [run for run in runs if isinstance(run, TrackRun) and run.errors]
    if tracks:
        plans = _floor_plans(_beside(page, "floor_plans", kind), [run for run in tracks if not run.bearing])
        return [_distributions(_beside(page, "errors", kind), tracks), *plans]
    wanted = bool(contrasts) and isinstance(runs[0], StudyRun)
    return [_intervals(_beside(page, "differences", kind), contrasts)] if wanted else []


def comparison_charts(
    runs: Sequence[StudyRun] | Sequence[TrackRun], contrasts: Sequence[Contrast]
) -> list[tuple[str, str]]:
    """The same figures for a page: the address of each panel as an image with its data, and words for the blind."""
    tracks = [run for run in runs if isinstance(run, TrackRun) and run.errors]
    if not tracks:
        wanted = bool(contrasts) and isinstance(runs[0], StudyRun)
        return [(svg_address(lambda figure: _draw_intervals(figure, contrasts)), "Differences")] if wanted else []
    furthest, unit = _scale(tracks)
    charts = [
        (
            svg_address(lambda figure: _draw_distributions(figure.subplots(), tracks, furthest, unit)),
            "Distribution of errors",
        ),
        (svg_address(lambda figure: _draw_violins(figure.subplots(), tracks, furthest, unit)), "Boxes of errors"),
    ]
    plans = [run for run in tracks if not run.bearing]

    def draw(figure: Figure, run: TrackRun, name: str, colour: str, why: str) -> None:
        axes = figure.subplots()
        _plan(axes, run, name, colour, why)
        axes.set(xlabel="x (m)", ylabel="y (m)")
        axes.set_title(axes.get_title("left"), pad=30)
        legend_above(axes, 3)

    for name, why in _planned(plans).items():
        height = _ratio(plans[0], name) * (WIDTH - 0.6) + 1.1
        for run, colour in zip(plans, _colours(len(plans)), strict=True):
            drawn = svg_address(partial(draw, run=run, name=name, colour=colour, why=why), WIDTH, height)
            charts.append((drawn, f"Floor plan of {name} by {run.name}"))
    return charts


def all_errors(run: TrackRun) -> np.ndarray:
    """The sorted horizontal errors, m, of all tracks, or the angles, rad, of bearings."""
    return np.sort(np.concatenate([track.error for track in run.errors.values()]))


def _distributions(path: Path, runs: Sequence[TrackRun]) -> Path:
    """Distribution functions of the errors of all runs, and boxes in violins."""
    furthest, unit = _scale(runs)
    with figure_file(path, 9.5, 4.0, "") as figure:
        left, right = figure.subplots(1, 2)
        _draw_distributions(left, runs, furthest, unit)
        _draw_violins(right, runs, furthest, unit)
    return path


def _scale(runs: Sequence[TrackRun]) -> tuple[float, Unit]:
    """The end of the axes of errors, in that unit, and the unit: the tail of one run alone shall not set it.

    The second largest 99th percentile of the runs, or the largest 95th where that is more.
    """
    p95, p99 = (sorted(float(np.quantile(all_errors(run), share)) for run in runs) for share in (0.95, 0.99))
    furthest = max(p95[-1], p99[-2:][0])
    unit = Unit("°", 180 / math.pi) if runs[0].bearing else length_unit(furthest / 2)
    return unit.factor * furthest, unit


def _quantity(runs: Sequence[TrackRun], unit: Unit) -> str:
    return f"{'angle to the true direction' if runs[0].bearing else 'horizontal error'} ({unit.name})"


def _draw_distributions(axes: Axes, runs: Sequence[TrackRun], furthest: float, unit: Unit) -> None:
    for run, colour in zip(runs, _colours(len(runs)), strict=True):
        own = unit.factor * all_errors(run)
        chosen = np.linspace(0, len(own) - 1, min(len(own), MOST_POINTS)).astype(int)
        beyond = 100 * np.mean(own > 1.02 * furthest)
        name = run.name + (f", {beyond:.1f} % beyond" if beyond >= 0.1 else "")
        axes.plot(own[chosen], 100 * (chosen + 1) / len(own), color=colour, label=literal(name))
    axes.set(xlim=(0, 1.02 * furthest), ylim=(0, 101), yticks=(0, 25, 50, 75, 90, 95, 100))
    axes.set(xlabel=_quantity(runs, unit), ylabel="estimates with at most this error (%)")
    legend_above(axes, 3)


def _draw_violins(axes: Axes, runs: Sequence[TrackRun], furthest: float, unit: Unit) -> None:
    _violins(axes, [unit.factor * all_errors(run) for run in runs], [run.name for run in runs], furthest)
    axes.set(ylabel=_quantity(runs, unit), xlabel="box: quartiles, whiskers: 5 and 95 %, point: RMSE")
    axes.set_title("Errors by run")


def _violins(axes: Axes, errors: Sequence[np.ndarray], names: Sequence[str], furthest: float) -> None:
    places, colours = np.arange(len(errors)), _colours(len(errors))
    thinned = [e[np.linspace(0, len(e) - 1, min(len(e), MOST_POINTS)).astype(int)] for e in errors]
    spread = [k for k, e in enumerate(thinned) if np.ptp(e) > 0]
    if spread:
        drawn = axes.violinplot([thinned[k] for k in spread], spread, widths=0.85, showextrema=False)
        for k, body in zip(spread, list(drawn["bodies"]), strict=True):  # type: ignore[call-overload]
            body.set(facecolor=colours[k], alpha=0.35)
    black = {"color": BLACK}
    axes.boxplot(thinned, positions=places, widths=0.2, whis=(5, 95), showfliers=False, medianprops=black)
    for place, own, colour in zip(places, errors, colours, strict=True):
        axes.plot(place, np.sqrt(np.mean(own**2)), "o", color=colour, markeredgecolor="white", markersize=6, zorder=5)
    axes.set_xticks(places, [literal(name) for name in names], rotation=20 if len(errors) > 3 else 0)
    axes.set(ylim=(0, 1.02 * furthest), xlim=(-0.7, len(errors) - 0.3))
    plain(axes, "y")


def _floor_plans(path: Path, runs: Sequence[TrackRun]) -> list[Path]:
    """The tracks of recordings that all runs have, a panel for each run, on the same axes."""
    shown, columns = _planned(runs), len(runs)
    if not shown:
        return []
    wide = min(3.3 * columns + 0.4, 16.0)
    heights = [_ratio(runs[0], name) * wide / columns + 0.6 for name in shown]
    with figure_file(path, wide, sum(heights) + 0.4, "") as figure:
        panels = figure.subplots(len(shown), columns, squeeze=False, sharex="row", sharey="row", height_ratios=heights)
        for row, (name, why) in zip(panels, shown.items(), strict=True):
            for axes, run, colour in zip(row, runs, _colours(columns), strict=True):
                _plan(axes, run, name, colour, why)
            row[0].set_ylabel("y (m)")
            for axes in row:
                axes.set_xlabel("x (m)")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
    return [path]


def _planned(runs: Sequence[TrackRun]) -> dict[str, str]:
    """The recordings with floor plans, and why these."""
    names = _common(runs)
    if not names:
        return {}
    own = [np.concatenate([e.error for key, e in runs[0].errors.items() if key[0] == name]) for name in names]
    chosen = drawn_of(np.array([np.sqrt(np.mean(e**2)) for e in own]), False, MOST_PLANS)
    return {names[k]: f"{why} by {runs[0].name}" if why else "" for k, why in chosen.items()}


def _common(runs: Sequence[TrackRun]) -> list[str]:
    """The recordings that all runs have."""
    return [name for name in _recordings(runs[0]) if all(name in _recordings(run) for run in runs)] if runs else []


def _recordings(run: TrackRun) -> list[str]:
    return list(dict.fromkeys(key[0] for key in run.errors))


def _plan(axes: Axes, run: TrackRun, name: str, colour: str, why: str) -> None:
    """Estimates in the run's colour over the wider truth, with anchors, stations and their names."""
    assert run.association is not None
    part, rig = run.association.of_recording(name), run.recordings[name].rig
    x, y, times = (float_column(part.rows, column) for column in ("x_m", "y_m", "t_s"))
    for k, (a, b) in enumerate(list(zip(part.starts[:-1], part.starts[1:], strict=True))[:MOST_TAGS]):
        _, positions, truth = broken_at_gaps(times[a:b], np.stack([x[a:b], y[a:b]], axis=1), part.truth[a:b, :2])
        axes.plot(*truth.T, color=TRUTH, linewidth=3.0, zorder=2.5, label="_truth" if k else "truth")
        axes.plot(*positions.T, color=colour, linewidth=1.0, zorder=3, label="_" if k else "estimates")
    low, high = _limits(run, name)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    draw_rig(axes, rig.stations, rig.anchors, float(np.max(high - low)))
    axes.set_aspect("equal", adjustable="box")
    axes.set_title(literal(f"{run.name}, {name}" + (f",\n{why}" if why else "")), fontsize=8.5)


def _limits(run: TrackRun, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the axes of a recording's floor plan: around its truth and its rig."""
    assert run.association is not None
    part, rig = run.association.of_recording(name), run.recordings[name].rig
    mounted = [*rig.anchors.values(), *(station.position for station in rig.stations.values())]
    certain = np.concatenate([part.truth[part.scored][:, :2], *(np.asarray(place)[None, :2] for place in mounted)])
    low, high = np.nanmin(certain, axis=0), np.nanmax(certain, axis=0)
    margin = max(0.1 * float(np.max(high - low)), 0.3)
    return low - margin, high + margin


def _ratio(run: TrackRun, name: str) -> float:
    """Height over width of a recording's floor plan."""
    width, height = np.subtract(*_limits(run, name)[::-1])
    return float(np.clip(height / width, 0.3, 1.5))


def _intervals(path: Path, contrasts: Sequence[Contrast]) -> Path:
    """The metrics of studies with their intervals less the first study's."""
    with figure_file(path, 7.5, 1.2 + 0.28 * len({one.subject for one in contrasts}), "") as figure:
        _draw_intervals(figure, contrasts)
    return path


def _draw_intervals(figure: Figure, contrasts: Sequence[Contrast]) -> None:
    metric = next((m for m in ("rmse_m", "rmse_direction_rad") if any(c.metric == m for c in contrasts)), "")
    shown = [one for one in contrasts if one.metric == (metric or contrasts[0].metric)][:60]
    names = list(dict.fromkeys(one.run for one in shown))
    subjects = list(dict.fromkeys(one.subject for one in shown))
    unit = unit_of(shown[0].metric, [one.difference.first for one in shown])
    axes = figure.add_subplot()
    for one in shown:
        k, n = subjects.index(one.subject), names.index(one.run)
        d, colour = one.difference, _colours(len(names))[n]
        height = len(subjects) - 1 - k + 0.12 * (n - (len(names) - 1) / 2)
        ends = [unit.factor * x for x in (d.low, d.high)]
        axes.plot(ends, [height] * 2, color=colour, label=literal(one.run) if k == 0 else None)
        axes.plot(unit.factor * d.value, height, "o" if one.differs else ".", color=colour)
    axes.axvline(0, color=BLACK, linewidth=0.7)
    axes.set_yticks(np.arange(len(subjects))[::-1], [literal(s) for s in subjects])
    axes.set(xlabel=f"{heading(shown[0].metric, unit)}, less the first study's; large point: differs")
    plain(axes, "x")
    legend_above(axes, 3)


def _colours(count: int) -> list[str]:
    return [LINES[k % len(LINES)] for k in range(count)]


def _beside(page: Path, name: str, kind: str) -> Path:
    return page.with_name(f"{page.stem}-{name}.{kind}")
