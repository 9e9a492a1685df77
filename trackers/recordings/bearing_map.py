"""A map over the floor of what a calibration leaves of bearings: errors that return with the place.

The errors of each angle of a station are a Gaussian process over the floor with an exponential kernel, given the mean
errors of visits to places, each with noise of its own (Rasmussen and Williams 2006, chapter 2). The levels are from
six Bluetooth walks. The visits are made in `tuning/bearing_map.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.recordings.input_file import AS_FILE, NUMBERS, Number

PLACE_SIGMA, VISIT_SIGMA = np.array([0.1, 0.2]), np.array([0.06, 0.15])
"""Standard deviations, rad, of the map of azimuth and of elevation, and of a visit about it."""

LENGTH_M = 0.6
"""Length, m, of the kernel exp(−distance/length)."""

STEP_M, MARGIN_M, MOST_NODES = 0.1, 2.0, 200
"""Step of a grid and its margin around the visits, m; with more nodes along a side the step is larger."""


class FloorGrid(NamedTuple):
    """A map at the nodes of a grid over the floor.

    `values` (S, X, Y, 4): of each station the mean of azimuth and elevation, and the standard deviations of an error
    about them, a visit's own noise included, rad. `corner` (2,): the first node, m. `step`: between nodes, m.
    `unknown` (4,): the values off the grid.
    """

    values: Float[np.ndarray, "S X Y 4"]
    corner: Float[np.ndarray, " 2"]
    step: float
    unknown: Float[np.ndarray, " 4"]


@dataclass(frozen=True)
class BearingMap:
    """Visits by station, (V, 4): x and y, m, and the mean errors of azimuth and elevation there, rad.

    `gain`: by how much visits left out are more probable with the map of the others, mean in nats.
    """

    __pydantic_config__: ClassVar = AS_FILE

    gain: Number
    stations: Mapping[str, Annotated[Float[np.ndarray, "V 4"], NUMBERS]]

    def of(self, stations: Sequence[str]) -> BearingMap | None:
        """The part on some stations; None where it has none of them."""
        part = {name: visits for name, visits in self.stations.items() if name in stations}
        return replace(self, stations=part) if part else None

    def key(self, stations: Sequence[str]) -> tuple[bytes, ...]:
        """What tells the map of these stations from others."""
        return tuple(self.stations[name].tobytes() if name in self.stations else b"" for name in stations)

    def grid(self, stations: Sequence[str], origin: Sequence[float] = (0.0, 0.0)) -> FloorGrid:
        """The map of these stations, about an `origin` (2,), m, at the nodes of a grid around all visits."""
        places = np.concatenate([visits[:, :2] for visits in self.stations.values()]) - origin
        low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
        step = max(STEP_M, float((high - low).max()) / MOST_NODES)
        counts = np.ceil((high - low) / step).astype(int) + 1
        axes = [first + step * np.arange(count) for first, count in zip(low, counts, strict=True)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        none = np.zeros((0, 4))
        columns = [
            np.concatenate(predicted(self.stations.get(name, none) - [*origin, 0.0, 0.0], nodes), axis=1)
            for name in stations
        ]
        unknown = np.concatenate([np.zeros(2), np.hypot(PLACE_SIGMA, VISIT_SIGMA)])
        return FloorGrid(np.stack(columns).reshape(len(stations), *counts, 4), low, step, unknown)


def predicted(
    visits: Float[np.ndarray, "V 4"], places: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]:
    """Means and standard deviations (N, 2), rad, of the errors of visits to `places`, m, given earlier `visits`."""
    among, across = (np.exp(-_distances(visits[:, :2], other) / LENGTH_M) for other in (visits[:, :2], places))
    # Both angles share the kernel, and thus its eigenvectors.
    eigenvalues, axes = np.linalg.eigh(among)
    across = axes.T @ across
    means, sigmas = [], []
    for errors, place, visit in zip(visits[:, 2:].T, PLACE_SIGMA, VISIT_SIGMA, strict=True):
        gains = place**2 / (place**2 * eigenvalues + visit**2)
        means.append((gains * (axes.T @ errors)) @ across)
        variances = place**2 * (1.0 - gains @ across**2)
        sigmas.append(np.sqrt(np.maximum(variances, 0.0) + visit**2))
    return np.stack(means, axis=1), np.stack(sigmas, axis=1)


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
