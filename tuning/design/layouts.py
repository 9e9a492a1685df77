"""Layouts: anchors on the walls of a hall, antennas in an array; their coordinates in a unit cube and constraints.

A layout maps `theta`, numbers between 0 and 1, to sensors. `project` maps any numbers to this range; `violation` is the
squared violation of the other constraints, 0 where they hold.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.aoa.phases import SphericalPhases
from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.uwb_imu.differences import PAIR, PAIRS, RangeDifferenceSensor
from trackwright.tuning.design.bound import Points, SensorAtEpoch, mean_bound

Theta = Float[Array | np.ndarray, "elements coordinates"]
"""Numbers from 0 to 1, one row per element."""

Bound = Callable[[Sequence[SensorAtEpoch], Points], Scalar]

WEIGHT = 300.0
"""Weight of violations against the logarithm of the bound: a violation costs more than any bound gains."""


class AbstractLayout(eqx.Module):
    """Elements to be placed (anchors, antennas or stations) and their constraints."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """The shape of theta: elements, coordinates of each."""

    @abstractmethod
    def positions(self, theta: Theta) -> Float[Array, "elements axes"]:
        """The positions of the elements, m."""

    @abstractmethod
    def sensors(self, theta: Theta) -> list[SensorAtEpoch]:
        """The sensors of one epoch."""

    @abstractmethod
    def project(self, theta: Theta) -> Theta:
        """The nearest theta within its range."""

    @abstractmethod
    def violation(self, theta: Theta) -> Float[Array, ""]:
        """The squared violation of constraints other than the range; 0 where they hold."""

    def objective(self, points: Points, bound: Bound = mean_bound) -> Callable[..., Scalar]:
        """The cost as a function of theta and the weight of violations: log of the bound plus weighted violations."""

        def cost(theta: Theta, weight: Scalar = WEIGHT) -> Scalar:
            return jnp.log(bound(self.sensors(theta), points)) + weight * self.violation(theta)

        return cost


class WallAnchors(AbstractLayout):
    """Anchors on the walls of a room; theta is each one's share of the perimeter, and of the height of its band.

    `corners` (c, 2) m, in order; `bands` (anchors, 2): each one's least and greatest height, m; `spacing`: minimum
    distance of two anchors, m; `measured`: what anchors at places (n, 3), m, measure, as `ranges` or
    `range_differences` of a sigma; `height`: of tags at a known height; `fixed` (k, 3) m: anchors that stay where they
    are, after the others. Bands keep the anchors out of one plane: the bound covers small errors only, not mirrored
    positions.
    """

    corners: Float[np.ndarray, "c 2"]
    bands: Float[np.ndarray, "elements 2"]
    spacing: float
    measured: Callable[[Float[Array, "anchors 3"], Mapping[str, Array]], list[SensorAtEpoch]] = eqx.field(static=True)
    height: float | None = eqx.field(static=True, default=None)
    fixed: Float[np.ndarray, "k 3"] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.bands), 2

    def positions(self, theta: Theta) -> Float[Array, "elements axes"]:
        """(anchors, 3)."""
        closed = np.vstack([self.corners, self.corners[:1]])
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        along = theta[:, 0] * length[-1]
        x, y = (jnp.interp(along, length, closed[:, k]) for k in (0, 1))
        low, high = self.bands[:, 0], self.bands[:, 1]
        return jnp.stack([x, y, low + theta[:, 1] * (high - low)], axis=1)

    def theta(self, places: Float[np.ndarray, "elements 3"]) -> Float[np.ndarray, "elements 2"]:
        """The theta of anchors (anchors, 3), m, on the walls; raises ValueError for an anchor off the walls."""
        closed = np.vstack([self.corners, self.corners[:1]])
        walls = np.diff(closed, axis=0)
        lengths = np.linalg.norm(walls, axis=1)
        before = np.concatenate([[0.0], np.cumsum(lengths)])
        along = []
        for place in np.asarray(places)[:, :2]:
            shares = np.clip(np.sum((place - closed[:-1]) * walls, axis=1) / lengths**2, 0.0, 1.0)
            off = np.linalg.norm(closed[:-1] + shares[:, None] * walls - place, axis=1)
            wall = int(np.argmin(off))
            if off[wall] > 1e-6:
                raise ValueError(f"the anchor at {place} m is {off[wall]:.3g} m off the walls")
            along.append((before[wall] + shares[wall] * lengths[wall]) / before[-1])
        low, high = self.bands[:, 0], self.bands[:, 1]
        return np.stack([along, (np.asarray(places)[:, 2] - low) / (high - low)], axis=1)

    def sensors(self, theta: Theta) -> list[SensorAtEpoch]:
        return self.measured(self._all(theta), {} if self.height is None else {"height": jnp.asarray(self.height)})

    def _all(self, theta: Theta) -> Float[Array, "anchors 3"]:
        """The positions of the anchors on the walls, then those of the fixed ones, m."""
        placed = self.positions(theta)
        return placed if self.fixed is None else jnp.concatenate([placed, jnp.asarray(self.fixed, placed.dtype)])

    def project(self, theta: Theta) -> Theta:
        """The perimeter wraps around, the height is clipped to the band."""
        return jnp.stack([theta[:, 0] % 1.0, jnp.clip(theta[:, 1], 0.0, 1.0)], axis=1)

    def violation(self, theta: Theta) -> Float[Array, ""]:
        return spacing_violation(self._all(theta), self.spacing)


class PlanarArray(AbstractLayout):
    """Antennas in the plane of an array that all stations share; theta is their positions in a centred box.

    `stations`: poses of the arrays; `half_box` (2,) m; `spacing`: minimum distance of two antennas, m; `side_lobe`: the
    maximum of the array factor outside the main beam. Without it the result is a sparse, ambiguous array, since the
    bound covers small errors only. `sigma_p` rad.
    """

    stations: Mapping[str, Station]
    half_box: Float[np.ndarray, " 2"]
    spacing: float
    side_lobe: float
    sigma_p: float
    count: int = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        return self.count, 2

    def positions(self, theta: Theta) -> Float[Array, "elements axes"]:
        """(antennas, 2)."""
        return (2 * jnp.asarray(theta) - 1) * jnp.asarray(self.half_box)[None, :]

    def theta(self, places: Float[np.ndarray, "elements 2"]) -> Float[np.ndarray, "elements 2"]:
        """The theta of antennas (n, 2), m."""
        return (np.asarray(places) / self.half_box + 1) / 2

    def sensors(self, theta: Theta) -> list[SensorAtEpoch]:
        flat = self.positions(theta)
        made = []
        for station in self.stations.values():
            axes = station.world_from_array()
            in_world = flat @ axes[:, :2].T
            template = SphericalPhases(station, self.sigma_p)
            made.append(SensorAtEpoch(eqx.tree_at(lambda s: s.antennas, template, in_world), {}, self.count))
        return made

    def project(self, theta: Theta) -> Theta:
        return jnp.clip(theta, 0.0, 1.0)

    def violation(self, theta: Theta) -> Float[Array, ""]:
        beyond = jnp.maximum(self.side_lobes(theta) - self.side_lobe, 0.0)
        return spacing_violation(self.positions(theta), self.spacing) + jnp.max(beyond) ** 2 + jnp.mean(beyond**2)

    def side_lobes(self, theta: Theta) -> Float[Array, " directions"]:
        """The array factor, 1 in the beam, at differences of direction cosines outside the main beam."""
        wavelength = next(s.wavelength for s in self.stations.values() if s.wavelength is not None)
        du, dv = np.meshgrid(np.linspace(0, 1, 21), np.linspace(-1, 1, 41), indexing="ij")
        outside = (du / 0.25) ** 2 + (dv / 0.4) ** 2 >= 1
        u = 2 * np.pi / wavelength * np.stack([du[outside], dv[outside]])
        phases = self.positions(theta) @ u
        return jnp.sqrt(jnp.mean(jnp.cos(phases), axis=0) ** 2 + jnp.mean(jnp.sin(phases), axis=0) ** 2 + 1e-12)


def spacing_violation(places: Float[Array, "elements axes"], spacing: float) -> Float[Array, ""]:
    """The sum over pairs of the squared shortfall of the spacing, relative to it."""
    n = places.shape[0]
    one, other = np.triu_indices(n, 1)
    square = jnp.sum((places[one] - places[other]) ** 2, axis=1)
    distance = jnp.sqrt(jnp.maximum(square, 1e-12))
    return jnp.sum(jnp.maximum(1.0 - distance / spacing, 0.0) ** 2)


def ranges(sigma: float, places: Float[Array, "anchors 3"], known: Mapping[str, Array]) -> list[SensorAtEpoch]:
    """A range from each of the places, m, with normal noise of `sigma` m; `known`: other inputs, as the height."""
    sensor = RangeSensor(1, 1, sigma, 1.0, 1e6)
    return [SensorAtEpoch(sensor, {"anchors": place, "anchor": jnp.zeros(1), **known}, 1) for place in places]


def range_differences(
    sigma: float, places: Float[Array, "anchors 3"], known: Mapping[str, Array]
) -> list[SensorAtEpoch]:
    """The differences of all from the first, which is as good as any: they share its time of arrival. See `ranges`."""
    slots = len(places) - 1
    if slots < 1:
        return []
    number = np.stack([np.arange(1, slots + 1), np.zeros(slots, int)], axis=1)
    inputs = {PAIRS.name: places[number].ravel(), PAIR.name: jnp.asarray(1.0 * number.ravel()), **known}
    reported = (*[0.0] * slots, *[0.5] * (slots * (slots - 1) // 2))
    return [SensorAtEpoch(RangeDifferenceSensor(slots, sigma, 1e6), inputs, slots, reported)]
