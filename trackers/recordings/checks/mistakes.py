"""The most likely mistakes in a table: of many changes of readings, rig or truth, those with the smallest errors left.

A change is named only where it explains nearly all rows, down to errors that need no explanation. Without a truth,
errors are the contradictions of readings of one moment.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.checks.changes import LATENCY_S, LEAST_SHIFT_M, Change, changes, delayed, fitted
from trackwright.trackers.recordings.checks.compared import LEAST_MOMENTS, Compared, needed
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.checks.residuals import typical_delay
from trackwright.trackers.recordings.kinds import unit_of

PENALTY, ALL_GAIN, GROUP_GAIN = 0.06, 0.65, 1.0
"""Log ratios of errors: the price of a change and of each fitted number, the least gain of a change, and of one with
numbers for single sensors."""

EXPLAINED, NEARLY, BROKEN, FEW_PLACES = 2.0, 0.75, 10.0, 0.25
"""Errors left, in those that need no explanation, and share of rows that a change has to bring below three; ratio of
the errors of one anchor to the others' from which it is broken; share of sensors whose places may be wrong."""

LEAST_DELAY_S, DELAY_GAIN, DELAY_GROUPS = 0.1, 2 / 3, 24
"""A warning of a delay needs so long a one, and errors that fall to this share; looked for in so many groups."""

CLOSING = {"m": (0.15, 0.3, 0.45, 0.08), "rad": (0.06, 0.12, 0.3, 0.03)}
"""Contradictions of one moment: from which on one sensor is looked for; that need an explanation; that may remain with
one; up to which all changes explain them."""

SMALLER, CLEARER, ALIKE, NAMED = 0.67, 0.5, 1.1, 3
"""Ratios of contradictions: from which a change explains large ones, that without one sensor, and up to which changes
do alike, as in a symmetric rig; how many of these are named. On no real recording is that without one below 0.6."""


class Found(NamedTuple):
    """A change, its cost, the groups (G,) that it is for, its numbers by group, and the sizes (G, m) that it leaves."""

    cost: float
    change: Change
    groups: np.ndarray
    numbers: dict[int, np.ndarray]
    after: np.ndarray


def check_against_truth(view: Compared, calibrated: bool = False, more: Sequence[Change] = ()) -> Iterator[CheckResult]:
    """An error for each likely mistake; a warning of broken anchors, or where nothing is large, of the clocks.

    `calibrated`: what a calibration of anchors and stations removes is no mistake. `more`: changes of this table alone.
    """
    kind, before, named = view.kind, view.sizes(), None
    limit = kind.sizes("large", before.shape[1])
    sound = np.all(~(before > limit), axis=1)
    unknown = ~sound if not sound.all() else _upside_down(view, limit)
    while unknown.any():
        tried = [one for one in (*changes(view), *more) if one.each or named is None]
        best = min(_found(view, tried, before, unknown, sound), key=lambda one: one.cost, default=None)
        if best is None:
            break
        named, unknown = best, unknown & ~best.groups
        delay = float(best.numbers[0][4]) if best.change.of == "delayed" else 0.0
        if delay and -LATENCY_S / 2 < delay <= LATENCY_S:
            yield from _late(view, before, delay)
        elif not _harmless(view, best) and not (calibrated and best.change.of == "offset"):
            level: Level = "warning" if best.change.of == "mounting" else "error"
            yield CheckResult(level, kind.name, _sentence(view, best))
    if unknown.any() and named is None and sound.any() and kind.sensors:
        one, others = (float(np.nanmedian((before / limit)[part])) for part in (unknown, sound))
        if one > BROKEN * others and unknown.sum() <= max(FEW_PLACES * len(unknown), 1):
            typical, rest = (_largest(view, before[part]) for part in (unknown, sound))
            found = f"errors against truth{_of_groups(view, unknown)} are typically {typical}, of the others {rest}"
            message = (
                "and no change of units, place or ids explains them: wild or blocked readings; measure there again"
            )
            yield CheckResult("warning", kind.name, f"{found}, {message}")
            return
    if named is None and kind.averaged:
        yield from _late(view, before, typical_delay(view.of_rows(view.group < DELAY_GROUPS)))


def _upside_down(view: Compared, limit: np.ndarray) -> np.ndarray:
    """All groups (G,) where a truth whose z points down is taken for a bias of each sensor, or none."""
    if not view.kind.sensors or view.kind.common:
        return np.zeros(len(view.ids), bool)
    other = view._replace(positions=view.positions * [1.0, 1.0, -1.0])
    before, after = view.sizes(bias=False), other.sizes(bias=False)
    down = (known_median(before) > limit).any() and np.nanmean(np.log(before / np.maximum(after, 1e-3))) >= ALL_GAIN
    return np.full(len(view.ids), bool(down))


def _found(
    view: Compared, tried: Iterable[Change], before: np.ndarray, large: np.ndarray, sound: np.ndarray
) -> Iterator[Found]:
    """The changes that explain the errors of all readings, or those of some of the groups that are `large`."""
    hidden = not (before > view.kind.sizes("large", before.shape[1])).any()
    before = view.sizes(bias=False) if hidden else before
    usual = _share(view.of_rows(sound[view.group])) if sound.any() and not hidden else 1.0
    for change in tried:
        groups, gains, numbers, after = np.zeros(len(large), bool), 0.0, dict[int, np.ndarray](), np.array(before)
        for k in np.flatnonzero(large).tolist() if change.each else [0]:
            part = view.of_rows(view.group == k) if change.each else view
            if not len(part.group) or (change.of == "place" and np.linalg.norm(np.ptp(part.positions, axis=0)) < 1.0):
                continue
            x = fitted(part, change)
            other = change.apply(part, x)
            sizes = other.sizes(bias=not hidden)
            of = np.arange(len(large)) == k if change.each else np.ones(len(large), bool)
            gain = _gain(view, change, before[of], sizes[of])
            if gain is not None and change.wrong(x) and _share(other) >= min(NEARLY, 0.9 * usual):
                groups, gains, numbers[k] = groups | of, gains + gain * of.sum(), x
                after[of] = sizes[of]
        if groups.any() and not (change.of == "place" and groups.sum() > max(FEW_PLACES * len(groups), 1)):
            count = sum(np.count_nonzero(x[list(change.free)] if len(change.free) else x) for x in numbers.values())
            yield Found(PENALTY * (1 + count) - gains / len(large), change, groups, numbers, after)


def _gain(view: Compared, change: Change, before: np.ndarray, sizes: np.ndarray) -> float | None:
    """By how much the logarithms of sizes of errors fall; None where some that matter do not, or too little."""
    floor, limit = (view.kind.sizes(which, before.shape[1]) for which in ("floor", "large"))
    # A change with which the errors are unknown improves nothing.
    known, after = np.isfinite(before), np.where(np.isfinite(sizes), sizes, np.fmax(before, 1e3))
    fall = np.where(known, np.log(np.maximum(before, floor) / np.maximum(after, floor)), 0.0)
    # Errors that were small and stay small neither need an explanation nor contradict one.
    matters = known & ((before > limit) | (after > limit)) & (np.abs(fall) > 0.02 if change.each else True)
    if not matters.any() or fall[matters].mean() < (GROUP_GAIN if change.each and change.starts else ALL_GAIN):
        return None
    # A place has enough freedom to take up a part of any error.
    most = limit if change.of == "place" else EXPLAINED * limit
    return float(fall.sum() / known.sum()) if (after <= most)[known].mean() >= NEARLY else None


def _share(view: Compared) -> float:
    """The share of the readings whose errors need no explanation."""
    errors = view.errors()
    most = 3 * view.kind.sizes("large", errors.shape[1]) + view.kind.sizes("bias", errors.shape[1])
    known = np.isfinite(errors)
    return float((np.abs(errors) <= most)[known].mean()) if known.any() else 0.0


def _harmless(view: Compared, found: Found) -> bool:
    """Whether a change is no mistake: heights of fixes are often of no use, or mirrored in the plane of the anchors."""
    if found.change.of == "shifted" and view.kind.position:
        x = found.numbers[0] - [0.0, *np.nanmean(view.positions, axis=0), 0.0]
        return bool(np.linalg.norm(x[1:3]) < LEAST_SHIFT_M and x[4] == 0.0)
    return found.change.of == "harmless"


def _late(view: Compared, before: np.ndarray, delay: float) -> Iterator[CheckResult]:
    """A warning of a difference of the clocks that is small enough to track, and makes errors larger."""
    # Fixes come late by the delay of the filter that made them.
    if abs(delay) >= LEAST_DELAY_S and not (view.kind.position and delay > 0):
        x, after = np.array([0.0, *np.nanmean(view.positions, axis=0), delay]), view.later(delay).sizes()
        ratio = np.nanmedian(after / np.maximum(before, view.kind.sizes("floor", before.shape[1])))
        if ratio <= DELAY_GAIN:
            found = Found(0.0, delayed(view), np.ones(len(view.ids), bool), {0: x}, after)
            yield CheckResult("warning", view.kind.name, _sentence(view, found))


def _sentence(view: Compared, found: Found) -> str:
    change, x = found.change, found.numbers[min(found.numbers)]
    parts = [f" ({text})" if (text := change.shown(x)) else "" for x in found.numbers.values()]
    where = _of_groups(view, found.groups, parts) if change.each else ""
    words, cause = change.told(x) if change.told else (change.words + parts[0] * (not change.each), change.cause)
    sizes = view.sizes(bias=False)
    large = found.groups & (sizes > view.kind.sizes("large", sizes.shape[1])).any(axis=1)
    before, after = (_largest(view, one[large if large.any() else found.groups]) for one in (sizes, found.after))
    return f"errors against truth{where} are typically {before}, and {after} with {words}: {cause}"


def _largest(view: Compared, sizes: np.ndarray) -> str:
    """The typical size of the largest errors of groups."""
    unit, factor = ("°", np.degrees(1.0)) if view.kind.angles else (f" {unit_of(view.columns[0])}", 1.0)
    largest = np.nanmax(sizes[np.isfinite(sizes).any(axis=1)], axis=1)
    return f"{significant(factor * float(np.median(largest)), 2)}{unit}"


def _of_groups(view: Compared, groups: np.ndarray, parts: list[str] | None = None) -> str:
    chosen, noun = np.flatnonzero(groups).tolist(), view.kind.noun
    if len(chosen) == len(groups) > 1 and not any(parts or ()):
        return f" of all {len(chosen)} {noun}s"
    names = [view.ids[k] + part for k, part in zip(chosen, parts or [""] * len(chosen), strict=True)]
    return f" of {noun}{'s' if len(names) > 1 else ''} {listed(names, 6)}"


def check_closing(view: Compared) -> Iterator[CheckResult]:
    """An error where readings of one moment contradict each other and one change explains it, as of units or ids.

    A warning where they do not without one anchor or station, or elsewhere or turned, and where nothing explains it.
    """
    kind, before = view.kind, view.closing()
    one, large, remaining, nothing = CLOSING[kind.unit]
    unit, factor = kind.shown
    if before <= one:
        return
    tried = list[tuple[float, str, str]]()
    for change in changes(view):
        other = change.apply(view, np.zeros(0))
        tried.append((other.closing(), change.words, change.cause))
        for k, name in enumerate(view.ids if change.each else ()):
            values = np.where((view.group == k)[:, None], other.values, view.values)
            part = view._replace(values=values).closing()
            tried.append((part, f"{change.words} of {kind.noun} {name}", change.cause))
    tried.sort()
    least = tried[0][0]
    message = f"readings of one moment contradict each other by {significant(factor * before, 2)}{unit}, and "
    left, k = min(_without_each(view), default=(np.inf, 0))
    if left <= CLEARER * min(least, before):
        message += (
            f"by {significant(factor * left, 2)}{unit} without {kind.noun} {view.ids[k]}: what rig.toml says of it is "
        )
        yield CheckResult("warning", kind.name, f"{message}wrong, or its readings are; measure it again")
    elif least <= min((SMALLER if before > large else CLEARER) * before, remaining):
        best = [one for one in tried if one[0] <= max(ALIKE * least, nothing)][:NAMED]
        causes = "; or ".join(dict.fromkeys(cause for _, _, cause in best))
        message += f"by {significant(factor * least, 2)}{unit} with {', or '.join(words for _, words, _ in best)}: "
        yield CheckResult("error", kind.name, message + causes)
    elif before > max(large, 2 * remaining):
        unexplained = "no change of units, signs or ids explains it; check positions and rotations in rig.toml"
        yield CheckResult("warning", kind.name, message + unexplained)


def _without_each(view: Compared) -> Iterator[tuple[float, int]]:
    """What contradiction remains without each anchor or station, where the others are enough."""
    for k in range(len(view.ids)):
        rest = view.of_rows((view.sensors.number != k).all(axis=1))
        enough = np.bincount(rest.moment, minlength=len(view.heights)) >= needed(view.kind, view.heights)
        if enough.sum() >= LEAST_MOMENTS:
            yield rest.of_rows(enough[rest.moment]).closing(), k
