"""Mistakes in odometry that the true path shows: units and signs of speed and yaw rate, and the clock.

The way and the turn of a second are compared. Without a true attitude the turn is that of the direction of motion of a
tag over the axle, which does not tell forward from backward.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from jaxtyping import Float

from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.imu import LEAST_WINDOWS, SAME_LIFT, Delay, best_delay
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import layout

HALF_S, HELD_S = 0.5, 1.0
"""Half the time over which ways and turns are compared, and the longest for which a reading holds, s."""

LEAST, MOST_TURN = (0.1, 0.1), 1.0
"""Way, m, and turn, rad, in such a time from which they are compared, and turn up to which a chord is the way."""

SURE = 0.7
"""Least share of ways and turns that have one sign relative to the true ones, and of the way along the body."""

FACTORS = (0.8, 1.25), (0.5, 2.0)
"""Ratios of measured to true speeds, and yaw rates, between which units are right; a noisy path turns more."""

COLUMNS = layout("odometry", ()).values
EXPECTED = ("metres per second", "forward"), ("radians per second", "to the left")
UNITS = (
    {1000.0: "millimetres per second", 100.0: "centimetres per second", 39.37: "inches per second", 3.6: "km/h"},
    {57.3: "degrees per second", 9.549: "turns per minute"},
)
"""How many of other units of speed and of yaw rate are one of those expected."""


def check_odometry(recording: RecordingFolder) -> Iterator[CheckResult]:
    """An error for speeds or yaw rates of another unit or sign than the truth's; another clock, as an IMU's."""
    rows, known = recording.rows("odometry"), recording.paths.number
    values = rows.floats(COLUMNS)
    for tag, first, end in zip(rows.tags, rows.starts[:-1], rows.starts[1:], strict=True):
        whole = first + np.flatnonzero(np.isfinite(values[first:end]).all(axis=1))
        seen = next((one for one in (tag, *recording.rig.on_body_of(tag)) if one in known), None)
        if seen is not None and len(whole) >= LEAST_WINDOWS:
            for one in _of_tag(rows.times[whole], values[whole], recording, seen):
                yield CheckResult(one.level, one.where, f"tag {tag}: {one.message}")


def _of_tag(
    times: Float[np.ndarray, " N"], values: Float[np.ndarray, "N 2"], recording: RecordingFolder, tag: str
) -> Iterator[CheckResult]:
    held = np.minimum(np.diff(times), HELD_S)[:, None]
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(values[:-1] * held, axis=0)])

    def measured(k: int, at: np.ndarray) -> np.ndarray:
        before, after = (np.interp(at + h, times, sums[:, k], np.nan, np.nan) for h in (-HALF_S, HALF_S))
        return after - before

    def size(k: int, at: np.ndarray) -> np.ndarray:
        return np.abs(measured(k, at))

    first, last = recording.paths.of_tag(tag)[0][[0, -1]].tolist()
    at = np.arange(first, last, HALF_S / 2)
    true, signed = _true(recording, tag, at)
    delay = Delay(0.0, 0.0, 0.0)
    for k in (1, 0):
        known = np.isfinite(true[k])
        if delay.fit < SAME_LIFT and known.sum() >= LEAST_WINDOWS:
            delay = best_delay(partial(size, k), at[known], np.abs(true[k][known]))
    late = delay.late if delay.fit >= SAME_LIFT else 0.0
    yield from delay.told("odometry", "the truth's motion", 0.2, 1) if late else ()
    for k, y in enumerate(true):
        x = measured(k, at + late) if k or signed else size(k, at + late)
        known = np.isfinite(x) & (np.abs(y) > LEAST[k])
        if known.sum() >= LEAST_WINDOWS and (wrong := _wrong(x[known], y[known], k)):
            yield CheckResult("error", "odometry", f"{COLUMNS[k]} {wrong}")


def _true(recording: RecordingFolder, tag: str, at: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "2 n"], bool]:
    """The true ways of the axle, m, and turns, rad, about times, s, NaN where not known; whether ways have a sign."""
    paths, one, known = recording.paths, np.array([0, len(at)]), recording.rig.tags.get(tag)
    aside = 0j if known is None or known.offset is None else complex(known.offset[0], known.offset[1])
    given = paths.headings is not None

    def place(shift: float) -> np.ndarray:
        x, y, _ = paths.at([tag], one, at + shift)[0].T
        return x + 1j * y - (aside * heading(shift) if given else 0)

    def heading(shift: float) -> np.ndarray:
        if given:
            return np.exp(1j * paths.headings_at([tag], one, at + shift))
        moved = place(shift + HALF_S / 2) - place(shift - HALF_S / 2)
        return np.exp(1j * np.where(np.abs(moved) > LEAST[0] / 2, np.angle(moved), np.nan))

    if not given and abs(aside) > LEAST[0]:
        return np.full((2, len(at)), np.nan), False
    turns, moved = np.angle(heading(HALF_S) * heading(-HALF_S).conj()), place(HALF_S) - place(-HALF_S)
    along, ways = (moved * heading(0.0).conj()).real, np.abs(moved)
    signed = given and bool(np.nansum(np.abs(along)) > SURE * np.nansum(ways))
    return np.stack([np.where(np.abs(turns) > MOST_TURN, np.nan, along if signed else ways), turns]), signed


def _wrong(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], k: int) -> str | None:
    """What is wrong with measured values beside true ones, in words; None where nothing is, or they do not tell."""
    sign = float(np.sign(x * y) @ np.abs(y)) / np.abs(y).sum()
    if abs(sign) < SURE:
        return None
    (unit, way), factor = EXPECTED[k], float(np.median(np.abs(x)) / np.median(np.abs(y)))
    words = [] if sign > 0 else [f"has the wrong sign, expected positive {way}; flip it"]
    if not FACTORS[k][0] <= factor <= FACTORS[k][1]:
        named = (
            f": looks like {name}" for size, name in UNITS[k].items() if FACTORS[0][0] < factor / size < FACTORS[0][1]
        )
        words.append(f"is typically {factor:.3g} times that of the truth{next(named, '')}, expected {unit}")
    return "; and ".join(words) or None
