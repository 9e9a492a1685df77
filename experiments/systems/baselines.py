"""The baselines on the command line: trackers of position fixes, and their lanes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from experiments.entry import Entry
from experiments.folder import Folder
from experiments.lanes import Lane, by_tag, known_height, lane_of, true_paths, values_of
from experiments.matching import numbers
from trackers.baselines.fixes import FIXES, fix_tracker, singer_tracker
from trackers.baselines.windows import MovingWindow
from trackers.core.recording import Readings

WINDOW = 9
"""Rows of the moving windows: the paper's choice for its median (Huang et al. 2018, section 4)."""


def fix_lanes(folder: Folder, free_height: bool) -> Iterator[Lane]:
    """Each tag's fixes, one row per table row; z counts as not seen where the tag's height is known and used."""
    paths = true_paths(folder)
    for tag, table in by_tag(folder.tables["fixes"]):
        values, seen = values_of(table, [f"{a}_m" for a in "xyz"])
        if not free_height and known_height(folder, tag) is not None:
            seen[:, 2] = False
        # Without reported spreads zeros stand here, so that lanes with and without share a batch.
        reported = np.nan_to_num(np.stack([numbers(table, f"{a}_std_m") for a in "xyz"], axis=1)) ** 2
        readings = {FIXES: Readings(values, seen, reported)}
        yield lane_of(folder, tag, "", table["t_s"].to_numpy(), readings, {}, paths)


def lacks_fixes(folder: Folder) -> str | None:
    """What a folder lacks for a tracker of fixes."""
    return None if "fixes" in folder.tables else "a fixes table, found no such table"


TRACKERS = {
    "fix-kf": Entry(
        "position from fixes, Kalman filter, constant velocity over the floor", "fixes", lacks_fixes,
        fix_lanes, lambda lane, planar: fix_tracker(planar=planar),
    ),
    "fix-singer": Entry(
        "position from fixes, Singer's fading acceleration", "fixes", lacks_fixes,
        fix_lanes, lambda lane, planar: singer_tracker(planar=planar), automatic=False,
    ),
    "moving-average": Entry(
        f"mean of the last {WINDOW} fixes", "fixes", lacks_fixes,
        fix_lanes, lambda lane, planar: MovingWindow(WINDOW, median=False, planar=planar), automatic=False,
    ),
    "median": Entry(
        f"median of the last {WINDOW} fixes, axis by axis", "fixes", lacks_fixes,
        fix_lanes, lambda lane, planar: MovingWindow(WINDOW, median=True, planar=planar), automatic=False,
    ),
}  # fmt: skip
