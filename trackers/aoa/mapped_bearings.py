"""Bearings of stations whose calibration has a map of what it leaves by place, and their tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from trackwright.trackers.aoa.fusion import BEARINGS, CALIBRATED, STATION, AbstractBearingSensor, bearing_tracker
from trackwright.trackers.core.filters.quadrature import AbstractPlaceSensor, AtPoints, QuadratureKalman
from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.state import wrap
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.calibration import UNKNOWN

DRIFTING = 0.5  # share of the variance about the map that drifts; the rest is white
FACTORS = np.sqrt(DRIFTING) / np.array(CALIBRATED["sigma_bias"])  # of a bias, times the standard deviation there


class MappedBearingSensor(AbstractBearingSensor, AbstractPlaceSensor):
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
