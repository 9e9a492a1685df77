"""Mistakes that show without truth: readings of one moment contradict each other, and no longer do with a change."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks.check_result import CheckResult
from trackwright.trackers.recordings.checks.closing import LEAST_MOMENTS, Moments, least_sensors, moments
from trackwright.trackers.recordings.checks.explanations import FACTORS
from trackwright.trackers.recordings.checks.sensor_mistakes import FLIGHT, angles_changed
from trackwright.trackers.recordings.kinds import KINDS

if TYPE_CHECKING:  # the folder's module imports `anomalies`
    from trackwright.trackers.recordings.folder import RecordingFolder

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


def check_closing(recording: RecordingFolder, table: str) -> list[CheckResult]:
    """An error where ranges or bearings contradict each other and one change explains it, as of units or ids.

    A warning where they do not without one anchor or station, and where nothing explains it.
    """
    kind = KINDS[table]
    closes = len(kind.sensors) == 1 and (kind.angles or kind.distance)
    found = moments(recording, table) if closes else None
    if found is None or (before := found.closing()) <= ONE_LARGE[kind.unit]:
        return []
    large = before > LARGE[kind.unit]
    tried = [(changed.closing(), change, cause) for change, cause, changed in (_changes(found) if large else ())]
    least = min(tried, default=(before,))[0]
    apart = min(_without_each(found), default=(np.inf, ""))
    unit, factor = kind.shown
    message = f"readings of one moment contradict each other by {significant(factor * before, 2)}{unit}"
    if apart[0] <= CLEARER * min(before, least):
        line = f"{message}, and by {significant(factor * apart[0], 2)}{unit} without {kind.noun} {apart[1]}"
        cause = "its place in rig.toml is wrong, or its readings are; measure it again"
        return [CheckResult("warning", table, f"{line}: {cause}")]
    if not large:
        return []
    if least > min(SMALLER * before, REMAINING[kind.unit]):
        line = f"{message}, and no change of units, signs or ids explains it; check positions and rotations in rig.toml"
        return [CheckResult("warning", table, line)] if before > 2 * REMAINING[kind.unit] else []
    alike = [one for one in sorted(tried) if one[0] <= ALIKE * least][:NAMED]
    changes, causes = ", or ".join(one[1] for one in alike), "; or ".join(dict.fromkeys(one[2] for one in alike))
    line = f"{message}, and by {significant(factor * least, 2)}{unit} with {changes}: {causes}"
    return [CheckResult("error", table, line)]


def _without_each(found: Moments) -> Iterator[tuple[float, str]]:
    """What contradictions are left without each anchor or station, where the others are enough for a position."""
    for k, name in enumerate(found.ids):
        values = found.values.copy()
        values[:, k] = np.nan
        enough = np.isfinite(values).all(axis=2).sum(axis=1) >= least_sensors(found.kind, np.isnan(found.heights))
        if enough.sum() >= LEAST_MOMENTS:
            yield found._replace(values=values[enough], heights=found.heights[enough]).closing(), name


def _changes(found: Moments) -> Iterator[tuple[str, str, Moments]]:
    """Changes of units, signs and ids in words, the mistake that they undo, and the readings with them."""
    noun, table = found.kind.noun, found.kind.name
    if not found.kind.angles:
        for factor, unit in (*FACTORS, *FLIGHT):
            words, cause = (
                f"the {table} multiplied by {factor:.4g}",
                f"{table} are {unit}, expected metres; convert them",
            )
            yield words, cause, found._replace(values=factor * found.values)
    else:
        cause = "another zero of the azimuth, or stations that face the other way in rig.toml; turn one of both"
        yield "the azimuth turned by 180°", cause, found._replace(values=found.values + np.array([np.pi, 0.0]))
        for change, (values, cause) in angles_changed(found.values).items():
            yield change, cause, found._replace(values=values)
            for k, station in enumerate(found.ids):
                own = np.arange(len(found.ids))[:, None] == k
                yield (
                    f"{change} of station {station}",
                    cause,
                    found._replace(values=np.where(own, values, found.values)),
                )
    for i, j in combinations(range(len(found.ids)), 2):
        order = np.arange(len(found.ids))
        order[[i, j]] = j, i
        yield (
            f"{noun}s {found.ids[i]} and {found.ids[j]} swapped",
            f"the ids of {noun}s are mixed up; correct rig.toml or the table",
            found._replace(places=found.places[order], axes=found.axes[order]),
        )
