"""A planar tag on a floor with walls: fixes by particles that walls kill."""

from __future__ import annotations

from trackers.core.motion import ConstantVelocity
from trackers.core.particle.filter import ParticleFilter
from trackers.core.tunable import Scale
from trackers.parts.fixes import FIXES, PATIENT, FixSensor, FixStart, FixTracker
from trackers.parts.walls import Walls


def floor_tracker(
    walls: Walls,
    sigma_a: float = 1.0,
    sigma_horizontal: float = 0.1,
    dof: float | None = 4.0,
    n_particles: int = 1000,
) -> FixTracker:
    """Constant velocity over the floor from fixes, by particles, none of which goes through a wall.

    The model of `fix_tracker` in the plane with a map, as the thesis says of its reference [25]. σa
    m/s² per √Hz, the fixes' sigma m; `dof` None for normal noise. Where walls have killed all particles the track
    begins anew at the next fix. Its numbers are tuned by the particles' score; see `trackers/core/particle/score.py`.
    """
    sensor = FixSensor(sigma_horizontal, sigma_horizontal, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), True, 2)
    particles = ParticleFilter(n_particles, potential=walls)
    return FixTracker(ConstantVelocity(sigma_a, 2), {FIXES: sensor}, start, particles, PATIENT)
