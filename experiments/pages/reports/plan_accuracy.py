"""The Cramér–Rao bound of one epoch over the floor of an installation, and where more anchors reduce it most."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.path import Path as Polygon

from trackwright.trackers.aoa.fusion import AXES, ORIGIN, BearingSensor, bearing_inputs
from trackwright.trackers.aoa.phases import SphericalPhases
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.tuning.design.bound import SensorAtEpoch, information
from trackwright.tuning.design.layouts import WallAnchors, range_differences, ranges
from trackwright.tuning.design.search import descend

CELLS = 60
"""Cells of the map along the longer side of the floor."""

UNLIMITED = 1e3
"""Bound, m, above which a position is not determined."""


class Sigmas(NamedTuple):
    """Standard deviations of a range, m, of an azimuth or elevation, rad, and of a phase, rad.

    `difference`: of a range difference, m, which anchors then give in the place of ranges.
    """

    range: float
    angle: float
    phase: float
    difference: float | None = None


@dataclass(frozen=True)
class FloorMap:
    """The bounds of a position on a grid over the floor, at one height of the tags.

    `x` (nx,) and `y` (ny,) m; `inside` (nx, ny): the cells of the floor; `height` m; `sigmas`; `flat`, `covariance`:
    the inverse of the information (nx, ny, 2, 2) with the height known and (nx, ny, 3, 3) without, m², NaN where a
    position is not determined.
    """

    x: Float[np.ndarray, " nx"]
    y: Float[np.ndarray, " ny"]
    inside: np.ndarray
    height: float
    sigmas: Sigmas
    flat: Float[np.ndarray, "nx ny 2 2"]
    covariance: Float[np.ndarray, "nx ny 3 3"]

    @cached_property
    def bounds(self) -> dict[str, Float[np.ndarray, "nx ny"]]:
        """Bounds of the root mean square error, m, by name, NaN outside of the floor and where not determined."""
        variances = {
            "horizontal, height known": self.flat[..., 0, 0] + self.flat[..., 1, 1],
            "horizontal": self.covariance[..., 0, 0] + self.covariance[..., 1, 1],
            "vertical": self.covariance[..., 2, 2],
            "3-D": np.trace(self.covariance, axis1=-2, axis2=-1),
        }
        return {name: np.sqrt(np.where(self.inside, v, np.nan)) for name, v in variances.items()}


def minimised(height_known: bool) -> str:
    """The name of the bound that proposed anchors minimise, with which the page opens."""
    return "horizontal, height known" if height_known else "3-D"


def sensors_of(rig: Rig, sigmas: Sigmas, height: float | None) -> list[SensorAtEpoch]:
    """One epoch: ranges of the anchors or their differences, phases of stations with antennas, angles of the others.

    `height`: of the tags, m, if known; the sensors then take a position in the plane. Noise is normal; biases are zero.
    """
    known = {} if height is None else {"height": jnp.asarray(height)}
    sensors = _measured(sigmas)(jnp.asarray([*rig.anchors.values()]).reshape(-1, 3), known)
    for station in rig.stations.values():
        if station.antennas is not None:
            sensors.append(SensorAtEpoch(SphericalPhases(station, sigmas.phase), known, len(station.antennas)))
        else:
            angles = BearingSensor(sigmas.angle, sigmas.angle, 1e6)
            origin, axes = np.split(bearing_inputs(station), [3])
            inputs = {ORIGIN.name: jnp.asarray(origin), AXES.name: jnp.asarray(axes)}
            sensors.append(SensorAtEpoch(angles, inputs | known, 2))
    return sensors


def _measured(sigmas: Sigmas) -> Callable[[jax.Array, Mapping[str, jax.Array]], list[SensorAtEpoch]]:
    """What anchors measure in an epoch, by their places."""
    return partial(ranges, sigmas.range) if sigmas.difference is None else partial(range_differences, sigmas.difference)


def floor_of(rig: Rig) -> Float[np.ndarray, "m 2"]:
    """Corners of the floor, m: the outline of the rig, else the box around its anchors and stations."""
    if rig.outline is not None:
        return np.asarray(rig.outline)
    points = np.array([*rig.anchors.values(), *(s.position for s in rig.stations.values())])[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    # A row of anchors along one wall has a box without area: the floor in front of it is as deep as the row is long.
    margin = np.where(high - low > 0.1, 0.0, (high - low).max() / 2)
    (x1, y1), (x2, y2) = low - margin, high + margin
    return np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2]])


def floor_map(rig: Rig, sigmas: Sigmas, height: float) -> FloorMap:
    """The bounds over the floor for tags at `height`, m. Raises UnusableInput for a rig that measures nothing."""
    if not rig.anchors and not rig.stations:
        raise UnusableInput(
            f"{rig.name}: has neither anchors nor stations; expected [anchors] or [stations] in rig.toml"
        )
    outline = floor_of(rig)
    low, high = outline.min(axis=0), outline.max(axis=0)
    cell = float((high - low).max()) / CELLS
    if not cell > 0:
        raise UnusableInput(
            f"{rig.name}: all anchors and stations are at one place, and there is no outline; add outline_m to [floor]"
        )
    x, y = (np.arange(a + cell / 2, b, cell) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    inside = Polygon(outline).contains_points(grid.reshape(-1, 2)).reshape(grid.shape[:2])
    with jax.enable_x64(True):
        flat = _covariances(sensors_of(rig, sigmas, height), grid)
        high_grid = np.concatenate([grid, np.full((*grid.shape[:2], 1), height)], axis=-1)
        covariance = _covariances(sensors_of(rig, sigmas, None), high_grid)
    return FloorMap(x, y, inside, height, sigmas, flat, covariance)


def _covariances(sensors: list[SensorAtEpoch], grid: Float[np.ndarray, "nx ny d"]) -> Float[np.ndarray, "nx ny d d"]:
    points = jnp.asarray(grid.reshape(-1, grid.shape[-1]))
    matrices = np.asarray(eqx.filter_jit(jax.vmap(lambda p: information(sensors, p)))(points))
    # A position that the sensors do not determine has an information with an eigenvalue of zero, up to rounding.
    values, vectors = np.linalg.eigh(matrices)
    determined = np.min(values, axis=1) > 1 / UNLIMITED**2
    values = np.where(determined[:, None], values, np.nan)
    inverse = np.einsum("kia,ka,kja->kij", vectors, 1 / values, vectors)
    return inverse.reshape(*grid.shape[:2], grid.shape[-1], grid.shape[-1])


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
    outline, height = floor_of(rig), floor.height if height_known else None
    with jax.enable_x64(True):
        layout = WallAnchors(outline, np.tile(band, (count, 1)), SPACING, _measured(floor.sigmas), height, fixed)
        starts = np.random.default_rng(0).random((STARTS, *layout.shape))
        optimum = descend(layout.objective(points), layout.project, starts)
        positions = np.asarray(layout.positions(optimum.theta))
    free = (name for k in range(1, count + len(fixed) + 1) if (name := f"P{k}") not in rig.anchors)
    anchors = dict(zip(free, positions, strict=False))
    with_them = replace(rig, anchors={**rig.anchors, **anchors}, outline=outline)
    return Placement(anchors, floor_map(with_them, floor.sigmas, floor.height))
