"""True paths: positions (n, T, 3) in metres, float64, one trajectory per key.

A path is a function of keys (n,) and times (T,) in seconds, which rise but need not be regular: one of these, with a
`volume` lower and upper corner (2, 3), a `functools.partial` of one, or a function of your own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from trackwright.sim.keys import Keys, namespace, normals, repeated, stream

Times = Float[np.ndarray, " T"]
Positions = Float[Any, "n T 3"]
Volume = Float[np.ndarray, "2 3"]

PathFunction = Callable[[Keys, Times], Positions]
"""(keys, times) -> positions (n, T, 3), m; one that works in NumPy alone keeps studies from one program."""

WORK_VOLUME = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.3]])
"""The paper's measurement area, 1 m x 1 m x 0.3 m, lower and upper corner; the origin is the middle of the table."""

_HARMONICS = 32
_SQUASH = 0.8
"""tanh(0.8 x) of a standard normal x is close to uniform on (-1, 1), so that hand motion fills the volume."""

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(60)
_SLOPE = float(np.sqrt(np.average((_SQUASH / np.cosh(_SQUASH * _NODES) ** 2) ** 2, weights=_WEIGHTS)))
"""Root mean square derivative of tanh(0.8 x) for a standard normal x, by Gauss–Hermite quadrature."""


def helix(
    keys: Keys, times: Times, volume: Volume = WORK_VOLUME, *, turns: float = 3.0, radius: float = 0.4
) -> Positions:
    """A helix (n, T, 3) about the volume's centre, from its floor at the first time to its lid at the last.

    All trajectories are the same. `radius` in m. Source: paper A, section 4 (200 points).
    """
    lower, upper = np.asarray(volume, float)
    t = np.asarray(times, float) - times[0]
    progress = t / t[-1] if t[-1] > 0 else t
    angle = (2 * np.pi * turns) * progress
    floor = (lower + upper)[:2] / 2 + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    path = np.concatenate([floor, (lower[2] + (upper[2] - lower[2]) * progress)[:, None]], axis=1)
    return repeated(np.clip(path, lower, upper)[None], keys)


def hand_motion(keys: Keys, times: Times, volume: Volume = WORK_VOLUME, *, speed: float = 0.3) -> Positions:
    """Smooth random hand motion (n, T, 3): band-limited Gaussian noise per axis, squashed into the volume by tanh.

    `speed`: the root mean square of the three-dimensional speed over the ensemble, m/s. With H the root sum of squares
    of the volume's half sides (0.72 m for the work volume) the root mean square acceleration is 2.9 speed² / H and the
    highest frequency before squashing 0.46 speed / H (0.19 Hz at 0.3 m/s). A path is nearly periodic, with a period of
    64 times that frequency's.
    """
    lower, upper = np.asarray(volume, float)
    half = (upper - lower) / 2
    fractions = (np.arange(_HARMONICS) + 0.5) / _HARMONICS
    omega_rms = speed / (_SLOPE * np.linalg.norm(half))
    omega = omega_rms * fractions / np.sqrt(np.mean(fractions**2))
    t = np.asarray(times, float)
    waves = np.concatenate([np.cos(t[:, None] * omega), np.sin(t[:, None] * omega)], axis=1)
    weights = normals(stream(keys, "hand motion"), (2 * _HARMONICS, 3)).astype(float) / np.sqrt(_HARMONICS)
    # One matrix product of fixed shape per trajectory: its bits do not depend on the number of trajectories.
    xp = namespace(weights)
    noise = xp.matmul(waves.astype(weights.dtype), weights)
    return xp.clip((lower + upper) / 2 + half * xp.tanh(_SQUASH * noise), lower, upper)


WALK_VOLUME = np.array([[0.8, 0.8, 0.8], [4.2, 4.2, 1.6]])
"""The volume of the tags' paths in the paper's chamber, lower and upper corner, m."""

WALK: PathFunction = partial(hand_motion, volume=WALK_VOLUME, speed=0.5)
"""Smooth random motion through that volume at 0.5 m/s."""

PATHS: Mapping[str, PathFunction] = MappingProxyType({"helix": helix, "hand": hand_motion})
"""Paths in the work volume by name."""
