"""Floor plans: tracks, true paths, installation and some 95 % ellipses; maps over the floor."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import MaxNLocator

from trackwright.experiments.pages.charts.style import GREY, literal
from trackwright.trackers.core.data.consistency import chi_square_quantile
from trackwright.trackers.core.model.rig import Rig

TRUTH = "#9aa5b0"
"""The colour of true paths, drawn below the tracks and wider: neither hides the other."""

HALO: list[AbstractPathEffect] = [withStroke(linewidth=2.0, foreground="white")]

LARGE = 3.0
"""An ellipse with a major axis so many times the median, as that of a start, is not drawn."""

CORNERS = 37
"""Points of an ellipse."""

AROUND = 2.5
"""Plans of what changed include anchors and stations if they are then at most so many times the size of the paths."""


class PlanPath(NamedTuple):
    """A path on a floor plan: its name in the legend, its colour, and positions (n, 2), m, with NaN in gaps.

    `centres` (k, 2), m, and `covs` (k, 2, 2), m²: some estimates and their covariances, drawn as 95 % ellipses.
    `ellipses`: what the legend calls them; empty: nothing. `times` (n,), s: written along the path; None: they are not.
    """

    name: str
    colour: str
    positions: Float[np.ndarray, "n 2"]
    centres: Float[np.ndarray, "k 2"] = np.zeros((0, 2))
    covs: Float[np.ndarray, "k 2 2"] = np.zeros((0, 2, 2))
    ellipses: str = ""
    times: Float[np.ndarray, " n"] | None = None


class Corners(NamedTuple):
    """The lower left and the upper right corner (2,), m, of a plan."""

    low: np.ndarray
    high: np.ndarray

    @property
    def size(self) -> float:
        """The longer side, m."""
        return float(np.max(self.high - self.low))


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names with their numbers: 2 before 10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def plan_corners(
    truths: Sequence[np.ndarray], estimated: Sequence[np.ndarray], rig: Rig, around: float = np.inf
) -> Corners:
    """The corners of a plan: around true paths (n, 2), 98 % of each of the estimated ones, and the installation.

    `around`: without an installation that makes the plan so many times as large.
    """
    points = [path[np.isfinite(path).all(axis=1)] for path in truths]
    finite = [path[np.isfinite(path).all(axis=1)] for path in estimated]
    points += [np.quantile(path, (0.01, 0.99), axis=0) for path in finite if len(path)]
    places = [*rig.anchors.values(), *(station.position for station in rig.stations.values())]
    mounted = np.concatenate([np.array([p[:2] for p in places]).reshape(-1, 2), rig.all_walls().reshape(-1, 2)])
    paths = np.concatenate([*points, np.zeros((0, 2))])
    drawn = np.concatenate([paths, mounted]) if len(paths) + len(mounted) else np.zeros((1, 2))
    if len(paths) and np.max(np.ptp(drawn, axis=0)) > around * np.max(np.ptp(paths, axis=0)):
        drawn = paths
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    # The millimetres of noise of a tag at rest shall not fill the plan.
    margin = max(0.08 * float(np.max(high - low)), 0.25)
    return Corners(low - margin, high + margin)


def draw_plan(axes: Axes, paths: Sequence[PlanPath], truths: Sequence[np.ndarray], rig: Rig, corners: Corners) -> None:
    """Draws the paths with their starts and ends over the true paths (n, 2), m, and the installation."""
    axes.set(xlabel="x (m)", ylabel="y (m)", xlim=(corners.low[0], corners.high[0]))
    axes.set(ylim=(corners.low[1], corners.high[1]))
    axes.set_aspect("equal")
    for k, truth in enumerate(truths):
        axes.plot(*truth.T, color=TRUTH, linewidth=3.0, zorder=2.5, solid_capstyle="round", label="_" if k else "truth")
    for k, path in enumerate(paths):
        there = np.flatnonzero(np.isfinite(path.positions).all(axis=1))
        dot: dict[str, Any] = {"marker": "o", "markersize": 4} if len(there) == 1 else {}
        label = literal(path.name) or "_"
        axes.plot(*path.positions.T, color=path.colour, alpha=0.9, linewidth=1.1, zorder=3, label=label, **dot)
        if len(path.centres):
            outlines = ellipses(path.centres, path.covs)
            axes.plot(*outlines.T, color=path.colour, linewidth=0.8, alpha=0.8, zorder=3.5, label=path.ellipses or "_")
            axes.plot(*path.centres.T, ".", color=path.colour, markersize=4, zorder=3.5, label="_")
        for row, marker, name in ((0, "o", "start"), (-1, "s", "end")) if len(there) > 1 else ():
            axes.plot(*path.positions[there[row]], marker, markerfacecolor="none", color=path.colour, markersize=8,
                      zorder=4.5, markeredgewidth=1.5, label=name if k == len(paths) - 1 else "_")  # fmt: skip
        if path.times is not None and len(there) > 1:
            _mark_times(axes, path.times[there], path.positions[there], path.colour)
    draw_rig(axes, rig, corners.size)


def _mark_times(axes: Axes, times: np.ndarray, positions: np.ndarray, colour: str) -> None:
    """About four times along a path, between its start and its end."""
    for at in MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(times[0], times[-1]):
        row = int(np.argmin(np.abs(times - at)))
        near = abs(times[row] - at) <= 0.02 * (times[-1] - times[0])
        if times[0] < at < times[-1] and near:
            axes.plot(*positions[row], "|", color=colour, markersize=7, markeredgewidth=1.5, zorder=4, label="_")
            axes.annotate(f"{at:.9g} s", positions[row], (4, 4), fontsize=7, color=colour, zorder=5,
                          textcoords="offset points", path_effects=HALO)  # fmt: skip


def draw_rig(axes: Axes, rig: Rig, size: float) -> None:
    """Walls; stations as squares, with the boresight unless it points up or down; anchors as triangles.

    Those that stand above each other share a label. `size`: of the plan, m.
    """
    for x1, y1, x2, y2 in rig.all_walls():
        axes.plot([x1, x2], [y1, y2], color=GREY, linewidth=2.0, solid_capstyle="round", zorder=2, label="_wall")
    marks = [(name, float(position[0]), float(position[1]), "^", False) for name, position in rig.anchors.items()]
    for name, station in rig.stations.items():
        x, y = float(station.position[0]), float(station.position[1])
        ahead = station.world_from_array()[:2, 2]
        level = float(np.hypot(*ahead)) > 0.3
        if level:
            dx, dy = 0.09 * size * ahead / np.hypot(*ahead)
            arrow = {"arrowstyle": "-|>", "color": GREY, "linewidth": 1.0}
            axes.annotate("", (x + dx, y + dy), (x, y), arrowprops=arrow)
        marks.append((name, x, y, "s", level and ahead[1] < 0))
    labels = _shared_labels(marks, size / 40)
    named = set[str]()
    for name, x, y, marker, above in marks:
        kind = {"s": "station", "^": "anchor"}[marker]
        label = "_" if kind in named else kind
        look: dict[str, Any] = {"marker": marker, "color": GREY, "markersize": 7, "markeredgecolor": "white"}
        axes.plot(x, y, linestyle="", zorder=5, clip_on=False, label=label, **look)
        named.add(kind)
        offset, side = ((0, 6), "bottom") if above else ((0, -7), "top")
        words: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": side, "fontsize": 7}
        if name in labels:
            text = literal(labels[name])
            axes.annotate(text, (x, y), offset, zorder=5, color=GREY, **words)


def _shared_labels(marks: Sequence[tuple[str, float, float, str, bool]], near: float) -> dict[str, str]:
    """The labels of the first of all marks that are nearer to each other than that."""
    stacks: list[tuple[float, float, list[str]]] = []
    for name, x, y, *_ in marks:
        nearby = [names for u, v, names in stacks if np.hypot(u - x, v - y) <= near]
        if nearby:
            nearby[0].append(name)
        else:
            stacks.append((x, y, [name]))
    return {names[0]: ", ".join(sorted(names, key=natural)) for _, _, names in stacks}


def ellipse_rows(positions: Sequence[np.ndarray], covs: Sequence[np.ndarray], most: int) -> np.ndarray:
    """The rows whose ellipses are drawn, at most so many: evenly over those with a usual covariance on all sides.

    `positions` (n, 2), m, and `covs` (n, 2, 2), m², of the same times on each side.
    """
    usable = np.ones(len(positions[0]), bool)
    for place, cov in zip(positions, covs, strict=True):
        proper = np.isfinite(place).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)) & (cov[:, 0, 0] > 0)
        major = np.full(len(cov), np.inf)
        major[proper] = np.linalg.eigvalsh(cov[proper])[:, 1]
        usable &= major <= LARGE**2 * (np.median(major[proper]) if proper.any() else 0.0)
    rows = np.flatnonzero(usable)
    return rows[np.unique((np.arange(most) + 0.5) * len(rows) / most).astype(int)] if len(rows) else rows


def ellipses(centres: Float[np.ndarray, "k 2"], covs: Float[np.ndarray, "k 2 2"]) -> Float[np.ndarray, "n 2"]:
    """The 95 % ellipses as one line with NaN between them."""
    squares, vectors = np.linalg.eigh(covs)
    turn = np.linspace(0, 2 * np.pi, CORNERS)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    half_axes = vectors * np.sqrt(chi_square_quantile(0.95, 2) * np.maximum(squares, 0))[:, None, :]
    lines = np.full((len(centres), CORNERS + 1, 2), np.nan)
    lines[:, :CORNERS] = np.swapaxes(half_axes @ circle, 1, 2) + centres[:, None]
    return lines.reshape(-1, 2)
