"""Stations with an array each, on a ceiling, all looking at one point: where they must hang."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.aoa.phases import SphericalPhases
from trackers.core.rig import Station
from tuning.design.bound import Look
from tuning.design.layouts import AbstractLayout, too_near


class CeilingStations(AbstractLayout):
    """Stations of one kind at a height, of each theta its place over the floor, turned to look at the target.

    `template`: a station with array and wavelength, its own pose unused; `corners` (2, 2) m: the lower and upper corner
    of where stations may hang; `height` m; `target` (3,) m; `up` (3,): what the arrays' y axes are turned to, as
    `sim.stations.facing` has it; `spacing` m; `sigma_p` rad; `number` of stations.
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

    def places(self, theta: Any) -> Any:
        """(stations, 3)."""
        low, high = (jnp.asarray(corner)[None, :] for corner in self.corners)
        return jnp.concatenate([low + theta * (high - low), jnp.full((self.number, 1), self.height)], axis=1)

    def looks(self, theta: Any) -> list[Look]:
        sensor = SphericalPhases(self.template, self.sigma_p)
        flat = jnp.asarray(self.template.antennas)
        made = []
        for place in self.places(theta):
            z = jnp.asarray(self.target) - place
            x = jnp.cross(jnp.asarray(self.up), z)
            x, z = x / jnp.sqrt(jnp.sum(x * x)), z / jnp.sqrt(jnp.sum(z * z))
            axes = jnp.stack([x, jnp.cross(z, x), z])
            pose = (flat @ axes[:2], place, axes)
            turned = eqx.tree_at(lambda s: (s.antennas, s.origin, s.array_from_world), sensor, pose)
            made.append(Look(turned, {}, len(flat)))
        return made

    def project(self, theta: Any) -> Any:
        return jnp.clip(theta, 0.0, 1.0)

    def violation(self, theta: Any) -> Any:
        return too_near(self.places(theta), self.spacing)
