"""Where the charts of a recording are shown: the files of `track` and the charts of its page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts import recording as charts
from trackwright.experiments.pages.charts.style import plotly_chart, write_panels
from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks, drawn_of

MANY = 11
"""Tracks of a recording from which on they have a chart of their RMSE over time."""


Panel = Callable[..., Axes]
"""A chart of a scored recording, drawn on the axes `ax`."""


class Figure(NamedTuple):
    """A figure of a recording: its title, and its panels, none where there is nothing to draw.

    `size`: width and height of a panel in a file, inches; None of a floor plan. `page`, `file`: where it is shown; on
    the page it has one panel, and is drawn of bearings, too: a chart of positions has no panels there.
    """

    title: str
    panels: Callable[[ScoredRecording], Sequence[Panel]]
    size: tuple[float, float] | None = (8.0, 1.8)
    page: bool = False
    file: bool = True


def _with_truth(*panels: Panel) -> Callable[[ScoredRecording], Sequence[Panel]]:
    return lambda scored: panels if scored.association.scored.any() else ()


def _covered(scored: ScoredRecording) -> Sequence[Panel]:
    return [charts.coverage] if any(np.isfinite(nees).any() for nees, _ in scored.nees_by_shape().values()) else []


def _of_each_axis(panel: Panel, least: int = 1) -> Callable[[ScoredRecording], Sequence[Panel]]:
    """A panel for each axis with errors, of recordings with so many tracks at least."""

    def panels(scored: ScoredRecording) -> Sequence[Panel]:
        if len(scored.rmse) < least or not scored.association.scored.any():
            return []
        begin, end = scored.association.starts[scored.worst_first()[0] :][:2]
        errors = scored.errors if least > 1 else scored.errors[begin:end]
        return [partial(panel, axis="xyz"[c]) for c in np.flatnonzero(np.isfinite(errors).any(axis=0))]

    return panels


CONSISTENCY = (charts.nees_over_time, charts.nis_over_time, charts.nis_histogram)
FIGURES = {
    "floor-plan": Figure("", lambda scored: [charts.floor_plan], None),
    "error-cdf": Figure("Distribution of errors", _with_truth(charts.error_cdf), (6.4, 3.4), page=True),
    "error-over-time": Figure("Error over time", _of_each_axis(charts.error_over_time)),
    "consistency": Figure("Consistency of the reported covariances", _with_truth(*CONSISTENCY)),
    "rmse-over-time": Figure("Root mean square error over time", _of_each_axis(charts.rmse_over_time, MANY)),
    "coverage": Figure("Truth inside the reported ellipses", _covered, page=True, file=False),
}
"""The figures of a recording by the names of their files; the coverage of all recordings is one file."""


def page_charts(scored: ScoredRecording) -> list[dict[str, Any]]:
    """The charts of the page of a recording as traces and layouts of plotly.js, with their titles."""
    shown = [(figure.title, panel) for figure in FIGURES.values() if figure.page for panel in figure.panels(scored)]
    return [{"title": title, **plotly_chart(_on_axes(partial(panel, scored)))} for title, panel in shown]


def plot_tracks(out: Path, tracks: ScoredTracks, kind: str = "png") -> list[str]:
    """Writes the figures of tracks and their errors into the folder `out`; returns their names without their endings.

    `kind`: the ending of the files, png or pdf. Of many recordings those in `tracks.drawn` have figures, all together
    the coverage of their ellipses; of bearings a few tracks have one instead.
    """
    figures = [*(_figures_of_bearings(tracks) if tracks.bearing else _figures_of_positions(tracks))]
    covered = {scored.folder.name: scored for scored in tracks.recordings if _covered(scored)}
    if covered:
        spatial = tracks.scored.nees_3d is not None and np.isfinite(tracks.scored.nees_3d).any()
        both = [partial(charts.coverage, covered, spatial=one) for one in ([False, True] if spatial else [False])]
        figures.append(("coverage", "Share of the truth inside the reported ellipses", both, (4.7, 3.8)))
    for name, title, panels, size in figures:
        columns = len(panels) if name == "coverage" else 1
        whole = None if size is None else (columns * size[0], 1.0 + len(panels) // columns * size[1])
        write_panels(out / f"{name}.{kind}", [_on_axes(panel) for panel in panels], whole, title, columns)
    return [name for name, *_ in figures]


Drawing = tuple[str, str, Sequence[Panel], tuple[float, float] | None]
"""The name of a file, its title, its panels and their size."""


def _figures_of_positions(tracks: ScoredTracks) -> Iterator[Drawing]:
    for k, why in tracks.drawn.items():
        scored = tracks.recordings[k]
        suffix = "" if len(tracks.folders) == 1 else f"-{_in_a_file_name(scored.folder.name)}"
        for name, figure in FIGURES.items():
            panels = [partial(panel, scored) for panel in figure.panels(scored)] if figure.file else []
            if panels:
                title = ", ".join(filter(None, (figure.title, scored.folder.name, why)))
                yield name + suffix, title, panels, figure.size


def _figures_of_bearings(tracks: ScoredTracks) -> Iterator[Drawing]:
    """Of a few tracks their angles over time."""
    ordered = sorted(tracks.recordings, key=lambda recording: recording.folder.name)
    pairs = [(scored, k) for scored in ordered for k in range(len(scored.rmse))]
    for place, why in drawn_of(np.concatenate([scored.rmse for scored in ordered]), True).items():
        scored, k = pairs[place]
        key = scored.association.rows.select("tag", "station").row(int(scored.association.starts[k]), named=True)
        label = f"{scored.folder.name}, tag {key['tag']}, station {key['station']}"
        panels = [partial(charts.bearing_over_time, scored, **key, angle=part.name) for part in scored.components()]
        name = "bearings-" + _in_a_file_name(label.replace(", ", "-"))
        yield name, "; ".join(filter(None, (label, why))), panels, (8.0, 1.8)


def _on_axes(panel: Panel) -> Callable[[Axes], Axes]:
    return lambda axes: panel(ax=axes)


def _in_a_file_name(text: str) -> str:
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)[:80]
