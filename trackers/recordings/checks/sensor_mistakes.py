"""Explanations of errors by single anchors, stations or tags: units, signs, offsets, orientation, position."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from trackwright.trackers.recordings.checks.compared import Compared, axes_of
from trackwright.trackers.recordings.checks.explanations import FACTORS, Explanation, metres, sizes_with
from trackwright.trackers.recordings.checks.phase_mistakes import of_phases
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.checks.robust_fit import robust_fit
from trackwright.trackers.recordings.kinds import wrapped

FLIGHT = ((0.5, "round-trip distances"), (2.0, "halved distances"))
LEAST_OFFSET_M = 1.0
LEAST_TURN = np.radians(15.0)
LEAST_MOVE_M = 0.5
"""Smallest offset of ranges, turn of a station and shift of a place that count as mistakes."""

ALIKE = 1.2
"""Ratio of errors up to which two places explain the readings alike, and that nearer to rig.toml's is named."""

LEAST_EXTENT_M = 1.0
"""Extent of the true positions, m, from which the place of an anchor or station is fitted."""


def sensor_explanations(view: Compared, large: np.ndarray) -> Iterator[Explanation]:
    """Changes of the readings and of the geometry that may hold for some groups alone.

    `large` (G,): the groups with errors that need an explanation.
    """
    if view.kind.sensors and view.kind.unit == "m":
        yield from _of_lengths(view)
    if view.kind.angles:
        yield from _of_bearings(view)
    if view.kind.numbered:
        yield from of_phases(view)
    if view.noun == "station":
        yield from _of_rotations(view)
    if view.kind.sensors:
        yield from _of_places(view)
        yield from _moved(view, large)


def _of_lengths(view: Compared) -> Iterator[Explanation]:
    for factor, unit in (*FACTORS, *FLIGHT):
        yield Explanation(
            f"the {view.table} multiplied by {factor:.4g}", f"{view.table} are {unit}, expected metres; convert them",
            sizes_with(view, values=factor * view.values), own=True,
        )  # fmt: skip
    yield Explanation(
        f"the sign of the {view.table} flipped", f"{view.table} with the wrong sign; flip it",
        sizes_with(view, values=-view.values), own=True,
    )  # fmt: skip
    offset = _medians(view, view.errors())
    kept = np.abs(offset[:, 0]) >= LEAST_OFFSET_M
    yield Explanation(
        f"a constant subtracted from the {view.table}",
        f"an offset of the {view.table}, as of an antenna delay that is not calibrated; calibrate the anchors",
        sizes_with(view, values=view.values - offset[view.group]), 1, True, kept,
        parts=tuple(f"{x:+.2f} m" for x in offset[:, 0]),
    )  # fmt: skip
    if not view.kind.distance:
        return
    ratio = _medians(view, view.values / np.maximum(view.predicted(), 0.1))
    kept = np.abs(np.log(np.maximum(np.abs(ratio[:, 0]), 1e-6))) > 0.05
    yield Explanation(
        f"the {view.table} divided by a constant",
        f"a scale error of the {view.table}; check their unit and the clock of the device",
        sizes_with(view, values=view.values / np.where(ratio == 0, 1.0, ratio)[view.group]), 1, True, kept,
        parts=tuple(f"{x:.3f}" for x in ratio[:, 0]),
    )  # fmt: skip


def angles_changed(values: np.ndarray) -> dict[str, tuple[np.ndarray, str]]:
    """Azimuths and elevations (…, 2) with other signs or swapped, and the mistake, by the change in words."""
    return {
        "the sign of the azimuth flipped": (
            values * np.array([-1.0, 1.0]),
            "the azimuth is positive to the right, expected to the left seen along the boresight; flip its sign",
        ),
        "the sign of the elevation flipped": (
            values * np.array([1.0, -1.0]), "the elevation is positive downward, expected upward; flip its sign",
        ),
        "the signs of azimuth and elevation flipped": (
            -values, "the station is upside down, or both angles have the opposite sign; turn it in rig.toml",
        ),
        "azimuth and elevation swapped": (values[..., ::-1], "azimuth and elevation are swapped; rename both"),
    }  # fmt: skip


def _of_bearings(view: Compared) -> Iterator[Explanation]:
    azimuth, elevation = view.values.T
    for change, (values, cause) in angles_changed(view.values).items():
        yield Explanation(change, cause, sizes_with(view, values=values), own=True)
    for sign, name in ((1.0, "turned"), (-1.0, "turned and its sign flipped")):
        turned = np.stack([sign * azimuth, elevation], axis=1)
        turn = _circular_medians(view, turned[:, 0] - view.predicted()[:, 0])
        values = turned - np.stack([turn[view.group], np.zeros(len(turned))], axis=1)
        yield Explanation(
            f"the azimuth {name}", "another orientation than rig.toml's, or another zero of the azimuth; correct "
            "rotation_wxyz", sizes_with(view, values=values), 1, True, np.abs(turn) >= LEAST_TURN,
            parts=tuple(f"by {x:.0f}°" for x in np.degrees(turn)),
        )  # fmt: skip


def _of_rotations(view: Compared) -> Iterator[Explanation]:
    q = view.rotations
    changed = {
        "rotation_wxyz read as x, y, z, w": (np.roll(q, 1, axis=1), "the quaternion is written x, y, z, w; reorder it"),
        "rotation_wxyz inverted": (
            q * np.array([1.0, -1.0, -1.0, -1.0]),
            "the quaternion takes world vectors to array vectors; invert it (negate x, y, z)",
        ),
    }  # fmt: skip
    for change, (rotations, cause) in changed.items():
        other = np.abs(np.abs(np.einsum("gi,gi->g", rotations, q)) - 1.0) > 1e-3
        yield Explanation(change, cause, sizes_with(view, axes=axes_of(rotations)), own=True, groups=other)


def _of_places(view: Compared) -> Iterator[Explanation]:
    for k, axis in enumerate("xyz"):
        flipped = view.places * np.where(np.arange(3) == k, -1.0, 1.0)
        other = np.abs(view.places[:, k]) > LEAST_MOVE_M / 2
        yield Explanation(
            f"the sign of {axis} of the position flipped", f"{axis} in rig.toml has the wrong sign; flip it",
            sizes_with(view, places=flipped), 1, True, other, place=True,
        )  # fmt: skip
    swapped = view.places[:, [1, 0, 2]]
    yield Explanation(
        "x and y of the position swapped", "x and y in rig.toml are swapped", sizes_with(view, places=swapped), 1, True,
        np.linalg.norm(swapped - view.places, axis=1) > LEAST_MOVE_M, place=True,
    )  # fmt: skip


def _moved(view: Compared, large: np.ndarray) -> Iterator[Explanation]:
    """The place of each group with large errors fitted to its readings, unless the tags hardly move."""
    places = view.places.copy()
    fitted = np.zeros(len(places), bool)
    for k in np.flatnonzero(large).tolist():
        own = view.group == k
        if np.linalg.norm(np.ptp(view.positions[own], axis=0)) < LEAST_EXTENT_M:
            continue
        part = view.of_rows(own)

        def errors(place: np.ndarray, part: Compared = part, k: int = k) -> np.ndarray:
            return part._replace(places=np.where(np.arange(len(places))[:, None] == k, place, part.places)).errors()

        starts = (view.places[k], view.places.mean(axis=0), 2 * part.positions.mean(axis=0) - view.places[k])
        place, size = min((robust_fit(errors, start) for start in starts), key=lambda fit: fit[1])
        sides = (place, _mirrored(place, part.positions))
        alike = [side for side in sides if np.nanmedian(np.abs(errors(side))) <= ALIKE * size]
        places[k] = min(alike or sides[:1], key=lambda side: float(np.linalg.norm(side - view.places[k])))
        fitted[k] = True
    moved = np.linalg.norm(places - view.places, axis=1) > LEAST_MOVE_M
    if not fitted.any():
        return
    yield Explanation(
        "another position", "a wrong position in rig.toml; measure it again", sizes_with(view, places=places), 3, True,
        fitted & moved, place=True, parts=tuple(f"at {metres(place)}" for place in places),
    )  # fmt: skip


def _mirrored(place: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """The place (3,) on the other side of the plane nearest to all positions (n, 3), from which ranges are the same."""
    centre = positions.mean(axis=0)
    normal = np.linalg.svd(positions - centre, full_matrices=False)[2][2]
    mirrored: np.ndarray = place - 2.0 * float((place - centre) @ normal) * normal
    return mirrored


def _medians(view: Compared, x: np.ndarray) -> np.ndarray:
    """The median of each group and column (G, m)."""
    return np.stack([known_median(x[view.group == k]) for k in range(len(view.ids))])


def _circular_medians(view: Compared, angles: np.ndarray) -> np.ndarray:
    """The median of angles of each group (G,), about their circular mean."""
    found = np.zeros(len(view.ids))
    for k in range(len(found)):
        own = angles[(view.group == k) & np.isfinite(angles)]
        if len(own):
            centre = np.angle(np.mean(np.exp(1j * own)))
            found[k] = centre + np.median(wrapped(own - centre, ("azimuth_rad",)))
    found = np.mod(found + np.pi, 2 * np.pi) - np.pi
    return found
