"""Stations on a ceiling, each with an array and all facing one point."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.aoa.phases import SphericalPhases
from trackers.core.rig import Station
from tuning.design.bound import SensorAtEpoch
from tuning.design.layouts import AbstractLayout, spacing_violation


class CeilingStations(AbstractLayout):
    """Stations of one kind at one height, facing the target; theta is their horizontal positions.

    `template`: a station with array and wavelength, its pose unused; `corners` (2, 2) m: lower and upper corner of the
    allowed area; `height` m; `target` (3,) m; `up` (3,): direction of the arrays' y axes, as in `sim.stations.facing`;
    `spacing` m; `sigma_p` rad; `number` of stations.
    """

    template: Station
    corners: Any
    height: float
    target: Any
    spacing: float
    sigma_p: float
    number: int = eqx.field(static=True)
    up: Any = eqx.field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))

    @property
    def shape(self) -> tuple[int, int]:
        return self.number, 2

    def positions(self, theta: Any) -> Any:
        """(stations, 3)."""
        low, high = (jnp.asarray(corner)[None, :] for corner in self.corners)
        return jnp.concatenate([low + theta * (high - low), jnp.full((self.number, 1), self.height)], axis=1)

    def sensors(self, theta: Any) -> list[SensorAtEpoch]:
        sensor = SphericalPhases(self.template, self.sigma_p)
        flat = jnp.asarray(self.template.antennas)
        made = []
        for place in self.positions(theta):
            z = jnp.asarray(self.target) - place
            x = jnp.cross(jnp.asarray(self.up), z)
            x, z = x / jnp.sqrt(jnp.sum(x * x)), z / jnp.sqrt(jnp.sum(z * z))
            axes = jnp.stack([x, jnp.cross(z, x), z])
            pose = (flat @ axes[:2], place, axes)
            turned = eqx.tree_at(lambda s: (s.antennas, s.origin, s.array_from_world), sensor, pose)
            made.append(SensorAtEpoch(turned, {}, len(flat)))
        return made

    def project(self, theta: Any) -> Any:
        return jnp.clip(theta, 0.0, 1.0)

    def violation(self, theta: Any) -> Any:
        return spacing_violation(self.positions(theta), self.spacing)
