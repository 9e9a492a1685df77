"""What can be laid out: anchors on the walls of a hall, antennas in an array. Coordinates in a unit cube, constraints.

A layout turns `theta`, numbers between 0 and 1, into sensors; `project` brings any numbers into their range, and
`violation` says how far the other constraints are from holding: 0 where they hold, growing with the square.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.aoa.phases import SphericalPhases
from trackers.core.rig import Station
from trackers.parts.ranges import RangeSensor
from tuning.design.bound import Look, mean_bound

Bound = Callable[[Sequence[Look], Any], Any]

WEIGHT = 300.0
"""Of the violations beside the logarithm of the bound: a violated constraint costs more than any bound gains."""


class AbstractLayout(eqx.Module):
    """Things to be placed, and where they may stand."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Of theta: things, and coordinates of each."""

    @abstractmethod
    def places(self, theta: Any) -> Any:
        """Where the things stand, m."""

    @abstractmethod
    def looks(self, theta: Any) -> list[Look]:
        """What one epoch reads."""

    @abstractmethod
    def project(self, theta: Any) -> Any:
        """The nearest theta in its range."""

    @abstractmethod
    def violation(self, theta: Any) -> Any:
        """How far constraints other than the range are from holding, squared; 0 where they hold."""

    def objective(self, points: Any, bound: Bound = mean_bound) -> Callable[..., Any]:
        """What is to be least, of theta and the constraints' weight: log of the bound, and violations."""

        def cost(theta: Any, weight: Any = WEIGHT) -> Any:
            return jnp.log(bound(self.looks(theta), points)) + weight * self.violation(theta)

        return cost


class WallAnchors(AbstractLayout):
    """Anchors on the walls of a room, of each theta how far round the room it is, and how high in its band.

    `corners` (c, 2) m, in order; `bands` (anchors, 2): each one's least and greatest height, m; `spacing`: how near two
    may be, m; `sensor`: what takes a range, one slot, the anchors numbered from 0; `height`: that of tags whose height
    is known. Bands keep anchors out of one plane: the bound knows of small errors alone, not of a tag's mirror image.
    """

    corners: Any
    bands: Any
    spacing: float
    sensor: RangeSensor
    height: float | None = eqx.field(static=True, default=None)

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.bands), 2

    def places(self, theta: Any) -> Any:
        """(anchors, 3)."""
        closed = np.vstack([self.corners, self.corners[:1]])
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        along = theta[:, 0] * length[-1]
        x, y = (jnp.interp(along, length, closed[:, k]) for k in (0, 1))
        low, high = self.bands[:, 0], self.bands[:, 1]
        return jnp.stack([x, y, low + theta[:, 1] * (high - low)], axis=1)

    def theta(self, places: np.ndarray) -> np.ndarray:
        """That of anchors (anchors, 3), m, on the walls; raises ValueError for one that isn't."""
        closed = np.vstack([self.corners, self.corners[:1]])
        ways = np.diff(closed, axis=0)
        lengths = np.linalg.norm(ways, axis=1)
        before = np.concatenate([[0.0], np.cumsum(lengths)])
        round_it = []
        for place in np.asarray(places)[:, :2]:
            shares = np.clip(np.sum((place - closed[:-1]) * ways, axis=1) / lengths**2, 0.0, 1.0)
            off = np.linalg.norm(closed[:-1] + shares[:, None] * ways - place, axis=1)
            wall = int(np.argmin(off))
            if off[wall] > 1e-6:
                raise ValueError(f"the anchor at {place} m is {off[wall]:.3g} m off the walls")
            round_it.append((before[wall] + shares[wall] * lengths[wall]) / before[-1])
        low, high = self.bands[:, 0], self.bands[:, 1]
        return np.stack([round_it, (np.asarray(places)[:, 2] - low) / (high - low)], axis=1)

    def looks(self, theta: Any) -> list[Look]:
        known = {} if self.height is None else {"height": jnp.asarray(self.height)}
        return [
            Look(self.sensor, {"anchors": place, "anchor": jnp.full(1, float(k)), **known}, 1)
            for k, place in enumerate(self.places(theta))
        ]

    def project(self, theta: Any) -> Any:
        """The way round the room begins anew, the height ends at the band."""
        return jnp.stack([theta[:, 0] % 1.0, jnp.clip(theta[:, 1], 0.0, 1.0)], axis=1)

    def violation(self, theta: Any) -> Any:
        return too_near(self.places(theta), self.spacing)


class PlanarArray(AbstractLayout):
    """Antennas in the plane of an array that all stations share, theta their places in a box about its middle.

    `stations`: where the arrays stand; `half_box` (2,) m; `spacing`: how near two antennas may be, m; `side_lobe`: the
    largest value that the array factor may have outside the main beam, where a beamformer could mistake it for the
    beacon: the bound, which knows of small errors alone, would take a sparse array. `sigma_p` rad.
    """

    stations: Mapping[str, Station]
    half_box: Any
    spacing: float
    side_lobe: float
    sigma_p: float
    count: int = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        return self.count, 2

    def places(self, theta: Any) -> Any:
        """(antennas, 2)."""
        return (2 * theta - 1) * jnp.asarray(self.half_box)[None, :]

    def theta(self, places: np.ndarray) -> np.ndarray:
        """That of antennas (n, 2), m."""
        return (np.asarray(places) / self.half_box + 1) / 2

    def looks(self, theta: Any) -> list[Look]:
        flat = self.places(theta)
        made = []
        for station in self.stations.values():
            axes = station.world_from_array()
            in_world = flat @ axes[:, :2].T
            template = SphericalPhases(station, self.sigma_p)
            made.append(Look(eqx.tree_at(lambda s: s.antennas, template, in_world), {}, self.count))
        return made

    def project(self, theta: Any) -> Any:
        return jnp.clip(theta, 0.0, 1.0)

    def violation(self, theta: Any) -> Any:
        beyond = jnp.maximum(self.side_lobes(theta) - self.side_lobe, 0.0)
        return too_near(self.places(theta), self.spacing) + jnp.max(beyond) ** 2 + jnp.mean(beyond**2)

    def side_lobes(self, theta: Any) -> Any:
        """The array factor, 1 in the beam, for the differences of direction cosines outside the main beam."""
        wavelength = next(s.wavelength for s in self.stations.values() if s.wavelength is not None)
        du, dv = np.meshgrid(np.linspace(0, 1, 21), np.linspace(-1, 1, 41), indexing="ij")
        outside = (du / 0.25) ** 2 + (dv / 0.4) ** 2 >= 1
        u = 2 * np.pi / wavelength * np.stack([du[outside], dv[outside]])
        phases = self.places(theta) @ u
        return jnp.sqrt(jnp.mean(jnp.cos(phases), axis=0) ** 2 + jnp.mean(jnp.sin(phases), axis=0) ** 2 + 1e-12)


def too_near(places: Any, spacing: float) -> Any:
    """The sum over pairs of what is missing of the spacing, as a share of it, squared."""
    n = places.shape[0]
    one, other = np.triu_indices(n, 1)
    square = jnp.sum((places[one] - places[other]) ** 2, axis=1)
    apart = jnp.sqrt(jnp.maximum(square, 1e-12))
    return jnp.sum(jnp.maximum(1.0 - apart / spacing, 0.0) ** 2)


def range_sensor(anchors: int, sigma_r: float) -> RangeSensor:
    """Ranges with normal noise of `sigma_r` m, as a bound takes them."""
    return RangeSensor(1, anchors, sigma_r, 1.0, 1e6)
