"""Bearings of stations whose calibration has a map of what it leaves by place, and their tracker."""

from __future__ import annotations

import math
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
from trackwright.trackers.recordings.bearing_map import FloorGrid

DRIFTING = 0.5
"""Share of the variance about the map that drifts; the rest is white."""

FACTORS = [math.sqrt(DRIFTING) / sigma for sigma in CALIBRATED["sigma_bias"]]
"""By what the standard deviation about the map is multiplied to be the factor of a bias of azimuth and elevation."""


class MappedBearingSensor(AbstractBearingSensor, AbstractPlaceSensor):
    """Azimuth and elevation, with the error of the place: its mean m, and s·b + white noise of standard deviation s.

    b is the bias of the angle in the state over its `CALIBRATED` standard deviation, s² half of the map's variance.
    `values` (S, X, Y, 4), `corner` (2,), `step`, `unknown` (4,): as in a `FloorGrid`, whose stations are in the
    order of `inputs["station"]`. Between nodes the map is bilinear. Filters other than `QuadratureKalman` leave out
    the white part, and the reported covariance of the two angles is not used.
    """

    values: Any
    corner: Any
    step: Any
    unknown: Any

    def __init__(self, grid: FloorGrid, sigma_azimuth: float, sigma_elevation: float, dof: float):
        super().__init__(sigma_azimuth, sigma_elevation, dof)
        self.values, self.corner, self.step, self.unknown = (np.asarray(x, float) for x in grid)

    def errors_at(self, inputs: Inputs, x: Any, y: Any) -> list[Any]:
        """Means of azimuth and elevation, and their standard deviations, rad, at x, y (…), m, for a row's station."""
        shape = self.values.shape[1:3]
        at = [(x - self.corner[0]) / self.step, (y - self.corner[1]) / self.step]
        inside = (at[0] >= 0) & (at[0] <= shape[0] - 1) & (at[1] >= 0) & (at[1] <= shape[1] - 1)
        cell = [jnp.clip(jnp.floor(a), 0, n - 2) for a, n in zip(at, shape, strict=True)]
        i, j = (c.astype(jnp.int32) for c in cell)
        # Off the grid a gradient would be an extrapolation's.
        u, v = (jnp.where(inside, a - c, 0.0)[..., None] for a, c in zip(at, cell, strict=True))
        station = inputs[STATION.name].astype(jnp.int32)
        values = jnp.asarray(self.values)
        near, far = (values[station, i, k] * (1.0 - u) + values[station, i + 1, k] * u for k in (j, j + 1))
        found = jnp.where(inside[..., None], near * (1.0 - v) + far * v, self.unknown)
        return [found[..., k] for k in range(4)]

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        """As `BearingSensor`, with the map's mean and the bias times its share of the standard deviation."""
        x, y = list(view.position)[:2]
        errors, angles = self.errors_at(inputs, x, y), self.angles(view.position, inputs)
        parts = zip(angles, errors[:2], errors[2:], FACTORS, self.biases(view, inputs), strict=True)
        return [angle + mean + factor * sigma * bias for angle, mean, sigma, factor, bias in parts]

    def at_points(self, reading: Reading, inputs: Inputs, x: Any, y: Any) -> Sequence[AtPoints]:
        errors, angles = self.errors_at(inputs, x, y), self.angles(Vector(x, y), inputs)
        reported = [reading.reported[0], reading.reported[2]] if len(reading.reported) else [0.0, 0.0]
        channels = []
        for k, own in enumerate((self.sigma_azimuth.value, self.sigma_elevation.value)):
            sigma = errors[2 + k]
            variance = own**2 + reported[k] * self.reported_std_scale.value**2 + (1.0 - DRIFTING) * sigma**2
            innovation = wrap(reading.values[k] - angles[k] - errors[k])
            channels.append(AtPoints(innovation, FACTORS[k] * sigma, jnp.sqrt(variance), self.dof.value))
        return channels


def mapped_bearing_tracker(stations: int, grid: FloorGrid) -> Tracker:
    """The `bearing_tracker` of calibrated stations, at a known height, with a map of theirs."""
    levels = {name: CALIBRATED[name] for name in ("sigma_azimuth", "sigma_elevation", "dof")}
    tracker = bearing_tracker(stations, planar=True, **CALIBRATED)
    return replace(tracker, sensors={BEARINGS: MappedBearingSensor(grid, **levels)}, filter=QuadratureKalman())
