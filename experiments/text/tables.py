"""Numbers, units and tables as text, for terminals, pages and Markdown: reports, evaluations and pose errors."""

from __future__ import annotations

import io
import math
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from rich import box
from rich.console import Console, RenderableType
from rich.table import Table

from trackwright.trackers.core.errors import counted, printable
from trackwright.trackers.evaluation.evaluate import Evaluation, Metrics
from trackwright.trackers.evaluation.metrics import ERROR_KINDS, METRICS, Metric
from trackwright.trackers.recordings.checks.rules import LEVELS, CheckResult
from trackwright.trackers.recordings.files import atomic_write, json_text

MISSING = "–"
STUDIES = {"bound_m": "Cramér–Rao bound", "bound_3d_m": "Cramér–Rao bound in 3-D", "us_per_row": "time per row"}
"""The metrics of a study that are no metrics of scores."""

SUFFIXES = {**ERROR_KINDS, "m": "", "rad": "", "m2": "", "s": "", "share": ""}
ENDINGS = {"_share": "%", "_rad": "rad", "_m2": "m²", "_m": "m", "_s": "s", "us_per_row": "µs"}
"""Units of a study's own metrics and numbers of other tables, by the ends of their names."""


class Unit(NamedTuple):
    """The unit in which a metric is shown, and the factor to it from the stored one."""

    name: str
    factor: float

    @property
    def digits(self) -> int:
        """The digits after the point of values in tables."""
        return {"m": 3, "cm": 1}.get(self.name, 2)


NO_UNIT = Unit("", 1.0)
SHOWN = {"%": Unit("%", 100.0), "rad": Unit("°", 180 / math.pi), "m²": Unit("cm²", 1e4), "rows": NO_UNIT}
"""The units in which metrics are shown, by those in which they are stored."""

SCALES = {"%": (100.0, 0), "": (1.0, 2), "s": (1.0, 1), "rows": (1.0, 0), "nats": (1.0, 2), "rad": (180 / math.pi, 2)}
"""Factor and digits in tables of metrics that are no lengths, by the units in which they are stored."""


def shown_metric(metrics: Mapping[str, Any], name: str) -> float | None:
    """A metric of a recording or track; None without it, and of errors in 3-D where the height is given, not estimated.

    A given height has no covariance, and its error is not the tracker's.
    """
    given = metrics.get("nees_3d_ratio") is None and metrics.get("nees_ratio") is not None
    return None if given and "_3d" in name else metrics.get(name)


def length_unit(size: float) -> Unit:
    """The customary unit of lengths of about `size` metres."""
    if size >= 1.0 or not math.isfinite(size):
        return Unit("m", 1.0)
    return Unit("cm", 100.0) if size >= 0.01 else Unit("mm", 1000.0)


def unit_of(metric: str, values: Iterable[float]) -> Unit:
    """The customary unit of a metric of this name and these sizes."""
    known = [abs(v) for v in values if math.isfinite(v)]
    by_name = next((unit for ending, unit in ENDINGS.items() if metric.endswith(ending)), "")
    unit = METRICS[metric].unit if metric in METRICS else by_name
    if unit == "m":
        return length_unit(float(np.median(known)) if known else math.nan)
    return SHOWN.get(unit, Unit(unit, 1.0))


def units_of(values: Mapping[str, Sequence[float]]) -> dict[str, Unit]:
    """The units of metrics shown side by side: all lengths in the first one's."""
    units = {metric: unit_of(metric, numbers) for metric, numbers in values.items()}
    lengths = [metric for metric in units if metric.endswith("_m")]
    return units | dict.fromkeys(lengths, units[lengths[0]] if lengths else NO_UNIT)


def heading(metric: str, unit: Unit = NO_UNIT, space: str = " ") -> str:
    """A metric's name in words, with the unit where it has one."""
    ending = next((ending for ending in SUFFIXES if metric.endswith(f"_{ending}")), "")
    own = f"{metric.removesuffix(f'_{ending}').replace('_', ' ').replace('rmse', 'RMSE')} {SUFFIXES.get(ending, '')}"
    words = METRICS[metric].words if metric in METRICS else STUDIES.get(metric, own.strip())
    return words + (f",{space}{unit.name}" if unit.name else "")


def number(value: float) -> str:
    """Four significant digits; a dash for NaN and infinities."""
    return f"{value:.4g}" if math.isfinite(value) else MISSING


def fixed(value: float | None, digits: int) -> str:
    """So many digits after the point, never −0; a dash for None and NaN."""
    return MISSING if value is None or math.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"


def rounded(value: float, spread: float) -> str:
    """The digits that the spread of the value justifies, two or three where it is unknown."""
    if not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    size = spread / 2 if math.isfinite(spread) and spread > 0 else abs(value) / 10
    return f"{value:.{min(max(1 - math.floor(math.log10(size) + 0.5), 0), 6)}f}"


def figures_drawn(names: Sequence[str]) -> str:
    """The number of figures and the names of the first four."""
    return f"{counted(len(names), 'figure')} ({', '.join(names[:4])}{', …' if len(names) > 4 else ''})"


def yes_no(value: bool | None) -> str:
    """yes, no, or nothing where it is unknown."""
    return "" if value is None else "yes" if value else "no"


def uncapitalised(text: str) -> str:
    """The text for the middle of a sentence; an abbreviation at its beginning stays in capitals."""
    return text if text[:2].isupper() else text[0].lower() + text[1:]


SHOWN_TRACKS, SHOWN_RECORDINGS = 10, 5
"""The most tracks listed per recording, and recordings of an archive: the worst."""

COLUMNS = tuple(metric for metric in METRICS.values() if metric.short)  # the metrics with a column, in their order

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
    return Console(width=100_000, markup=False, emoji=False).measure(table).maximum


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


def checks_text(results: Sequence[CheckResult]) -> str:
    """The results as aligned lines in their order, and a last line with their counts."""
    width = max((len(one.where) for one in results), default=0)
    lines = [printable(f"{one.level:<7}  {one.where:<{width}}  {one.message}") for one in results]
    errors, warnings, infos = (sum(one.level == level for one in results) for level in LEVELS)
    return "\n".join([*lines, f"errors: {errors}, warnings: {warnings}, notes: {infos}"])


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
