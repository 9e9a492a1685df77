"""The workshop of Huang et al. 2018, section 4: a vehicle on a route round a workstation, and fixes of its tag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from trackwright.sim.corruptions import Corruption, correlated_noise, corrupted, gauss_markov, outliers
from trackwright.sim.keys import Keys, namespace, stream, uniforms
from trackwright.sim.tables import AXES, AbstractDraw, ArrayRows, SimulatedWorld, by_name, static
from trackwright.trackers.mhk.tracker import STILL
from trackwright.trackers.recordings.folder import RecordingFolder

LARGEST_SPEED, LARGEST_ACCELERATION = 2.0, 2.0  # limits of the paper's vehicle, m/s and m/s²
TAG_HEIGHT, RATE_HZ = 1.2, 10.0  # of the vehicles: height of the tag, m, and fixes per second
ANCHOR_HEIGHT = 2.5  # of all anchors, m; heights are ambiguous by their mirror image at this plane

FIX_ERRORS: Mapping[str, Corruption] = MappingProxyType(
    {"noise": correlated_noise(STILL), "drift": gauss_markov(0.07, 0.5), "outliers": outliers(0.25, 0.19)}
)
"""The paper's noise at rest; drift and outliers chosen such that the errors of raw fixes equal the paper's."""


@dataclass(frozen=True)
class Route:
    """A closed route: a rectangle with rounded corners, centred on the origin, anticlockwise; lengths in m."""

    width: float = 10.0
    depth: float = 6.0
    radius: float = 1.0

    @property
    def length(self) -> float:
        """The length of one round, m."""
        return float(self._ends()[-1])

    def at(self, arclength: Float[Any, "*rows"]) -> Float[Any, "*rows 2"]:
        """Positions (..., 2), m, at these arc lengths, m, from the middle of the lower side."""
        xp, ends = namespace(arclength), self._ends()
        s = xp.fmod(xp.asarray(arclength), ends[-1])
        s = xp.where(s < 0, s + ends[-1], s)
        part = xp.minimum(sum((s >= end).astype(np.int32) for end in ends), len(ends) - 1)
        # Of each part: each side starts at the end of the corner before it; the first side starts at its middle.
        parts = np.arange(len(ends))
        quarter, turns = parts // 2 % 4, parts % 2 == 1
        heading = quarter * (np.pi / 2)
        corner = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * (np.array([self.width, self.depth]) / 2 - self.radius)
        corner, direction = corner[quarter], np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        begin = corner + self.radius * np.stack([np.sin(heading), -np.cos(heading)], axis=-1)
        side = np.array([self.width, self.depth, self.width, self.depth])[quarter] - 2 * self.radius
        side[0] /= 2
        starts = np.concatenate([[0.0], ends[:-1]])
        of_parts = np.stack([starts, side, heading, turns, *begin.T, *direction.T, *corner.T])
        # A product with zeros and a one: in a program a look-up takes several times as long as the filter.
        at = (part == parts.reshape(-1, *[1] * s.ndim)).astype(s.dtype)
        start, side, heading, turning, *points = xp.tensordot(of_parts.astype(s.dtype), at, 1)
        back, angle = side - (s - start), heading + (s - start) / self.radius
        straight = [begin - back * direction for begin, direction in zip(points[:2], points[2:4], strict=True)]
        turned = [points[4] + self.radius * xp.sin(angle), points[5] - self.radius * xp.cos(angle)]
        return xp.stack([xp.where(turning > 0, a, b) for a, b in zip(turned, straight, strict=True)], axis=-1)

    def distance(self, points: Float[np.ndarray, "*rows 2"]) -> Float[np.ndarray, "*rows"]:
        """The distance of points (..., 2), m, from the route, inside or outside: an error without regard to time."""
        half = np.array([self.width, self.depth]) / 2 - self.radius
        beyond = np.abs(np.asarray(points, float)) - half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        return np.abs(outside + np.minimum(beyond.max(axis=-1), 0.0) - self.radius)

    def knots(self, spacing: float = 0.05) -> Float[np.ndarray, "k 2"]:
        """The route as a closed polyline: corners (k, 2), m, at most `spacing` m apart along it."""
        return self.at(np.linspace(0, self.length, int(np.ceil(self.length / spacing)) + 1))

    def _ends(self) -> Float[np.ndarray, " 9"]:
        """Arc lengths, m, at the ends of the parts of the route: half a side, corner, side, corner, …, half a side."""
        a, b, c = self.width - 2 * self.radius, self.depth - 2 * self.radius, self.radius * np.pi / 2
        return np.cumsum([a / 2, c, b, c, a, c, b, c, a / 2])


class VehicleDraw(AbstractDraw):
    """Vehicles at rest at a random position on the route that accelerate at 1 m/s² and keep `speed`, also in corners.

    `errors`: corruptions of the fixes by name, in order. `rows`: fixes of each. Its arrays: `positions`, `fixes`
    (n, T, 3) m, where `seen`. Raises ValueError for a speed or corners beyond the limits of the paper's vehicle.
    """

    errors: Mapping[str, Corruption] = by_name(default_factory=lambda: FIX_ERRORS)
    route: Route = static(default=Route())
    speed: float = static(default=0.5)
    rows: int = static(default=2000)

    measured = MappingProxyType({"fixes": "seen"})

    def __check_init__(self) -> None:
        radius = self.route.radius
        if not 0 < self.speed <= min(LARGEST_SPEED, (LARGEST_ACCELERATION * radius) ** 0.5):
            raise ValueError(f"speed {self.speed} m/s: the vehicle reaches 2 m/s, and 2 m/s² in corners of {radius} m")

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        return np.arange(self.rows) / RATE_HZ

    def arrays(self, keys: Keys) -> dict[str, Any]:
        times, speed = self.times, self.speed
        # ½ t² until t = `speed`, when 1 m/s² has led to `speed`; constant speed from there.
        covered = np.where(times < speed, 0.5 * times**2, speed * times - 0.5 * speed**2)
        start = uniforms(stream(keys, "start"), (1,)).astype(float) * self.route.length
        floor = self.route.at(start + covered)
        xp = namespace(floor)
        positions = xp.concatenate([floor, xp.full_like(floor[..., :1], TAG_HEIGHT)], axis=-1)
        fixes, seen = corrupted(self.errors, keys, times, positions)
        return {"positions": positions, "fixes": fixes, "seen": seen}

    def folder(self, world: SimulatedWorld) -> RecordingFolder:
        """Fixes and truth in space, the designed route as the rig's path."""
        half = np.array([self.route.width, self.route.depth]) / 2 + 1.0
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        anchors = {str(k + 1): np.array([*c, ANCHOR_HEIGHT]) for k, c in enumerate(corners)}
        fixes = ArrayRows(world.times, world.ids, {AXES: np.where(world.seen, world.arrays["fixes"], np.nan)})
        return world.recorded({"fixes": fixes, "truth": world.truth()}, anchors=anchors, path_knots=self.route.knots())
