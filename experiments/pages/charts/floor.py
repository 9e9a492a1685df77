"""Floor plans: tracks with some 95 % ellipses, true paths, and the installation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts.style import GREY, broken_at_gaps, literal
from trackwright.experiments.pages.reports.pages import drawn_rows
from trackwright.experiments.pages.scored_tracks import ScoredRecording
from trackwright.trackers.core.data.consistency import chi_square_quantile
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.rows import covariances

TRUTH = "#9aa5b0"
"""The colour of true paths, drawn below the tracks and wider: neither hides the other."""

LARGE = 3.0
"""An ellipse with a major axis so many times the median, as of a start, is not drawn."""


class PlanPath(NamedTuple):
    """A path on a floor plan: its name in the legend, its colour, and positions (n, 2), m, with NaN in gaps.

    `centres` (k, 2), m, and `covs` (k, 2, 2), m²: some estimates and their covariances, drawn as 95 % ellipses.
    `ellipses`: what the legend calls them.
    """

    name: str
    colour: str
    positions: Float[np.ndarray, "n 2"]
    centres: Float[np.ndarray, "k 2"] = np.zeros((0, 2))
    covs: Float[np.ndarray, "k 2 2"] = np.zeros((0, 2, 2))
    ellipses: str = "_"


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names with their numbers: 2 before 10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def draw_plan(
    axes: Axes, paths: Sequence[PlanPath], truths: Sequence[np.ndarray], rig: Rig, around_estimates: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Draws paths with starts and ends, true paths (n, 2), m, and the installation; returns the corners (2,), m.

    `around_estimates`: whether the axes hold 98 % of each path and of its ellipses, too.
    """
    points = [truth[np.isfinite(truth).all(axis=1)] for truth in truths]
    points += [np.array([p[:2] for p in (*rig.anchors.values(), *(s.position for s in rig.stations.values()))])]
    points += [rig.all_walls()]
    for k, truth in enumerate(truths):
        axes.plot(*truth.T, color=TRUTH, linewidth=3.0, zorder=2.5, solid_capstyle="round", label="_" if k else "truth")
    for k, path in enumerate(paths):
        colour, there = path.colour, path.positions[np.isfinite(path.positions).all(axis=1)]
        dot: dict[str, Any] = {"marker": "o", "markersize": 4} if len(there) == 1 else {}
        label = literal(path.name) or "_"
        axes.plot(*path.positions.T, color=colour, alpha=0.9, linewidth=1.1, zorder=3, label=label, **dot)
        outlines = _ellipses(path.centres, path.covs)
        if len(outlines):
            axes.plot(*outlines.T, color=colour, linewidth=0.8, alpha=0.8, zorder=3.5, label=path.ellipses)
            axes.plot(*path.centres.T, ".", color=colour, markersize=4, zorder=3.5, label="_")
        for row, marker, name in ((0, "o", "start"), (-1, "s", "end")) if len(there) > 1 else ():
            axes.plot(*there[row], marker, markerfacecolor="none", color=colour, markersize=8, zorder=4.5,
                      markeredgewidth=1.5, label=name if k == len(paths) - 1 else "_")  # fmt: skip
        for own in (there, outlines[np.isfinite(outlines[:, 0])]) if around_estimates else ():
            points += [np.quantile(own, (0.01, 0.99), axis=0)] if len(own) else []
    drawn = np.concatenate([p.reshape(-1, 2) for p in points if len(p)] or [np.zeros((1, 2))])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    size = float(np.max(high - low))
    # The millimetres of noise of a tag at rest shall not fill the plan.
    low, high = low - max(0.08 * size, 0.25), high + max(0.08 * size, 0.25)
    axes.set(xlabel="x (m)", ylabel="y (m)", xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    _draw_rig(axes, rig, size)
    return low, high


def _draw_rig(axes: Axes, rig: Rig, size: float) -> None:
    """Walls, anchors, and stations with the boresight unless it points up or down; those above each other share a name.

    `size`: of the plan, m.
    """
    for x1, y1, x2, y2 in rig.all_walls():
        axes.plot([x1, x2], [y1, y2], color=GREY, linewidth=2.0, solid_capstyle="round", zorder=2, label="_wall")
    anchors = {name: place[:2] for name, place in rig.anchors.items()}
    stations = {name: station.position[:2] for name, station in rig.stations.items()}
    for kind, marker, places in (("anchor", "^", anchors), ("station", "s", stations)):
        if places:
            axes.plot(*np.array([*places.values()]).T, marker, color=GREY, markersize=7, markeredgecolor="white",
                      zorder=5, clip_on=False, label=kind)  # fmt: skip
    for station in rig.stations.values():
        ahead = station.world_from_array()[:2, 2]
        if np.hypot(*ahead) > 0.3:
            x, y = map(float, station.position[:2])
            dx, dy = 0.11 * size * ahead / np.hypot(*ahead)
            axes.annotate("", (x + dx, y + dy), (x, y), arrowprops={"arrowstyle": "-|>", "color": GREY})
    stacks: dict[tuple[float, float], list[str]] = {}
    for name, place in (anchors | stations).items():
        near = (one for one in stacks if np.hypot(*(place - one)) <= size / 40)
        stacks.setdefault(next(near, (float(place[0]), float(place[1]))), []).append(name)
    for at, names in stacks.items():
        text = literal(", ".join(sorted(names, key=natural)))
        axes.annotate(text, at, (0, -7), textcoords="offset points", ha="center", va="top", fontsize=7, color=GREY)


def track_paths(
    sides: Sequence[ScoredRecording],
    track: int,
    looks: Sequence[tuple[str, str, str]],
    ellipses: int,
    most: int = 10**9,
) -> list[PlanPath]:
    """The paths of a track by one or several trackers, with at most so many ellipses, at the same times for all.

    `looks`: name, colour and name of the ellipses of each. `most`: about so many points of a path are kept, the first,
    the last and those with the largest errors among them.
    """
    rows, paths = sides[0].rows_of(track), []
    places = [side.places[rows] for side in sides]
    covs = [covariances(side.rows[rows])[:, :2, :2] for side in sides]
    some = _ellipse_rows(places, covs, ellipses)
    for side, (name, colour, named), place, cov in zip(sides, looks, places, covs, strict=True):
        there = np.isfinite(place).all(axis=1)
        times, errors = side.times[rows][there], side.miss[rows][there]
        _, path, weight = broken_at_gaps(times, place[there], np.nan_to_num(errors))
        kept = drawn_rows(np.array([len(path)]), np.where(np.isnan(path[:, 0]), np.inf, weight), most)
        paths.append(PlanPath(name, colour, path[kept], place[some], cov[some], named))
    return paths


def true_path(scored: ScoredRecording, track: int) -> list[np.ndarray]:
    """The true path (n, 2), m, of a track, NaN in gaps: of the truth table, else at its rows; none without truth."""
    rows, paths = scored.rows_of(track), scored.folder.paths
    tag, known = str(scored.rows["tag"][rows.start]), scored.scored[rows]
    times, path = scored.times[rows][known], scored.truth[rows][known]
    times, path = paths.of_tag(tag) if tag in paths.number else (times, path)
    return [broken_at_gaps(times, path[:, :2])[1]] if len(times) else []


def _ellipse_rows(positions: Sequence[np.ndarray], covs: Sequence[np.ndarray], most: int) -> np.ndarray:
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


def _ellipses(centres: Float[np.ndarray, "k 2"], covs: Float[np.ndarray, "k 2 2"]) -> Float[np.ndarray, "n 2"]:
    """The 95 % ellipses as one line with NaN between them."""
    squares, vectors = np.linalg.eigh(covs)
    turn = np.append(np.linspace(0, 2 * np.pi, 37), np.nan)
    half_axes = vectors * np.sqrt(chi_square_quantile(0.95, 2) * np.maximum(squares, 0))[:, None, :]
    return (np.swapaxes(half_axes @ np.stack([np.cos(turn), np.sin(turn)]), 1, 2) + centres[:, None]).reshape(-1, 2)
