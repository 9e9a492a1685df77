"""What a reading is expected to be at a place, for every kind of readings, and its gradient."""

from __future__ import annotations

from typing import Any

import numpy as np

from trackwright.trackers.core.model.rig import angle_slopes

WIDTHS = {"ranges": 3, "tdoa": 6, "bearings": 12, "fixes": 0}
"""Numbers of the geometry of a reading: an anchor, two anchors, origin and axes of a station, none."""

CHANNELS = {"ranges": 1, "tdoa": 1, "bearings": 2, "fixes": 3}


def predicted(kind: str, place: Any, geometry: Any, near: Any, xp: Any = np) -> Any:
    """The readings (…, m) expected at places (…, 3), m: m, or of bearings azimuth and elevation, rad.

    `geometry` (…, g): as of `WIDTHS`. `near` (…, m): the measured values, from which angles are at most π away. `xp`:
    numpy or jax.numpy.
    """
    if kind == "fixes":
        return place
    ray = place - geometry[..., :3]
    if kind == "bearings":
        u = _in_array(ray, geometry, xp)
        angles = xp.stack([xp.arctan2(u[..., 0], u[..., 2]), xp.arctan2(u[..., 1], xp.hypot(u[..., 0], u[..., 2]))], -1)
        turn = angles - near
        return near + turn - 2 * np.pi * xp.round(turn / (2 * np.pi))
    length = xp.sqrt(xp.sum(ray * ray, axis=-1, keepdims=True))
    if kind == "tdoa":
        other = place - geometry[..., 3:6]
        length = length - xp.sqrt(xp.sum(other * other, axis=-1, keepdims=True))
    return length


def gradient(kind: str, place: np.ndarray, geometry: np.ndarray) -> np.ndarray:
    """The gradients (…, m, 3) of `predicted` with respect to the place."""
    if kind == "fixes":
        return np.broadcast_to(np.eye(3), (*place.shape[:-1], 3, 3))
    ray = place - geometry[..., :3]
    if kind == "bearings":
        return np.asarray(angle_slopes(np.moveaxis(_in_array(ray, geometry, np), -1, 0)) @ _axes(geometry))
    unit = _unit(ray)
    if kind == "tdoa":
        unit = unit - _unit(place - geometry[..., 3:6])
    return np.asarray(unit[..., None, :])


def _unit(ray: np.ndarray) -> np.ndarray:
    return np.asarray(ray / np.sqrt(np.sum(ray * ray, axis=-1, keepdims=True)))


def _axes(geometry: Any) -> Any:
    return geometry[..., 3:12].reshape((*geometry.shape[:-1], 3, 3))


def _in_array(ray: Any, geometry: Any, xp: Any) -> Any:
    return xp.sum(_axes(geometry) * ray[..., None, :], axis=-1)
