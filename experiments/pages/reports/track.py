"""The page of `track`: estimates that move over the floor plan, with linked charts, in one HTML file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl
from markupsafe import Markup

from trackwright.experiments.pages.reports.packing import MOST_POINTS, MOST_ROWS, MOST_TRACKS, rounded, script_json
from trackwright.experiments.pages.reports.track_data import recording_data
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.experiments.text.wording import shown_metric
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.metrics import METRICS

PAGE = "report.html"
"""File in the output folder of `trackwright track`."""

SCRIPTS = ("data", "formats", "colours", "plan", "polar", "overlay", "series", "charts", "playback", "main")
"""The page's own scripts, in the order in which they need each other."""

MOST_RECORDINGS = 60
"""The most recordings of a page; the terminal's table has all."""

MOST_LISTED = 40
"""The most tracks in the table: those with the largest errors."""

SHOWN = {"m": ("m", 1.0, 3), "rad": ("°", 180 / math.pi, 2), "%": ("", 100.0, 0), "s": ("s", 1.0, 1),
         "rows": ("", 1.0, 0), "": ("", 1.0, 2)}  # fmt: skip
"""The unit in a column's heading, the factor to it from the stored one, and the digits, by the stored unit."""


def write_track_page(path: Path, runs: Sequence[Mapping[str, Any]], command: str, kind: str = "track") -> None:
    """Writes the page, whole or not at all. `runs`: those of `run_data`, one for each tracker; `kind`: who wrote it."""
    # jinja takes a while to import, which a run without a page need not wait for.
    from trackwright.experiments.pages.reports.pages import write_page

    write_page(path, track_page(runs, command, kind))


def track_page(runs: Sequence[Mapping[str, Any]], command: str = "", kind: str = "track") -> str:
    """The text of the page; arguments as of `write_track_page`."""
    from trackwright.experiments.pages.reports.pages import page

    names = list(dict.fromkeys(recording["name"] for run in runs for recording in run["recordings"]))
    return page(
        "track.html",
        title=", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else ""),
        kind=kind,
        tracker=runs[0]["tracker"],
        data=Markup(script_json({"runs": runs, "command": command, "columns": _columns()})),
        scripts=SCRIPTS,
    )


def run_data(
    tracks: ScoredTracks,
    events: pl.DataFrame,
    evaluation: Evaluation | None,
    tracker: str,
    name: str = "",
    of: int = 1,
    figures: bool = False,
) -> dict[str, Any]:
    """Everything that the page shows of one tracker, within limits on rows, tracks and residuals of all together.

    `evaluation`: None without truth. `tracker`: what it is; `name`: its name where the page has `of` trackers, more
    than one. `figures`: whether there are figures in files, whose choice of recordings the page names.
    """
    shown = tracks.recordings[:MOST_RECORDINGS]
    total = of * max(sum(len(recording.times) for recording in shown), 1)
    recordings = []
    for recording in shown:
        share = len(recording.times) / total
        of_recording = events.filter(pl.col("recording") == recording.folder.name)
        limits = (max(int(share * most), least) for most, least in
                  ((MOST_ROWS, 200), (MOST_TRACKS, 3), (MOST_POINTS, 100)))  # fmt: skip
        recordings.append(recording_data(recording, of_recording, *limits))
    return {
        "name": name,
        "tracker": tracker,
        "recordings": recordings,
        "recordingCount": len(tracks.recordings),
        "metrics": [] if evaluation is None else _metrics(evaluation),
        "statements": [] if evaluation is None else evaluation.statements,
        "figures": tracks.drawn_words if figures else "",
    }


def _columns() -> list[dict[str, Any]]:
    """The columns of the table of metrics."""
    columns = []
    for metric in METRICS.values():
        if metric.page:
            (unit, factor, digits), words = SHOWN[metric.unit], metric.short.replace("\n/", "/").replace("\n", " ")
            title = f"{words}, {unit}" if unit else words
            columns.append({"key": metric.name, "title": title, "factor": factor, "digits": digits})
    return columns


def _metrics(evaluation: Evaluation) -> list[dict[str, Any]]:
    """The main metrics of each recording and of the tracks with the largest errors, without those that have no data.

    Errors in 3-D of a height that is given, not estimated, are left out.
    """

    def size(metrics: Mapping[str, Any]) -> float:
        return metrics.get("rmse_m") or metrics.get("rmse_direction_rad") or 0.0

    def known(metrics: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        for column in _columns():
            value = shown_metric(metrics, column["key"])
            if value is not None:
                yield column["key"], rounded(value)

    worst = sorted(evaluation.tracks, key=size, reverse=True)[:MOST_LISTED]
    return [
        {key: metrics[key] for key in ("recording", "tag", "station") if metrics.get(key) is not None}
        | dict(known(metrics))
        for metrics in (*evaluation.recordings, *worst)
    ]
