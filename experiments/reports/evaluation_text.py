"""An evaluation as a table for people and as JSON for programs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from experiments.cli.console import compact_table, rendered
from trackers.evaluation import Evaluation, Metrics
from trackers.recordings.atomic import json_text

SHOWN_TRACKS = 10
"""More tracks of one recording than this are not listed; its worst are."""


class Column(NamedTuple):
    """A figure's column: heading, name, factor and digits (None for an error, which is shown in the table's unit)."""

    title: str
    figure: str
    scale: float | None = None
    digits: int = 1
    main: bool = True


POSITION_COLUMNS = (
    Column("RMSE", "rmse_m"),
    Column("median", "median_m", main=False),
    Column("p90", "p90_m", main=False),
    Column("p95", "p95_m"),
    Column("p99", "p99_m", main=False),
    Column("max", "max_m"),
    Column("3-D\nRMSE", "rmse_3d_m"),
    Column("3-D\np95", "p95_3d_m", main=False),
)
BEARING_COLUMNS = (
    Column("az\nRMSE", "rmse_azimuth_rad"),
    Column("az\nbias", "bias_azimuth_rad", main=False),
    Column("el\nRMSE", "rmse_elevation_rad"),
    Column("el\nbias", "bias_elevation_rad", main=False),
    Column("angle\nRMSE", "rmse_direction_rad", main=False),
    Column("angle\nmedian", "median_direction_rad", main=False),
    Column("angle\np95", "p95_direction_rad"),
)
BELIEF_COLUMNS = (
    Column("% in 95 %\nellipse", "coverage_95", 100.0, 0),
    Column("NEES\n/dof", "nees_mean", 0.5, 2, main=False),
    Column("NIS\n/dof", "nis_ratio", 1.0, 2, main=False),
    Column("lost\ns", "lost_s", 1.0, 1),
)


def to_json(evaluation: Evaluation, work: Mapping[str, Any] | None = None) -> str:
    """Every figure as JSON, the missing ones as null; `work`: what there is to say of points of work."""
    kind = "bearing" if evaluation.bearing else "position"
    parts = {"overall": evaluation.overall, "recordings": evaluation.recordings, "tracks": evaluation.tracks}
    return json_text({"kind": kind, **parts} | ({} if work is None else {"worksteps": work}))


def to_text(evaluation: Evaluation, width: int = 120) -> str:
    """The figures as a table and what was not counted; the main figures only where `width` characters hold no more."""
    console = Console(width=width)
    columns = (BEARING_COLUMNS if evaluation.bearing else POSITION_COLUMNS) + BELIEF_COLUMNS
    table = _table(evaluation, columns)
    if console.measure(table, options=console.options.update(max_width=10_000)).maximum > width:
        columns = tuple(column for column in columns if column.main)
        table = _table(evaluation, columns)
    return rendered(width, table, *_notes(evaluation, columns))


def _table(evaluation: Evaluation, columns: Sequence[Column]) -> Table:
    unit, scale, digits = _unit(evaluation)
    what = "Bearing errors" if evaluation.bearing else "Horizontal and 3-D position errors"
    table = compact_table(f"{what} in {unit}")
    for name in _labels(evaluation):
        table.add_column(name, overflow="fold")
    for name in ("n", *(column.title for column in columns)):
        table.add_column(name, justify="right", no_wrap=True)
    for labels, figures, style in _lines(evaluation):
        cells = [_number(figures[c.figure], c.scale or scale, digits if c.scale is None else c.digits) for c in columns]
        table.add_row(*labels, str(figures["n"]), *cells, style=style)
    return table


def _labels(evaluation: Evaluation) -> list[str]:
    return ["recording", "tag", "station"] if evaluation.bearing else ["recording", "tag"]


def _lines(evaluation: Evaluation) -> list[tuple[list[str], Metrics, str | None]]:
    """The table's rows: labels, figures, style."""
    labels = _labels(evaluation)
    lines: list[tuple[list[str], Metrics, str | None]] = []
    for recording in evaluation.recordings:
        tracks = [track for track in evaluation.tracks if track["recording"] == recording["recording"]]
        lines += [([track[label] for label in labels], track, None) for track in _worst(tracks, evaluation.bearing)]
        if len(tracks) > 1:
            blank = [""] * (len(labels) - 2)
            lines.append(([recording["recording"], f"all {len(tracks)}", *blank], recording, "bold"))
    if len(evaluation.recordings) > 1:
        lines.append((["overall", *[""] * (len(labels) - 1)], evaluation.overall, "bold"))
    return lines


def _worst(tracks: list[Metrics], bearing: bool) -> list[Metrics]:
    if len(tracks) <= SHOWN_TRACKS:
        return tracks
    by = "p95_direction_rad" if bearing else "p95_m"
    return sorted(tracks, key=lambda track: -1.0 if track[by] is None else track[by], reverse=True)[:SHOWN_TRACKS]


def _unit(evaluation: Evaluation) -> tuple[str, float, int]:
    """The unit's name, how many of them are one SI unit, and the digits after the point."""
    if evaluation.bearing:
        return "degrees", 180 / math.pi, 2
    size = evaluation.overall["rmse_m"]
    if size >= 1.0:
        return "m", 1.0, 3
    return ("cm", 100.0, 1) if size >= 0.01 else ("mm", 1000.0, 2)


def _number(value: float | None, scale: float, digits: int) -> str:
    # Zero is added because a rounded −0.0 would be printed with its sign.
    return "–" if value is None else f"{round(value * scale, digits) + 0.0:.{digits}f}"


def _notes(evaluation: Evaluation, columns: Sequence[Column]) -> list[str]:
    overall, notes = evaluation.overall, []
    if max(Counter(track["recording"] for track in evaluation.tracks).values()) > SHOWN_TRACKS:
        notes.append(f"Of a recording's tracks at most {SHOWN_TRACKS} are listed, those with the largest p95.")
    if any(overall[c.figure] is not None for c in columns if c.figure in ("nees_mean", "nis_ratio")):
        notes.append(
            "NEES/dof and NIS/dof are 1 where the reported covariance is right, above 1 where it is too small."
        )
    if evaluation.bearing:
        notes.append("The angle is between the estimated and the true direction.")
    reasons = {
        "n_no_estimate": "without an estimate",
        "n_no_truth": "without truth at their time",
        "n_hole": "in holes of the truth",
    }
    n_excluded = [f"{overall[name]} {why}" for name, why in reasons.items() if overall[name]]
    if n_excluded:
        notes.append(f"Not counted of {overall['n_rows']} rows: {', '.join(n_excluded)}.")
    return notes
