"""Tables of estimates compared with truth track by track, and moved by the alignment and the time offset of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.exchange.alignment import Alignment
from trackwright.trackers.exchange.compare import TrajectoryErrors, compare_trajectories
from trackwright.trackers.exchange.pose_errors import Statistics, Step
from trackwright.trackers.exchange.poses import trajectory_of_table
from trackwright.trackers.recordings.tracks_table import is_bearing


class ComparedTrack(NamedTuple):
    """The errors of the track of one tag."""

    recording: str
    tag: str
    errors: TrajectoryErrors

    def to_dict(self) -> dict[str, Any]:
        """All of it in plain numbers, for JSON."""
        return {"recording": self.recording, "tag": self.tag} | self.errors.to_dict()


def compare_tracks(
    tracks: pl.DataFrame,
    truths: Mapping[str, pl.DataFrame],
    align: Alignment = "none",
    time_offset: float | Literal["auto"] = 0.0,
    tolerance: float = 0.01,
    rpe: Sequence[str] = ("1m", "1s"),
    all_pairs: bool = False,
) -> tuple[pl.DataFrame, list[ComparedTrack]]:
    """The estimates, each track aligned and shifted in time, and the errors of each track that has a truth.

    `tracks`: the columns of tracks.parquet. `truths`: by recording, a truth table. Further arguments as of
    `compare_trajectories`, which is called for each track. Raises UnusableInput as it does, for bearings, and where no
    track has a truth.
    """
    if is_bearing(tracks):
        raise UnusableInput("the tracks hold bearings; expected positions x_m, y_m; leave the trajectory options out")
    moved, compared = [], []
    for (recording, tag), rows in tracks.partition_by(["recording", "tag"], as_dict=True, maintain_order=True).items():
        truth = truths.get(str(recording))
        own = None if truth is None else truth.filter(pl.col("tag").cast(pl.String) == str(tag))
        if own is None or own.is_empty():
            continue
        name = f"track of tag {tag} in '{recording}'"
        errors = compare_trajectories(
            trajectory_of_table(rows, name),
            trajectory_of_table(own, f"truth of tag {tag} in '{recording}'"),
            align, time_offset, tolerance, rpe, all_pairs,
        )  # fmt: skip
        moved.append(errors.similarity.table(rows).with_columns(pl.col("t_s") + errors.time_offset))
        compared.append(ComparedTrack(str(recording), str(tag), errors))
    if not compared:
        known = [f"{name}: {listed(sorted(truth['tag'].unique().cast(pl.String)))}" for name, truth in truths.items()]
        raise UnusableInput(
            f"no track has a truth: tracks of {listed(tracks['recording'].unique())}, tags "
            f"{listed(tracks['tag'].unique())}; truth of {listed(known) or 'no recording'}; give the --truth of "
            "the same recording and tag"
        )
    return pl.concat(moved), compared


def pooled_names(steps: Sequence[str]) -> list[str]:
    """The names that `pooled` may have with relative errors over these steps."""
    return ["ape_m", *(f"rpe_{Step.of(step)}_m" for step in steps), "speed_mps"]


def pooled(compared: Sequence[ComparedTrack]) -> dict[str, float]:
    """Root mean squares over all tracks, for `--fail-if`: ape_m, rpe_STEP_m, speed_mps."""
    parts: dict[str, list[Statistics]] = {}
    for track in compared:
        found = {"ape_m": track.errors.ape_m}
        found |= {f"rpe_{step}_m": errors for step, errors in track.errors.rpe_m.items()}
        if track.errors.speed_mps is not None:
            found["speed_mps"] = track.errors.speed_mps
        for name, errors in found.items():
            parts.setdefault(name, []).append(errors)
    return {name: math.sqrt(sum(e["sse"] for e in all_) / sum(e["n"] for e in all_)) for name, all_ in parts.items()}
