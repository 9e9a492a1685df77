"""The Cramér–Rao bound of one epoch over the floor of an installation, and its dilution of precision."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
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
from trackwright.tuning.design.layouts import range_sensor

CELLS = 60
"""Cells of the map along the longer side of the floor."""

UNLIMITED = 1e3
"""Bound, m, above which a position is not determined."""


class Sigmas(NamedTuple):
    """Standard deviations of a range, m, of an azimuth or elevation, rad, and of a phase, rad."""

    range: float
    angle: float
    phase: float


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
    """One epoch: a range of every anchor, phases of every station with antennas, angles of every other station.

    `height`: of the tags, m, if known; the sensors then take a position in the plane. Noise is normal; biases are zero.
    """
    known = {} if height is None else {"height": jnp.asarray(height)}
    sensors = [
        SensorAtEpoch(range_sensor(1, sigmas.range), {"anchors": jnp.asarray(p), "anchor": jnp.zeros(1), **known}, 1)
        for p in rig.anchors.values()
    ]
    for station in rig.stations.values():
        if station.antennas is not None:
            sensors.append(SensorAtEpoch(SphericalPhases(station, sigmas.phase), known, len(station.antennas)))
        else:
            angles = BearingSensor(sigmas.angle, sigmas.angle, 1e6)
            origin, axes = np.split(bearing_inputs(station), [3])
            inputs = {ORIGIN.name: jnp.asarray(origin), AXES.name: jnp.asarray(axes)}
            sensors.append(SensorAtEpoch(angles, inputs | known, 2))
    return sensors


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
    found = np.asarray(eqx.filter_jit(jax.vmap(lambda p: information(sensors, p)))(points))
    # A position that the sensors do not determine has an information with an eigenvalue of zero, up to rounding.
    values, vectors = np.linalg.eigh(found)
    determined = np.min(values, axis=1) > 1 / UNLIMITED**2
    values = np.where(determined[:, None], values, np.nan)
    inverse = np.einsum("kia,ka,kja->kij", vectors, 1 / values, vectors)
    return inverse.reshape(*grid.shape[:2], grid.shape[-1], grid.shape[-1])
