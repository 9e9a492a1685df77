"""Changes of the readings, the truth or the rig whose numbers are fitted: offsets, turns, places, delays, ids."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.recordings.checks.changes import (
    LEAST_MOVE_M,
    Change,
    exchanged,
    frame_cause,
    resolving,
    transform_text,
)
from trackwright.trackers.recordings.checks.compared import Compared, robust_fit
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.kinds import wrapped

LEAST_OFFSET_M, LEAST_SCALE, LEAST_TURN = 1.0, 0.05, np.radians(15.0)
"""Smallest offset of ranges, logarithm of a ratio and turn of a station that count as mistakes."""

ALIKE = 1.2
"""Ratio of errors up to which two places explain the readings alike, and that nearer to rig.toml's is named."""

LEAST_EXTENT_M = 1.0
"""Extent of the true positions, m, from which the place of an anchor or station is fitted."""

FEW, COARSE = 240, 600
"""Readings for the first search of a frame, and for that of a delay."""

TURNS = 5
"""Turns of the truth from which a frame is fitted: those with the smallest errors of 24."""

LONGEST_DELAY_S = 60.0
NEAREST = 3
"""Delays from which a finer grid goes on."""

LATENCY_S = 1.0
"""Delays of measurements up to here are a property of the sensor."""

LEAST_SHIFT_M, LEAST_YAW = 0.4, np.radians(4.0)
LEAST_CLOCK_S = 0.05
"""Least difference of the clocks that is given with the frame of the truth, s."""

FARTHEST_M = 200.0
"""Shift of the truth, m, up to which phases are compared with it: far away on the boresight all are equal."""

LEAST_MOTION_M = 0.5
CLEAR = 1.5
"""Sum of the log ratios of errors from which two of them count as swapped."""

MOST_SWAPPED = 32
"""Anchors, stations or tags that are compared with each other's places."""


def fitted_changes(view: Compared, large: Bool[np.ndarray, " G"]) -> Iterator[Change]:
    """The changes with numbers fitted to the readings; `large` (G,): the groups whose errors need an explanation."""
    kind = view.kind
    if kind.sensors and kind.unit == "m":
        yield _offset(view)
        if kind.distance:
            yield _scale(view)
    if kind.angles:
        yield from _azimuths_turned(view)
    if kind.numbered:
        yield _wavelength(view)
        yield _station_turned(view)
    if kind.sensors:
        yield from _moved(view, large)
    yield from _shifted(view)
    yield from _turned(view)
    yield from _delayed(view)
    yield from _swapped_sensors(view)
    yield from _swapped_tags(view)


def _offset(view: Compared) -> Change:
    offset = view.medians(view.errors())
    subtracted, place = offset[view.group], ""
    if view.kind.difference:
        # Many tags see an anchor in the corner from one side, so that its place is an offset to them.
        subtracted, place = subtracted - offset[view.sensors.number[:, 1]], ", or of another position"
    return Change(
        f"a constant subtracted from the {view.kind.name}",
        f"an offset of the {view.kind.name}, as of an antenna delay that is not calibrated{place}; calibrate the "
        "anchors",
        {"values": view.values - subtracted}, 1, True, np.abs(offset[:, 0]) >= LEAST_OFFSET_M, systematic=True,
        parts=tuple(f"{x:+.2f} m" for x in offset[:, 0]),
    )  # fmt: skip


def _scale(view: Compared) -> Change:
    ratio = view.medians(view.values / np.maximum(view.predicted(), 0.1))
    return Change(
        f"the {view.kind.name} divided by a constant",
        f"a scale error of the {view.kind.name}; check their unit and the clock of the device",
        {"values": view.values / np.where(ratio == 0, 1.0, ratio)[view.group]}, 1, True,
        np.abs(np.log(np.maximum(np.abs(ratio[:, 0]), 1e-6))) > LEAST_SCALE, systematic=True,
        parts=tuple(f"{x:.3f}" for x in ratio[:, 0]),
    )  # fmt: skip


def _azimuths_turned(view: Compared) -> Iterator[Change]:
    azimuth, elevation = view.values.T
    for sign, name in ((1.0, "turned"), (-1.0, "turned and its sign flipped")):
        turn = _circular_medians(view, sign * azimuth - view.predicted()[:, 0])
        yield Change(
            f"the azimuth {name}", "another orientation than rig.toml's, or another zero of the azimuth; correct "
            "rotation_wxyz", {"values": np.stack([sign * azimuth - turn[view.group], elevation], axis=1)}, 1, True,
            np.abs(turn) >= LEAST_TURN, systematic=sign > 0, parts=tuple(f"by {x:.0f}°" for x in np.degrees(turn)),
        )  # fmt: skip


def _circular_medians(view: Compared, angles: np.ndarray) -> np.ndarray:
    """The median of angles of each group (G,), about their circular mean."""
    medians = np.zeros(len(view.ids))
    for k in range(len(medians)):
        known = angles[(view.group == k) & np.isfinite(angles)]
        if len(known):
            centre = np.angle(np.mean(np.exp(1j * known)))
            medians[k] = centre + np.median(_half_turns(known - centre))
    return _half_turns(medians)


def _half_turns(angles: np.ndarray) -> np.ndarray:
    """Angles in [−π, π)."""
    return wrapped(angles[:, None], ("turn_rad",))[:, 0]


def _wavelength(view: Compared) -> Change:
    """The wavelength of each station that makes its errors smallest."""
    wavelengths = view.sensors.wavelengths
    logs = _searched(
        view, lambda logs: {"wavelengths": wavelengths * np.exp(logs)}, np.linspace(np.log(0.25), np.log(4.0), 139)
    )
    return Change(
        "another wavelength", "a wrong wavelength_m, or antennas_m in another scale; correct rig.toml",
        {"wavelengths": wavelengths * np.exp(logs)}, 1, True,
        (np.abs(logs) >= LEAST_SCALE) & resolving(view, np.exp(-logs)),
        parts=tuple(f"{x:.4g} m" for x in np.exp(logs) * wavelengths),
    )  # fmt: skip


def _station_turned(view: Compared) -> Change:
    """Each station turned about the vertical by the angle that makes its errors smallest."""

    def turned(yaw: np.ndarray) -> dict[str, np.ndarray]:
        return {"axes": about_vertical(yaw) @ view.sensors.axes}

    turns = _half_turns(_searched(view, turned, np.radians(np.arange(-180.0, 180.0, 3.0))))
    return Change(
        "the station turned about the vertical", "another orientation than rig.toml's; correct rotation_wxyz or "
        "yaw_deg", turned(turns), 1, True, np.abs(turns) >= LEAST_TURN,
        parts=tuple(f"by {x:.0f}°" for x in np.degrees(turns)),
    )  # fmt: skip


def about_vertical(yaw: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n 3 3"]:
    """The matrices of turns about z, rad."""
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(np.shape(yaw))
    rows = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]])
    return np.moveaxis(rows, (0, 1), (-2, -1))


def _searched(
    view: Compared, changed: Callable[[np.ndarray], dict[str, np.ndarray]], grid: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " G"]:
    """The number of each station with the smallest errors: the best of a grid, then of a finer one round it."""
    best, step = np.zeros(len(view.ids)), float(grid[1] - grid[0])
    for offsets in (grid, np.linspace(-step, step, 9)):
        sizes = (view.changed(**changed(best + x)).sizes() for x in offsets)
        best = best + offsets[np.argmin(np.stack([np.nansum(np.log(x + 1e-3), axis=1) for x in sizes]), axis=0)]
    return best


def _moved(view: Compared, large: np.ndarray) -> Iterator[Change]:
    """The place of each group with large errors fitted to its readings, unless the tags hardly move.

    Of differences one place at a time: that of one anchor is wrong in the readings of others, too.
    """
    given = view.sensors.places
    fitted = {
        k: _place(view, k)
        for k in np.flatnonzero(large).tolist()
        if _extent(view.of_rows(view.group == k)) >= LEAST_EXTENT_M
    }
    for chosen in [[k] for k in fitted] if view.kind.difference else [list(fitted)] if fitted else []:
        places = given.copy()
        places[chosen] = [fitted[k] for k in chosen]
        yield Change(
            "another position", "a wrong position in rig.toml; measure it again", {"places": places}, 3, True,
            np.linalg.norm(places - given, axis=1) > LEAST_MOVE_M, place=True,
            parts=tuple(f"at {_metres(place)}" for place in places),
        )  # fmt: skip


def _place(view: Compared, k: int) -> Float[np.ndarray, "3"]:
    """The place of a group, m, that fits its readings best, of places that do alike that nearest to the given one."""
    given, part = view.sensors.places, view.of_rows(view.group == k)

    def errors(place: np.ndarray) -> np.ndarray:
        return part.changed(places=np.where(np.arange(len(given))[:, None] == k, place, given)).errors()

    starts = (given[k], given.mean(axis=0), 2 * part.positions.mean(axis=0) - given[k])
    place, size = min((robust_fit(errors, start) for start in starts), key=lambda fit: fit[1])
    sides = (place, _mirrored(place, part.positions))
    alike = [side for side in sides if np.nanmedian(np.abs(errors(side))) <= ALIKE * size]
    return min(alike or sides[:1], key=lambda side: float(np.linalg.norm(side - given[k])))


def _extent(view: Compared) -> float:
    """How far the true positions reach, m."""
    return float(np.linalg.norm(np.ptp(view.positions, axis=0)))


def _mirrored(place: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """The place (3,) on the other side of the plane nearest to all positions (n, 3), from which ranges are the same."""
    centre = positions.mean(axis=0)
    normal = np.linalg.svd(positions - centre, full_matrices=False)[2][2]
    mirrored: np.ndarray = place - 2.0 * float((place - centre) @ normal) * normal
    return mirrored


def _metres(vector: np.ndarray) -> str:
    return f"({', '.join(f'{x + 0.0:.2f}' for x in np.round(vector, 2))}) m"


def _shifted(view: Compared) -> Iterator[Change]:
    centre = view.positions.mean(axis=0)
    target = _middle(view, centre)
    starts = [np.zeros(3), target - centre, np.append((target - centre)[:2], 0.0)]
    shift = _fitted(view, lambda shift, part: part.positions + shift, starts)
    if LEAST_SHIFT_M <= np.linalg.norm(shift) <= _farthest(view):
        shift, delay, positions = _with_clock(view, np.add, shift)
        placement = np.concatenate([shift, [0.0], delay])
        yield Change(
            f"the truth shifted by {_metres(shift)}{_clock_words(delay)}",
            frame_cause(view, "has another origin than", placement), {"positions": positions}, 3 + len(delay),
            harmless=view.kind.position and bool(np.linalg.norm(shift[:2]) < LEAST_SHIFT_M),
        )  # fmt: skip


def _turned(view: Compared) -> Iterator[Change]:
    """The truth turned about z, mirrored or not, and shifted."""
    centre = view.positions.mean(axis=0)
    target = np.append(_middle(view, centre)[:2], centre[2])
    for mirrored in (False, True):

        def placed(x: np.ndarray, positions: np.ndarray, mirrored: bool = mirrored) -> np.ndarray:
            away = (positions - centre) * np.array([1.0, -1.0 if mirrored else 1.0, 1.0])
            turned: np.ndarray = x[1:] + away @ about_vertical(x[0]).T
            return turned

        starts = [np.append(yaw, c) for yaw in np.arange(24) * np.pi / 12 for c in (centre, target)]
        x = _fitted(view, lambda x, part, placed=placed: placed(x, part.positions), starts, TURNS)  # type: ignore[misc]
        yaw = float(_half_turns(x[:1])[0])
        if (not mirrored and abs(yaw) < LEAST_YAW) or np.linalg.norm(x[1:] - centre) > _farthest(view):
            continue
        x, delay, positions = _with_clock(view, placed, x)
        yaw, origin = float(_half_turns(x[:1])[0]), placed(x, np.zeros((1, 3)))[0]
        words = f"{'mirrored (y flipped), then ' if mirrored else ''}turned by {np.degrees(yaw):.1f}° about z"
        if np.linalg.norm(origin) >= LEAST_SHIFT_M:
            words += f" and shifted by {_metres(origin)}"
        cause = frame_cause(view, "is turned against", np.concatenate([origin, [np.degrees(yaw)], delay]))
        yield Change(
            f"the truth {words}{_clock_words(delay)}",
            frame_cause(view, "is mirrored against") if mirrored else cause,
            {"positions": positions}, (5 if mirrored else 4) + len(delay),
        )  # fmt: skip


def _with_clock(
    view: Compared, placed: Callable[[np.ndarray, np.ndarray], np.ndarray], x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "N 3"]]:
    """The numbers of the `placed` positions fitted again with the clock; none or one number by which it is off, s."""

    def positions(x: np.ndarray) -> np.ndarray:
        return placed(x[:-1], view.later(float(x[-1])).positions)

    x, _ = robust_fit(lambda x: view.changed(positions=positions(x)).errors(), np.append(x, 0.0), 8)
    delay = float(x[-1])
    # Fixes come late by the delay of the filter that made them.
    if abs(delay) < LEAST_CLOCK_S or (view.kind.position and 0.0 < delay <= LATENCY_S):
        x[-1] = 0.0
    return x[:-1], x[-1:][x[-1:] != 0.0], positions(x)


def _clock_words(delay: np.ndarray) -> str:
    return "".join(f" and {abs(x):.2f} s {'later' if x > 0 else 'earlier'}" for x in delay)


def _fitted(
    view: Compared,
    positions: Callable[[np.ndarray, Compared], np.ndarray],
    starts: Sequence[np.ndarray],
    most: int | None = None,
) -> np.ndarray:
    """The numbers whose `positions` fit the readings best, from starts, or the best `most` of them."""

    def errors(x: np.ndarray, part: Compared = view) -> np.ndarray:
        return part.changed(positions=positions(x, part)).errors()

    few = view.thinned(FEW)
    if most is not None:
        starts = sorted(starts, key=lambda x: float(np.nanmean(np.log1p(np.abs(errors(x, few))))))[:most]
    rough = min((robust_fit(lambda x: errors(x, few), start, 8) for start in starts), key=lambda fit: fit[1])[0]
    return robust_fit(errors, rough, 4)[0]


def _middle(view: Compared, centre: np.ndarray) -> np.ndarray:
    """The mean (3,) of fixes, or of anchors or stations; the `centre` of the truth along an axis without a fix."""
    if not view.kind.position:
        return np.asarray(view.sensors.places.mean(axis=0))
    known = np.isfinite(view.values)
    sums = np.where(known, view.values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), sums / np.maximum(known.sum(axis=0), 1), centre)


def _farthest(view: Compared) -> float:
    return FARTHEST_M if view.kind.numbered else np.inf


def _delayed(view: Compared) -> Iterator[Change]:
    """The truth of some seconds before or after."""
    extent = max(_extent(view.of_rows(view.tag == k)) for k in np.unique(view.tag))
    span = float(np.ptp(view.times))
    if extent < LEAST_MOTION_M or span < 2.0:
        return
    longest, few = min(LONGEST_DELAY_S, 0.45 * span), view.thinned(COARSE)
    grid, step = np.arange(-longest, longest + 1.0, 1.0), 1.0
    while step > 0.02:
        part = few if step > 0.1 else view
        # A path that repeats itself has several, of which the right one need not be that nearest to the grid.
        nearest = sorted(grid, key=lambda delay: float(_logs(part.later(delay).sizes()).sum()))[:NEAREST]
        grid, step = np.unique(np.add.outer(nearest, step * np.arange(-1.0, 1.01, 0.25))), step / 4
    yield delayed_by(view, float(nearest[0]))


def delayed_by(view: Compared, delay: float) -> Change:
    """The truth of `delay` s before."""
    earlier, late = ("earlier", "late") if delay > 0 else ("later", "early")
    return Change(
        f"the measurements taken {abs(delay):.2f} s {earlier}",
        f"the {view.kind.name} come {abs(delay):.2f} s {late}: their clock and that of the truth differ; "
        f"import the truth again with --align-truth, or --transform {transform_text(0.0, 0.0, 0.0, 0.0, delay)}",
        {"positions": view.later(delay).positions}, 1, harmless=-LATENCY_S / 2 < delay <= LATENCY_S,
    )  # fmt: skip


def _swapped_sensors(view: Compared) -> Iterator[Change]:
    """Each anchor or station at the place of another."""
    count, sensors = len(view.ids), view.sensors
    if not view.kind.sensors or not 2 <= count <= MOST_SWAPPED:
        return
    few = view.thinned(max(FEW, 60 * count))
    if len(view.kind.sensors) == 1:
        all_at = [few.changed(places=sensors.places[[k] * count], axes=sensors.axes[[k] * count]) for k in range(count)]
        order = _assignment(np.stack([_logs(other.sizes()) for other in all_at], axis=1))
    else:
        # A difference has two anchors, each of which may be another.
        orders = [exchanged(count, i, j) for i, j in combinations(range(count), 2)]
        order = min(orders, key=lambda order: float(_logs(few.changed(places=sensors.places[order]).sizes()).sum()))
    if (order != np.arange(count)).any():
        yield Change(
            _exchange(view.kind.noun, view.ids, order),
            f"the ids of {view.kind.noun}s are mixed up; correct rig.toml or the table",
            {"places": sensors.places[order], "axes": sensors.axes[order]}, by_group=True,
            groups=order != np.arange(count), together=True,
        )  # fmt: skip


def _swapped_tags(view: Compared) -> Iterator[Change]:
    """Each tag on the path of another."""
    used = np.array([k for k in np.unique(view.tag) if view.tags[k] in view.paths.number])
    if not 2 <= len(used) <= MOST_SWAPPED:
        return
    few = view.thinned(max(FEW, 60 * len(used)))
    costs = np.zeros((len(used), len(used)))
    for j, other in enumerate(used):
        errors = np.abs(few.later(0.0, np.full(len(view.tags), other)).errors())
        for i, tag in enumerate(used):
            costs[i, j] = _logs(known_median(errors[few.tag == tag])[None])[0]
    order = _assignment(costs)
    if (order != np.arange(len(used))).any():
        of = np.arange(len(view.tags))
        of[used] = used[order]
        yield Change(
            _exchange("tag", [view.tags[k] for k in used], order),
            "the ids of tags are mixed up between truth and measurements; correct one table",
            {"positions": view.later(0.0, of).positions}, 1,
        )  # fmt: skip


def _logs(sizes: np.ndarray) -> np.ndarray:
    """The sum over columns (G,) of the logarithms of sizes, large where one is unknown."""
    total: np.ndarray = np.log(np.where(np.isfinite(sizes), np.maximum(sizes, 1e-3), 1e3)).sum(axis=1)
    return total


def _assignment(costs: np.ndarray) -> np.ndarray:
    """The column of each row (n,), no two equal, that makes the sum small: only exchanges that clearly do."""
    from scipy.optimize import linear_sum_assignment  # a quarter of a second, and few recordings come here

    order = linear_sum_assignment(costs)[1]
    assigned = np.arange(len(costs))
    for first in assigned.tolist():
        cycle, last = [first], first
        while (last := int(order[last])) != first:
            cycle.append(last)
        if costs[cycle, cycle].sum() - costs[cycle, order[cycle]].sum() > CLEAR:
            assigned[cycle] = order[cycle]
    return assigned


def _exchange(noun: str, ids: Sequence[str], order: np.ndarray) -> str:
    moved = [k for k in range(len(ids)) if order[k] != k]
    if len(moved) == 2:
        return f"{noun}s {ids[moved[0]]} and {ids[moved[1]]} swapped"
    return f"{noun}s exchanged ({', '.join(f'{ids[k]} for {ids[order[k]]}' for k in moved)})"
