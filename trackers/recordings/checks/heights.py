"""Checks of the heights of tags in rig.toml: against the z of the truth, and against ranges that would be too short."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl

from trackers.core.rig import Rig
from trackers.recordings.checks.check_result import CheckResult

OFF_M = 0.5
"""Difference of heights, m, from which it counts as a mistake."""

SHORT = 0.5
"""Share of a tag's ranges shorter than its height above or below the anchors from which the height counts as wrong."""


def check_heights(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """An error for each tag of known height that truth or ranges contradict."""
    results = []
    for tag, known in rig.tags.items():
        if known.height is not None:
            own = {name: tables[name].filter(pl.col("tag") == tag) for name in ("truth", "ranges") if name in tables}
            contrary = _true_height(own, known.height) or _short_ranges(rig, own, known.height)
            if contrary:
                results.append(
                    CheckResult("error", "rig.toml", f"height_m of tag {tag} is {known.height:g}, {contrary}")
                )
    return results


def _true_height(own: Mapping[str, pl.DataFrame], height: float) -> str:
    z = own["truth"]["z_m"].drop_nulls().to_numpy() if "truth" in own else np.zeros(0)
    if not len(z) or abs((true := float(np.median(z))) - height) <= OFF_M:
        return ""
    flipped = abs(true + height) <= OFF_M
    fix = "z of the truth points down; flip its sign" if flipped else "expected one height; correct one of the two"
    return f"but z of its truth is typically {true:.2f} m: {fix}"


def _short_ranges(rig: Rig, own: Mapping[str, pl.DataFrame], height: float) -> str:
    read = own["ranges"].filter(pl.col("range_m").is_not_null()) if "ranges" in own else pl.DataFrame()
    if not len(read):
        return ""
    apart = read["anchor"].replace_strict({key: abs(float(at[2]) - height) for key, at in rig.anchors.items()})
    short = float(np.mean(read["range_m"].to_numpy() < apart.to_numpy() - OFF_M))
    if short < SHORT:
        return ""
    return (
        f"but {100 * short:.0f} % of its ranges are shorter than the difference of height to their anchors; correct it"
    )
