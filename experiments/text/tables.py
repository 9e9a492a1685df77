"""Tables as text, for a terminal and in Markdown: sections of reports, evaluations and pose errors."""

from __future__ import annotations

import io
import math
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl
from rich import box
from rich.console import Console, RenderableType
from rich.table import Table

from trackwright.experiments.text.wording import SCALES, SHOWN, Unit, fixed, length_unit, shown_metric
from trackwright.trackers.evaluation.evaluate import Evaluation, Metrics
from trackwright.trackers.evaluation.metrics import METRICS, Metric
from trackwright.trackers.recordings.files import atomic_write, json_text

UNLIMITED = 100_000
"""Characters a line where a table is not to be wrapped."""

SHOWN_TRACKS, SHOWN_RECORDINGS = 10, 5
"""The most tracks listed per recording, and recordings of an archive: the worst."""

COLUMNS = tuple(metric for metric in METRICS.values() if metric.short)
"""The metrics with a column, in their order."""

_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


class Section(NamedTuple):
    """A part of a report, for a terminal and a page: title, table and note; the first `n_text` columns are text.

    `parts`: what follows on a page alone: texts, names with texts, and groups of charts.
    """

    title: str
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    n_text: int = 1
    note: str = ""
    parts: Sequence[Any] = ()

    def table(self) -> Table:
        """The table for a terminal: text, aligned left, may be wrapped."""
        made = Table(title=self.title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, collapse_padding=True)
        for k, name in enumerate(self.head):
            made.add_column(name, justify="left" if k < self.n_text else "right", overflow="fold")
        for row in self.rows:
            made.add_row(*row)
        return made


def terminal_width(elsewhere: int = 120) -> int:
    """Characters that a line of a table may have: the terminal's, or `elsewhere` where the output goes there."""
    return shutil.get_terminal_size((elsewhere, 24)).columns if sys.stdout.isatty() else elsewhere


def sections_text(sections: Sequence[Section], elsewhere: int, *lines: str) -> str:
    """The tables with rows and their notes, and more lines, for a terminal, or `elsewhere` characters wide."""
    parts: list[RenderableType] = []
    for one in sections:
        if one.rows:
            gap = [""] if parts and isinstance(parts[-1], str) else []
            parts += [*gap, one.table(), *([one.note] if one.note else [])]
    return rendered(terminal_width(elsewhere), *parts, *filter(None, lines))


def rendered(width: int, *parts: RenderableType) -> str:
    """Tables and lines as text of at most `width` characters a line, without trailing blanks."""
    page = io.StringIO()
    console = Console(file=page, width=width, highlight=False, markup=False, emoji=False)
    for part in parts:
        if isinstance(part, Table) and part.title:
            # The title of a narrow table may be wider than the table.
            console.print(part.title)
            part.title = None
        console.print(part)
    return "\n".join(line.rstrip() for line in page.getvalue().splitlines()) + "\n"


def width_of(table: Table) -> int:
    """Characters a line of the table without wrapping."""
    return Console(width=UNLIMITED, markup=False, emoji=False).measure(table).maximum


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows as lines with two spaces between columns, without a frame."""
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
    for row in rows:
        table.add_row(*row)
    return rendered(UNLIMITED, table).rstrip("\n")


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Rows as a table in Markdown, the first one its head."""
    return "".join(f"| {' | '.join(row)} |\n" for row in (rows[0], ["---"] * len(rows[0]), *rows[1:]))


def replace_tables(page: Path, name: str, text: str) -> None:
    """Replace what a page has between the marks of the tables of this name."""
    begin, end = f"<!-- tables of {name} -->", "<!-- end of the tables -->"
    before, _, rest = page.read_text("utf-8").partition(begin)
    new = f"{before}{begin}\n\n{text}\n{end}{rest.partition(end)[2]}"
    atomic_write(page, lambda path: path.write_text(new, "utf-8"))


def to_json(evaluation: Evaluation) -> str:
    """All metrics and statements as JSON, missing metrics as null."""
    return json_text(content(evaluation))


def content(evaluation: Evaluation) -> dict[str, Any]:
    """What evaluation.json holds."""
    kind = "bearing" if evaluation.bearing else "position"
    names = "statements", "overall", "recordings", "tracks"
    return {"kind": kind} | {name: getattr(evaluation, name) for name in names}


def to_text(evaluation: Evaluation, width: int = 120) -> str:
    """The metrics as a table, what they mean, and the excluded rows; the main metrics where `width` holds no more.

    Metrics that no row has are left out.
    """
    labels = ["recording", "tag", "station"][: 2 + evaluation.bearing]
    blank, rows, note = [""] * (len(labels) - 2), list[tuple[list[str], Metrics]](), ""
    for recording in evaluation.recordings:
        tracks = [track for track in evaluation.tracks if track["recording"] == recording["recording"]]
        if len(tracks) > SHOWN_TRACKS:
            note = f"At most {SHOWN_TRACKS} tracks per recording are listed, those with the largest p95."
        shown = _worst(evaluation, tracks, SHOWN_TRACKS) if len(tracks) > SHOWN_TRACKS else tracks
        rows += [([track[label] for label in labels], track) for track in shown]
        rows += [([recording["recording"], f"all {len(tracks)}", *blank], recording)] if len(tracks) > 1 else []
    if len(evaluation.recordings) > 1:
        rows.append((["overall", "", *blank], evaluation.overall))
    return _text(evaluation, labels, rows, note, width)


def archive_text(evaluation: Evaluation, width: int = 120) -> str:
    """As `to_text`, of any number of recordings: overall, the medians over recordings, and the worst recordings."""
    # Those without truth have no errors to be among.
    recordings = [metrics for metrics in evaluation.recordings if metrics["n"]] or evaluation.recordings
    worst = _worst(evaluation, recordings, SHOWN_RECORDINGS)
    medians = pl.DataFrame(recordings, infer_schema_length=None).drop("recording").median().row(0, named=True)
    rows = [(["overall"], evaluation.overall), ([f"median of {len(recordings)}"], medians | {"n": round(medians["n"])})]
    rows += [([metrics["recording"]], metrics) for metrics in worst]
    note = f"The {len(worst)} recordings with the largest p95 are listed."
    return _text(evaluation, ["recording"], rows, note, width)


def _worst(evaluation: Evaluation, of: Sequence[Metrics], most: int) -> list[Metrics]:
    """Those with the largest 95th percentile; those without truth come last."""
    name = "p95_direction_rad" if evaluation.bearing else "p95_m"
    return sorted(of, key=lambda metrics: -1.0 if metrics[name] is None else metrics[name], reverse=True)[:most]


def _text(
    evaluation: Evaluation, labels: Sequence[str], rows: Sequence[tuple[list[str], Metrics]], note: str, width: int
) -> str:
    known = [c for c in COLUMNS if any(shown_metric(metrics, c.name) is not None for _, metrics in rows)]
    overall = evaluation.overall
    unit = SHOWN["rad"] if evaluation.bearing else length_unit(overall["rmse_m"])
    for rank in (3, 2, 1, 0):
        columns = [column for column in known if column.rank <= rank]
        spatial = " and 3-D" * any("3d" in column.name for column in columns)
        what = (
            "Bearing errors in degrees" if evaluation.bearing else f"Horizontal{spatial} position errors in {unit.name}"
        )
        cells_of = [[*words, *cells(metrics, columns, unit)] for words, metrics in rows]
        table = Section(what, [*labels, *map(title_of, columns)], cells_of, len(labels)).table()
        if width_of(table) <= width:
            break
    reasons = {"no_estimate": "without an estimate", "no_truth": "without truth at their time"}
    reasons["hole"] = "in gaps of the truth"
    excluded = [f"{overall[f'n_{name}']} {why}" for name, why in reasons.items() if overall[f"n_{name}"]]
    meaning = (
        "% in 95 %: rows whose 95 % ellipse holds the truth. NEES/dof: above 1 covariances are too small. Regret: nats "
        "of log density lost by their scale, 0.1 is little. NIS/dof: below 1 readings scatter less than expected."
    )
    judged = any(overall[c.name] is not None for c in columns if c.name in ("nees_ratio", "nis_ratio"))
    left_out = f"Excluded of {overall['n_rows']} rows: {', '.join(excluded)}." if excluded else ""
    lines = (*evaluation.statements, note, meaning * judged, left_out)
    return rendered(width, table, *filter(None, lines))


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


def pose_errors_text(compared: Sequence[Any], align: str, width: int) -> str:
    """The errors of each track, a row for each kind of error, and what was done to the estimates before.

    `compared`: of each track, what `to_dict` gives.
    """
    tracks, rows = sorted((one.to_dict() for one in compared), key=lambda of: -of["ape_m"]["rmse"]), []
    unit = length_unit(tracks[0]["ape_m"]["rmse"])
    for of in tracks[:SHOWN_TRACKS]:
        steps = [(f"RPE {step}", found, of["rpe_rad"].get(step)) for step, found in of["rpe_m"].items()]
        for label, lengths, angles in (("APE", of["ape_m"], of["ape_rad"]), *steps):
            for name, found, (shown, factor), digits in (
                (label, lengths, unit, unit.digits + 1),
                (f"{label}, angle", angles, Unit("deg", 180 / math.pi), 3),
            ):
                if found is not None:
                    numbers = (fixed(found[k] * factor, digits) for k in _STATISTICS)
                    rows.append([of["tag"], name, shown, str(found["n"]), *numbers])
    table = Section("Absolute and relative pose errors", ["tag", "error", "unit", "n", *_STATISTICS], rows, 2).table()
    pairs, possible = (sum(of[key] for of in tracks) for key in ("pairs", "possible"))
    offsets = {f"{round(of['time_offset_s'], 4):.12g}" for of in tracks}
    scales = {f"{of['alignment']['scale']:.6g}" for of in tracks}
    scale = "" if scales == {"1"} else f", scale {' to '.join(sorted(scales))}"
    notes = (
        f"As evo: {pairs} of {possible} poses have a true pose within {tracks[0]['time_tolerance_s']:g} s; time offset "
        f"{' to '.join(sorted(offsets))} s; alignment {align}{scale}.",
        "APE and RPE are horizontal: a height is unknown." if any(of["planar"] for of in tracks) else "",
        f"The {SHOWN_TRACKS} tracks with the largest APE are listed." if len(tracks) > SHOWN_TRACKS else "",
    )
    return rendered(width, table, *filter(None, notes))
