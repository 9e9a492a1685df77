"""Floor plans of a page: a track with the noise levels before and after a fit over its true path."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from trackwright.experiments.pages.plots.style import (
    BEFORE,
    BLUE,
    GREEN,
    GREY,
    WIDTH,
    legend_above,
    literal,
    svg_address,
)
from trackwright.experiments.pages.plots.tracks import draw_rig
from trackwright.experiments.pages.reports.tracks_compared import Side, TrackChange
from trackwright.trackers.core.data.chi_square import chi_square_quantile
from trackwright.trackers.core.model.rig import Rig

CORNERS = 25
"""Points of an ellipse."""

AROUND = 2.5
"""The axes include the anchors and stations where the plan is then at most so many times the size of the paths."""


def plan_chart(change: TrackChange) -> str:
    """Paths before and after, 95 % ellipses of the same moments on both, truth, anchors, stations and walls."""
    low, high = _limits(change)
    ratio = float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.4, 1.2))

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot(aspect="equal", xlabel="x (m)", ylabel="y (m)")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        if len(change.truth):
            axes.plot(*change.truth.T, color=GREEN, alpha=0.35, linewidth=5.0, label="truth", zorder=2.2)
        for side, name, colour, width in ((change.before, "before", BEFORE, 1.0), (change.after, "after", BLUE, 1.3)):
            single = len(side.path) == 1
            axes.plot(*side.path.T, color=colour, linewidth=width, marker="o" if single else "", label=name, zorder=3)
            if len(side.centres):
                label = f"95 % ellipses {name}"
                axes.plot(*_outlines(side).T, color=colour, linewidth=0.8, zorder=3.5, label=label)
        for row, marker in ((0, "o"), (-1, "s")):
            axes.plot(*change.after.path[row], marker, color=BLUE, markerfacecolor="white", markersize=9,
                      markeredgewidth=2.0, label="_ends", zorder=4)  # fmt: skip
        for x1, y1, x2, y2 in change.rig.all_walls():
            axes.plot([x1, x2], [y1, y2], color=GREY, linewidth=1.5, label="_wall", zorder=2)
        draw_rig(axes, change.rig.stations, change.rig.anchors, float(np.max(high - low)))
        legend_above(axes, 3)
        axes.set_title(literal(f"{change.recording}, tag {change.tag}"), pad=30)

    return svg_address(draw, WIDTH, ratio * (WIDTH - 0.6) + 1.1)


def _limits(change: TrackChange) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the axes: around the truth, 98 % of the estimates, and the rig unless it is far larger."""
    sides = [side.path[np.isfinite(side.path).all(axis=1)] for side in (change.before, change.after)]
    points = np.concatenate([change.truth, *(np.quantile(path, (0.01, 0.99), axis=0) for path in sides)])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    mounted = _mounted(change.rig)
    if len(mounted):
        wide_low, wide_high = np.minimum(low, mounted.min(axis=0)), np.maximum(high, mounted.max(axis=0))
        if np.max(wide_high - wide_low) <= AROUND * np.max(high - low):
            low, high = wide_low, wide_high
    # The millimetres of noise of a tag at rest shall not fill the plan.
    margin = max(0.08 * float(np.max(high - low)), 0.1)
    return low - margin, high + margin


def _mounted(rig: Rig) -> Float[np.ndarray, "n 2"]:
    places = [*rig.anchors.values(), *(station.position for station in rig.stations.values())]
    return np.array([place[:2] for place in places], float).reshape(-1, 2)


def _outlines(side: Side) -> Float[np.ndarray, "n 2"]:
    """The 95 % ellipses as one line with NaN between them."""
    squares, vectors = np.linalg.eigh(side.covs)
    turn = np.linspace(0, 2 * np.pi, CORNERS)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    axes_ = vectors * np.sqrt(chi_square_quantile(0.95, 2) * np.maximum(squares, 0))[:, None, :]
    lines = np.full((len(side.centres), CORNERS + 1, 2), np.nan)
    lines[:, :CORNERS] = np.swapaxes(axes_ @ circle, 1, 2) + side.centres[:, None]
    return lines.reshape(-1, 2)
