"""Readings of some moments without truth: the positions that fit them best, and the errors that remain.

Ranges are fitted by damped Gauss-Newton steps from below the anchors, rays of bearings by linear least squares.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.model.rig import angles_in_array
from trackwright.trackers.recordings.checks.readings import MOST_ROWS
from trackwright.trackers.recordings.kinds import KINDS, Kind, wrapped

if TYPE_CHECKING:  # the folder's module imports `anomalies`
    from trackwright.trackers.recordings.folder import RecordingFolder

SPANS_S = (0.1, 0.25, 0.5, 1.0)
"""Times within which readings are taken for those of one moment, s; the first in which enough of them come."""

LEAST_MOMENTS, MOST_MOMENTS = 15, 60
MOST_SENSORS = 12
LEAST_EXTENT_M = 1.0
"""Extent of the anchors or stations, m, below which any ranges of a moment contradict or fit each other alike."""

STEPS = 12


class Moments(NamedTuple):
    """Readings (E, G, m) of E moments and G anchors or stations, NaN where one is missing.

    `ids`, `places` (G, 3) m and `axes` (G, 3, 3), from array to world, of the sensors. `heights` (E,) m: NaN where not
    known.
    """

    kind: Kind
    ids: tuple[str, ...]
    values: Float[np.ndarray, "E G m"]
    places: Float[np.ndarray, "G 3"]
    axes: Float[np.ndarray, "G 3 3"]
    heights: Float[np.ndarray, " E"]

    def closing(self) -> float:
        """The root mean square of the errors that remain in a typical moment, m or rad."""
        errors = self._of_bearings() if self.kind.angles else self._of_ranges()
        return float(np.median(np.sqrt(np.nanmean(errors**2, axis=(1, 2)))))

    def _of_ranges(self) -> Float[np.ndarray, "E G 1"]:
        known = np.isfinite(self.values[..., 0])
        r = np.where(known, self.values[..., 0], 0.0)
        free = np.isnan(self.heights)
        p = np.tile(self.places.mean(axis=0) - np.array([0.0, 0.0, 1.0]), (len(r), 1))
        p[:, 2] = np.where(free, p[:, 2], self.heights)
        allowed = np.stack([np.ones_like(free), np.ones_like(free), free], axis=1)
        for _ in range(STEPS):
            away = p[:, None] - self.places
            distance = np.maximum(np.linalg.norm(away, axis=2), 1e-6)
            errors = np.where(known, r - distance, 0.0)
            J = away / distance[..., None] * known[..., None] * allowed[:, None]
            normal = np.einsum("egi,egj->eij", J, J) + 0.02 * np.eye(3)
            p = p + np.linalg.solve(normal, np.einsum("egi,eg->ei", J, errors)[..., None])[..., 0] * allowed
        found = np.where(known, r - np.linalg.norm(p[:, None] - self.places, axis=2), np.nan)
        return found[..., None]

    def _of_bearings(self) -> Float[np.ndarray, "E G 2"]:
        azimuth, elevation = np.moveaxis(self.values, 2, 0)
        known = np.isfinite(azimuth) & np.isfinite(elevation)
        local = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        ray = np.einsum("gij,jeg->egi", self.axes, np.where(known, local, 0.0))
        across = (np.eye(3) - ray[..., None] * ray[..., None, :]) * known[..., None, None]
        normal, side = across.sum(axis=1), np.einsum("egij,gj->ei", across, self.places)
        height = np.where(np.isnan(self.heights), 0.0, self.heights)
        # A known height weighs more than all rays.
        weight = np.where(np.isnan(self.heights), 1e-6, 1e3)
        normal[:, 2, 2] += weight
        side[:, 2] += weight * height
        p = np.linalg.solve(normal, side[..., None])[..., 0]
        found = self.values - angles_in_array(np.einsum("gij,egi->jeg", self.axes, p[:, None] - self.places))
        return np.where(known[..., None], wrapped(found, self.kind.least), np.nan)


def moments(recording: RecordingFolder, table: str) -> Moments | None:
    """Moments of a table with more readings than a position takes; None with too few, or sensors all at one place."""
    rig, rows = recording.rig, recording.rows(table)
    part = slice(MOST_ROWS)
    kind = KINDS[table]
    known, columns = kind.places(rig), kind.least
    values, times = rows.floats(columns)[part], rows.times[part]
    whole = np.isfinite(values).all(axis=1)
    sensor = rows.codes(kind.noun, list(known))[part].astype(int)
    ids = [key for k, key in enumerate(known) if (sensor[whole] == k).any()]
    if not 2 <= len(ids) <= MOST_SENSORS:
        return None
    number = np.array([ids.index(key) if key in ids else -1 for key in known])[sensor]
    tag = np.repeat(np.arange(len(rows.tags)), np.diff(rows.starts))[part]
    given = [rig.tags[name].height if name in rig.tags else None for name in rows.tags]
    heights = np.array([np.nan if height is None else height for height in given])
    _, places, axes, _, _ = kind.sensors_of(rig, ids, np.zeros((0, 1), int), len(columns))
    if np.linalg.norm(np.ptp(places, axis=0)) < LEAST_EXTENT_M:
        return None
    for span in SPANS_S:
        found = _grid(np.floor(times[whole] / span), tag[whole], number[whole], values[whole], len(ids))
        seen = np.isfinite(found[1]).all(axis=2).sum(axis=1)
        free = np.isnan(heights[found[0]])
        enough = np.flatnonzero(seen >= least_sensors(kind, free))
        if len(enough) >= LEAST_MOMENTS and 2 * len(enough) >= len(seen):
            chosen = enough[np.unique(np.linspace(0, len(enough) - 1, MOST_MOMENTS).astype(int))]
            return Moments(kind, tuple(ids), found[1][chosen], places, axes, heights[found[0][chosen]])
    return None


def least_sensors(kind: Kind, free: np.ndarray) -> np.ndarray:
    """How many sensors a moment needs to contradict itself; `free`: where the height is not known."""
    return np.where(free, 3, 2) + (0 if kind.angles else 2)


def _grid(
    moment: np.ndarray, tag: np.ndarray, sensor: np.ndarray, values: np.ndarray, sensors: int
) -> tuple[np.ndarray, np.ndarray]:
    """The tag (E,) and the latest readings (E, sensors, m) of each moment of each tag."""
    order = np.lexsort((moment, tag))
    new = (np.diff(moment[order], prepend=np.nan) != 0) | (np.diff(tag[order], prepend=-1) != 0)
    row = np.cumsum(new) - 1
    found = np.full((int(new.sum()), sensors, values.shape[1]), np.nan)
    found[row, sensor[order]] = values[order]
    return tag[order][new], found
