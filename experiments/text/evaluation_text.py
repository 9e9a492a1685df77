"""An evaluation and pose errors as tables for a terminal, and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import polars as pl

from trackwright.experiments.text.tables import compact_table, rendered, width_of
from trackwright.experiments.text.wording import SCALES, SHOWN, Unit, fixed, length_unit, shown_metric
from trackwright.trackers.evaluation.evaluate import Evaluation, Metrics
from trackwright.trackers.evaluation.metrics import METRICS, Metric
from trackwright.trackers.recordings.atomic import json_text

if TYPE_CHECKING:
    from trackwright.trackers.exchange.trajectories import Statistics, TrajectoryErrors

SHOWN_TRACKS, SHOWN_RECORDINGS = 10, 5
"""The most tracks listed per recording, and recordings of an archive: the worst."""

COLUMNS = tuple(metric for metric in METRICS.values() if metric.short)
"""The metrics with a column, in their order."""

_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")

Row = tuple[list[str], Metrics, str | None]
"""A row of a table: its labels, its metrics and a style."""


def to_json(evaluation: Evaluation) -> str:
    """All metrics and statements as JSON, missing metrics as null."""
    return json_text(content(evaluation))


def content(evaluation: Evaluation) -> dict[str, Any]:
    """What evaluation.json holds."""
    kind = "bearing" if evaluation.bearing else "position"
    return {"kind": kind} | {
        name: getattr(evaluation, name) for name in ("statements", "overall", "recordings", "tracks")
    }


def to_text(evaluation: Evaluation, width: int = 120) -> str:
    """The metrics as a table, what they mean, and the excluded rows; the main metrics where `width` holds no more.

    Metrics that no row has are left out.
    """
    labels = ["recording", "tag", "station"][: 2 + evaluation.bearing]
    blank, rows, notes = [""] * (len(labels) - 2), list[Row](), list[str]()
    for recording in evaluation.recordings:
        tracks = [track for track in evaluation.tracks if track["recording"] == recording["recording"]]
        shown = _worst(evaluation, tracks, SHOWN_TRACKS) if len(tracks) > SHOWN_TRACKS else tracks
        rows += [([track[label] for label in labels], track, None) for track in shown]
        if len(tracks) > 1:
            rows.append(([recording["recording"], f"all {len(tracks)}", *blank], recording, "bold"))
        if len(tracks) > SHOWN_TRACKS:
            notes = [f"At most {SHOWN_TRACKS} tracks per recording are listed, those with the largest p95."]
    if len(evaluation.recordings) > 1:
        rows.append((["overall", "", *blank], evaluation.overall, "bold"))
    return _text(evaluation, labels, rows, notes, width)


def archive_text(evaluation: Evaluation, width: int = 120) -> str:
    """As `to_text`, of any number of recordings: overall, the medians over recordings, and the worst recordings."""
    # Those without truth have no errors to be among.
    recordings = [metrics for metrics in evaluation.recordings if metrics["n"]] or evaluation.recordings
    worst = _worst(evaluation, recordings, SHOWN_RECORDINGS)
    medians = pl.DataFrame(recordings, infer_schema_length=None).drop("recording").median().row(0, named=True)
    rows: list[Row] = [
        (["overall"], evaluation.overall, "bold"),
        ([f"median of {len(recordings)}"], medians | {"n": round(medians["n"])}, None),
        *(([metrics["recording"]], metrics, None) for metrics in worst),
    ]
    notes = [f"The {len(worst)} recordings with the largest p95 are listed."]
    return _text(evaluation, ["recording"], rows, notes, width)


def _worst(evaluation: Evaluation, of: Sequence[Metrics], most: int) -> list[Metrics]:
    """Those with the largest 95th percentile; those without truth come last."""
    name = "p95_direction_rad" if evaluation.bearing else "p95_m"
    return sorted(of, key=lambda metrics: -1.0 if metrics[name] is None else metrics[name], reverse=True)[:most]


def _text(evaluation: Evaluation, labels: Sequence[str], rows: Sequence[Row], notes: list[str], width: int) -> str:
    known = [c for c in COLUMNS if any(shown_metric(metrics, c.name) is not None for _, metrics, _ in rows)]
    unit = SHOWN["rad"] if evaluation.bearing else length_unit(evaluation.overall["rmse_m"])
    name = "degrees" if evaluation.bearing else unit.name
    for rank in (3, 2, 1, 0):
        columns = [column for column in known if column.rank <= rank]
        spatial = " and 3-D" * any("3d" in column.name for column in columns)
        what = "Bearing" if evaluation.bearing else f"Horizontal{spatial} position"
        table = compact_table(f"{what} errors in {name}", labels, [title_of(column) for column in columns])
        for words, metrics, style in rows:
            table.add_row(*words, *cells(metrics, columns, unit), style=style)
        if width_of(table) <= width:
            break
    return rendered(width, table, *evaluation.statements, *notes, *_notes(evaluation, columns))


def cells(metrics: Metrics, columns: Sequence[Metric], unit: Unit) -> Iterator[str]:
    """The metrics in columns, lengths in this unit; of values from 10,000 no digits after the point, in groups."""
    for column in columns:
        value = shown_metric(metrics, column.name)
        factor, digits = SCALES.get(column.unit, (unit.factor ** (2 if column.unit == "m²" else 1), unit.digits))
        scaled = None if value is None else value * factor
        yield f"{scaled:,.0f}" if scaled is not None and abs(scaled) >= 1e4 else fixed(scaled, digits)


def title_of(column: Metric) -> str:
    """The heading of a column, in up to two lines."""
    return f"{column.short}\ns" if column.unit == "s" else column.short


def _notes(evaluation: Evaluation, columns: Sequence[Metric]) -> Iterator[str]:
    overall = evaluation.overall
    if any(overall[c.name] is not None for c in columns if c.name in ("nees_ratio", "nis_ratio")):
        yield (
            "% in 95 %: share of rows whose 95 % ellipse holds the truth. NEES/dof: 1 if covariances are correct, "
            "above 1 if they are too small. Regret: nats of log density lost by their scale, 0.1 is little, 1 much. "
            "NIS/dof: 1 if readings scatter as the tracker predicts, below 1 if they scatter less."
        )
    if evaluation.bearing:
        yield "angle: between the estimated and the true direction."
    reasons = {
        "no_estimate": "without an estimate",
        "no_truth": "without truth at their time",
        "hole": "in gaps of the truth",
    }
    excluded = [f"{overall[f'n_{name}']} {why}" for name, why in reasons.items() if overall[f"n_{name}"]]
    if excluded:
        yield f"Excluded of {overall['n_rows']} rows: {', '.join(excluded)}."


def pose_errors_text(compared: Sequence[TrajectoryErrors], align: str, width: int) -> str:
    """The errors of each track, a row for each kind of error, and what was done to the estimates before."""
    worst = sorted(compared, key=lambda track: -track.ape_m["rmse"])[:SHOWN_TRACKS]
    unit = length_unit(worst[0].ape_m["rmse"])
    table = compact_table("Absolute and relative pose errors", ["tag", "error"], ["unit", "n", *_STATISTICS])
    for track in worst:
        for label, name, factor, of in _rows(track, unit.name, unit.factor):
            digits = unit.digits + 1 if name == unit.name else 3
            table.add_row(track.tag, label, name, str(of["n"]), *(fixed(of[k] * factor, digits) for k in _STATISTICS))
    scales = [e.alignment.scale for e in compared]
    scale = " to ".join(dict.fromkeys((f"{min(scales):.6g}", f"{max(scales):.6g}")))
    scale = "" if scale == "1" else f", scale {scale}"
    times = f"{worst[0].time_tolerance_s:g} s; time offset {worst[0].time_offset_s:.12g} s"
    notes = {
        f"As evo: {sum(e.pairs for e in compared)} of {sum(e.possible for e in compared)} poses have a true one within "
        f"{times}; alignment {align}{scale}.": True,
        "The errors in the first table are of all rows, at the time of each, by the truth interpolated there.": True,
        "APE and RPE are horizontal: a height is unknown.": any(e.planar for e in compared),
        f"At most {SHOWN_TRACKS} tracks are listed, those with the largest APE.": len(compared) > SHOWN_TRACKS,
    }
    return rendered(width, table, *(note for note, holds in notes.items() if holds))


def _rows(errors: TrajectoryErrors, unit: str, factor: float) -> Iterator[tuple[str, str, float, Statistics]]:
    """Of each error: its name, its unit, the factor to it, and its statistics."""
    yield "APE", unit, factor, errors.ape_m
    if errors.ape_rad is not None:
        yield "APE, angle", "deg", 180 / math.pi, errors.ape_rad
    for step, statistics in errors.rpe_m.items():
        yield f"RPE {step}", unit, factor, statistics
        if step in errors.rpe_rad:
            yield f"RPE {step}, angle", "deg", 180 / math.pi, errors.rpe_rad[step]
