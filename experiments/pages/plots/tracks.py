"""The floor plan of one recording's tracks."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from trackwright.experiments.pages.plots.style import GREY, LINES, broken_at_gaps, figure_file, literal
from trackwright.trackers.core.data.chi_square import chi_square_quantile
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.evaluation.scoring import covariances
from trackwright.trackers.recordings.columns import float_column

ELLIPSES = 24
"""The most ellipses in all, at most half of them along one track; more would hide the tracks."""


TRUTH = "#9aa5b0"
"""The colour of true paths, drawn below the tracks and wider."""

HALO = [withStroke(linewidth=2.0, foreground="white")]

TIMES = 4
"""About so many times are written along a track."""

LARGE = 3.0
"""An ellipse with a major axis so many times the median, as that of a start, is not drawn."""


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names with their numbers: 2 before 10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


class _Path(NamedTuple):
    """One tag's path: times (n,), s, positions (n, 2), m, and covariances (n, 2, 2), m², NaN where none is reported."""

    times: np.ndarray
    positions: np.ndarray
    covs: np.ndarray


def floor_plan(
    path: Path | str,
    tracks: pl.DataFrame,
    truth: pl.DataFrame | None = None,
    stations: Mapping[str, Station] | None = None,
    anchors: Mapping[str, np.ndarray] | None = None,
    title: str = "Tracks on the floor plan",
    walls: np.ndarray | None = None,
    shown: Mapping[str, str] | None = None,
) -> Path:
    """Writes the floor plan of one recording: tracks, truth, rig and some 95 % ellipses; returns the path.

    `tracks`: rows of tag, t_s, x_m, y_m and, for ellipses, std_x_m, std_y_m, cov_xy_m2. `truth`: t_s, tag, x_m, y_m.
    `walls`: (n, 4) m, x1, y1, x2, y2. `shown`: the tags that are drawn, at most six, with remarks for the legend.
    Outliers don't set the scale; a note in the plot names their number.
    """
    tags = sorted(tracks["tag"].cast(pl.String).unique().to_list(), key=natural)
    remarks = dict.fromkeys(tags, "") if shown is None else shown
    drawn = list(remarks)[: len(LINES)]
    estimated = [_path_of(tracks, tag) for tag in drawn]
    true = [] if truth is None else [_path_of(truth, tag) for tag in drawn]
    mounted = {name: np.asarray(position)[:2] for name, position in (anchors or {}).items()}
    mounted |= {name: np.asarray(station.position)[:2] for name, station in (stations or {}).items()}
    certain = [*(p.positions for p in true), *(p[None] for p in mounted.values())]
    certain += [] if walls is None else [walls.reshape(-1, 2)]
    low, high = _limits([p.positions for p in estimated], certain)
    width, height = _size(high - low)
    width += 0.055 * max((len(remark) for remark in remarks.values()), default=0)
    with figure_file(path, width, height, title) as figure:
        axes = figure.add_subplot(aspect="equal", xlabel="x (m)", ylabel="y (m)")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        for x1, y1, x2, y2 in [] if walls is None else walls:
            axes.plot([x1, x2], [y1, y2], color=GREY, linewidth=2.0, solid_capstyle="round", zorder=2)
        draw_rig(axes, stations or {}, anchors or {}, float(np.max(high - low)))
        for line in true:
            # Below the track, and wider: neither hides the other.
            _, positions = broken_at_gaps(line.times, line.positions)
            axes.plot(*positions.T, color=TRUTH, linewidth=3.0, zorder=2.5, solid_capstyle="round")
        for line, colour in zip(estimated, LINES, strict=False):
            _draw_track(axes, line, colour, min(ELLIPSES // len(drawn), ELLIPSES // 2))
            _mark_times(axes, line, colour, TIMES if len(drawn) <= 3 else 0)
        axes.legend(
            handles=_handles({tag: remarks[tag] for tag in drawn}, bool(true), bool(stations), bool(anchors)),
            loc="upper left",
            bbox_to_anchor=(1.01, 1.0),
            borderaxespad=0,
        )
        axes.set_title("\n".join(_notes(estimated, len(tags), low, high)), color=GREY, fontsize=8)
    return Path(path)


def _path_of(table: pl.DataFrame, tag: str) -> _Path:
    """The rows of a tag that have a position, in time order."""
    rows = table.filter(pl.col("tag").cast(pl.String) == tag).sort("t_s")
    positions = np.stack([float_column(rows, "x_m"), float_column(rows, "y_m")], axis=1)
    there = np.isfinite(positions).all(axis=1)
    return _Path(float_column(rows, "t_s")[there], positions[there], covariances(rows)[there, :2, :2])


def _limits(estimated: list[np.ndarray], certain: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The axes' corners: around truth and rig, and 98 % of each tag's estimates."""
    points = [p for p in certain if len(p)]
    points += [np.quantile(p, (0.01, 0.99), axis=0) for p in estimated if len(p)]
    every = np.concatenate(points) if points else np.zeros((1, 2))
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
    # The millimetres of noise of a tag at rest shall not fill the plot.
    margin = max(0.08 * float(np.max(high - low)), 0.25)
    return low - margin, high + margin


def _size(extent: np.ndarray) -> tuple[float, float]:
    """Width and height in inches: a plan of about 30 square inches, and room for legend and labels."""
    ratio = float(np.clip(extent[1] / extent[0], 0.25, 2.5))
    width = float(np.clip(np.sqrt(30 / ratio), 3.5, 8.5))
    return width + 1.9, width * ratio + 1.3


def _draw_track(axes: Axes, line: _Path, colour: str, n_ellipses: int) -> None:
    _, positions = broken_at_gaps(line.times, line.positions)
    single = len(line.positions) == 1
    axes.plot(
        *positions.T, color=colour, alpha=0.9, linewidth=1.1, zorder=3, marker="o" if single else "", markersize=4
    )
    proper = np.flatnonzero(np.isfinite(line.covs).all(axis=(1, 2)) & (line.covs[:, 0, 0] > 0))
    if len(proper) == 0:
        return
    squares, vectors = np.linalg.eigh(line.covs[proper])
    usual = squares[:, 1] <= LARGE**2 * np.median(squares[:, 1])
    proper, squares, vectors = proper[usual], squares[usual], vectors[usual]
    few = np.unique((np.arange(n_ellipses) + 0.5) * len(proper) / n_ellipses).astype(int)
    chosen, squares, vectors = proper[few], squares[few], vectors[few]
    axis_lengths = 2 * np.sqrt(chi_square_quantile(0.95, 2) * np.maximum(squares, 0))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    positions = line.positions[chosen]
    ellipses = EllipseCollection(
        axis_lengths[:, 1],
        axis_lengths[:, 0],
        angles,
        units="xy",
        offsets=positions,
        transOffset=axes.transData,
        facecolors="none",
        edgecolors=colour,
        linewidths=0.8,
        alpha=0.8,
        zorder=3.5,
    )
    axes.add_collection(ellipses, autolim=False)
    axes.plot(*positions.T, ".", color=colour, markersize=4, zorder=3.5)


def _mark_times(axes: Axes, line: _Path, colour: str, times: int) -> None:
    """The start, an open circle, the end, an open square, and some times along the track."""
    if len(line.times) < 2:
        return
    for row, marker in ((0, "o"), (-1, "s")):
        axes.plot(*line.positions[row], marker, markerfacecolor="none", color=colour, markersize=8, zorder=4.5,
                  markeredgewidth=1.5)  # fmt: skip
    if not times:
        return
    for at in MaxNLocator(times + 1, steps=[1, 2, 5, 10]).tick_values(line.times[0], line.times[-1]):
        row = int(np.argmin(np.abs(line.times - at)))
        near = abs(line.times[row] - at) <= 0.02 * (line.times[-1] - line.times[0])
        if line.times[0] < at < line.times[-1] and near:
            axes.plot(*line.positions[row], "|", color=colour, markersize=7, markeredgewidth=1.5, zorder=4)
            axes.annotate(f"{at:.9g} s", line.positions[row], (4, 4), fontsize=7, color=colour, zorder=5,
                          textcoords="offset points", path_effects=HALO)  # fmt: skip


def draw_rig(axes: Axes, stations: Mapping[str, Station], anchors: Mapping[str, np.ndarray], size: float) -> None:
    """Stations as squares, with the boresight unless it points up or down; anchors as triangles.

    Those that stand above each other share a label.
    """
    marks = [(name, float(position[0]), float(position[1]), "^", False) for name, position in anchors.items()]
    for name, station in stations.items():
        x, y = float(station.position[0]), float(station.position[1])
        ahead = station.world_from_array()[:2, 2]
        level = float(np.hypot(*ahead)) > 0.3
        if level:
            dx, dy = 0.06 * size * ahead / np.hypot(*ahead)
            axes.annotate(
                "", (x + dx, y + dy), (x, y), arrowprops={"arrowstyle": "-|>", "color": GREY, "linewidth": 1.0}
            )
        marks.append((name, x, y, "s", level and ahead[1] < 0))
    stacks: list[tuple[float, float, list[str]]] = []
    for name, x, y, *_ in marks:
        near = [names for u, v, names in stacks if np.hypot(u - x, v - y) <= size / 40]
        if near:
            near[0].append(name)
        else:
            stacks.append((x, y, [name]))
    labels = {names[0]: ", ".join(sorted(names, key=natural)) for _, _, names in stacks}
    for name, x, y, marker, above in marks:
        axes.plot(x, y, marker, color=GREY, markersize=7, markeredgecolor="white", zorder=5)
        offset, side = ((0, 6), "bottom") if above else ((0, -7), "top")
        words: dict[str, Any] = {
            "textcoords": "offset points",
            "ha": "center",
            "va": side,
            "fontsize": 7,
            "color": GREY,
        }
        axes.annotate(literal(labels.get(name, "")), (x, y), offset, zorder=5, **words)


def _handles(tags: Mapping[str, str], truth: bool, stations: bool, anchors: bool) -> list[Line2D]:
    handles = [
        Line2D([], [], color=colour, label=literal(f"tag {tag}" + (f"\n{remark}" if remark else "")))
        for (tag, remark), colour in zip(tags.items(), LINES, strict=False)
    ]
    if truth:
        handles.append(Line2D([], [], color=TRUTH, linewidth=3.0, label="truth"))
    for marker, label in (("o", "start"), ("s", "end")):
        handles.append(Line2D([], [], color=GREY, linestyle="", marker=marker, markerfacecolor="none", label=label))
    for there, marker, label in ((stations, "s", "station"), (anchors, "^", "anchor")):
        if there:
            handles.append(Line2D([], [], color=GREY, linestyle="", marker=marker, label=label))
    return handles


def _notes(estimated: list[_Path], n_tags: int, low: np.ndarray, high: np.ndarray) -> list[str]:
    notes = []
    if any(np.isfinite(line.covs).all(axis=(1, 2)).any() for line in estimated):
        notes.append("dots: estimates with their reported 95 % ellipses")
    if n_tags > len(estimated):
        notes.append(f"{len(estimated)} of {n_tags} tags are shown")
    outside = sum(int(((line.positions < low) | (line.positions > high)).any(axis=1).sum()) for line in estimated)
    if outside:
        notes.append(f"{outside} of {sum(len(line.positions) for line in estimated)} estimates lie outside the axes")
    return notes
