"""Where the charts of a recording are shown: the files of `track` and the charts of its page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.experiments.pages.charts import recording as charts
from trackwright.experiments.pages.charts.style import Draw, plotly_chart, write_panels
from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks, drawn_of

Figure = tuple[str, str, Sequence[Draw], tuple[float, float] | None]
"""The name of a file, its title, its panels, and the size of one in inches, None of a floor plan."""

WIDE = (8.0, 1.8)


def page_charts(scored: ScoredRecording) -> list[dict[str, Any]]:
    """The charts of the page of a recording as traces and layouts of plotly.js, with their titles."""
    shown = {"Distribution of errors": charts.error_cdf} if scored.association.scored.any() else {}
    shown |= {"Truth inside the reported ellipses": charts.coverage} if _covered(scored) else {}
    return [{"title": title, **plotly_chart(_on_axes(chart, scored))} for title, chart in shown.items()]


def figures_of_positions(scored: ScoredRecording) -> Iterator[Figure]:
    """The figures of a recording in files."""
    yield "floor-plan", "", [_on_axes(charts.floor_plan, scored)], None
    if not scored.association.scored.any():
        return
    yield "error-cdf", "Distribution of errors", [_on_axes(charts.error_cdf, scored)], (6.4, 3.4)
    errors = scored.errors[scored.rows_of(scored.worst_first()[0])]
    axes = ["xyz"[c] for c in np.flatnonzero(np.isfinite(errors).any(axis=0))]
    yield "error-over-time", "Error over time", [_on_axes(charts.error_over_time, scored, axis=a) for a in axes], WIDE
    consistency = charts.nees_over_time, charts.nis_over_time, charts.nis_histogram
    title = "Consistency of the reported covariances"
    yield "consistency", title, [_on_axes(chart, scored) for chart in consistency], WIDE


def plot_tracks(out: Path, tracks: ScoredTracks, kind: str = "png") -> list[str]:
    """Writes the figures of tracks and their errors into the folder `out`; returns their names without their endings.

    `kind`: the ending of the files, png or pdf. Of many recordings those in `tracks.drawn` have figures, all together
    the coverage of their ellipses; of bearings a few tracks have one instead.
    """
    figures = list(_figures_of_bearings(tracks)) if tracks.bearing else []
    for k, why in ({} if tracks.bearing else tracks.drawn).items():
        name = tracks.recordings[k].folder.name
        suffix = "" if len(tracks.folders) == 1 else f"-{_in_a_file_name(name)}"
        for figure, title, panels, size in figures_of_positions(tracks.recordings[k]):
            figures.append((figure + suffix, ", ".join(filter(None, (title, name, why))), panels, size))
    covered = {scored.folder.name: scored for scored in tracks.recordings if _covered(scored)}
    if covered:
        spatial = tracks.scored.nees_3d is not None and np.isfinite(tracks.scored.nees_3d).any()
        both = [_on_axes(charts.coverage, covered, spatial=one) for one in ([False, True] if spatial else [False])]
        figures.append(("coverage", "Share of the truth inside the reported ellipses", both, (4.7, 3.8)))
    for name, title, panels, size in figures:
        columns = len(panels) if name == "coverage" else 1
        whole = None if size is None else (columns * size[0], 1.0 + len(panels) // columns * size[1])
        write_panels(out / f"{name}.{kind}", panels, whole, title, columns)
    return [name for name, *_ in figures]


def _figures_of_bearings(tracks: ScoredTracks) -> Iterator[Figure]:
    """Of a few tracks their angles over time."""
    ordered = sorted(tracks.recordings, key=lambda recording: recording.folder.name)
    pairs = [(scored, k) for scored in ordered for k in range(len(scored.rmse))]
    for place, why in drawn_of(np.concatenate([scored.rmse for scored in ordered]), True).items():
        scored, k = pairs[place]
        key = scored.association.rows.select("tag", "station").row(scored.rows_of(k).start, named=True)
        label = f"{scored.folder.name}, tag {key['tag']}, station {key['station']}"
        panels = [_on_axes(charts.bearing_over_time, scored, **key, angle=part.name) for part in scored.components()]
        name = "bearings-" + _in_a_file_name(label.replace(", ", "-"))
        yield name, "; ".join(filter(None, (label, why))), panels, WIDE


def _covered(scored: ScoredRecording) -> bool:
    return any(np.isfinite(nees).any() for nees, _ in scored.nees_by_shape().values())


def _on_axes(chart: Any, *given: Any, **named: Any) -> Draw:
    return lambda axes: chart(*given, ax=axes, **named)


def _in_a_file_name(text: str) -> str:
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)[:80]
