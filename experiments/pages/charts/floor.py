"""Floor plans: tracks with some 95 % ellipses, true paths, and the installation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.pages.charts.style import GREY, Chart, Line, broken_at_gaps, path
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
    positions: np.ndarray
    centres: np.ndarray = np.zeros((0, 2))
    covs: np.ndarray = np.zeros((0, 2, 2))
    ellipses: str = ""


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names with their numbers: 2 before 10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def plan(
    name: str, title: str, paths: Sequence[PlanPath], truths: Sequence[np.ndarray], rig: Rig, around: bool = True,
    **more: Any,
) -> Chart:  # fmt: skip
    """Paths with starts and ends, true paths (n, 2), m, and the installation.

    `around`: whether the axes hold 98 % of each path and of its ellipses, too.
    """
    points = [*truths, np.reshape(rig.places(), (-1, 3))[:, :2], rig.all_walls().reshape(-1, 2)]
    parts = [path(truth, "" if k else "truth", TRUTH, 3.0) for k, truth in enumerate(truths)]
    for one in paths:
        there, outlines = one.positions[np.isfinite(one.positions[:, 0])], _ellipses(one.centres, one.covs)
        parts.append(path(one.positions, one.name, one.colour, 1.1, marker="circle" * (len(there) == 1), size=4))
        parts.append(path(outlines, one.ellipses, one.colour, 0.8))
        parts.append(path(one.centres, "", one.colour, 0.0, marker="circle", size=4))
        for row, marker, word in ((0, "circle-open", "start"), (-1, "square-open", "end")) if len(there) > 1 else ():
            parts.append(path(there[[row]], word * (one is paths[-1]), one.colour, 0.0, marker=marker, size=8))
        own = (there, outlines) if around else ()
        points += [np.nanquantile(of, (0.01, 0.99), axis=0, method="nearest") for of in own if len(of)]
    drawn = np.concatenate([*points, np.zeros((1, 2))] if not any(map(len, points)) else points)
    low, high = np.nanmin(drawn, axis=0), np.nanmax(drawn, axis=0)
    size = float(np.max(high - low))
    # The millimetres of noise of a tag at rest shall not fill the plan.
    (left, bottom), (right, top) = low - max(0.08 * size, 0.25), high + max(0.08 * size, 0.25)
    look: dict[str, Any] = {"equal": True, "width": 8.5, "height": None} | more
    return Chart(name, title, "x (m)", "y (m)", [*parts, *rig_lines(rig, size)], (left, right), (bottom, top), **look)


def rig_lines(rig: Rig, size: float) -> list[Line]:
    """Walls, anchors, and stations with a stroke ahead unless they look up or down; near ones share a name.

    `size`: of the plan, m.
    """
    walls = np.pad(rig.all_walls().reshape(-1, 2, 2), ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)
    lines = [path(walls, "", GREY, 2.0)] if len(walls) else []
    for station in rig.stations.values():
        ahead = station.world_from_array()[:2, 2]
        if np.hypot(*ahead) > 0.3:
            end = station.position[:2] + 0.11 * size * ahead / np.hypot(*ahead)
            lines.append(path(np.array([station.position[:2], end]), "", GREY, 1.0))
    stations = {name: station.position for name, station in rig.stations.items()}
    for kind, marker, places in (("anchor", "triangle-up", rig.anchors), ("station", "square", stations)):
        stacks: dict[tuple[float, float], list[str]] = {}
        for name in sorted(places, key=natural):
            x, y = map(float, places[name][:2])
            near = (one for one in stacks if np.hypot(one[0] - x, one[1] - y) <= size / 40)
            stacks.setdefault(next(near, (x, y)), []).append(name)
        if stacks:
            names = [", ".join(of) for of in stacks.values()]
            lines.append(path(np.array([*stacks]), kind, GREY, 0.0, marker=marker, size=7, text=names))
    return lines


def track_paths(
    sides: Sequence[ScoredRecording], track: int, looks: Sequence[tuple[str, str, str]], count: int, most: int = 10**9
) -> list[PlanPath]:
    """The paths of a track by one or several trackers, with at most `count` ellipses, at the same times for all.

    `looks`: name, colour and name of the ellipses of each. `most`: about so many points of a path are kept.
    """
    rows, paths, usable = sides[0].rows_of(track), [], True
    places = [side.columns("x_m", "y_m")[rows] for side in sides]
    covs = [covariances(side.rows[rows])[:, :2, :2] for side in sides]
    for place, cov in zip(places, covs, strict=True):
        proper = np.isfinite(place).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)) & (cov[:, 0, 0] > 0)
        major = np.linalg.eigvalsh(np.where(proper[:, None, None], cov, np.eye(2)))[:, 1]
        usable &= proper & (major <= LARGE**2 * (np.median(major[proper]) if proper.any() else 0.0))
    some = np.flatnonzero(usable)
    some = some[np.unique((np.arange(count) + 0.5) * len(some) / count).astype(int)] if len(some) else some
    for side, (name, colour, named), place, cov in zip(sides, looks, places, covs, strict=True):
        there = np.isfinite(place).all(axis=1)
        _, whole = broken_at_gaps(side.times[rows][there], place[there])
        paths.append(PlanPath(name, colour, whole[:: -(-len(whole) // most) or 1], place[some], cov[some], named))
    return paths


def true_path(scored: ScoredRecording, track: int) -> list[np.ndarray]:
    """The true path (n, 2), m, of a track, NaN in gaps: of the truth table, else at its rows; none without truth."""
    rows, paths = scored.rows_of(track), scored.folder.paths
    tag, known = str(scored.rows["tag"][rows.start]), scored.scored[rows]
    own = scored.times[rows][known], scored.columns("true_x_m", "true_y_m")[rows][known]
    times, places = paths.of_tag(tag) if tag in paths.number else own
    return [broken_at_gaps(times, places[:, :2])[1]] if len(times) else []


def _ellipses(centres: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """The 95 % ellipses (n, 2) as one line with NaN between them."""
    squares, vectors = np.linalg.eigh(covs)
    turn = np.append(np.linspace(0, 2 * np.pi, 37), np.nan)
    half_axes = vectors * np.sqrt(chi_square_quantile(0.95, 2) * np.maximum(squares, 0))[:, None, :]
    return (np.swapaxes(half_axes @ np.stack([np.cos(turn), np.sin(turn)]), 1, 2) + centres[:, None]).reshape(-1, 2)
