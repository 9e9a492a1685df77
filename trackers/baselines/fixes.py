"""Trackers of position fixes: Kalman filters of constant velocity and of Singer's model, and particles among walls."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trackwright.trackers.core.model.motion import ConstantVelocity, GroundMotion
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.fixes import ELSEWHERE, FIXES, PATIENT, FixSensor, FixStart

if TYPE_CHECKING:
    from trackwright.trackers.parts.walls import Walls


def fix_tracker(
    sigma_a: float = 1.0,
    sigma_z: float = 0.3,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.3,
    dof: float | None = 4.0,
    planar: bool = False,
) -> Tracker:
    """Constant velocity in x and y, from fixes; the height is a random walk, or known and not estimated if `planar`.

    `sigma_a` m/s² per √Hz, `sigma_z` m per √s; the sensor's sigmas m. `dof`: degrees of freedom of Student's t, None
    for normal noise.
    """
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, 2)
    return Tracker(GroundMotion(sigma_a, sigma_z), {FIXES: sensor}, start, track_loss=PATIENT, latency_of=FIXES)


def singer_tracker(
    sigma_a: float = 1.0,
    tau: float = 1.0,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.3,
    dof: float | None = 4.0,
    planar: bool = False,
) -> Tracker:
    """Singer's motion (1970) from fixes, in three dimensions or, if `planar`, in x and y.

    `sigma_a` m/s² and `tau` s: standard deviation and time constant of the acceleration; the sensor's sigmas m.
    """
    from trackwright.trackers.parts.singer import Singer

    n = 2 if planar else 3
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, n, n)
    return Tracker(Singer(sigma_a, tau, n), {FIXES: sensor}, start, track_loss=PATIENT, latency_of=FIXES)


def floor_tracker(
    walls: Walls,
    sigma_a: float = 1.0,
    sigma_horizontal: float = 0.1,
    dof: float | None = 4.0,
    n_particles: int = 1000,
) -> Tracker:
    """Planar constant velocity from fixes by particles, with weight zero for a particle that crosses a wall.

    The model of a planar `fix_tracker` with a floor plan (reference [25] of the thesis). `sigma_a` m/s² per √Hz,
    `sigma_horizontal` m; `dof`: degrees of freedom of Student's t, None for normal noise. Once no particle is left the
    track restarts at the next fix, and where later fixes agree on another place. Gradients are score-function
    estimates: `trackers/core/filters/particle/score.py`.
    """
    sensor = FixSensor(sigma_horizontal, sigma_horizontal, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), True, 2)
    from trackwright.trackers.core.filters.particle.filter import ParticleFilter

    particles = ParticleFilter(n_particles, potential=walls)
    return Tracker(ConstantVelocity(sigma_a, 2), {FIXES: sensor}, start, particles, ELSEWHERE, FIXES)
