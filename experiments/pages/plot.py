"""Charts for notebooks, `trackwright.plot`: on given or new axes of matplotlib, which they return, or as a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trackwright.experiments.pages import charts
from trackwright.experiments.pages.chart import Chart, draw
from trackwright.experiments.pages.report import write_page
from trackwright.experiments.pages.scored_tracks import AnyEstimates, AnyRecording, scored_tracks
from trackwright.experiments.pages.track import run_data, track_page
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def _plot(chart: Callable[..., Chart], needs_truth: bool = True) -> Callable[..., Axes]:
    """The chart of estimates, or of several by name, and their recording, on the axes `ax` or new ones."""

    def plot(estimates: Any, recording: AnyRecording, *more: Any, ax: Any = None, **named: Any) -> Axes:
        several, runs = isinstance(estimates, Mapping), {}
        if several and chart not in (charts.error_cdf, charts.coverage):
            raise UnusableInput(f"{chart.__name__}: found {len(estimates)} runs by name; expected one; draw each")
        for name, run in (estimates if several else {"": estimates}).items():
            runs[name] = scored_tracks(run, recording, needs_truth).recordings[0]
            if needs_truth and not np.isfinite(runs[name].miss).any():
                raise UnusableInput(f"{chart.__name__}: no estimate has a truth at its time")
        return draw(chart(runs if several else runs[""], *more, **named), ax)

    plot.__name__, plot.__doc__ = chart.__name__, chart.__doc__
    return plot


floor_plan = _plot(charts.floor_plan, needs_truth=False)
error_over_time = _plot(charts.error_over_time)
error_cdf = _plot(charts.error_cdf)
coverage = _plot(charts.coverage)
nees_over_time = _plot(charts.nees_over_time)
nis_over_time = _plot(charts.nis_over_time, needs_truth=False)


@dataclass(frozen=True)
class Playback:
    """A page of estimates, about 5 MB, which a notebook shows; `save` writes it as a file for a browser."""

    title: str
    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        style = 'style="width:100%;height:900px;border:0"'
        return f'<iframe title="{escape(self.title)}" srcdoc="{escape(self.html)}" {style}></iframe>'

    def save(self, path: Path | str) -> Path:
        """Writes the page, whole or not at all; returns its path."""
        return write_page(path, self.html)


def playback(estimates: AnyEstimates | Mapping[str, AnyEstimates], recording: AnyRecording) -> Playback:
    """The page with floor plan, time slider, linked charts and residuals; of several runs by name, with a selector."""
    runs = estimates if isinstance(estimates, Mapping) else {"": estimates}
    data = []
    for name, run in runs.items():
        tracks = scored_tracks(run, recording)
        evaluation = Evaluation.of(tracks.rows) if tracks.rows["why"].is_null().any() else None
        data.append(run_data(tracks, evaluation, name or recording.name, name, len(runs)))
    return Playback(f"{recording.name}, {', '.join(filter(None, runs)) or 'estimates'}", track_page(data))
