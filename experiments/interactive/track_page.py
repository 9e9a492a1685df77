"""The page of `track`: its data and its scripts in one file that needs no network.

The page is put together from text without jinja, which takes as long to import as everything here takes to run.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import polars as pl

from experiments import reports
from experiments.interactive.decimation import MOST_POINTS, MOST_ROWS, MOST_TRACKS
from experiments.interactive.packing import plotting_script, rounded, script_json
from experiments.interactive.recording_data import recording_data
from experiments.scored_tracks import ScoredTracks
from trackers.evaluation import Evaluation
from trackers.recordings.atomic import atomic_write

PAGE = "report.html"
"""File in the output folder of `trackwright track`."""

HERE, SHARED = Path(__file__).parent / "page", Path(reports.__file__).parent / "templates"
SCRIPTS = ("data", "formats", "colours", "plan", "overlay", "series", "charts", "playback", "main")
"""The page's own scripts, in the order in which they need each other."""

MOST_RECORDINGS = 60
"""The most recordings of a page; the terminal's table has all."""

MOST_LISTED = 40
"""The most tracks in the table: those with the largest errors."""

METRICS = ("n", "rmse_m", "median_m", "p95_m", "max_m", "rmse_3d_m", "rmse_azimuth_rad", "rmse_elevation_rad",
           "coverage_95", "nees_ratio", "nis_ratio", "lost_s")  # fmt: skip


def write_track_page(
    path: Path, tracks: ScoredTracks, events: pl.DataFrame, evaluation: Evaluation | None, tracker: str, command: str
) -> None:
    """Writes the page, whole or not at all. `evaluation`: None without truth; `tracker`: its name and what it is."""
    text = track_page(tracks, events, evaluation, tracker, command)
    atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def track_page(
    tracks: ScoredTracks, events: pl.DataFrame, evaluation: Evaluation | None, tracker: str, command: str
) -> str:
    """The text of the page; arguments as of `write_track_page`."""
    names = ", ".join(folder.name for folder in tracks.folders[:3])
    more = len(tracks.folders) - 3
    title = names + (f" and {more} more" if more > 0 else "")
    data = page_data(tracks, events, evaluation) | {"tracker": tracker, "command": command}
    scripts = [SHARED / "plotting.js", *(HERE / f"{name}.js" for name in SCRIPTS)]
    own = "\n".join(path.read_text(encoding="utf-8") for path in scripts)
    parts = {
        "title": escape(title),
        "tracker": escape(tracker),
        "style": (SHARED / "style.css").read_text(encoding="utf-8") + (HERE / "track.css").read_text(encoding="utf-8"),
        "plotly": plotting_script(),
        "data": script_json(data),
        "theme": (SHARED / "theme.js").read_text(encoding="utf-8"),
        "scripts": f'(() => {{\n"use strict";\n{own}\n}})();',
    }
    template = (HERE / "track.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{ (\w+) \}\}", lambda found: parts[found[1]], template)


def page_data(tracks: ScoredTracks, events: pl.DataFrame, evaluation: Evaluation | None) -> dict[str, Any]:
    """Everything that the page shows, within the limits on rows, tracks and residuals of all recordings together."""
    shown = tracks.recordings[:MOST_RECORDINGS]
    total = max(sum(len(recording.times) for recording in shown), 1)
    found = []
    for recording in shown:
        share = len(recording.times) / total
        own = events.filter(pl.col("recording") == recording.folder.name)
        limits = (max(int(share * most), least) for most, least in
                  ((MOST_ROWS, 200), (MOST_TRACKS, 3), (MOST_POINTS, 100)))  # fmt: skip
        found.append(recording_data(recording, own, *limits))
    return {
        "recordings": found,
        "recordingCount": len(tracks.recordings),
        "metrics": [] if evaluation is None else _metrics(evaluation.recordings, evaluation.tracks),
        "statements": [] if evaluation is None else evaluation.statements,
    }


def _metrics(recordings: Sequence[dict[str, Any]], tracks: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The main metrics of each recording and of the tracks with the largest errors, without those that have no data."""

    def size(metrics: dict[str, Any]) -> float:
        return metrics.get("rmse_m") or metrics.get("rmse_direction_rad") or 0.0

    return [
        {key: metrics[key] for key in ("recording", "tag", "station") if metrics.get(key) is not None}
        | {key: rounded(value) for key in METRICS if (value := metrics.get(key)) is not None}
        for metrics in (*recordings, *sorted(tracks, key=size, reverse=True)[:MOST_LISTED])
    ]
