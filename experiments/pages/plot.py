"""Charts for notebooks, `trackwright.plot`: on given or new axes of matplotlib, which they return, or as a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import update_wrapper
from html import escape
from inspect import Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trackwright.experiments.pages.charts import recording as charts
from trackwright.experiments.pages.charts.style import Chart
from trackwright.experiments.pages.reports.pages import write_page
from trackwright.experiments.pages.reports.track import NO_EVENTS, run_data, track_page
from trackwright.experiments.pages.scored_tracks import AnyEstimates, AnyRecording, scored_tracks
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.rows import is_scored

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEIGHT = 900
"""Height of the page in a notebook, pixels; it scrolls."""


def _plot(chart: Callable[..., Chart], truth: bool = True, bearings: bool = False) -> Callable[..., Axes]:
    """The chart of estimates, or of several by name, and their recording, on the axes `ax` or new ones.

    `truth`: whether it needs one; `bearings`: whether it can show them.
    """

    def plot(estimates: Any, recording: AnyRecording | None = None, *more: Any, ax: Any = None, **named: Any) -> Axes:
        from trackwright.experiments.pages.charts.drawing import draw

        several = isinstance(estimates, Mapping)
        runs = {}
        for name, run in (estimates if several else {"": estimates}).items():
            runs[name] = scored = scored_tracks(run, recording, truth).recordings[0]
            if scored.angles and not bearings:
                raise UnusableInput(f"{chart.__name__}: found bearings; expected estimates of positions")
            if truth and not scored.scored.any():
                raise UnusableInput(f"{chart.__name__}: no estimate has a truth at its time")
        return draw(chart(runs if several else runs[""], *more, **named), ax)

    # The estimates and their recording take the place of the scored ones.
    first, own = signature(plot).parameters, [*signature(chart).parameters.values()][1:]
    shown = [first["estimates"], first["recording"], *own, first["ax"]]
    setattr(update_wrapper(plot, chart), "__signature__", Signature(shown))  # noqa: B010
    return plot


floor_plan = _plot(charts.floor_plan, truth=False)
error_over_time = _plot(charts.error_over_time)
error_cdf = _plot(charts.error_cdf, bearings=True)
coverage = _plot(charts.coverage, bearings=True)
nees_over_time = _plot(charts.nees_over_time)
nis_over_time = _plot(charts.nis_over_time, truth=False, bearings=True)
nis_histogram = _plot(charts.nis_histogram, truth=False, bearings=True)
bearing_over_time = _plot(charts.bearing_over_time, truth=False, bearings=True)

__all__ = [*(name for name, value in globals().items() if hasattr(value, "__wrapped__")), "Playback", "playback"]


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
