"""The default planar array of eight antennas for 24 GHz, and the Cramér–Rao bounds of a layout."""

from __future__ import annotations

import numpy as np

from trackwright.trackers.core.model.inputs import AnyArray

SPEED_OF_LIGHT = 299_792_458.0
"""In vacuum, m/s."""

DEFAULT_WAVELENGTH = SPEED_OF_LIGHT / 24e9
"""Of the paper's 24 GHz beacon, m."""

DEFAULT_ANTENNAS = np.array(
    [
        [-0.02194, 0.00592],
        [-0.01902, -0.01740],
        [0.02975, -0.01795],
        [0.01168, -0.02000],
        [-0.01878, -0.00221],
        [-0.02975, 0.02000],
        [0.01432, -0.01224],
        [-0.01018, -0.00996],
    ]
)
"""Eight antennas within ±4 cm × ±2 cm, x and y in m, in the order of antennas 1 to 8 of the paper.

The figure with the true positions is lost. These are fitted: the bounds of the five antenna sets of Table 1 have the
ratios of the printed errors; among the many such layouts this one has low ambiguity, found by
`experiments/lab/papers/will_2020/fit_array_layout.py`.
"""


def boresight_bounds(antennas: AnyArray, wavelength: float = DEFAULT_WAVELENGTH, sigma_p: float = 1.0) -> np.ndarray:
    """Cramér–Rao bounds (…, 2), rad, of azimuth and elevation at boresight from one row of phases of one array.

    `antennas` (..., n, 2) in m, `sigma_p` the phase noise in rad. One unknown common offset leaves the information
    G' (I - 11'/n) G / sigma_p², with G = 2 pi / wavelength times the positions: the scatter about their centroid.
    """
    centred = antennas - antennas.mean(axis=-2, keepdims=True)
    x, y = centred[..., 0], centred[..., 1]
    xx, yy, xy = (x * x).sum(-1), (y * y).sum(-1), (x * y).sum(-1)
    variances = np.stack([yy, xx], axis=-1) / (xx * yy - xy * xy)[..., None]
    return sigma_p * wavelength / (2 * np.pi) * np.sqrt(variances)
