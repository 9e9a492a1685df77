"""The trajectories of a table of estimates or of truth, as the writers of other programs' files take them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.scoring import covariances
from trackwright.trackers.exchange.poses import PoseTrajectory, trajectory_of_table
from trackwright.trackers.recordings.tracks_table import NO_ESTIMATE, is_bearing


@dataclass(frozen=True, eq=False)
class ExportedTrack:
    """A trajectory with its recording and tag, and the covariances (n, 3, 3), m², of its positions, or None."""

    recording: str
    tag: str
    poses: PoseTrajectory
    covariances: np.ndarray | None = None

    @property
    def file_name(self) -> str:
        """Recording and tag as the name of a file without its ending."""
        text = f"{self.recording}-{self.tag}"
        return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)[:100]


def tracks_of(table: pl.DataFrame) -> list[ExportedTrack]:
    """The trajectories of a table of estimates or truth; rows and tracks without an estimate are left out.

    Raises UnusableInput for bearings, and if nothing remains.
    """
    if is_bearing(table):
        raise UnusableInput("the tracks hold bearings, no positions; --format csv writes them")
    usable = pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite()).fill_null(False)
    if "status" in table.columns:
        usable &= ~pl.col("status").is_in(NO_ESTIMATE).fill_null(False)
    kept = table.filter(usable)
    tracks = []
    for (recording, own), rows in kept.partition_by(["recording", "tag"], as_dict=True, maintain_order=True).items():
        rows = rows.sort("t_s", maintain_order=True)
        given = covariances(rows) if "std_x_m" in rows.columns else None
        poses = trajectory_of_table(rows, f"tag {own} of '{recording}'")
        tracks.append(ExportedTrack(str(recording), str(own), poses, given))
    if not tracks:
        raise UnusableInput("no track holds an estimate; run `trackwright check` on the recording")
    return tracks
