"""Where the beacon goes: paths (n, T, 3) in metres, float64, one per key, each inside its volume.

Every path has the signature (keys, times, volume): one key per trajectory, times (T,) in seconds, rising but not
necessarily regular, and the volume's lower and upper corners (2, 3). A partial of one of them, or a function of the
user's own of keys and times, is a path for `sim.scenarios.simulate_phases`.
"""

from __future__ import annotations

import numpy as np

from sim.keys import Keys, normals, stream, uniforms

WORK_VOLUME = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.3]])
"""The paper's measurement area, 1 m x 1 m x 0.3 m, lower and upper corner; the origin is the middle of the table."""

_HARMONICS = 32
_SQUASH = 0.8
"""tanh(0.8 x) of a standard normal x is close to uniform on (-1, 1): the hand visits all of the volume."""


def helix(
    keys: Keys,
    times: np.ndarray,
    volume: np.ndarray = WORK_VOLUME,
    *,
    turns: float = 3.0,
    radius: float = 0.4,
    varied: bool = False,
) -> np.ndarray:
    """A helix (n, T, 3) about the volume's middle, from its floor at the first time to its lid at the last.

    Every trajectory is the same unless `varied`: then start angle, sense of rotation and centre are random. `radius` in
    m; raises ValueError where the helix does not fit into the volume. Source: paper A, section 4 (200 points).
    """
    lower, upper = np.asarray(volume, float)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    room = half[:2] - radius
    if not (radius > 0 and np.all(room >= 0)):
        raise ValueError(f"a helix of radius {radius} m does not fit into {2 * half[0]} m x {2 * half[1]} m")
    draws = np.full((len(keys), 4), 0.5)
    if varied:
        draws = uniforms(stream(keys, "helix"), (4,)).astype(float)
    start = 2 * np.pi * (draws[:, :1] - 0.5)
    sense = np.where(draws[:, 1:2] < 0.5, -1.0, 1.0)
    centre = middle[:2] + (2 * draws[:, None, 2:] - 1) * room

    progress = _progress(times)
    angle = start + sense * (2 * np.pi * turns) * progress
    path = np.empty((len(keys), len(progress), 3))
    path[..., :2] = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    path[..., 2] = lower[2] + (upper[2] - lower[2]) * progress
    return np.clip(path, lower, upper)


def hand_motion(keys: Keys, times: np.ndarray, volume: np.ndarray = WORK_VOLUME, *, speed: float = 0.3) -> np.ndarray:
    """Smooth random hand motion (n, T, 3): band-limited Gaussian noise per axis, squashed into the volume by tanh.

    `speed`: the root mean square of the three-dimensional speed over the ensemble, m/s. With H the root sum of squares
    of the volume's half sides (0.72 m for the work volume) the root mean square acceleration is 2.9 speed² / H and the
    highest frequency before squashing 0.46 speed / H (0.19 Hz at 0.3 m/s); a path first comes near its start again
    after 64 periods of that frequency. Raises ValueError for a speed that isn't positive.
    """
    if not speed > 0:
        raise ValueError(f"the speed of a hand is positive, found {speed} m/s")
    lower, upper = np.asarray(volume, float)
    half = (upper - lower) / 2
    fractions = (np.arange(_HARMONICS) + 0.5) / _HARMONICS
    omega_rms = speed / (_rms_slope() * np.linalg.norm(half))
    omega = omega_rms * fractions / np.sqrt(np.mean(fractions**2))

    t = np.asarray(times, float)
    waves = np.concatenate([np.cos(t[:, None] * omega), np.sin(t[:, None] * omega)], axis=1)
    weights = normals(stream(keys, "hand motion"), (2 * _HARMONICS, 3)).astype(float) / np.sqrt(_HARMONICS)
    # One product per trajectory, of one shape: its numbers can't depend on how many others there are.
    noise = np.matmul(waves, weights)
    return np.clip((lower + upper) / 2 + half * np.tanh(_SQUASH * noise), lower, upper)


def straight_lines_with_halts(
    keys: Keys, times: np.ndarray, volume: np.ndarray = WORK_VOLUME, *, speed: float = 0.3, halt_s: float = 1.0
) -> np.ndarray:
    """Straight lines at constant speed between random places in the volume, with a halt at each: (n, T, 3).

    `speed` in m/s; each path begins with a halt of `halt_s` seconds. Raises ValueError unless both are positive.
    """
    if not (speed > 0 and halt_s > 0):
        raise ValueError(f"speed and halt are positive, found {speed} m/s and {halt_s} s")
    lower, upper = np.asarray(volume, float)
    t = np.asarray(times, float) - times[0]
    # So many halts alone outlast the recording, however short the lines between them turn out.
    n_lines = int(np.ceil(t[-1] / halt_s)) + 1
    places = lower + (upper - lower) * uniforms(stream(keys, "straight lines"), (n_lines + 1, 3)).astype(float)
    lines = np.diff(places, axis=1)
    durations = np.maximum(np.sqrt((lines**2).sum(axis=-1)) / speed, np.finfo(float).tiny)
    ends = np.cumsum(halt_s + durations, axis=1)

    path = np.repeat(places[:, :1], len(t), axis=1)
    for k in range(n_lines):
        share = np.clip((t - (ends[:, k, None] - durations[:, k, None])) / durations[:, k, None], 0.0, 1.0)
        path += share[..., None] * lines[:, k, None]
    return np.clip(path, lower, upper)


def _progress(times: np.ndarray) -> np.ndarray:
    """How much of the recording has passed, 0 to 1; 0 where it has one row only."""
    t = np.asarray(times, float) - times[0]
    return t / t[-1] if t[-1] > 0 else t


def _rms_slope() -> float:
    """Root mean square slope of tanh(_SQUASH x) under a standard normal x, by Gauss-Hermite quadrature."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    slopes = _SQUASH / np.cosh(_SQUASH * nodes) ** 2
    return float(np.sqrt(np.sum(weights * slopes**2) / np.sum(weights)))
