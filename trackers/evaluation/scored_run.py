"""A run of a tracker with its events, its scores against truth, and what both show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.cautions import mirrored_heights
from trackwright.trackers.evaluation.evaluate import Evaluation, truths_of, with_truth
from trackwright.trackers.evaluation.events import events_of
from trackwright.trackers.evaluation.residuals import residual_ratios
from trackwright.trackers.evaluation.rows import is_scored, refuse_without_overlap
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.tracks import Tracks


def silent(name: str, total: int | None = None) -> Any:
    """Begins a stage of which nobody hears."""
    return lambda done, now="": None


@dataclass(frozen=True)
class ScoredRun:
    """What one tracker found in recordings: `tracks` and their `events`, the `scored_rows`, and notices."""

    named: NamedTracker
    folders: Sequence[RecordingFolder]
    tracks: Tracks
    events: pl.DataFrame
    rows: pl.DataFrame
    notices: list[str]

    @classmethod
    def of(
        cls,
        parts: Sequence[tuple[NamedTracker, Sequence[RecordingFolder]]],
        seed: int = 0,
        begin: Callable[..., Any] = silent,
    ) -> ScoredRun:
        """Runs a tracker, with numbers of its own for each of the `parts`; `begin` begins a stage, with its length."""
        named, folders = parts[0][0], [folder for _, of in parts for folder in of]
        batches = [batch for one, of in parts for batch in one.batches(of)]
        advance = begin("tracking", sum(len(batch.trajectories) for batch in batches))
        tracks = named.track(batches, advance, seed=seed)
        begin("errors and events")
        truths, lines = truths_of(folders), list[str]()
        rows = with_truth(tracks.table, folders)
        if is_scored(rows).any():
            lines = mirrored_heights(rows, folders)
        elif truths:
            try:
                refuse_without_overlap(rows, truths)
            except UnusableInput as problem:
                lines = [f"not evaluated: {problem}"]
        events = events_of(tracks.table, named.spec, batches)
        return cls(named, folders, tracks, events, rows, [*tracks.notices, *lines])

    @property
    def evaluation(self) -> Evaluation:
        """The metrics."""
        return Evaluation.of(self.rows, residual_ratios(self.tracks))
