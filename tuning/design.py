"""Layout design: where anchors, stations or antennas should stand, by the Cramér–Rao bound of one epoch over a volume.

An epoch is one reading of every sensor. Its information about the position p is Σ HᵀH over the sensors, with H the
Jacobian of the whitened residual, by automatic differentiation of the sensors' own `measure` and `residual`. No
unbiased estimate from one epoch has a root mean square error below the root of tr (Σ HᵀH)⁻¹.

A layout maps `theta`, numbers between 0 and 1, to sensors: anchors on the walls of a hall, or antennas in an array.
`project` maps any numbers to this range; `violation` is the squared violation of the other constraints, 0 where they
hold. The bound is minimised by gradient from many starts, or by grid search for comparison.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from trackwright.trackers.aoa.phases import SphericalPhases
from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.motion import Kinematic
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.uwb_imu.differences import PAIR, PAIRS, RangeDifferenceSensor

Points = Float[Array | np.ndarray, "k d"]


class SensorAtEpoch(NamedTuple):
    """A sensor with its number of `channels`, the inputs of its row, and the noise that the device reports."""

    sensor: AbstractSensor
    inputs: Mapping[str, Array]
    channels: int
    reported: tuple[float, ...] = ()


def information(sensors: Sequence[SensorAtEpoch], position: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Fisher's information (d, d), 1/m², of one epoch about `position` (d,), m, with all channels seen.

    d is 2 where the inputs hold the `height`.
    """
    total = jnp.zeros((len(position), len(position)), position.dtype)
    for noise, alike in _by_kind(sensors):

        def of_look(look: tuple[AbstractSensor, Mapping[str, Array]], noise: Any = noise) -> Float[Array, "d d"]:
            return _of_sensor(SensorAtEpoch(*look, *noise), position)

        total = total + jnp.sum(jax.vmap(of_look)(alike), axis=0)
    return total


def _by_kind(sensors: Sequence[SensorAtEpoch]) -> Iterator[tuple[Any, Any]]:
    """Sensors of one kind with their inputs, stacked for one compiled function; first their channels and noise."""
    kinds = defaultdict(list)
    for sensor, inputs, channels, reported in sensors:
        leaves, tree = jax.tree_util.tree_flatten((sensor, inputs))
        kinds[(channels, reported), tree, tuple(jnp.shape(x) for x in leaves)].append(leaves)
    for (noise, tree, _), members in kinds.items():
        yield noise, jax.tree_util.tree_unflatten(tree, [jnp.stack(parts) for parts in zip(*members, strict=True)])


def _of_sensor(look: SensorAtEpoch, position: Float[Array, " d"]) -> Float[Array, "d d"]:
    sensor, inputs, channels, reported = look

    def predicted(p: Float[Array, " d"]) -> list[Scalar]:
        return list(sensor.measure(Kinematic(Vector(*p), Vector(*(jnp.zeros_like(x) for x in p))), inputs))

    # The noise-free reading is a constant: it does not depend on the assumed position.
    exact = Reading(jax.lax.stop_gradient(predicted(position)), [jnp.asarray(True)] * channels, reported)

    def residual_at(p: Float[Array, " d"]) -> tuple[Float[Array, " m"], Scalar | None]:
        residual = sensor.residual(exact, predicted(p))
        return jnp.stack(residual.whitened), residual.dof

    H, dof = jax.jacfwd(residual_at, has_aux=True)(position)
    # Fisher's information of Student's t is (ν + 1)/(ν + 3) of the normal's.
    return (1.0 if dof is None else (dof + 1.0) / (dof + 3.0)) * (H.T @ H)


def variance(J: Float[Array, "d d"]) -> Float[Array, ""]:
    """tr J⁻¹ of an information (2, 2) or (3, 3), by Cramer's rule: batched LAPACK calls can deadlock on few cores."""
    if len(J) == 2:
        return (J[0, 0] + J[1, 1]) / (J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0])
    a, b, c = J
    by_a, by_b, by_c = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    return (by_a[0] + by_b[1] + by_c[2]) / (a @ by_a)


def bounds(sensors: Sequence[SensorAtEpoch], points: Points) -> Float[Array, " k"]:
    """The bound (k,), m, of the root mean square position error at each of the points (k, d)."""
    variances = jax.vmap(lambda p: variance(information(sensors, p)))(points)
    # Rounding can make the variance negative where a direction is undetermined; the bound is unlimited there.
    return jnp.sqrt(jnp.where(variances > 0, variances, 1e12))


def mean_bound(sensors: Sequence[SensorAtEpoch], points: Points) -> Float[Array, ""]:
    """The root mean square of the bounds over the points, m: for tags anywhere in the volume."""
    return jnp.sqrt(jnp.mean(bounds(sensors, points) ** 2))


Theta = Float[Array | np.ndarray, "elements coordinates"]
"""Numbers from 0 to 1, one row per element."""

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

    def objective(self, points: Points) -> Callable[..., Scalar]:
        """The cost as a function of theta and the weight of violations: log of the bound plus weighted violations."""

        def cost(theta: Theta, weight: Scalar = WEIGHT) -> Scalar:
            return jnp.log(mean_bound(self.sensors(theta), points)) + weight * self.violation(theta)

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


Objective = Callable[..., Scalar]
"""Cost as a function of theta, and optionally of the weight of the violations."""

WEIGHT_INCREASE = 1000.0
"""Factor by which the weight of violations rises during a descent."""

_BATCH = 1024

MOST_SWEEPS = 20


class SearchResult(NamedTuple):
    """The best `theta`, its `value`, and the number of `evaluations` of the cost or its gradient."""

    theta: Float[np.ndarray, "elements coordinates"]
    value: float
    evaluations: int


def descend(
    objective: Objective,
    project: Callable[[Theta], Theta],
    starts: Float[np.ndarray, "s elements coordinates"],
    steps: int = 150,
    rate: float = 0.05,
) -> SearchResult:
    """The best result of Adam (Kingma & Ba 2015) with projected steps from all `starts` (s, …), in one call.

    The `rate` falls to zero along a cosine while the weight of violations, the cost's second argument, rises by
    `WEIGHT_INCREASE` to its final value: full weight from the beginning would trap most starts. A non-finite gradient
    counts as zero.
    """
    optimiser = optax.scale_by_adam()

    def descent(theta: Theta) -> tuple[Theta, Scalar]:
        def step(carry: Any, done: Any) -> tuple[Any, None]:
            theta, state = carry
            gradient = jax.grad(objective)(theta, WEIGHT * WEIGHT_INCREASE ** (done - 1.0))
            gradient = jnp.where(jnp.all(jnp.isfinite(gradient)), gradient, 0.0)
            # Adam raises a float to the power of an integer count, which strict promotion would refuse.
            with jax.numpy_dtype_promotion("standard"):
                update, state = optimiser.update(gradient, state, theta)
            return (project(theta - 0.5 * rate * (1.0 + jnp.cos(jnp.pi * done)) * update), state), None

        (theta, _), _ = jax.lax.scan(step, (theta, optimiser.init(theta)), jnp.arange(steps) / steps)
        return theta, objective(theta)

    ends, values = jax.jit(jax.vmap(descent))(jnp.asarray(starts))
    return _best(np.asarray(ends), np.asarray(values), len(starts) * (steps + 1))


def exhaust(
    objective: Objective, choices: Float[np.ndarray, "c coordinates"], ways: Iterable[tuple[int, ...]]
) -> SearchResult:
    """The best of all `ways` to place elements on a grid of `choices` (c, d); a way is the indices of its choices."""
    evaluate = jax.jit(jax.vmap(lambda theta: objective(theta)))
    remaining, best, number = iter(ways), None, 0
    while chosen := list(islice(remaining, _BATCH)):
        # The last batch is padded to the shape of the others.
        filled = chosen + [chosen[-1]] * (_BATCH - len(chosen))
        thetas = choices[np.array(filled)]
        number += len(chosen)
        best_of_batch = _best(thetas, np.asarray(evaluate(jnp.asarray(thetas))), number)
        best = best_of_batch if best is None or best_of_batch.value < best.value else best
    assert best is not None
    return best._replace(evaluations=number)


def exchange(objective: Objective, choices: np.ndarray, starts: Sequence[np.ndarray]) -> SearchResult:
    """Fedorov's exchange (1972) on a grid: elements move in turn to the best of all `choices` (c, d), until none moves.

    For too many combinations to try all. From each of the `starts`, indices (n,) of choices.
    """
    evaluate = jax.jit(jax.vmap(lambda theta: objective(theta)))
    best, number = None, 0
    for start in starts:
        chosen, value = np.array(start), np.inf
        for _ in range(MOST_SWEEPS):
            before = chosen.copy()
            for k in range(len(chosen)):
                tried = np.repeat(chosen[None], len(choices), axis=0)
                tried[:, k] = np.arange(len(choices))
                values = np.asarray(evaluate(jnp.asarray(choices[tried])))
                number += len(choices)
                values = np.where(np.isfinite(values), values, np.inf)
                chosen, value = tried[int(np.argmin(values))], float(values.min())
            if np.array_equal(chosen, before):
                break
        if best is None or value < best.value:
            best = SearchResult(choices[chosen], value, number)
    assert best is not None
    return best._replace(evaluations=number)


def _best(thetas: np.ndarray, values: np.ndarray, evaluations: int) -> SearchResult:
    k = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    return SearchResult(thetas[k], float(values[k]), evaluations)
