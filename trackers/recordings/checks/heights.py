"""Checks of the heights of tags in rig.toml: against the z of the truth, and against ranges that would be too short."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.checks.check_result import CheckResult
from trackwright.trackers.recordings.kinds import KINDS, Kind

OFF_M = 0.5
"""Difference of heights, m, from which it counts as a mistake."""

SHORT = 0.5
"""Share of a tag's ranges shorter than its height above or below the anchors from which the height counts as wrong."""


def check_heights(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """An error for each tag of known height that truth or ranges contradict."""
    heights = {tag: known.height for tag, known in rig.tags.items() if known.height is not None}
    if not heights:
        return []
    contrary: dict[str, str] = {}
    for name, kind in KINDS.items():
        if name in tables and kind.distance:
            contrary |= _short_distances(rig, tables[name], kind, heights)
    contrary |= _true_heights(tables["truth"], heights) if "truth" in tables else {}
    return [
        CheckResult("error", "rig.toml", f"height_m of tag {tag} is {heights[tag]:g}, but {why}")
        for tag, why in contrary.items()
    ]


def _true_heights(truth: pl.DataFrame, heights: Mapping[str, float]) -> dict[str, str]:
    """For each tag whose true heights are elsewhere: where."""
    typical = truth.filter(pl.col("tag").is_in(list(heights))).group_by("tag", maintain_order=True)
    found = {}
    for tag, z in typical.agg(pl.col("z_m").median()).iter_rows():
        if z is not None and abs(z - heights[tag]) > OFF_M:
            down = abs(z + heights[tag]) <= OFF_M
            fix = "z of the truth points down; flip its sign" if down else "one of the two is wrong"
            found[tag] = f"z of its truth is typically {z:.2f} m: {fix}"
    return found


def _short_distances(rig: Rig, table: pl.DataFrame, kind: Kind, heights: Mapping[str, float]) -> dict[str, str]:
    """For each tag most of whose distances are too short for its height: how many."""
    distance = kind.columns[0].name
    own = table.filter(pl.col("tag").is_in(list(heights)) & pl.col(distance).is_not_null())
    z = pl.col(kind.noun).replace_strict({key: float(at[2]) for key, at in rig.anchors.items()}, default=None)
    least = (z - pl.col("tag").replace_strict(dict(heights))).abs() - OFF_M
    shares = own.group_by("tag", maintain_order=True).agg((pl.col(distance) < least).mean())
    return {
        tag: f"{100 * share:.0f} % of its {kind.name} are shorter than the difference of height to their {kind.noun}s; "
        "correct it"
        for tag, share in shares.iter_rows()
        if share is not None and share > SHORT
    }
