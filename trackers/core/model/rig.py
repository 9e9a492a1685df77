"""The geometry of an installation: anchors, stations with their arrays, tags, a known path. Plain NumPy, SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from trackwright.trackers.core.errors import UnusableInput

Point = Float[np.ndarray, " 3"]
"""A position in space, m."""


def angles_in_array(points: Float[Any, "3 *rows"]) -> Float[Any, "*rows 2"]:
    """Azimuth and elevation (..., 2), rad, of points in array frames: u = (sin az cos el, sin el, cos az cos el)."""
    (x, y, z), xp = points, points.__array_namespace__()
    return xp.stack([xp.arctan2(x, z), xp.arctan2(y, xp.hypot(x, z))], axis=-1)


@dataclass(frozen=True)
class Station:
    """An angle-of-arrival station.

    `position`: (3,) m, world frame. `rotation`: (4,) unit quaternion w, x, y, z from array frame to world frame.
    `antennas`: (n, 2) m in the array's x–y plane, with `wavelength` in m; both None where the station gives angles.
    A longer or shorter quaternion is normalised. Raises UnusableInput for one without a direction.
    """

    position: Point
    rotation: Float[np.ndarray, " 4"]
    antennas: Float[np.ndarray, "n 2"] | None = None
    wavelength: float | None = None

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, float)
        if np.shape(self.position) != (3,):
            raise UnusableInput(f"Station: position = {np.asarray(self.position).tolist()}; expected [x, y, z], m")
        if rotation.shape != (4,) or not 0 < math.hypot(*rotation) < math.inf:
            raise UnusableInput(
                f"Station: rotation = {rotation.tolist()}; expected a quaternion w, x, y, z, as (1, 0, 0, 0)"
            )

    def world_from_array(self) -> Float[np.ndarray, "3 3"]:
        """The 3 × 3 matrix that takes array-frame vectors to world-frame vectors; its columns are the array's axes."""
        w, x, y, z = np.asarray(self.rotation, float) / math.hypot(*self.rotation)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.array(rows)

    def position_in_array(self, world: Float[Any, "*rows 3"]) -> Float[Any, "*rows 3"]:
        """World points (..., 3), m, in this station's array frame."""
        return (world - np.asarray(self.position)) @ self.world_from_array()

    def angles(self, world: Float[Any, "*rows 3"]) -> Float[Any, "*rows 2"]:
        """Azimuth and elevation (..., 2), rad, of world points (..., 3): u = (sin az cos el, sin el, cos az cos el)."""
        points = self.position_in_array(world)
        return angles_in_array(points.__array_namespace__().moveaxis(points, -1, 0))

    def antenna_positions(self) -> Float[np.ndarray, "n 3"]:
        """The antenna positions (n, 3), m, world frame; raises UnusableInput for a station without an array."""
        if self.antennas is None:
            raise UnusableInput("this station has no antennas_m: it reports angles, not phases")
        flat = np.concatenate([self.antennas, np.zeros((len(self.antennas), 1))], axis=1)
        return self.position + flat @ self.world_from_array().T


@dataclass(frozen=True)
class Tag:
    """A tag: its constant `height`, m, if known, and its position on the body (`offset`, (3,) m, body axes)."""

    height: float | None = None
    offset: Point | None = None


# Share of the largest extent, and extent across their best plane, m, up to which anchors leave mirror images.
THIN, FLAT = 0.1, 0.6
# Heights, m: of anchors that tags are likely above, at most, and below, at least; one that no tag reaches.
FLOOR, CEILING, ANYWHERE = 0.5, 2.0, 1e4

SAY_SIDE = "give height_m in rig.toml, or --side above or below"


@dataclass(frozen=True)
class Rig:
    """The fixed geometry of an installation.

    `bodies`: the tags on each rigid body, which have an `offset`.
    `path_knots`: (k, 2) m, corners of a known path on the floor. `walls`: (n, 4) m, x1, y1, x2, y2 of each; `outline`:
    (m, 2) m, corners of the floor that holds the tags. `about`, `licence`, `source`: free text. `side`: above or below,
    where the tags are of anchors in one plane; None if unknown. Raises UnusableInput for another side, and for an
    anchor without three finite coordinates.
    """

    name: str
    anchors: Mapping[str, Point] = field(default_factory=dict)
    stations: Mapping[str, Station] = field(default_factory=dict)
    tags: Mapping[str, Tag] = field(default_factory=dict)
    bodies: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    path_knots: Float[np.ndarray, "k 2"] | None = None
    walls: Float[np.ndarray, "n 4"] | None = None
    outline: Float[np.ndarray, "m 2"] | None = None
    about: str = ""
    licence: str = ""
    source: str = ""
    side: str | None = None

    def __post_init__(self) -> None:
        if self.side not in (None, "above", "below"):
            raise UnusableInput(f"side {self.side!r}: expected 'above' or 'below', of the plane of the anchors")
        for name, place in self.anchors.items():
            if np.shape(place) != (3,) or not np.all(np.isfinite(place)):
                raise UnusableInput(f"Rig: anchor {name} is at {np.asarray(place).tolist()}; expected [x, y, z], m")

    def places(self) -> list[Point]:
        """The positions of its anchors, then of its stations, (3,) m each."""
        return [np.asarray(p) for p in (*self.anchors.values(), *(s.position for s in self.stations.values()))]

    @property
    def plane(self) -> float | None:
        """The height, m, of the plane of the anchors, at which heights may be mirrored; None where they have none."""
        places = np.array([*self.anchors.values()], float).reshape(-1, 3)
        if len(places) < 3:
            return None
        _, sizes, axes = np.linalg.svd(places - places.mean(axis=0))
        flat = sizes[2] <= THIN * sizes[0] and np.ptp(places @ axes[2]) <= FLAT
        return float(places[:, 2].mean()) if flat and abs(axes[2, 2]) > 0.7 else None

    @property
    def likely_side(self) -> str | None:
        """The `side`, or that which is likely by the height of the plane; None for either."""
        height = FLOOR if self.plane is None else self.plane
        return self.side or ("above" if height <= FLOOR else "below" if height >= CEILING else None)

    def height_limits(self) -> Float[np.ndarray, " 2"]:
        """The lowest and highest height of the tags, m: the plane of the anchors, if any, on the likely side of it."""
        limits = np.array([-ANYWHERE, ANYWHERE])
        if self.plane is not None and self.likely_side is not None:
            limits[int(self.likely_side == "below")] = self.plane
        return limits

    def mirror_notice(self) -> list[str]:
        """A line where heights may be mirrored, and nobody said on which side the tags are."""
        if self.plane is None or self.side is not None:
            return []
        where = f"{self.name}: heights may be mirrored at the plane of the anchors, z {self.plane:.2f} m"
        return [f"{where}; tags are taken to be {self.likely_side or 'on either side of'} it; {SAY_SIDE}"]

    def on_body_of(self, tag: str) -> tuple[str, ...]:
        """The tags on the body of this one, itself among them; without `bodies` all that have an `offset` are on one.

        None of a tag on no body.
        """
        if tag not in self.tags or self.tags[tag].offset is None:
            return ()
        with_offset = tuple(name for name, known in self.tags.items() if known.offset is not None)
        bodies = tuple(self.bodies.values()) or (with_offset,)
        return next((body for body in bodies if tag in body), ())

    def all_walls(self) -> Float[np.ndarray, "n 4"]:
        """The walls and the edges of the outline, (n, 4), m."""
        walls = np.zeros((0, 4)) if self.walls is None else self.walls
        corners = np.zeros((0, 2)) if self.outline is None else self.outline
        return np.vstack([walls, np.hstack([corners, np.roll(corners, -1, axis=0)])])


# Distance in x or y, m, from the middle of its places at which a place is of no site: left at a map's origin, say.
ELSEWHERE_M = 1e5
# Least distance, m, by which a room of unknown outline is wider on each side than its anchors or stations.
MARGIN = 10.0


def room_rows(
    points: Float[np.ndarray, "n d"], outline: Float[np.ndarray, "m 2"] | None, rows: int
) -> Float[np.ndarray, "rows 4"]:
    """Lowest and highest x, lowest and highest y of the tags, m, in each of the rows: the input `room`.

    The bounding box of the outline. Without one, of the anchors or stations at `points` (n, 2 or 3), extended on
    each side by its longer side and at least by `MARGIN`, since tags may be outside of it.
    """
    corners = np.asarray(points)[:, :2] if outline is None else np.asarray(outline)
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.0 if outline is not None else max(MARGIN, float((high - low).max()))
    return np.broadcast_to(np.stack([low - margin, high + margin], axis=1).ravel(), (rows, 4))


def mirrored(height: Any, limits: Any) -> Any:
    """Heights, m, mirrored at the limit, (2,) m, beyond which they are; others as they are."""
    return 2.0 * height.clip(limits[0], limits[1]) - height


def checked_knots(knots: ArrayLike) -> Float[np.ndarray, "k 2"]:
    """The knots of a path as an array, m; raises UnusableInput for one that is not finite or repeats the one before."""
    knots = np.asarray(knots, float)
    if knots.ndim != 2 or knots.shape[1:] != (2,) or len(knots) < 2:
        raise UnusableInput(f"a path has at least two knots [x, y], found an array of shape {knots.shape}")
    if not np.all(np.isfinite(knots)):
        raise UnusableInput(f"knot {int(np.argmin(np.isfinite(knots).all(axis=1)))} of the path is not finite")
    lengths = np.sqrt((np.diff(knots, axis=0) ** 2).sum(axis=1))
    if not np.all(lengths > 0):
        k = int(np.argmin(lengths)) + 1
        raise UnusableInput(f"knot {k} of the path repeats the one before, {knots[k].tolist()}; leave one of them out")
    return knots
