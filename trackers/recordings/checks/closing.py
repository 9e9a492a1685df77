"""Readings of some moments without truth: the positions that fit them best, and the errors that remain.

Ranges and their differences are fitted by damped Gauss-Newton steps from below the anchors, rays of bearings by linear
least squares. Where readings of one moment contradict each other, and no longer do with a change, that is the likely
mistake. The place of one anchor is fitted to the errors that the best positions leave, the turn of a station by search.
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
from trackwright.trackers.recordings.checks.compared import robust_fit
from trackwright.trackers.recordings.checks.readings import MOST_ROWS
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Kind, wrapped


class Limits(NamedTuple):
    """Contradictions, m or rad: up to `large` nothing needs an explanation, but one sensor is looked for from `one` on.

    `remaining`: it may remain with a change that explains it; twice as much is reported without an explanation.
    `nothing`: up to which all changes explain it: one spare reading is soon explained.
    """

    large: float
    remaining: float
    one: float
    nothing: float


LIMITS = {"m": Limits(0.3, 0.45, 0.15, 0.08), "rad": Limits(0.12, 0.3, 0.06, 0.03)}

SMALLER, CLEARER, ALIKE, NAMED = 0.67, 0.5, 1.1, 3
"""Ratios of contradictions: from which a change explains large ones, that without one anchor or station, and up to
which changes do alike, as in a symmetric rig; how many of these are named.

On no real recording is the best ratio without one below 0.6; of the changes none may come as near.
"""

LEAST_MOVE_M, LEAST_TURN, FITTED, AS_WELL = 0.6, np.radians(15.0), 0.75, 1.5
"""Move of an anchor and turn of a station that are a mistake, the ratio of contradictions that they must reach, and the
ratio to those without it, which are smaller in any case.

On real recordings as they are, the place that fits best is up to 0.5 m away, or leaves more than 0.8.
"""

ELSEWHERE = "its place in rig.toml is wrong, or its readings are; measure it again"

SPANS_S, LEAST_MOMENTS, MOST_MOMENTS, MOST_SENSORS = (0.1, 0.25, 0.5, 1.0), 15, 60, 12
"""Times within which readings are taken for one moment's, s; the first in which enough of them come."""

LEAST_EXTENT_M, STEPS, FIT_STEPS = 1.0, 12, 12
"""Extent of the anchors or stations, m, below which any ranges of a moment contradict or fit each other alike; steps to
positions, and to the place of an anchor."""


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
        return float(np.median(np.sqrt(np.nanmean(self.fitted()[1] ** 2, axis=(1, 2)))))

    def fitted(self) -> tuple[Float[np.ndarray, "E 3"], Float[np.ndarray, "E G m"]]:
        """The positions that fit the readings of each moment best, and the errors that they leave."""
        return self._of_bearings() if self.kind.angles else self._of_ranges()

    def _of_ranges(self) -> tuple[np.ndarray, np.ndarray]:
        r, free, signs = self.values[..., 0], np.isnan(self.heights), np.array([1.0, -1.0])[: self.sensors.shape[1]]
        p = np.tile(self.places.mean(axis=0) - np.array([0.0, 0.0, 1.0]), (len(r), 1))
        p[:, 2] = np.where(free, p[:, 2], self.heights)
        allowed = np.stack([np.ones_like(free), np.ones_like(free), free], axis=1)
        for step in range(STEPS + 1):
            away = p[:, None] - self.places
            distance = np.maximum(np.linalg.norm(away, axis=2), 1e-6)
            slopes = np.einsum("egki,k->egi", (away / distance[..., None])[:, self.sensors], signs)
            errors = r - distance[:, self.sensors] @ signs
            J, e = slopes * np.isfinite(r)[..., None] * allowed[:, None], np.nan_to_num(errors)
            normal = np.einsum("egi,egj->eij", J, J) + 0.02 * np.eye(3)
            if step < STEPS:
                p = p + np.linalg.solve(normal, np.einsum("egi,eg->ei", J, e)[..., None])[..., 0] * allowed
        return p, errors[..., None]

    def _of_bearings(self) -> tuple[np.ndarray, np.ndarray]:
        azimuth, elevation = np.moveaxis(self.values, 2, 0)
        known = np.isfinite(azimuth) & np.isfinite(elevation)
        local = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        ray = np.einsum("gij,jeg->egi", self.axes, np.where(known, local, 0.0))
        across = (np.eye(3) - ray[..., None] * ray[..., None, :]) * known[..., None, None]
        normal, side = across.sum(axis=1), np.einsum("egij,gj->ei", across, self.places)
        # A known height weighs more than all rays.
        weight = np.where(np.isnan(self.heights), 1e-6, 1e3)
        normal[:, 2, 2] += weight
        side[:, 2] += weight * np.nan_to_num(self.heights)
        p = np.linalg.solve(normal, side[..., None])[..., 0]
        differences = self.values - angles_in_array(np.einsum("gij,egi->jeg", self.axes, p[:, None] - self.places))
        return p, np.where(known[..., None], wrapped(differences, self.kind.least), np.nan)


def moments(recording: RecordingFolder, table: str) -> Moments | None:
    """Moments of a table with more readings than a position takes; None with too few, or sensors all at one place."""
    rig, rows, kind = recording.rig, recording.rows(table), KINDS[table]
    measured = kind.measured(rig, rows)
    whole = np.flatnonzero(np.isfinite(measured.values[:MOST_ROWS]).all(axis=1))
    numbers = measured.sensors.number[whole]
    used, sensor = np.unique(numbers, return_inverse=True)
    columns, number = np.unique(sensor.reshape(numbers.shape), axis=0, return_inverse=True)
    places, axes = measured.sensors.places[used], measured.sensors.axes[used]
    if not 2 <= len(used) <= MOST_SENSORS or np.linalg.norm(np.ptp(places, axis=0)) < LEAST_EXTENT_M:
        return None
    times, values = rows.times[whole], measured.values[whole]
    tag = rows.of_each(np.arange(len(rows.tags)))[whole]
    given = [rig.tags[name].height if name in rig.tags else None for name in rows.tags]
    heights = np.array([np.nan if height is None else height for height in given])
    for span in SPANS_S:
        moment = np.floor(times / span)
        order = np.lexsort((moment, tag))
        new = (np.diff(moment[order], prepend=np.nan) != 0) | (np.diff(tag[order], prepend=-1) != 0)
        latest = np.full((int(new.sum()), len(columns), values.shape[1]), np.nan)
        latest[np.cumsum(new) - 1, number.ravel()[order]] = values[order]
        known = heights[tag[order][new]]
        enough = np.flatnonzero(_enough(kind, latest, known))
        if len(enough) >= LEAST_MOMENTS and 2 * len(enough) >= len(latest):
            chosen = enough[np.unique(np.linspace(0, len(enough) - 1, MOST_MOMENTS).astype(int))]
            ids = tuple(measured.ids[k] for k in used)
            return Moments(kind, ids, latest[chosen], places, axes, columns, known[chosen])
    return None


def _enough(kind: Kind, values: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Whether moments have readings of so many sensors, or pairs, that they can contradict each other."""
    spare = 0 if kind.angles else 3 if kind.difference else 1
    return np.asarray(np.isfinite(values).all(axis=2).sum(axis=1) >= np.where(np.isnan(heights), 3, 2) + spare)


class Trial(NamedTuple):
    """What contradiction is left with a change, the change in words, and the mistake that it undoes."""

    left: float
    words: str
    cause: str


def check_closing(recording: RecordingFolder, table: str) -> Iterator[CheckResult]:
    """An error where readings of one moment contradict each other and one change explains it, as of units or ids.

    A warning where they do not with one anchor elsewhere or one station turned, or without one, and where nothing
    explains it.
    """
    kind = KINDS[table]
    closes = kind.difference or (len(kind.sensors) == 1 and (kind.angles or kind.distance))
    readings = moments(recording, table) if closes else None
    if readings is None or (before := readings.closing()) <= LIMITS[kind.unit].one:
        return
    limits, (unit, factor) = LIMITS[kind.unit], kind.shown
    large = before > limits.large
    tried = sorted(Trial(changed.closing(), words, cause) for words, cause, changed in _changes(readings))
    least = min(tried[0].left, before)
    explained = least <= min((SMALLER if large else CLEARER) * before, limits.remaining)
    without = min(_without_each(readings), default=Trial(np.inf, "", ""))
    fitted = sorted(_turned_each(readings) if kind.angles else () if kind.difference else _moved_each(readings))
    message = f"readings of one moment contradict each other by {significant(factor * before, 2)}{unit}"

    def found(tried: Sequence[Trial], link: str = "with") -> str:
        """The words and the causes of the changes that explain it as well as the first."""
        best = [one for one in tried if one.left <= max(ALIKE * tried[0].left, limits.nothing)][:NAMED]
        causes = "; or ".join(dict.fromkeys(one.cause for one in best))
        text = f"{significant(factor * tried[0].left, 2)}{unit} {link} {', or '.join(one.words for one in best)}"
        return f"{message}, and by {text}: {causes}"

    enough = min(FITTED * least, AS_WELL * without.left, limits.remaining)
    if fitted and fitted[0].left <= enough and not (explained and least <= limits.nothing):
        yield CheckResult("warning", table, found(fitted))
    elif without.left <= CLEARER * least:
        yield CheckResult("warning", table, found([without], "without"))
    elif explained:
        yield CheckResult("error", table, found(tried))
    elif large and before > 2 * limits.remaining:
        unexplained = "no change of units, signs or ids explains it; check positions and rotations in rig.toml"
        yield CheckResult("warning", table, f"{message}, and {unexplained}")


def _without_each(readings: Moments) -> Iterator[Trial]:
    """Each anchor or station left out, where the others are enough for a position."""
    for k, name in enumerate(readings.ids):
        values = np.where((readings.sensors == k).any(axis=1)[:, None], np.nan, readings.values)
        enough = _enough(readings.kind, values, readings.heights)
        if enough.sum() >= LEAST_MOMENTS:
            part = readings._replace(values=values[enough], heights=readings.heights[enough])
            yield Trial(part.closing(), f"{readings.kind.noun} {name}", ELSEWHERE)


def _moved_each(readings: Moments) -> Iterator[Trial]:
    """Each anchor at the place that fits best, if that is elsewhere."""
    if np.linalg.norm(np.ptp(readings.fitted()[0][:, :2], axis=0)) < LEAST_EXTENT_M:
        return
    for k, name in enumerate(readings.ids):
        place = moved(readings, k)
        if (away := float(np.linalg.norm(place - readings.places[k]))) >= LEAST_MOVE_M:
            there = f"anchor {name} {away:.1f} m elsewhere, at ({', '.join(f'{x:.2f}' for x in place)}) m"
            yield Trial(_at(readings, k, place).closing(), there, ELSEWHERE)


def _at(readings: Moments, k: int, place: Float[np.ndarray, "3"]) -> Moments:
    return readings._replace(places=np.where(np.arange(len(readings.ids))[:, None] == k, place, readings.places))


def moved(readings: Moments, k: int) -> Float[np.ndarray, "3"]:
    """The place of an anchor with which the best positions leave the smallest errors."""
    return robust_fit(lambda place: _at(readings, k, place).fitted()[1][..., 0], readings.places[k], FIT_STEPS)[0]


def _turned_each(readings: Moments) -> Iterator[Trial]:
    """Each station turned about the vertical as fits best, if that is by much."""
    cause = "another orientation than rig.toml's; correct rotation_wxyz or yaw_deg"
    for k, name in enumerate(readings.ids):
        one, tried = np.arange(len(readings.ids))[:, None, None] == k, []
        for angle in np.radians(np.arange(-175.0, 180.0, 5.0)):
            axes = np.where(one, about_vertical(angle) @ readings.axes, readings.axes)
            tried.append((readings._replace(axes=axes).closing(), angle))
        left, angle = min(tried)
        if abs(angle) >= LEAST_TURN:
            yield Trial(left, f"station {name} turned by {np.degrees(angle):.0f}° about the vertical", cause)


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
