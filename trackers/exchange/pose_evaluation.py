"""Pose errors, as in evo, and metrics of a file of estimates or a table of tracks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import Evaluation, evaluate
from trackwright.trackers.exchange.estimates import (
    ComparedTrack,
    assigned,
    compare_tracks,
    pooled,
    read_estimates,
    read_truth,
)
from trackwright.trackers.exchange.pose_errors import Alignment
from trackwright.trackers.recordings.checks.rules import check_units
from trackwright.trackers.recordings.folder import RecordingFolder, Selection, read_recordings
from trackwright.trackers.recordings.tracks_table import read_tracks

STEPS = ("1m", "1s")


@dataclass(frozen=True)
class Poses:
    """Estimates and their truths: of a file, or of a folder of `track`, in one part of them."""

    tracks: pl.DataFrame
    folders: list[RecordingFolder]

    @classmethod
    def read(
        cls, source: Path, truth: Sequence[Path], part: Selection, check: bool, say: Callable[[str], None]
    ) -> Poses:
        """Reads them; `truth`: recordings, or a trajectory file of the one tag that the estimates follow. `check`: the
        units of a file. `say` gets each notice. Raises UnusableInput."""
        name, tag = None, next(iter(part.tags), None)
        if source.is_dir():
            tracks = part.of_estimates(read_tracks(source))
            followed = tracks.select("recording", "tag").unique()
            name, tag = followed.row(0) if len(followed) == 1 else (None, None)
        elif len(part.tags) > 1:
            raise UnusableInput(f"--tag {' '.join(part.tags)}: a file of estimates follows one tag; expected one")
        folders = _truth(truth, tag, name, say)
        truths = {folder.name: folder.tables["truth"] for folder in folders if "truth" in folder.tables}
        if not truths:
            raise UnusableInput(f"{truth[0]}: no truth table; expected a recording with truth, or a trajectory file")
        if source.is_file():
            read, lines = read_estimates(source)
            tracks = part.of_estimates(assigned(read, truths, tag, source))
            # Of a truth in a file, there is no geometry beside which estimates may be large.
            for folder in (folder for folder in folders if folder.rig.places() and check):
                own = {"fixes": tracks.filter(pl.col("recording") == folder.name)}
                lines = (*lines, *(result.message for result in check_units(folder.rig, own)))
            for line in lines:
                say(f"{source}: {line}")
        return cls(tracks, folders)

    def compared(
        self,
        align: Alignment = "none",
        offset: float | Literal["auto"] = 0.0,
        tolerance: float = 0.01,
        steps: Sequence[str] = STEPS,
        all_pairs: bool = False,
    ) -> tuple[pl.DataFrame, list[ComparedTrack], Evaluation]:
        """The tracks as they are compared, their pose errors, and the metrics with the pooled pose errors."""
        truths = {folder.name: folder.tables["truth"] for folder in self.folders if "truth" in folder.tables}
        moved, compared = compare_tracks(self.tracks, truths, align, offset, tolerance, steps, all_pairs)
        evaluation = evaluate(moved, self.folders)
        return moved, compared, replace(evaluation, overall=evaluation.overall | pooled(compared))


def _truth(
    paths: Sequence[Path], tag: str | None, name: str | None, say: Callable[[str], None]
) -> list[RecordingFolder]:
    """The recordings, or a trajectory file as the truth of a tag and a recording, where they are known."""
    if not paths:
        raise UnusableInput("no --truth; expected recording folders, or a trajectory file: --truth FOLDER|FILE")
    for path in paths:
        if not path.exists():
            raise UnusableInput(f"--truth {path}: does not exist; expected a recording folder, or a trajectory file")
    if len(paths) > 1 and not all(path.is_dir() for path in paths):
        raise UnusableInput(f"--truth {paths[0]} and others; expected one trajectory file, or recording folders")
    folders = read_recordings(paths) if paths[0].is_dir() else [read_truth(paths[0], tag or "1")]
    for path, folder in zip(paths, folders, strict=True):
        for line in folder.notices:
            say(f"{path}: {line}")
    return folders if paths[0].is_dir() or name is None else [replace(folders[0], name=name)]
