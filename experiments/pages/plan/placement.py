"""Where more anchors reduce the bound over the floor most: by the gradient of the mean bound, from many starts."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from trackwright.experiments.pages.plan.accuracy import FloorMap, floor_map, floor_of
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.tuning.design.layouts import WallAnchors, range_sensor
from trackwright.tuning.design.search import descend

STARTS = 24
POINTS = 200
"""The most points of the floor over which the bound is averaged."""

SPACING = 0.5
"""Minimum distance of two anchors, m."""

LOWEST, HIGHEST = 0.3, 3.0
"""Heights, m, between which an anchor is proposed where the anchors of the rig reach neither higher nor lower."""


class Placement(NamedTuple):
    """Proposed anchors (3,), m, by name, and the bounds over the `floor` with them."""

    anchors: dict[str, Float[np.ndarray, "3"]]
    floor: FloorMap


def place_anchors(rig: Rig, count: int, floor: FloorMap, height_known: bool) -> Placement:
    """The best places of `count` more anchors on the outline of the floor.

    The bound is that of the horizontal position if the height is known, else of the position in space. Anchors are
    called P1, P2, ..., less the names in the rig. Raises UnusableInput for a rig with stations or without anchors.
    """
    if not rig.anchors or rig.stations:
        has = "stations" if rig.stations else "no anchors"
        raise UnusableInput(f"--place {count}: {rig.name} has {has}; expected a rig with anchors alone")
    fixed = np.array([*rig.anchors.values()])
    band = np.array([min(LOWEST, fixed[:, 2].min()), max(HIGHEST, fixed[:, 2].max())])
    grid = np.stack(np.meshgrid(floor.x, floor.y, indexing="ij"), axis=-1)[floor.inside]
    points = grid[np.linspace(0, len(grid) - 1, min(POINTS, len(grid))).astype(int)]
    if not height_known:
        points = np.column_stack([points, np.full(len(points), floor.height)])
    sensor = range_sensor(count + len(fixed), floor.sigmas.range)
    outline, height = floor_of(rig), floor.height if height_known else None
    with jax.enable_x64(True):
        layout = WallAnchors(outline, np.tile(band, (count, 1)), SPACING, sensor, height, fixed)
        starts = np.random.default_rng(0).random((STARTS, *layout.shape))
        found = descend(layout.objective(points), layout.project, starts)
        positions = np.asarray(layout.positions(found.theta))
    free = (name for k in range(1, count + len(fixed) + 1) if (name := f"P{k}") not in rig.anchors)
    anchors = dict(zip(free, positions, strict=False))
    with_them = replace(rig, anchors={**rig.anchors, **anchors}, outline=outline)
    return Placement(anchors, floor_map(with_them, floor.sigmas, floor.height))
