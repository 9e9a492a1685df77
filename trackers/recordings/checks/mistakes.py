"""The most likely mistake in a table: of many changes of readings, truth or rig, the one with the smallest errors left.

It is named only where it explains nearly all rows, down to errors that need no explanation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.changes import Change, changes, delayed_by, fitted_changes
from trackwright.trackers.recordings.checks.compared import Compared
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.checks.residuals import typical_delay

PENALTY, ALL_GAIN, GROUP_GAIN, UNCHANGED = 0.06, 0.65, 1.0, 0.02
"""Log ratios of errors: the price of a fitted number, the least gain of a change, and of one with numbers for single
sensors, and up to which errors count as unchanged."""

EXPLAINED, NEARLY = 2.0, 0.75
"""Errors left, in those that need no explanation, and the share of rows that a change has to bring below three."""

BROKEN = 10.0
"""Ratio of the errors of one anchor to the others' from which it is broken."""

FEW_PLACES = 0.25
"""Share of anchors or stations whose places may be wrong."""

LEAST_DELAY_S, DELAY_GAIN, DELAY_GROUPS = 0.1, 2 / 3, 24
"""A warning of a delay needs so long a one, and errors that fall to this share; looked for in so many groups."""


def check_against_truth(view: Compared, calibrated: bool = False) -> list[CheckResult]:
    """An error for the most likely mistake; else a warning of a broken anchor or of the clocks.

    `calibrated`: what a calibration of anchors and stations removes is no mistake.
    """
    name, before = view.kind.name, view.sizes()
    limit = view.kind.sizes("large", before.shape[1])
    large = np.any(before > limit, axis=1)
    best = _best(view, before, large) if large.any() else _upside_down(view)
    if best is not None and not (best[0].harmless or (calibrated and best[0].systematic)):
        return [CheckResult("error", name, _sentence(view, *best))]
    if best is None and large.any() and not large.all() and view.kind.sensors:
        one, others = (float(np.nanmedian((before / limit)[part])) for part in (large, ~large))
        if one > BROKEN * others and large.sum() <= max(FEW_PLACES * len(large), 1):
            (typical, rest), of = _largest(view, before, large, ~large), _of_groups(view, large)
            message = f"errors against truth{of} are typically {typical}, of the others {rest}, and no change of units"
            message += ", place or ids explains them: wild or blocked readings; measure there again, or leave them out"
            return [CheckResult("warning", name, message)]
    late = _late(view.of_rows(view.group < DELAY_GROUPS)) if view.kind.averaged else None
    return [] if late is None else [CheckResult("warning", name, late)]


def _best(view: Compared, before: np.ndarray, large: np.ndarray) -> tuple[Change, np.ndarray, np.ndarray] | None:
    """The change of the lowest cost, the groups (G,) that it is for and the errors left; None without any."""
    found: list[tuple[float, Change, np.ndarray, np.ndarray]] = []
    for change in (*changes(view), *fitted_changes(view, large)):
        other = view.changed(**change.fields)
        sizes = change.handicap * other.sizes()
        cost, groups = _judged(view, change, sizes, before, large)
        if groups.any() and (not found or cost < found[0][0]) and _explains(view, other, groups, sizes, large):
            found = [(cost, change, groups, sizes)]
    return found[0][1:] if found else None


def _judged(
    view: Compared, change: Change, sizes: np.ndarray, before: np.ndarray, large: np.ndarray
) -> tuple[float, np.ndarray]:
    """The cost of a change and the groups (G,) that it is for, none where it explains too little."""
    floor, limit = (view.kind.sizes(which, before.shape[1]) for which in ("floor", "large"))
    # A change with which the errors are unknown improves nothing.
    after, known = np.where(np.isfinite(sizes), sizes, np.fmax(before, 1e3)), np.isfinite(before)
    ratio = np.where(known, np.log(np.maximum(after, floor) / np.maximum(before, floor)), 0.0)
    gains = -ratio.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    # Errors that were small and stay small neither need an explanation nor contradict one.
    matters = known & ((before > limit) | (after > limit))
    if not change.by_group:
        enough = -float(ratio[matters].sum()) >= ALL_GAIN * max(int(matters.sum()), 1)
        return PENALTY * (change.numbers + 1) - float(gains.mean()), np.full(len(gains), enough)
    allowed = np.ones(len(gains), bool) if change.groups is None else change.groups
    changed = matters & (np.abs(ratio) > UNCHANGED)
    groups = large & allowed & changed.any(axis=1)
    least = GROUP_GAIN if change.numbers else ALL_GAIN
    groups &= np.where(changed, -ratio, 0.0).sum(axis=1) >= least * changed.sum(axis=1)
    if change.together:
        groups = allowed & (gains[allowed].mean() >= ALL_GAIN)
    if change.numbers > 1:
        # A place has enough freedom to take up a part of any error.
        groups &= (~matters | ((after <= limit) & (ratio <= -ALL_GAIN))).all(axis=1)
    if change.place and groups.sum() > max(FEW_PLACES * len(groups), 1):
        groups &= False
    return PENALTY * (change.numbers * int(groups.sum()) + 1) - float(gains[groups].sum()) / len(gains), groups


def _explains(view: Compared, other: Compared, groups: np.ndarray, sizes: np.ndarray, large: np.ndarray) -> bool:
    """Whether a change leaves small errors, in nearly all rows or in as many as in the groups that need none."""
    limit = view.kind.sizes("large", sizes.shape[1])
    own = np.isfinite(sizes[groups])
    if (sizes[groups] <= EXPLAINED * limit)[own].mean() < NEARLY:
        return False
    errors, most = view.errors(), 3 * limit + view.kind.sizes("bias", len(limit))
    left = np.abs(other.errors()) <= most, np.abs(errors) <= most
    rows, sound = (part[view.group][:, None] & np.isfinite(errors) for part in (groups, ~large))
    share, usual = (
        float(inside[part].mean()) if part.any() else 1.0 for inside, part in zip(left, (rows, sound), strict=True)
    )
    return share >= min(NEARLY, 0.9 * usual)


def _upside_down(view: Compared) -> tuple[Change, np.ndarray, np.ndarray] | None:
    """A truth whose z points down: each sensor takes it for a bias of its own."""
    if not view.kind.sensors or view.kind.common:
        return None
    positions = view.positions * np.array([1.0, 1.0, -1.0])
    floor, large = (view.kind.sizes(which, len(view.columns)) for which in ("floor", "large"))
    before, after = (np.maximum(one.sizes(bias=False), floor) for one in (view, view.changed(positions=positions)))
    if not (known_median(before) > large).any() or np.nanmean(np.log(before / after)) < ALL_GAIN:
        return None
    words, cause = "the sign of z of the truth flipped", "z of the truth points down; flip it"
    return Change(words, cause, {"positions": positions}), np.ones(len(view.ids), bool), after


def _late(view: Compared) -> str | None:
    """A difference of the clocks that is small enough to track, and makes errors larger."""
    delay = typical_delay(view)
    # Fixes come late by the delay of the filter that made them.
    if not abs(delay) >= LEAST_DELAY_S or (view.kind.position and delay > 0):
        return None
    change, before = delayed_by(view, delay), view.sizes()
    after = view.changed(**change.fields).sizes()
    ratio = after / np.maximum(before, view.kind.sizes("floor", before.shape[1]))
    return _sentence(view, change, np.ones(len(view.ids), bool), after) if np.nanmedian(ratio) <= DELAY_GAIN else None


def _sentence(view: Compared, change: Change, groups: np.ndarray, sizes: np.ndarray) -> str:
    before, after = *_largest(view, view.sizes(bias=False), groups), *_largest(view, sizes, groups)
    where = _of_groups(view, groups, change.parts) if change.by_group else ""
    return f"errors against truth{where} are typically {before}, and {after} with {change.words}: {change.cause}"


def _largest(view: Compared, sizes: np.ndarray, *parts: np.ndarray) -> list[str]:
    """The typical size of the largest errors of some groups."""
    unit, factor = view.kind.shown
    known = [x[np.isfinite(x).any(axis=1)] for x in (sizes[part] for part in parts)]
    return [f"{significant(factor * float(np.median(np.nanmax(x, axis=1))), 2)}{unit}" for x in known]


def _of_groups(view: Compared, groups: np.ndarray, parts: Sequence[str] = ()) -> str:
    chosen, noun = np.flatnonzero(groups).tolist(), view.kind.noun
    if len(chosen) == len(groups) > 1 and not parts:
        return f" of all {len(chosen)} {noun}s"
    names = [f"{view.ids[k]}{f' ({parts[k]})' if parts else ''}" for k in chosen]
    return f" of {noun}{'s' if len(names) > 1 else ''} {listed(names, 6)}"
