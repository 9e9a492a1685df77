"""Recordings of rooms with anchors on the walls, whose places surveys are to find."""

from __future__ import annotations

import numpy as np
import polars as pl

import trackwright as tw

SCALE, DOF, LASTS = 0.1, 4.0, 3.0
"""Scale, m, and degrees of freedom of the errors, and the time, s, that lasting ones last."""

SECONDS, RATE = 90.0, 4.0  # duration of all walks of a survey, and epochs a second


def on_walls(size, shares):
    """The places (n, 2), m, on the walls of a room of this size (2,) at shares of the way around it."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * size
    along = np.cumsum(np.append(0.0, np.abs(np.diff(corners, axis=0)).sum(axis=1)))
    return np.column_stack([np.interp(shares * along[-1], along, column) for column in corners.T])


def simulated_site(seed, heights, lasting, seconds=SECONDS):
    """Recordings of a room, `seconds` in all, true anchors (A, 3) and true positions (n, 3) of each epoch, m."""
    random = np.random.default_rng([seed, 35])
    size, count = random.uniform([5.0, 4.0], [12.0, 10.0]), int(random.integers(4, 13))
    walls = on_walls(size, (np.arange(count) + random.uniform(0.0, 0.6, count)) / count)
    anchors = np.column_stack([walls, random.uniform(0.3, 2.8, count)])[random.permutation(count)]
    # Three anchors in a line make no frame.
    ahead, asides = (anchors[1] - anchors[0])[:2], (anchors[2:] - anchors[0])[:, :2]
    third = 2 + int(np.argmax(np.abs(asides @ [-ahead[1], ahead[0]])))
    anchors[[2, third]] = anchors[[third, 2]]
    delays = 0.3 * random.standard_normal() + 0.1 * random.standard_normal(count)
    names = [f"A{k:02d}" for k in range(count)]
    folders, paths = [], []
    for number, height in enumerate(heights):
        times = np.arange(int(seconds / len(heights) * RATE)) / RATE
        path = smooth_path(times, np.append(size, 2.5), random)
        if height is not None:
            path[:, 2] = height
        ranges = np.linalg.norm(path[:, None] - anchors, axis=2) + delays
        ranges += SCALE * random.standard_t(DOF, ranges.shape) + lasting * lasting_errors(times, count, random)
        row, anchor = np.nonzero((random.random(ranges.shape) < 0.9) & (ranges > 0.05))
        table = pl.DataFrame({
            "t_s": times[row], "tag": ["0"] * len(row), "anchor": [names[k] for k in anchor],
            "range_m": ranges[row, anchor],
        })  # fmt: skip
        rig = tw.Rig(f"survey {seed}-{number}", tags={"0": tw.Tag(height=height)})
        folders.append(tw.RecordingFolder(rig.name, None, rig, {"ranges": table}))
        paths.append(path)
    return folders, anchors, paths


def smooth_path(times, size, random):
    """A smooth path (n, 3), m, through a room of this size, half a metre from its walls and floor."""
    frequency, phase = random.uniform(0.01, 0.1, (3, 6, 1)), random.uniform(0.0, 2.0 * np.pi, (3, 6, 1))
    waves = np.sin(2.0 * np.pi * frequency * times + phase).sum(axis=1)
    share = 0.5 + 0.5 * waves / np.abs(waves).max(axis=1, keepdims=True)
    return np.asarray(0.5 + share.T * (size - 1.0))


def lasting_errors(times, count, random):
    """Errors (n, count) of unit variance with an exponential correlation over `LASTS` s."""
    from scipy.signal import lfilter  # seconds of imports

    keep = np.exp(-1.0 / (RATE * LASTS))
    steps = random.standard_normal((len(times), count)) * np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], steps, axis=0))
