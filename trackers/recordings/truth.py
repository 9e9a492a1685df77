"""Ground truth of a recording: true positions by tag, and their interpolation at the times of estimates."""

from __future__ import annotations

from enum import IntEnum
from itertools import pairwise

import numpy as np
import polars as pl

from trackers.recordings.columns import float_column, require_columns, run_starts
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tables import HOLE_M, HOLE_S

TruthPath = tuple[np.ndarray, np.ndarray]
"""Times (n,), s, and positions (n, 3), m, of one tag."""


class TruthStatus(IntEnum):
    """Whether an estimate is scored against truth, and the reason if it is not."""

    SCORED = 0
    NO_ESTIMATE = 1
    NO_TRUTH = 2
    HOLE = 3


def truth_by_tag(folder: RecordingFolder) -> dict[str, TruthPath]:
    """The true path of each tag of a recording; empty without a truth table."""
    return truth_paths(folder.tables["truth"], folder.name) if "truth" in folder.tables else {}


def truth_paths(truth: pl.DataFrame, recording: str) -> dict[str, TruthPath]:
    """The true path of each tag, sorted by time, one row per time; rows without x or y are dropped.

    `truth`: columns t_s, tag, x_m, y_m and optionally z_m. `recording`: its name, for messages. Raises UnusableInput.
    """
    require_columns(truth, ["t_s", "tag", "x_m", "y_m"], f"the truth of recording '{recording}'")
    ordered = (
        truth.with_columns(pl.col("tag").cast(pl.String))
        .filter(pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite()))
        .unique(["tag", "t_s"], keep="first", maintain_order=True)
        .sort(["tag", "t_s"])
    )
    times = float_column(ordered, "t_s")
    positions = np.stack([float_column(ordered, axis) for axis in ("x_m", "y_m", "z_m")], axis=1)
    starts = run_starts(ordered, ["tag"])
    tags = ordered["tag"].gather(starts[:-1]).to_list()
    return {tag: (times[a:b], positions[a:b]) for tag, (a, b) in zip(tags, pairwise(starts), strict=True)}


def interpolate_truth(at: np.ndarray, times: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True positions (n, 3), m, linearly interpolated at the times `at` (n,), and their `TruthStatus` (n,).

    `times` (t,) and `positions` (t, 3): a path of at least one row. NaN outside its span and in its holes.
    """
    status = np.full(len(at), TruthStatus.SCORED, np.uint8)
    position = np.stack([np.interp(at, times, axis) for axis in positions.T], axis=1)
    if len(times) > 1:
        moved = np.sqrt(np.nansum(np.diff(positions, axis=0) ** 2, axis=1))
        hole = (np.diff(times) > HOLE_S) & (moved > HOLE_M)
        after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
        status[hole[after - 1] & (times[after - 1] < at) & (at < times[after])] = TruthStatus.HOLE
    status[(at < times[0]) | (at > times[-1])] = TruthStatus.NO_TRUTH
    position[status != TruthStatus.SCORED] = np.nan
    return position, status
