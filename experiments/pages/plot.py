"""Charts for notebooks, `trackwright.plot`: on given or new axes of matplotlib, which they return, or as a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import polars as pl

from trackwright.experiments.pages.charts import recording as charts
from trackwright.experiments.pages.charts.recording import *  # noqa: F403
from trackwright.experiments.pages.reports.pages import write_page
from trackwright.experiments.pages.reports.track import run_data, track_page
from trackwright.experiments.pages.scored_tracks import AnyEstimates, AnyRecording, scored_tracks
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.rows import is_scored

__all__ = ["Playback", "playback"]
__all__ += charts.__all__

NO_EVENTS = pl.DataFrame(schema={"recording": pl.String, "tag": pl.String, "t_s": pl.Float64, "event": pl.String})

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
        return write_page(path, self.html)


def playback(estimates: AnyEstimates | Mapping[str, AnyEstimates], recording: AnyRecording) -> Playback:
    """The page with floor plan, time slider, linked charts and residuals; of several runs by name, with a selector.

    A recording without truth has a page without errors.
    """
    runs = estimates if isinstance(estimates, Mapping) else {"": estimates}
    data = []
    for name, run in runs.items():
        tracks = scored_tracks(run, recording)
        evaluation = Evaluation.of(tracks.rows) if is_scored(tracks.rows).any() else None
        data.append(run_data(tracks, NO_EVENTS, evaluation, name or recording.name, name, len(runs)))
    return Playback(f"{recording.name}, {', '.join(filter(None, runs)) or 'estimates'}", track_page(data))
