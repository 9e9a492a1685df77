"""The page of `track` in a notebook: `trackwright.plot.playback`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.experiments.pages.interactive.track_page import run_data, track_page
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.trackers.core.data.estimates import Estimates
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.association import associate_truth
from trackwright.trackers.evaluation.evaluate import associate, evaluate
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import Tracks

HEIGHT = 900
"""Height of the page in a notebook, pixels; it scrolls."""


@dataclass(frozen=True)
class Playback:
    """An interactive page of estimates, which a notebook shows; `save` writes it as a file for a browser.

    `html`: its text, about 5 MB, most of it the plotting library.
    """

    title: str
    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{HEIGHT}px;border:0"
        return f'<iframe title="{escape(self.title)}" srcdoc="{escape(self.html)}" style="{style}"></iframe>'

    def save(self, path: Path | str) -> Path:
        """Writes the page, whole or not at all; returns its path."""
        atomic_write(Path(path), lambda temporary: temporary.write_text(self.html, encoding="utf-8"))
        return Path(path)


def playback(
    estimates: Tracks | Estimates | Mapping[str, Tracks | Estimates], recording: RecordingFolder | Recording
) -> Playback:
    """The page with floor plan, time slider, linked charts and residuals; of several runs by name, with a selector.

    A recording without truth has a page without errors.
    """
    runs = estimates if isinstance(estimates, Mapping) else {"": estimates}
    data = [_run(name, own, recording, len(runs)) for name, own in runs.items()]
    return Playback(f"{recording.name}, {', '.join(filter(None, runs)) or 'estimates'}", track_page(data))


def _run(name: str, estimates: Tracks | Estimates, recording: RecordingFolder | Recording, of: int) -> dict[str, Any]:
    known = "truth" in recording.tables if isinstance(recording, RecordingFolder) else "position" in recording.truth
    if known:
        association = associate(estimates, recording)
    else:
        table = estimates.to_polars()
        association = associate_truth(table if "tag" in table.columns else table.with_columns(tag=pl.lit("")), {})
    # A recording in arrays has no installation and no tables of readings.
    folder = (
        recording
        if isinstance(recording, RecordingFolder)
        else RecordingFolder(recording.name, None, Rig(recording.name), {})
    )
    tracks = ScoredTracks(association, [folder], estimates.batches if isinstance(estimates, Tracks) else ())
    evaluation = evaluate(association, recording) if association.scored.any() else None
    events = pl.DataFrame(schema={"recording": pl.String, "tag": pl.String, "t_s": pl.Float64, "event": pl.String})
    return run_data(tracks, events, evaluation, name or recording.name, name, of)
