"""A tool on its round: from one point of work to another, at rest at each, as a hand moves it."""

from __future__ import annotations

import numpy as np

from sim.keys import Keys, stream, uniforms


def visits(keys: Keys, times: np.ndarray, points: np.ndarray, *, speed: float = 0.3, rest_s: float = 1.0) -> np.ndarray:
    """Paths (n, T, 3) that rest for `rest_s` seconds at each of a random round of the `points` (K, 3), m, K at least 2.

    No point follows itself. Ways between are straight and of least jerk (Flash & Hogan 1985), at a mean speed of
    `speed` m/s but never shorter than a quarter of a second. Raises ValueError for a single point, and unless speed and
    rest are positive.
    """
    if len(points) < 2:
        raise ValueError(f"a round needs two points of work or more, found {len(points)}")
    if not (speed > 0 and rest_s > 0):
        raise ValueError(f"speed and rest are positive, found {speed} m/s and {rest_s} s")
    t = np.asarray(times, float) - times[0]
    # So many rests alone outlast the recording, however short the ways.
    count = int(np.ceil(t[-1] / rest_s)) + 1
    draws = uniforms(stream(keys, "round"), (count + 1,)).astype(float)
    first = np.minimum((draws[:, :1] * len(points)).astype(int), len(points) - 1)
    # Each step goes on by one to K - 1 places in the list, so that none stays.
    steps = 1 + np.minimum((draws[:, 1:] * (len(points) - 1)).astype(int), len(points) - 2)
    order = np.concatenate([first, first + np.cumsum(steps, axis=1)], axis=1) % len(points)
    places = np.asarray(points, float)[order]
    ways = np.diff(places, axis=1)
    durations = np.maximum(np.sqrt((ways**2).sum(axis=-1)) / speed, 0.25)
    ends = np.cumsum(rest_s + durations, axis=1)

    path = np.repeat(places[:, :1], len(t), axis=1)
    for k in range(count):
        s = np.clip((t - (ends[:, k, None] - durations[:, k, None])) / durations[:, k, None], 0.0, 1.0)
        path += (s**3 * (10 - 15 * s + 6 * s**2))[..., None] * ways[:, k, None]
    return path
