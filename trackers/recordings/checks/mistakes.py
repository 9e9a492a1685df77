"""Readings that contradict the truth, and the change that explains their errors best: the most likely mistake.

The errors of each anchor, station or tag are compared by their medians, so that outliers count little: the best change
has the smallest mean logarithm of these medians, and pays for each fitted number. The changes are looked for where
errors are large alone.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.compared import Compared
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.checks.residuals import typical_delay

if TYPE_CHECKING:
    from trackwright.trackers.recordings.checks.changes import Change

PENALTY = 0.06
"""Log ratio of errors by which a fitted number must pay."""

ALL_GAIN, GROUP_GAIN = 0.65, 1.0
"""Mean log ratio of errors that a change must reach, and one with numbers fitted to single sensors."""

UNCHANGED = 0.02
"""Log ratio of errors up to which a change leaves them as they are."""

FEW = 0.25
"""Share of anchors or stations whose places may be wrong."""

LEAST_DELAY_S, DELAY_GAIN, MOST_GROUPS = 0.1, 2 / 3, 24
"""A warning of a delay needs at least so long a delay, and errors that fall at least to this share once it is removed.

It is looked for in so many groups, which are enough to tell one delay of a table from chance.
"""


def check_against_truth(view: Compared, calibrated: bool = False) -> list[CheckResult]:
    """The most likely mistake where the readings contradict the truth: an error; else a warning of their clocks.

    `calibrated`: what a calibration of anchors and stations removes is none.
    """
    before = view.sizes()
    large = np.any(before > view.kind.sizes("large", before.shape[1]), axis=1)
    explained = _likely_mistake(view, before, large, calibrated) if large.any() else _upside_down(view)
    if explained is not None:
        return [CheckResult("error", view.kind.name, explained)]
    late = _late(view.of_rows(view.group < MOST_GROUPS)) if view.kind.averaged else None
    return [] if late is None else [CheckResult("warning", view.kind.name, late)]


def _late(view: Compared) -> str | None:
    """As `_likely_mistake`, for a difference of the clocks that is small enough to track, and makes errors larger."""
    delay = typical_delay(view)
    # Fixes come late by the delay of the filter that made them.
    if not abs(delay) >= LEAST_DELAY_S or (view.kind.position and delay > 0):
        return None
    from trackwright.trackers.recordings.checks.fitted_changes import delayed_by

    change = delayed_by(view, delay)
    before, after = view.sizes(), view.changed(**change.fields).sizes()
    ratio = after / np.maximum(before, view.kind.sizes("floor", before.shape[1]))
    return _sentence(view, np.ones(len(view.ids), bool), change, after) if np.nanmedian(ratio) <= DELAY_GAIN else None


def _likely_mistake(view: Compared, before: np.ndarray, large: np.ndarray, calibrated: bool) -> str | None:
    """The errors and the most likely cause in a line; None where nothing explains them.

    `before` (G, m): their sizes; `large` (G,): the groups that need an explanation.
    """
    from trackwright.trackers.recordings.checks.changes import changes
    from trackwright.trackers.recordings.checks.fitted_changes import fitted_changes

    best = None
    for change in chain(changes(view), fitted_changes(view, large)):
        sizes = change.handicap * view.changed(**change.fields).sizes()
        judged = _judged(view, change, sizes, before, large)
        if judged is not None and (best is None or judged[0] < best[0]):
            best = *judged, change, sizes
    if best is None or best[2].harmless or (calibrated and best[2].systematic):
        return None
    return _sentence(view, *best[1:])


def _upside_down(view: Compared) -> str | None:
    """As `_likely_mistake`, for a truth whose z points down: each sensor takes it for a bias of its own."""
    if not view.kind.sensors or view.kind.common:
        return None
    positions = view.positions * np.array([1.0, 1.0, -1.0])
    floor, large = (view.kind.sizes(which, len(view.columns)) for which in ("floor", "large"))
    before, after = (np.maximum(one.sizes(bias=False), floor) for one in (view, view.changed(positions=positions)))
    gains = np.log(before / after)
    if not (known_median(before) > large).any() or np.mean(gains[np.isfinite(gains)]) < ALL_GAIN:
        return None
    from trackwright.trackers.recordings.checks.changes import Change

    change = Change(
        "the sign of z of the truth flipped", "z of the truth points down; flip it", {"positions": positions}
    )
    return _sentence(view, np.ones(len(view.ids), bool), change, after)


def _judged(
    view: Compared, change: Change, sizes: np.ndarray, before: np.ndarray, large: np.ndarray
) -> tuple[float, np.ndarray] | None:
    """The cost of a change and the groups (G,) that it is for; None where it explains too little."""
    floor, limit = (view.kind.sizes(which, before.shape[1]) for which in ("floor", "large"))
    # A change with which the errors are unknown improves nothing.
    after = np.where(np.isfinite(sizes), sizes, np.fmax(before, 1e3))
    known = np.isfinite(before)
    ratio = np.where(known, np.log(np.maximum(after, floor) / np.maximum(before, floor)), 0.0)
    gains = -ratio.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    # Errors that were small and stay small neither need an explanation nor contradict one.
    matters = known & ((before > limit) | (after > limit))
    if not change.by_group:
        if -float(ratio[matters].sum()) < ALL_GAIN * max(int(matters.sum()), 1):
            return None
        return PENALTY * (change.parameters + 1) - float(gains.mean()), np.ones(len(gains), bool)
    # Nor do errors that the change leaves as they are.
    changed = matters & (np.abs(ratio) > UNCHANGED)
    least = GROUP_GAIN if change.parameters else ALL_GAIN
    groups = large & changed.any(axis=1)
    groups &= np.where(changed, -ratio, 0.0).sum(axis=1) >= least * changed.sum(axis=1)
    if change.groups is not None:
        groups &= change.groups
    if change.together and change.groups is not None:
        groups = change.groups & (gains[change.groups].mean() >= ALL_GAIN)
    if change.parameters > 1:
        # A place has enough freedom to take up a part of any error.
        groups &= (~matters | ((after <= limit) & (ratio <= -ALL_GAIN))).all(axis=1)
    if not groups.any() or (change.place and groups.sum() > max(FEW * len(groups), 1)):
        return None
    cost = PENALTY * (change.parameters * int(groups.sum()) + 1) - float(gains[groups].sum()) / len(gains)
    return cost, groups


def _sentence(view: Compared, groups: np.ndarray, change: Change, sizes: np.ndarray) -> str:
    chosen = np.flatnonzero(groups)
    unit, factor = view.kind.shown
    # A sensor of other readings may have too few of its own, and hence no errors.
    both = (x[chosen][np.isfinite(x[chosen]).any(axis=1)] for x in (view.sizes(bias=False), sizes))
    largest = [f"{significant(factor * float(np.nanmedian(np.nanmax(x, axis=1))), 2)}{unit}" for x in both]
    where = ""
    if change.by_group:
        names = [f"{view.ids[k]}{f' ({change.parts[k]})' if change.parts else ''}" for k in chosen]
        noun = f"{view.kind.noun}s" if len(chosen) > 1 else view.kind.noun
        where = f" of {noun} {listed(names, 6)}"
        if len(chosen) == len(groups) and len(chosen) > 1 and not change.parts:
            where = f" of all {len(chosen)} {noun}"
    return (
        f"errors against truth{where} are typically {largest[0]}, and {largest[1]} with {change.words}: {change.cause}"
    )
