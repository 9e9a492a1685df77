"""The workshop of Huang et al. 2018, section 4: a vehicle on a route round a workstation, and fixes of its tag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.sim.corruptions import Corruption, correlated_noise, corrupted, gauss_markov, outliers
from trackwright.sim.keys import Keys, in_blocks, stream, trajectory_ids, trajectory_keys, uniforms
from trackwright.sim.tables import AXES, ArrayRows, folder_of
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

    def at(self, arclength: Float[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows 2"]:
        """Positions (..., 2), m, at these arc lengths, m, from the middle of the lower side."""
        ends = self._ends()
        s = np.asarray(np.fmod(np.asarray(arclength, float), ends[-1]))
        s[s < 0] += ends[-1]
        part = np.minimum(np.searchsorted(ends, s, side="right"), len(ends) - 1)
        along = s - np.concatenate([[0.0], ends]).take(part)
        # Of each part: each side starts at the end of the corner before it; the first side starts at its middle.
        parts = np.arange(len(ends))
        quarter, turns = parts // 2 % 4, parts % 2 == 1
        heading = quarter * (np.pi / 2)
        corner = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * (np.array([self.width, self.depth]) / 2 - self.radius)
        corner, direction = corner[quarter], np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        begin = corner + self.radius * np.stack([np.sin(heading), -np.cos(heading)], axis=-1)
        side = np.array([self.width, self.depth, self.width, self.depth])[quarter] - 2 * self.radius
        side[0] /= 2
        back = side.take(part) - along
        positions = np.stack(
            [x.take(part) - back * d.take(part) for x, d in zip(begin.T, direction.T, strict=True)], axis=-1
        )
        turning = turns.take(part)
        at = part[turning]
        angle = heading[at] + along[turning] / self.radius
        positions[turning] = corner[at] + self.radius * np.stack([np.sin(angle), -np.cos(angle)], axis=-1)
        return positions

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


@dataclass(frozen=True)
class SimulatedFixes:
    """Fixes of n tags at T times with their truth: m and s; `route`: the designed one; `ids`: the trajectory ids."""

    times: Float[np.ndarray, " T"]
    positions: Float[np.ndarray, "n T 3"]
    fixes: Float[np.ndarray, "n T 3"]
    seen: Bool[np.ndarray, "n T 3"]
    route: Float[np.ndarray, "k 2"]
    anchors: dict[str, Float[np.ndarray, " 3"]]
    ids: Int[np.ndarray, " n"]

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder: fixes and truth in space, the designed route as the rig's path."""
        fixes = self.fixes if self.seen.all() else np.where(self.seen, self.fixes, np.nan)
        tables = {
            name: ArrayRows.regular(self.times, self.ids, {AXES: values})
            for name, values in (("fixes", fixes), ("truth", self.positions))
        }
        return folder_of(name, tables, self.ids, anchors=self.anchors, path_knots=self.route)


def simulate_agv(
    n: int | Sequence[int] | np.ndarray = 1,
    seed: int = 0,
    *,
    route: Route = Route(),
    speed: float = 0.5,
    rows: int = 2000,
    errors: Mapping[str, Corruption] = FIX_ERRORS,
) -> SimulatedFixes:
    """Vehicles at rest at a random position on the route that accelerate at 1 m/s² and keep `speed`, also in corners.

    `n`: number of trajectories, or their ids. `errors`: corruptions of the fixes by name, in order. Raises
    ValueError for a speed or corners beyond the limits of the paper's vehicle.
    """
    if not 0 < speed <= min(LARGEST_SPEED, (LARGEST_ACCELERATION * route.radius) ** 0.5):
        raise ValueError(f"speed {speed} m/s: the vehicle reaches 2 m/s, and 2 m/s² in corners of {route.radius} m")
    ids = trajectory_ids(n)
    keys = trajectory_keys(seed, ids)
    times = np.arange(rows) / RATE_HZ
    # ½ t² until t = `speed`, when 1 m/s² has led to `speed`; constant speed from there.
    covered = np.where(times < speed, 0.5 * times**2, speed * times - 0.5 * speed**2)

    def driven(keys: Keys) -> tuple[np.ndarray, ...]:
        start = uniforms(stream(keys, "start"), (1,)).astype(float) * route.length
        floor = route.at(start + covered)
        positions = np.empty((*floor.shape[:-1], 3))
        positions[..., :2], positions[..., 2] = floor, TAG_HEIGHT
        return positions, *corrupted(errors, keys, times, positions, np.ones(positions.shape, bool))

    positions, fixes, seen = in_blocks(driven, keys)
    half = np.array([route.width, route.depth]) / 2 + 1.0
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    anchors = {str(k + 1): np.array([*c, ANCHOR_HEIGHT]) for k, c in enumerate(corners)}
    return SimulatedFixes(times, positions, fixes, seen, route.knots(), anchors, ids)
