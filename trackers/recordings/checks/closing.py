"""Readings of some moments without truth: the positions that fit them best, and the errors that remain.

Ranges and their differences are fitted by damped Gauss-Newton steps from below the anchors, rays of bearings by linear
least squares. Where readings of one moment contradict each other, and no longer do with a change, that is the likely
mistake. The place of one anchor is fitted by scores from which the positions are projected out (parity vectors: Potter
and Suman 1977), the turn of a station by search.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.core.model.rig import angles_in_array
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.changes import about_vertical, exchanged, value_changes
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

ALIKE, NAMED, NOTHING = 1.1, 3, {"m": 0.08, "rad": 0.03}
"""Ratio up to which changes explain them alike, as in a symmetric rig, how many of these are named, and contradictions,
m or rad, up to which all explain them: one spare reading is soon explained."""

LEAST_MOVE_M, LEAST_TURN, FITTED, AS_WELL = 0.6, np.radians(15.0), 0.75, 1.5
"""Move of an anchor and turn of a station that are a mistake, the ratio of contradictions that they must reach, and the
ratio to those without it, which are smaller in any case.

On real recordings as they are, the place that fits best is up to 0.5 m away, or leaves more than 0.8.
"""

ELSEWHERE = "its place in rig.toml is wrong, or its readings are; measure it again"

SPANS_S = (0.1, 0.25, 0.5, 1.0)
"""Times within which readings are taken for those of one moment, s; the first in which enough of them come."""

LEAST_MOMENTS, MOST_MOMENTS = 15, 60
MOST_SENSORS = 12
LEAST_EXTENT_M = 1.0
"""Extent of the anchors or stations, m, below which any ranges of a moment contradict or fit each other alike."""

STEPS, LARGEST_STEP_M = 12, 2.0


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
        return np.where(np.isfinite(self.values), self.parity()[1][..., None], np.nan)

    def parity(self) -> tuple[np.ndarray, ...]:
        """Positions (E, 3) of ranges or differences, errors (E, G), derivatives (E, G, 3), and shares (E, G).

        Of an error of one reading alone the position leaves that share; both are 0 where a reading is missing.
        """
        known = np.isfinite(self.values[..., 0])
        r = np.where(known, self.values[..., 0], 0.0)
        free = np.isnan(self.heights)
        p = np.tile(self.places.mean(axis=0) - np.array([0.0, 0.0, 1.0]), (len(r), 1))
        p[:, 2] = np.where(free, p[:, 2], self.heights)
        allowed = np.stack([np.ones_like(free), np.ones_like(free), free], axis=1)
        for step in range(STEPS + 1):
            predicted, slopes = self._predicted(p)
            errors = np.where(known, r - predicted, 0.0)
            J = slopes * known[..., None] * allowed[:, None]
            normal = np.einsum("egi,egj->eij", J, J) + 0.02 * np.eye(3)
            if step < STEPS:
                p = p + np.linalg.solve(normal, np.einsum("egi,eg->ei", J, errors)[..., None])[..., 0] * allowed
        left = 1.0 - np.einsum("egi,egi->eg", J, np.linalg.solve(normal, J.transpose(0, 2, 1)).transpose(0, 2, 1))
        return p, errors, slopes, np.where(known, left, 0.0)

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
    return np.where(free, 3, 2) + (0 if kind.angles else 3 if kind.difference else 1)


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

    A warning where they do not with one anchor elsewhere or one station turned, or without one, and where nothing
    explains it.
    """
    kind = KINDS[table]
    closes = kind.difference or (len(kind.sensors) == 1 and (kind.angles or kind.distance))
    readings = moments(recording, table) if closes else None
    if readings is None or (before := readings.closing()) <= ONE_LARGE[kind.unit]:
        return
    large = before > LARGE[kind.unit]
    tried = sorted((changed.closing(), words, cause) for words, cause, changed in _changes(readings))
    least = min(tried[0][0], before)
    explained = least <= min((SMALLER if large else CLEARER) * before, REMAINING[kind.unit])
    apart, without = min(_without_each(readings), default=(np.inf, ""))
    fitted = sorted(_turned_each(readings) if kind.angles else () if kind.difference else _moved_each(readings))
    unit, factor = kind.shown

    def text(size: float) -> str:
        return f"{significant(factor * size, 2)}{unit}"

    def alike(tried: Sequence[tuple[float, str, str]]) -> tuple[str, str]:
        """The words and the causes of the changes that explain it as well as the first."""
        best = [trial for trial in tried if trial[0] <= max(ALIKE * tried[0][0], NOTHING[kind.unit])][:NAMED]
        return ", or ".join(words for _, words, _ in best), "; or ".join(dict.fromkeys(cause for _, _, cause in best))

    message = f"readings of one moment contradict each other by {text(before)}"
    enough = min(FITTED * least, AS_WELL * apart, REMAINING[kind.unit])
    if fitted and fitted[0][0] <= enough and not (explained and least <= NOTHING[kind.unit]):
        words, causes = alike(fitted)
        yield CheckResult("warning", table, f"{message}, and by {text(fitted[0][0])} with {words}: {causes}")
    elif apart <= CLEARER * least:
        yield CheckResult(
            "warning", table, f"{message}, and by {text(apart)} without {kind.noun} {without}: {ELSEWHERE}"
        )
    elif explained:
        words, causes = alike(tried)
        yield CheckResult("error", table, f"{message}, and by {text(least)} with {words}: {causes}")
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


def _moved_each(readings: Moments) -> Iterator[tuple[float, str, str]]:
    """What contradictions are left with each anchor at the place that fits best, if that is elsewhere."""
    if np.linalg.norm(np.ptp(readings.parity()[0][:, :2], axis=0)) < LEAST_EXTENT_M:
        return
    for k, name in enumerate(readings.ids):
        left, place = min((_moved(readings, k)), key=lambda fit: fit[0])
        away = float(np.linalg.norm(place - readings.places[k]))
        if away >= LEAST_MOVE_M:
            there = f"anchor {name} {away:.1f} m elsewhere, at ({', '.join(f'{x:.2f}' for x in place)}) m"
            yield left, there, ELSEWHERE


def _moved(readings: Moments, k: int) -> Iterator[tuple[float, np.ndarray]]:
    """What contradictions are left with an anchor at places (3,) that fit better and better, and these."""
    place = readings.places[k]
    for _ in range(STEPS):
        moved = readings._replace(places=np.where(np.arange(len(readings.ids))[:, None] == k, place, readings.places))
        _, errors, slopes, left = moved.parity()
        size = np.sqrt((errors**2).sum(axis=1) / (left > 0.0).sum(axis=1))
        closing = float(np.median(size))
        yield closing, place
        # Moments that contradict themselves far more than others count little.
        weight, away = 1.0 / (1.0 + (size / (2.0 * closing + 1e-9)) ** 2), -slopes[:, k]
        information = np.einsum("e,ei,ej->ij", weight * left[:, k], away, away)
        little = (0.01 * np.trace(information) + 1e-6) * np.eye(3)
        step = np.linalg.solve(information + little, (weight * errors[:, k]) @ away)
        place = place + step * min(1.0, LARGEST_STEP_M / max(float(np.linalg.norm(step)), 1e-9))


def _turned_each(readings: Moments) -> Iterator[tuple[float, str, str]]:
    """What contradictions are left with each station turned about the vertical as fits best, if that is by much."""
    for k, name in enumerate(readings.ids):
        tried = []
        for angle in np.radians(np.arange(-175.0, 180.0, 5.0)):
            axes = np.where(
                np.arange(len(readings.ids))[:, None, None] == k, about_vertical(angle) @ readings.axes, readings.axes
            )
            tried.append((readings._replace(axes=axes).closing(), angle))
        left, angle = min(tried)
        if abs(angle) >= LEAST_TURN:
            words = f"station {name} turned by {np.degrees(angle):.0f}° about the vertical"
            yield left, words, "another orientation than rig.toml's; correct rotation_wxyz or yaw_deg"


def _changes(readings: Moments) -> Iterator[tuple[str, str, Moments]]:
    """Changes of units, signs and ids in words, the mistake that they undo, and the readings with them."""
    kind, noun, count = readings.kind, readings.kind.noun, len(readings.ids)
    if kind.angles:
        cause = "another zero of the azimuth, or stations that face the other way in rig.toml; turn one of both"
        yield "the azimuth turned by 180°", cause, readings._replace(values=readings.values + np.array([np.pi, 0.0]))
    for words, cause, of, _ in value_changes(kind, readings.values.shape[2]):
        values = of(readings.values)
        yield words, cause, readings._replace(values=values)
        for k, name in enumerate(() if kind.difference else readings.ids):
            mask = readings.sensors == k
            yield f"{words} of {noun} {name}", cause, readings._replace(values=np.where(mask, values, readings.values))
    for k in np.flatnonzero(np.abs(readings.places[:, 2]) > LEAST_MOVE_M / 2).tolist() if not kind.angles else ():
        places = readings.places * np.where(np.arange(count) == k, -1.0, 1.0)[:, None] ** [0, 0, 1]
        words, cause = f"the sign of z of {noun} {readings.ids[k]} flipped", "a wrong sign of z in rig.toml; flip it"
        yield words, cause, readings._replace(places=places)
    for i, j in combinations(range(count), 2):
        order = exchanged(count, i, j)
        words, cause = f"{noun}s {readings.ids[i]} and {readings.ids[j]} swapped", f"the ids of {noun}s are mixed up"
        other = readings._replace(places=readings.places[order], axes=readings.axes[order])
        yield words, f"{cause}; correct rig.toml or the table", other
