"""Where the charts of a recording are shown: the files of `track` and the charts of its page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.experiments.pages.charts import recording as charts
from trackwright.experiments.pages.charts.style import Chart, Draw, plotly_chart, write_charts
from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks, drawn_of
from trackwright.trackers.recordings.columns import float_column

WIDE, PLAN = (8.0, 2.6), (8.5, None)
"""Sizes of charts over time and of floor plans, as `Chart` has them."""


def page_charts(scored: ScoredRecording) -> list[dict[str, Any]]:
    """The charts of the page of a recording as traces and layouts of plotly.js, with their titles."""
    shown = {"Distribution of errors": charts.error_cdf} if scored.scored.any() else {}
    shown |= {"Truth inside the reported ellipses": charts.coverage} if _covered(scored) else {}
    return [{"title": title, **plotly_chart(_on_axes(chart, scored))} for title, chart in shown.items()]


def charts_of_positions(scored: ScoredRecording) -> Iterator[Chart]:
    """The charts of a recording in files."""
    yield Chart("floor-plan", "", _on_axes(charts.floor_plan, scored), *PLAN)
    if not scored.scored.any():
        return
    yield Chart("error-cdf", "Distribution of errors", _on_axes(charts.error_cdf, scored), 6.4, 3.4)
    errors = scored.errors[scored.rows_of(scored.worst_first()[0])]
    for axis in ("xyz"[c] for c in np.flatnonzero(np.isfinite(errors).any(axis=0))):
        draw = _on_axes(charts.error_over_time, scored, axis=axis)
        yield Chart(f"error-over-time-{axis}", "Error over time", draw, *WIDE)
    for chart in (charts.nees_over_time, charts.nis_over_time, charts.nis_histogram):
        name = chart.__name__.replace("_", "-")
        yield Chart(name, "Consistency of the reported covariances", _on_axes(chart, scored), *WIDE)


def plot_tracks(out: Path, tracks: ScoredTracks, kind: str = "png") -> list[str]:
    """Writes the charts of tracks and their errors into the folder `out`; returns the names of the files.

    `kind`: the ending of the files, png or pdf. Of many recordings those in `tracks.drawn` have charts, all together
    the coverage of their ellipses; of bearings a few tracks have one of each angle instead.
    """
    figures = list(_charts_of_bearings(tracks)) if tracks.bearing else []
    for k, why in ({} if tracks.bearing else tracks.drawn).items():
        name = tracks.recordings[k].folder.name
        suffix = "" if len(tracks.folders) == 1 else f"-{name}"
        for chart in charts_of_positions(tracks.recordings[k]):
            title = ", ".join(filter(None, (chart.title, name, why)))
            figures.append(chart._replace(name=chart.name + suffix, title=title))
    covered = {scored.folder.name: scored for scored in tracks.recordings if _covered(scored)}
    spatial = bool(np.isfinite(float_column(tracks.rows, "nees_3d")).any())
    for one in [False, *[True] * spatial] if covered else []:
        title = "Share of the truth inside the reported " + ("ellipsoids" if one else "ellipses")
        draw = _on_axes(charts.coverage, covered, spatial=one)
        figures.append(Chart("coverage-3d" if one else "coverage", title, draw, 4.7, 4.2))
    return write_charts(out, figures, kind)


def _charts_of_bearings(tracks: ScoredTracks) -> Iterator[Chart]:
    """Of a few tracks their angles over time."""
    ordered = sorted(tracks.recordings, key=lambda recording: recording.folder.name)
    pairs = [(scored, k) for scored in ordered for k in range(len(scored.rmse))]
    for place, why in drawn_of(np.concatenate([scored.rmse for scored in ordered]), True).items():
        scored, k = pairs[place]
        key = scored.first.select("tag", "station").row(k, named=True)
        label = f"{scored.folder.name}, tag {key['tag']}, station {key['station']}"
        for part in scored.components():
            draw = _on_axes(charts.bearing_over_time, scored, **key, angle=part.name)
            name = f"bearings-{label.replace(', ', '-')}-{part.name}".replace(" ", "_")
            yield Chart(name, "; ".join(filter(None, (label, why))), draw, *WIDE)


def _covered(scored: ScoredRecording) -> bool:
    return any(np.isfinite(nees).any() for nees, _ in scored.nees_by_shape().values())


def _on_axes(chart: Any, *given: Any, **named: Any) -> Draw:
    return lambda axes: chart(*given, ax=axes, **named)
