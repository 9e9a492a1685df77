"""A map over the floor of what a calibration leaves of bearings: errors that return with the place.

The errors of each angle of a station are a Gaussian process over the floor with an exponential kernel, given the mean
errors of visits to places, each with noise of its own (Rasmussen and Williams 2006, chapter 2). The levels are from
six Bluetooth walks. Visits (V, 4) of a station are x and y, m, and the mean errors of azimuth and elevation there, rad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

PLACE_SIGMA, VISIT_SIGMA = np.array([0.1, 0.2]), np.array([0.06, 0.15])  # rad, of the map's angles, of a visit about it
LENGTH_M = 0.6  # of the kernel exp(−distance/length)
STEP_M, MARGIN_M, MOST_NODES = 0.1, 2.0, 200  # of a grid: step, margin, nodes along a side before the step is larger
UNKNOWN = np.concatenate([np.zeros(2), np.hypot(PLACE_SIGMA, VISIT_SIGMA)])  # the values off a grid


def predicted(visits: Float[np.ndarray, "V 4"], places: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 4"]:
    """Means of the errors of both angles of a visit to `places`, m, given earlier `visits`, and their sds, rad."""
    among, across = (
        np.exp(-np.linalg.norm(visits[:, None, :2] - other, axis=-1) / LENGTH_M) for other in (visits[:, :2], places)
    )
    # Both angles share the kernel, and thus its eigenvectors.
    eigenvalues, axes = np.linalg.eigh(among)
    across = axes.T @ across
    gains = PLACE_SIGMA**2 / (np.multiply.outer(eigenvalues, PLACE_SIGMA**2) + VISIT_SIGMA**2)
    means = across.T @ (gains * (axes.T @ visits[:, 2:]))
    variances = PLACE_SIGMA**2 * np.maximum(1.0 - (across**2).T @ gains, 0.0) + VISIT_SIGMA**2
    return np.concatenate([means, np.sqrt(variances)], axis=1)


def floor_grid(
    visits: Mapping[str, Float[np.ndarray, "V 4"]], stations: Sequence[str], origin: Sequence[float] = (0.0, 0.0)
) -> tuple[Float[np.ndarray, "S X Y 4"], Float[np.ndarray, " 2"], float]:
    """The map of stations at the nodes of a grid around all visits: as `predicted`; first node about `origin`; step."""
    places = np.concatenate([of_station[:, :2] for of_station in visits.values()]) - origin
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    step = max(STEP_M, float((high - low).max()) / MOST_NODES)
    counts = np.ceil((high - low) / step).astype(int) + 1
    nodes = low + step * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 2)
    values = [predicted(visits.get(name, np.zeros((0, 4))) - [*origin, 0.0, 0.0], nodes) for name in stations]
    return np.stack(values).reshape(len(stations), *counts, 4), low, step
