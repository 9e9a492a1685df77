"""What tracked recordings show against their readings or noise levels: mirrored heights, innovations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import SAY_SIDE
from trackwright.trackers.evaluation.evaluate import with_truth
from trackwright.trackers.evaluation.rows import is_scored
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker

CONTRADICTED, CORRELATED = 1.5, 3.0  # by what factor innovations are off, and rows that carry the information of one
APART_M, MIRRORED_SHARE = 0.5, 0.1
"""Distance of true heights from the anchors' plane, m, from which on their side counts; share of estimates on the other
side that is worth a line."""


def level_caution(metrics: Mapping[str, Any]) -> str:
    """How innovations contradict the noise levels, by a factor or by correlation; empty where they do not."""
    ratio, rows, samples = (metrics[name] for name in ("nis_ratio", "n_rows", "n_effective_nis"))
    if ratio is None:
        return ""
    if not CONTRADICTED**-2 <= ratio <= CONTRADICTED**2:
        return f"{math.sqrt(ratio):.2g} times what the noise levels let expect (NIS/dof {ratio:.2g})"
    return f"correlated, {rows} rows with the information of {samples:.0f}" if rows > CORRELATED * samples else ""


def mirrored_heights(rows: pl.DataFrame, folders: Sequence[RecordingFolder]) -> list[str]:
    """A line with the recordings in which heights are on the other side of the anchors' plane than the true ones."""
    names = []
    for folder in folders:
        part, plane = rows.filter(pl.col("recording") == folder.name), folder.rig.plane
        if plane is not None and "std_z_m" in part.columns:
            true, estimated = (float_column(part, name) - plane for name in ("true_z_m", "z_m"))
            apart = is_scored(part) & (abs(true) > APART_M) & (float_column(part, "std_z_m") > 0)
            if np.mean((true * estimated < 0) & apart) > MIRRORED_SHARE:
                names.append(folder.name)
    return [f"{listed(names)}: height mirrored at the anchors' plane; {SAY_SIDE}"] if names else []


def mirror_cautions(named: NamedTracker, folders: Sequence[RecordingFolder]) -> list[str]:
    """The lines on heights that are, or may be, mirrored where the tracker, as it is, runs on recordings."""
    if all(batch.planar for batch in named.batches(folders)) or all(folder.rig.plane is None for folder in folders):
        return []
    tracks = named.run(folders)
    told = [line for line in tracks.notices if SAY_SIDE in line]
    return [*told, *mirrored_heights(with_truth(tracks.table, folders), folders)]
