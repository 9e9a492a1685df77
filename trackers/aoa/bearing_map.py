"""A map over the floor of what a calibration leaves of bearings, errors that return with the place, and its tracker.

The errors of each angle of a station are a Gaussian process over the floor with an exponential kernel, given the mean
errors of visits to places, each with noise of its own (Rasmussen and Williams 2006, chapter 2). The levels are from
six Bluetooth walks. The visits (V, 4) of a station, x and y, m, and the mean errors of azimuth and elevation there,
rad, are made in `tuning/bearing_map.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from trackwright.trackers.aoa.fusion import BEARINGS, CALIBRATED, STATION, BearingSensor, bearing_tracker
from trackwright.trackers.core.filters.quadrature import AbstractPlaceSensor, AtPoints, QuadratureKalman
from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.state import wrap
from trackwright.trackers.core.run.tracker import Tracker

PLACE_SIGMA, VISIT_SIGMA = np.array([0.1, 0.2]), np.array([0.06, 0.15])  # rad, of the map's angles, of a visit about it
LENGTH_M = 0.6  # of the kernel exp(−distance/length)
STEP_M, MARGIN_M, MOST_NODES = 0.1, 2.0, 200  # of a grid: step, margin, nodes along a side before the step is larger
UNKNOWN = np.concatenate([np.zeros(2), np.hypot(PLACE_SIGMA, VISIT_SIGMA)])  # the values off a grid
DRIFTING = 0.5  # share of the variance about the map that drifts; the rest is white
FACTORS = np.sqrt(DRIFTING) / np.array(CALIBRATED["sigma_bias"])  # of a bias, times the standard deviation there


def predicted(visits: Float[np.ndarray, "V 4"], places: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 4"]:
    """Means of the errors of both angles of a visit to `places`, m, given earlier `visits`, and their sds, rad."""
    among, across = (
        np.exp(-np.linalg.norm(visits[:, None, :2] - other, axis=-1) / LENGTH_M) for other in (visits[:, :2], places)
    )
    # Both angles share the kernel, and thus its eigenvectors.
    eigenvalues, axes = np.linalg.eigh(among)
    across = axes.T @ across
    gains = PLACE_SIGMA**2 / (np.multiply.outer(eigenvalues, PLACE_SIGMA**2) + VISIT_SIGMA**2)
    means = across.T @ (gains * (axes.T @ visits[:, 2:]))
    variances = PLACE_SIGMA**2 * np.maximum(1.0 - (across**2).T @ gains, 0.0) + VISIT_SIGMA**2
    return np.concatenate([means, np.sqrt(variances)], axis=1)


def floor_grid(
    visits: Mapping[str, Float[np.ndarray, "V 4"]], stations: Sequence[str], origin: Sequence[float] = (0.0, 0.0)
) -> tuple[Float[np.ndarray, "S X Y 4"], Float[np.ndarray, " 2"], float]:
    """The map of stations at the nodes of a grid around all visits: as `predicted`; first node about `origin`; step."""
    places = np.concatenate([of_station[:, :2] for of_station in visits.values()]) - origin
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    step = max(STEP_M, float((high - low).max()) / MOST_NODES)
    counts = np.ceil((high - low) / step).astype(int) + 1
    nodes = low + step * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 2)
    values = [predicted(visits.get(name, np.zeros((0, 4))) - [*origin, 0.0, 0.0], nodes) for name in stations]
    return np.stack(values).reshape(len(stations), *counts, 4), low, step


class MappedBearingSensor(BearingSensor, AbstractPlaceSensor):
    """Azimuth and elevation, with the error of the place: its mean m, and s·b + white noise of standard deviation s.

    b is the bias of the angle in the state over its `CALIBRATED` standard deviation, s² half of the map's variance.
    `values` (S, X, Y, 4), `corner` (2,), m, `step`, m: a `floor_grid` of stations in the order of `inputs["station"]`,
    bilinear between nodes. Filters other than `QuadratureKalman` leave out the white part; the reported covariance of
    the two angles is not used.
    """

    values: Any
    corner: Any
    step: Any

    def __init__(
        self, grid: tuple[np.ndarray, np.ndarray, float], sigma_azimuth: float, sigma_elevation: float, dof: float
    ):
        super().__init__(sigma_azimuth, sigma_elevation, dof)
        self.values, self.corner, self.step = (np.asarray(x, float) for x in grid)

    def errors_at(self, inputs: Inputs, x: Any, y: Any) -> list[Any]:
        """Means of azimuth and elevation, and their standard deviations, rad, at x, y (…), m, for a row's station."""
        at, most = [(x - self.corner[0]) / self.step, (y - self.corner[1]) / self.step], self.values.shape[1:3]
        inside = (at[0] >= 0) & (at[0] <= most[0] - 1) & (at[1] >= 0) & (at[1] <= most[1] - 1)
        cell = [jnp.clip(jnp.floor(a), 0, n - 2) for a, n in zip(at, most, strict=True)]
        i, j = (c.astype(jnp.int32) for c in cell)
        # Off the grid a gradient would be an extrapolation's.
        u, v = (jnp.where(inside, a - c, 0.0)[..., None] for a, c in zip(at, cell, strict=True))
        station, values = inputs[STATION.name].astype(jnp.int32), jnp.asarray(self.values)
        near, far = (values[station, i, k] * (1.0 - u) + values[station, i + 1, k] * u for k in (j, j + 1))
        found = jnp.where(inside[..., None], near * (1.0 - v) + far * v, UNKNOWN)
        return [found[..., k] for k in range(4)]

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        """As `BearingSensor`, with the map's mean and the bias times its share of the standard deviation."""
        errors, angles = self.errors_at(inputs, *list(view.position)[:2]), self.angles(view.position, inputs)
        parts = zip(angles, errors[:2], errors[2:], FACTORS, self.biases(view, inputs), strict=True)
        return [angle + mean + factor * sigma * bias for angle, mean, sigma, factor, bias in parts]

    def at_points(self, reading: Reading, inputs: Inputs, x: Any, y: Any) -> Sequence[AtPoints]:
        """Azimuth and elevation at points x, y (q,), m."""
        errors, angles = self.errors_at(inputs, x, y), self.angles(Vector(x, y), inputs)
        reported = [reading.reported[0], reading.reported[2]] if len(reading.reported) else [0.0, 0.0]
        channels = []
        for k, own in enumerate((self.sigma_azimuth.value, self.sigma_elevation.value)):
            variance = own**2 + reported[k] * self.reported_std_scale.value**2 + (1.0 - DRIFTING) * errors[2 + k] ** 2
            innovation = wrap(reading.values[k] - angles[k] - errors[k])
            channels.append(AtPoints(innovation, FACTORS[k] * errors[2 + k], jnp.sqrt(variance), self.dof.value))
        return channels


def mapped_bearing_tracker(stations: int, grid: tuple[np.ndarray, np.ndarray, float]) -> Tracker:
    """The `bearing_tracker` of calibrated stations, at a known height, with a `floor_grid` of theirs."""
    levels = {name: CALIBRATED[name] for name in ("sigma_azimuth", "sigma_elevation", "dof")}
    tracker = bearing_tracker(stations, planar=True, **CALIBRATED)
    return replace(tracker, sensors={BEARINGS: MappedBearingSensor(grid, **levels)}, filter=QuadratureKalman())
