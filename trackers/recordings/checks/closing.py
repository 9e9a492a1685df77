"""Readings of some moments without truth: the positions that fit them best, and the errors that remain.

Ranges and their differences are fitted by damped Gauss-Newton steps from below the anchors, rays of bearings by linear
least squares. Where readings of one moment contradict each other, and no longer do with a change, that is the likely
mistake.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.core.model.rig import angles_in_array
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.changes import exchanged, value_changes
from trackwright.trackers.recordings.checks.readings import MOST_ROWS
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Kind, wrapped

LARGE = {"m": 0.3, "rad": 0.12}
"""Contradiction, m or rad, up to which nothing needs an explanation."""

SMALLER = 0.67
"""Ratio of contradictions from which a change explains them."""

REMAINING = {"m": 0.45, "rad": 0.3}
"""Contradiction that may remain with a change that explains it; twice as much is reported without an explanation."""

ONE_LARGE, CLEARER = {"m": 0.15, "rad": 0.06}, 0.5
"""Contradiction, m or rad, from which one anchor or station is looked for, and the ratio that it must reach.

On no real recording is the best ratio below 0.6; of the changes none may come as near.
"""

ALIKE, NAMED = 1.1, 3
"""Ratio up to which changes explain them alike, as in a symmetric rig, and how many of these are named."""

SPANS_S = (0.1, 0.25, 0.5, 1.0)
"""Times within which readings are taken for those of one moment, s; the first in which enough of them come."""

LEAST_MOMENTS, MOST_MOMENTS = 15, 60
MOST_SENSORS = 12
LEAST_EXTENT_M = 1.0
"""Extent of the anchors or stations, m, below which any ranges of a moment contradict or fit each other alike."""

STEPS = 12


class Moments(NamedTuple):
    """Readings (E, G, m) of E moments and G anchors, pairs of anchors or stations, NaN where one is missing.

    `ids`, `places` (S, 3) m and `axes` (S, 3, 3), from array to world, of the sensors. `sensors` (G, k): which of them
    a reading is of; two are the anchors of a difference. `heights` (E,) m: NaN where not known.
    """

    kind: Kind
    ids: tuple[str, ...]
    values: Float[np.ndarray, "E G m"]
    places: Float[np.ndarray, "S 3"]
    axes: Float[np.ndarray, "S 3 3"]
    sensors: Int[np.ndarray, "G k"]
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
            predicted, slopes = self._predicted(p)
            errors = np.where(known, r - predicted, 0.0)
            J = slopes * known[..., None] * allowed[:, None]
            normal = np.einsum("egi,egj->eij", J, J) + 0.02 * np.eye(3)
            p = p + np.linalg.solve(normal, np.einsum("egi,eg->ei", J, errors)[..., None])[..., 0] * allowed
        return np.where(known, r - self._predicted(p)[0], np.nan)[..., None]

    def _predicted(self, p: Float[np.ndarray, "E 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Distances (E, G) of positions, m, or their differences, and the derivatives (E, G, 3)."""
        away = p[:, None] - self.places
        distance = np.maximum(np.linalg.norm(away, axis=2), 1e-6)
        both = [(distance[:, of], (away / distance[..., None])[:, of]) for of in self.sensors.T]
        return both[0] if len(both) == 1 else (both[0][0] - both[1][0], both[0][1] - both[1][1])

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
        differences = self.values - angles_in_array(np.einsum("gij,egi->jeg", self.axes, p[:, None] - self.places))
        return np.where(known[..., None], wrapped(differences, self.kind.least), np.nan)


def moments(recording: RecordingFolder, table: str) -> Moments | None:
    """Moments of a table with more readings than a position takes; None with too few, or sensors all at one place."""
    rig, rows, kind = recording.rig, recording.rows(table), KINDS[table]
    measured = kind.measured(rig, rows)
    whole = np.flatnonzero(np.isfinite(measured.values[:MOST_ROWS]).all(axis=1))
    sensors = measured.sensors.number[whole]
    used, sensor = np.unique(sensors, return_inverse=True)
    ids, places, axes = tuple(measured.ids[k] for k in used), measured.sensors.places[used], measured.sensors.axes[used]
    columns, number = np.unique(sensor.reshape(sensors.shape), axis=0, return_inverse=True)
    number = number.ravel()
    if not 2 <= len(ids) <= MOST_SENSORS or np.linalg.norm(np.ptp(places, axis=0)) < LEAST_EXTENT_M:
        return None
    times, values = rows.times[whole], measured.values[whole]
    tag = rows.of_each(np.arange(len(rows.tags)))[whole]
    given = [rig.tags[name].height if name in rig.tags else None for name in rows.tags]
    heights = np.array([np.nan if height is None else height for height in given])
    for span in SPANS_S:
        tags, latest = _grid(np.floor(times / span), tag, number, values, len(columns))
        seen = np.isfinite(latest).all(axis=2).sum(axis=1)
        free = np.isnan(heights[tags])
        enough = np.flatnonzero(seen >= least_sensors(kind, free))
        if len(enough) >= LEAST_MOMENTS and 2 * len(enough) >= len(seen):
            chosen = enough[np.unique(np.linspace(0, len(enough) - 1, MOST_MOMENTS).astype(int))]
            return Moments(kind, ids, latest[chosen], places, axes, columns, heights[tags[chosen]])
    return None


def least_sensors(kind: Kind, free: np.ndarray) -> np.ndarray:
    """How many sensors, or pairs, a moment needs to contradict itself; `free`: where the height is not known."""
    return np.where(free, 3, 2) + (0 if kind.angles else 3 if kind.difference else 2)


def _grid(
    moment: np.ndarray, tag: np.ndarray, sensor: np.ndarray, values: np.ndarray, sensors: int
) -> tuple[np.ndarray, np.ndarray]:
    """The tag (E,) and the latest readings (E, sensors, m) of each moment of each tag."""
    order = np.lexsort((moment, tag))
    new = (np.diff(moment[order], prepend=np.nan) != 0) | (np.diff(tag[order], prepend=-1) != 0)
    row = np.cumsum(new) - 1
    latest = np.full((int(new.sum()), sensors, values.shape[1]), np.nan)
    latest[row, sensor[order]] = values[order]
    return tag[order][new], latest


def check_closing(recording: RecordingFolder, table: str) -> Iterator[CheckResult]:
    """An error where readings of one moment contradict each other and one change explains it, as of units or ids.

    A warning where they do not without one anchor or station, and where nothing explains it.
    """
    kind = KINDS[table]
    closes = kind.difference or (len(kind.sensors) == 1 and (kind.angles or kind.distance))
    readings = moments(recording, table) if closes else None
    if readings is None or (before := readings.closing()) <= ONE_LARGE[kind.unit]:
        return
    large = before > LARGE[kind.unit]
    changes = _changes(readings) if large else ()
    tried = sorted((changed.closing(), words, cause) for words, cause, changed in changes)
    least = tried[0][0] if tried else before
    apart, without = min(_without_each(readings), default=(np.inf, ""))
    unit, factor = kind.shown
    before_text, apart_text, least_text = (f"{significant(factor * x, 2)}{unit}" for x in (before, apart, least))
    message = f"readings of one moment contradict each other by {before_text}"
    if apart <= CLEARER * min(before, least):
        cause = "its place in rig.toml is wrong, or its readings are; measure it again"
        yield CheckResult("warning", table, f"{message}, and by {apart_text} without {kind.noun} {without}: {cause}")
    elif large and least <= min(SMALLER * before, REMAINING[kind.unit]):
        alike = [trial for trial in tried if trial[0] <= ALIKE * least][:NAMED]
        words = ", or ".join(words for _, words, _ in alike)
        causes = "; or ".join(dict.fromkeys(cause for _, _, cause in alike))
        yield CheckResult("error", table, f"{message}, and by {least_text} with {words}: {causes}")
    elif large and before > 2 * REMAINING[kind.unit]:
        unexplained = "no change of units, signs or ids explains it; check positions and rotations in rig.toml"
        yield CheckResult("warning", table, f"{message}, and {unexplained}")


def _without_each(readings: Moments) -> Iterator[tuple[float, str]]:
    """What contradictions are left without each anchor or station, where the others are enough for a position."""
    for k, name in enumerate(readings.ids):
        values = readings.values.copy()
        values[:, (readings.sensors == k).any(axis=1)] = np.nan
        enough = np.isfinite(values).all(axis=2).sum(axis=1) >= least_sensors(readings.kind, np.isnan(readings.heights))
        if enough.sum() >= LEAST_MOMENTS:
            yield readings._replace(values=values[enough], heights=readings.heights[enough]).closing(), name


def _changes(readings: Moments) -> Iterator[tuple[str, str, Moments]]:
    """Changes of units, signs and ids in words, the mistake that they undo, and the readings with them."""
    kind, noun, count = readings.kind, readings.kind.noun, len(readings.ids)
    if kind.angles:
        cause = "another zero of the azimuth, or stations that face the other way in rig.toml; turn one of both"
        yield "the azimuth turned by 180°", cause, readings._replace(values=readings.values + np.array([np.pi, 0.0]))
    for words, cause, of, _ in value_changes(kind, readings.values.shape[2]):
        values = of(readings.values)
        yield words, cause, readings._replace(values=values)
        for k, name in enumerate(readings.ids if kind.angles else ()):
            mask = readings.sensors == k
            yield f"{words} of {noun} {name}", cause, readings._replace(values=np.where(mask, values, readings.values))
    for i, j in combinations(range(count), 2):
        order = exchanged(count, i, j)
        words, cause = f"{noun}s {readings.ids[i]} and {readings.ids[j]} swapped", f"the ids of {noun}s are mixed up"
        other = readings._replace(places=readings.places[order], axes=readings.axes[order])
        yield words, f"{cause}; correct rig.toml or the table", other
