"""Kalman filters on position fixes: constant velocity over the floor, and Singer's fading acceleration."""

from __future__ import annotations

from trackers.core.motion import GroundMotion
from trackers.core.tunable import Scale
from trackers.parts.fixes import FIXES, PATIENT, FixSensor, FixStart, FixTracker
from trackers.parts.singer import Singer


def fix_tracker(
    sigma_a: float = 1.0,
    sigma_z: float = 0.3,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.3,
    dof: float | None = 4.0,
    planar: bool = False,
) -> FixTracker:
    """Constant velocity over the floor and a drifting height unless it is known (`planar`), from fixes.

    σa m/s² per √Hz, σz m per √s, the sensor's sigmas m; `dof` None for the textbook's normal noise.
    """
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, 2)
    return FixTracker(GroundMotion(sigma_a, sigma_z), {FIXES: sensor}, start, track_loss=PATIENT)


def singer_tracker(
    sigma_a: float = 1.0,
    tau: float = 1.0,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.3,
    dof: float | None = 4.0,
    planar: bool = False,
) -> FixTracker:
    """Singer's motion (1970), an acceleration of σa m/s² that fades with τ s, in the plane or in space, from fixes."""
    n = 2 if planar else 3
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, n, n)
    return FixTracker(Singer(sigma_a, tau, n), {FIXES: sensor}, start, track_loss=PATIENT)
