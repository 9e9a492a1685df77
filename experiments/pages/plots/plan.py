"""The map of the bound over the floor of an installation, as a PNG."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from trackwright.experiments.pages.plan.accuracy import FloorMap
from trackwright.experiments.pages.plots.style import BLACK, GREY, VERMILION, figure_file, literal
from trackwright.trackers.core.model.rig import Rig

LABELLED = 12
"""The most anchors whose ids are written beside them."""

TOGETHER = 0.2
"""Horizontal distance, m, of anchors that share a label."""


def bound_maps(path: Path, rig: Rig, floor: FloorMap, proposed: Mapping[str, np.ndarray]) -> None:
    """A map of each bound, with anchors, stations and proposed anchors (3,), m, written whole or not at all."""
    fields = {name: bound for name, bound in floor.bounds.items() if np.any(np.isfinite(bound))}
    half = (floor.x[1] - floor.x[0]) / 2
    edges = [np.append(values - half, values[-1] + half) for values in (floor.x, floor.y)]
    (left, right), (bottom, top) = ((e[0], e[-1]) for e in edges)
    tall = float(np.clip((top - bottom) / (right - left), 0.35, 1.6))
    title = f"{rig.name}: bound of one epoch" + (f", with {', '.join(proposed)}" if proposed else "")
    with figure_file(path, 3.4 * max(len(fields), 1) + 0.4, 3.2 * tall + 1.3, title) as figure:
        panels = figure.subplots(1, max(len(fields), 1), squeeze=False)[0]
        for axes, (name, bound) in zip(panels, fields.items(), strict=False):
            # A few cells beside an anchor or in line with two would take all colours, and so would a small spread.
            least, high, largest = np.nanquantile(100 * bound, (0.0, 0.97, 1.0))
            most = max(high, 2 * least)
            mesh = axes.pcolormesh(*edges, 100 * bound.T, cmap="viridis_r", vmin=least, vmax=most)
            extend = "max" if largest > most else "neither"
            figure.colorbar(mesh, ax=axes, shrink=0.8, extend=extend, label="bound (cm)", location="bottom")
            _draw_rig(axes, rig, proposed)
            axes.set_aspect("equal")
            axes.grid(visible=False)
            rms = 100 * float(np.sqrt(np.nanmean(bound**2)))
            axes.set(title=f"{name}: {rms:.3g} cm RMS", xlabel="x (m)", ylabel="y (m)" if axes is panels[0] else "")


def _draw_rig(axes: Axes, rig: Rig, proposed: Mapping[str, np.ndarray]) -> None:
    for x1, y1, x2, y2 in rig.all_walls():
        axes.plot([x1, x2], [y1, y2], color=GREY, linewidth=0.8)
    places = {**rig.anchors, **{name: station.position for name, station in rig.stations.items()}, **proposed}
    at: dict[tuple[float, float], list[str]] = {}
    for name, (x, y, _) in places.items():
        mark, colour, size = ("*", VERMILION, 11) if name in proposed else ("^", BLACK, 6)
        axes.plot(x, y, mark, color=colour, markersize=size, clip_on=False)
        # Anchors above each other share a label.
        near = [other for other in at if np.hypot(other[0] - x, other[1] - y) < TOGETHER]
        at.setdefault(near[0] if near else (x, y), []).append(name)
    centre = np.mean([place[:2] for place in places.values()], axis=0)
    for (x, y), names in at.items() if len(places) <= LABELLED else ():
        right, above = (-1 if x > centre[0] else 1), (-1 if y > centre[1] else 1)
        text = axes.annotate(
            literal(", ".join(names)), (x, y), xytext=(6 * right, 6 * above), textcoords="offset points", fontsize=8,
            ha="left" if right > 0 else "right", va="bottom" if above > 0 else "top",
        )  # fmt: skip
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
    for station in rig.stations.values():
        (x, y), (east, north) = station.position[:2], station.world_from_array()[:2, 2]
        axes.annotate("", (x + 0.6 * east, y + 0.6 * north), (x, y), arrowprops={"arrowstyle": "->"})
