"""Readings that contradict the truth, and the change that explains their errors best: the most likely mistake.

Each explanation is a change of the readings, the truth or the rig, some with fitted numbers. The errors of each anchor,
station or tag are compared by their medians, so that outliers count little: the best explanation has the smallest mean
logarithm of these medians, and pays for each fitted number.
"""

from __future__ import annotations

import numpy as np

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks.check_result import CheckResult
from trackwright.trackers.recordings.checks.compared import Compared
from trackwright.trackers.recordings.checks.explanations import PENALTY, Explanation
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.checks.sensor_mistakes import sensor_explanations
from trackwright.trackers.recordings.checks.world_mistakes import world_explanations

ALL_GAIN, OWN_GAIN = 0.65, 1.0
"""Mean log ratio of errors that an explanation must reach, and one with numbers fitted to single sensors."""

UNCHANGED = 0.02
"""Log ratio of errors up to which a change leaves them as they are."""

FEW = 0.25
"""Share of anchors or stations whose places may be wrong."""


def check_against_truth(view: Compared) -> list[CheckResult]:
    """The most likely mistake where the readings contradict the truth: an error; else nothing."""
    explained = most_likely_mistake(view)
    return [] if explained is None else [CheckResult("error", view.table, explained)]


def most_likely_mistake(view: Compared) -> str | None:
    """The errors and the most likely cause in a line; None where they are small, or nothing explains them."""
    before = view.sizes(view.errors())
    large = np.any(before > view.kind.sizes("large", before.shape[1]), axis=1)
    if not large.any():
        return _upside_down(view)
    found = []
    for explanation in sensor_explanations(view, large):
        found += _judged(view, explanation, before, large)
    for explanation in world_explanations(view):
        found += _judged(view, explanation, before, large)
    if not found:
        return None
    _, groups, best = min(found, key=lambda one: one[0])
    return None if best.harmless else _sentence(view, best, groups)


def _upside_down(view: Compared) -> str | None:
    """As `most_likely_mistake`, for a truth whose z points down: each sensor takes it for a bias of its own."""
    if not view.kind.sensors or view.kind.common:
        return None
    down = view._replace(positions=view.positions * np.array([1.0, 1.0, -1.0]))
    floor, large = (view.kind.sizes(which, len(view.columns)) for which in ("floor", "large"))
    before, after = (np.maximum(one.sizes(one.errors(), bias=False), floor) for one in (view, down))
    gains = np.log(before / after)
    if not (known_median(before) > large).any() or np.mean(gains[np.isfinite(gains)]) < ALL_GAIN:
        return None
    best = Explanation("the sign of z of the truth flipped", "z of the truth points down; flip it", after)
    return _sentence(view, best, np.ones(len(view.ids), bool))


def _judged(
    view: Compared, one: Explanation, before: np.ndarray, large: np.ndarray
) -> list[tuple[float, np.ndarray, Explanation]]:
    """The cost of an explanation and the groups that it is for; none where it explains too little."""
    floor, limit = (view.kind.sizes(which, before.shape[1]) for which in ("floor", "large"))
    # A change with which the errors are unknown improves nothing.
    after = np.where(np.isfinite(one.sizes), one.sizes, np.fmax(before, 1e3))
    known = np.isfinite(before)
    ratio = np.where(known, np.log(np.maximum(after, floor) / np.maximum(before, floor)), 0.0)
    gains = -ratio.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    # Errors that were small and stay small neither need an explanation nor contradict one.
    matters = known & ((before > limit) | (after > limit))
    if not one.own:
        if -float(ratio[matters].sum()) < ALL_GAIN * max(int(matters.sum()), 1):
            return []
        return [(PENALTY * (one.parameters + 1) - float(gains.mean()), np.ones(len(gains), bool), one)]
    # Nor do errors that the change leaves as they are.
    changed = matters & (np.abs(ratio) > UNCHANGED)
    groups = large & changed.any(axis=1)
    groups &= np.where(changed, -ratio, 0.0).sum(axis=1) >= (OWN_GAIN if one.parameters else ALL_GAIN) * changed.sum(
        axis=1
    )
    if one.groups is not None:
        groups &= one.groups
    if one.together and one.groups is not None:
        groups = one.groups & (gains[one.groups].mean() >= ALL_GAIN)
    if one.parameters > 1:
        # A place has enough freedom to take up a part of any error.
        groups &= (~matters | ((after <= limit) & (ratio <= -ALL_GAIN))).all(axis=1)
    if one.place and groups.sum() > max(FEW * len(groups), 1):
        return []
    if not groups.any():
        return []
    cost = PENALTY * (one.parameters * int(groups.sum()) + 1) - float(gains[groups].sum()) / len(gains)
    return [(cost, groups, one)]


def _sentence(view: Compared, best: Explanation, groups: np.ndarray) -> str:
    chosen = np.flatnonzero(groups)
    errors = view.sizes(view.errors(), bias=False)[chosen]
    unit, factor = view.kind.shown
    largest = [factor * float(np.nanmedian(np.nanmax(x, axis=1))) for x in (errors, best.sizes[chosen])]
    sizes = [f"{significant(size, 2)}{unit}" for size in largest]
    where = ""
    if best.own:
        names = [f"{view.ids[k]}{f' ({best.parts[k]})' if best.parts else ''}" for k in chosen]
        noun = f"{view.noun}s" if len(chosen) > 1 else view.noun
        where = f" of {noun} {listed(names, 6)}"
        if len(chosen) == len(groups) and len(chosen) > 1 and not best.parts:
            where = f" of all {len(chosen)} {noun}"
    return f"errors against truth{where} are typically {sizes[0]}, and {sizes[1]} with {best.change}: {best.cause}"
