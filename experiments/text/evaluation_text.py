"""An evaluation as a table for a terminal and as JSON."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import polars as pl
from rich.table import Table

from trackwright.experiments.text.tables import compact_table, rendered, width_of
from trackwright.experiments.text.wording import SCALES, Unit, fixed, length_unit, shown_metric
from trackwright.trackers.evaluation.evaluate import Evaluation, Metrics
from trackwright.trackers.evaluation.metrics import METRICS, Metric
from trackwright.trackers.recordings.atomic import json_text

SHOWN_TRACKS = 10
"""The most tracks listed per recording: the worst."""

LARGE = 1e4
"""Values in a table from here on have no digits after the point."""

SHOWN_RECORDINGS = 5
"""Recordings of an archive that are listed: the worst."""

Line = tuple[list[str], Metrics, str | None]
"""A row of a table: its labels, its metrics and a style."""


COLUMNS = tuple(metric for metric in METRICS.values() if metric.short)
"""The metrics with a column, in their order."""

RANKS = (3, 2, 1, 0)


def to_json(evaluation: Evaluation) -> str:
    """All metrics and statements as JSON, missing metrics as null."""
    return json_text(content(evaluation))


def content(evaluation: Evaluation) -> dict[str, Any]:
    """What evaluation.json holds."""
    return {
        "kind": "bearing" if evaluation.bearing else "position",
        "statements": evaluation.statements,
        "overall": evaluation.overall,
        "recordings": evaluation.recordings,
        "tracks": evaluation.tracks,
    }


def to_text(evaluation: Evaluation, width: int = 120) -> str:
    """The metrics as a table, what they mean, and the excluded rows; the main metrics where `width` holds no more.

    Metrics that no line has are left out.
    """
    labels = ["recording", "tag", "station"] if evaluation.bearing else ["recording", "tag"]
    notes = []
    if max(Counter(track["recording"] for track in evaluation.tracks).values()) > SHOWN_TRACKS:
        notes.append(f"At most {SHOWN_TRACKS} tracks per recording are listed, those with the largest p95.")
    return _text(evaluation, labels, _lines(evaluation, labels), notes, width)


def archive_text(evaluation: Evaluation, width: int = 120) -> str:
    """As `to_text`, of any number of recordings: overall, the medians over recordings, and the worst recordings."""
    recordings = evaluation.recordings
    worst = heapq.nlargest(SHOWN_RECORDINGS, recordings, key=partial(_p95, evaluation.bearing))
    lines: list[Line] = [
        (["overall"], evaluation.overall, "bold"),
        ([f"median of {len(recordings)}"], _median(recordings), None),
        *(([metrics["recording"]], metrics, None) for metrics in worst),
    ]
    notes = [f"The {len(worst)} recordings with the largest p95 are listed."]
    return _text(evaluation, ["recording"], lines, notes, width)


def _text(evaluation: Evaluation, labels: Sequence[str], lines: Sequence[Line], notes: list[str], width: int) -> str:
    shown = [c for c in COLUMNS if any(shown_metric(metrics, c.name) is not None for _, metrics, _ in lines)]
    for rank in RANKS:
        columns = [column for column in shown if column.rank <= rank]
        table = _table(evaluation, columns, labels, lines)
        if width_of(table) <= width:
            break
    return rendered(width, table, *evaluation.statements, *notes, *_notes(evaluation, columns))


def _table(evaluation: Evaluation, columns: Sequence[Metric], labels: Sequence[str], lines: Sequence[Line]) -> Table:
    # Angles between directions, or lengths.
    unit = Unit("degrees", 180 / math.pi) if evaluation.bearing else length_unit(evaluation.overall["rmse_m"])
    spatial = " and 3-D" * any("3d" in column.name for column in columns)
    what = "Bearing" if evaluation.bearing else f"Horizontal{spatial} position"
    table = compact_table(f"{what} errors in {unit.name}", labels, [title_of(column) for column in columns])
    for words, metrics, style in lines:
        table.add_row(*words, *cells(metrics, columns, unit), style=style)
    return table


def cells(metrics: Metrics, columns: Sequence[Metric], unit: Unit) -> Iterator[str]:
    """The metrics in columns, lengths in this unit; of large values no digits after the point, and groups of three."""
    for column in columns:
        value = shown_metric(metrics, column.name)
        power = 2 if column.unit == "m²" else 1
        factor, digits = SCALES.get(column.unit, (unit.factor**power, unit.digits))
        scaled = None if value is None else value * factor
        yield f"{scaled:,.0f}" if scaled is not None and abs(scaled) >= LARGE else fixed(scaled, digits)


def title_of(column: Metric) -> str:
    """The heading of a column, in up to two lines."""
    return f"{column.short}\ns" if column.unit == "s" else column.short


def _lines(evaluation: Evaluation, labels: Sequence[str]) -> list[Line]:
    """The table's rows of tracks, recordings and all."""
    lines: list[Line] = []
    for recording in evaluation.recordings:
        tracks = worst = [track for track in evaluation.tracks if track["recording"] == recording["recording"]]
        if len(tracks) > SHOWN_TRACKS:
            worst = heapq.nlargest(SHOWN_TRACKS, tracks, key=partial(_p95, evaluation.bearing))
        lines += [([track[label] for label in labels], track, None) for track in worst]
        if len(tracks) > 1:
            blank = [""] * (len(labels) - 2)
            lines.append(([recording["recording"], f"all {len(tracks)}", *blank], recording, "bold"))
    if len(evaluation.recordings) > 1:
        lines.append((["overall", *[""] * (len(labels) - 1)], evaluation.overall, "bold"))
    return lines


def _median(recordings: Sequence[Metrics]) -> Metrics:
    """The median of each metric over the recordings that have it."""
    medians = pl.DataFrame(recordings, infer_schema_length=None).drop("recording").median().row(0, named=True)
    return medians | {"n": round(medians["n"])}


def _p95(bearing: bool, metrics: Metrics) -> float:
    """The 95th percentile by which the worst come first; those without truth come last."""
    p95 = metrics["p95_direction_rad" if bearing else "p95_m"]
    return -1.0 if p95 is None else p95


def _notes(evaluation: Evaluation, columns: Sequence[Metric]) -> list[str]:
    overall, notes = evaluation.overall, []
    if any(overall[c.name] is not None for c in columns if c.name in ("nees_ratio", "nis_ratio")):
        notes.append(
            "% in 95 %: share of rows whose 95 % ellipse holds the truth. NEES/dof: 1 if covariances are correct, "
            "above 1 if they are too small. Regret: nats of log density lost by their scale, 0.1 is little, 1 much. "
            "NIS/dof: 1 if readings scatter as the tracker predicts, below 1 if they scatter less."
        )
    if evaluation.bearing:
        notes.append("angle: between the estimated and the true direction.")
    reasons = {
        "n_no_estimate": "without an estimate",
        "n_no_truth": "without truth at their time",
        "n_hole": "in gaps of the truth",
    }
    n_excluded = [f"{overall[name]} {why}" for name, why in reasons.items() if overall[name]]
    if n_excluded:
        notes.append(f"Excluded of {overall['n_rows']} rows: {', '.join(n_excluded)}.")
    return notes
