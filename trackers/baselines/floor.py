"""Particle filter for a tag on a floor with walls, from position fixes."""

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
    """Planar constant velocity from fixes by particles; those that cross a wall have weight zero.

    The model of a planar `fix_tracker` with a floor plan (reference [25] of the thesis). `sigma_a` m/s² per √Hz,
    `sigma_horizontal` m; `dof`: degrees of freedom of Student's t, None for normal noise. Once no particle is left the
    track restarts at the next fix. Gradients are score-function estimates: `trackers/core/particle/score.py`.
    """
    sensor = FixSensor(sigma_horizontal, sigma_horizontal, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), True, 2)
    particles = ParticleFilter(n_particles, potential=walls)
    return FixTracker(ConstantVelocity(sigma_a, 2), {FIXES: sensor}, start, particles, PATIENT)
