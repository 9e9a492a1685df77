"""A comparison of runs: their metrics side by side, which differ from the first run, and charts of their errors.

Differences are significant at 5 % for the whole table: p-values are adjusted for the number of comparisons (Holm).
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import polars as pl
from markupsafe import Markup

from trackwright.experiments.pages.chart import Chart
from trackwright.experiments.pages.charts import coverage, error_cdf
from trackwright.experiments.pages.report import report_page, typed, write_page
from trackwright.experiments.text.expectations import Value, with_interval
from trackwright.experiments.text.tables import COLUMNS, Section, cells, title_of
from trackwright.experiments.text.wording import (
    MISSING,
    SHOWN,
    Unit,
    heading,
    length_unit,
    shown_metric,
    unit_of,
    yes_no,
)
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.evaluation.comparison import Difference, holm, paired_differences
from trackwright.trackers.evaluation.evaluate import Metrics
from trackwright.trackers.evaluation.rows import is_scored, scored_rows
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.tracks_table import EVALUATION, TRACKS, read_tracks, source_paths

LEVEL, WIDTH = 0.05, 150


@dataclass(frozen=True)
class Run:
    """Tracks of recordings: their metrics by recording, "" for all, and their `scored_rows` where there is a truth.

    `kind`: position or bearing.
    """

    name: str
    metrics: Mapping[str, Metrics]
    kind: str = "position"
    rows: pl.DataFrame | None = None


class Contrast(NamedTuple):
    """A metric of a run against the first run's; `p`: adjusted for the number of contrasts, NaN if unknown."""

    metric: str
    run: str
    difference: Difference
    p: float

    @property
    def differs(self) -> bool | None:
        """Whether the runs differ; None where that is unknown."""
        return None if math.isnan(self.p) else self.p <= LEVEL


def read_runs(folders: Sequence[Path]) -> tuple[list[Run], list[str]]:
    """The runs in these folders, and notices; raises UnusableInput for one folder twice, and for runs of two kinds."""
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise UnusableInput("evaluate: a folder is given more than once; expected different runs; remove one")
    # The last parts of the paths, as few as tell them apart.
    parts = [folder.resolve().parts for folder in folders]
    names = ([os.sep.join(path[-length:]) for path in parts] for length in range(1, max(map(len, parts)) + 1))
    read = [_read(folder) for folder in folders]
    if len(kinds := dict(zip((kind for kind, _ in read), folders, strict=True))) > 1:
        found = ", ".join(f"{folder} holds {kind}s" for kind, folder in kinds.items())
        raise UnusableInput(f"{found}; expected runs of one kind, tracks of positions or of bearings")
    runs, notices, known = [], list[str](), dict[str, RecordingFolder]()
    for path in dict.fromkeys(path for folder in folders for path in source_paths(folder)):
        try:
            known |= {(recording := read_recording(path)).name: recording}
        except UnusableInput as problem:
            notices.append(f"{problem}; no intervals and figures for it")
    truths = {name: recording.tables["truth"] for name, recording in known.items() if "truth" in recording.tables}
    stations = {name: recording.rig.stations for name, recording in known.items()}
    for name, folder, (kind, metrics) in zip(next(x for x in names if len({*x}) == len(x)), folders, read, strict=True):
        kept = truths and (folder / TRACKS).is_file()
        rows = scored_rows(read_tracks(folder), truths, stations) if kept else None
        runs.append(Run(name, metrics, kind, None if rows is None or not is_scored(rows).any() else rows))
    return runs, notices


def _read(folder: Path) -> tuple[str, dict[str, Metrics]]:
    """What a folder holds, positions or bearings, and the metrics by recording; raises UnusableInput."""
    path = folder / EVALUATION
    if not path.is_file():
        done = f"write it with `trackwright evaluate {folder}`" if (folder / TRACKS).is_file() else ""
        raise UnusableInput(f"{folder}: no {EVALUATION}; {done or 'expected a folder of `trackwright track`'}")
    try:
        content = json.loads(file_bytes(path))
        rows = {"": content["overall"]} | {str(row["recording"]): row for row in content["recordings"]}
        metrics: dict[str, Metrics] = {
            name: {key: float(value) for key, value in row.items() if value is not None and key != "recording"}
            for name, row in rows.items()
        }
        return str(content.get("kind", "position")), metrics
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise UnusableInput(f"{path}: cannot be read as JSON of ours; run `evaluate` again") from error


def comparison(runs: Sequence[Run]) -> tuple[list[Section], list[Contrast]]:
    """The tables of a comparison and the contrasts behind them."""
    first, *others = runs
    found = [one for run in others for one in _paired(first, run)]
    adjusted = holm([one.p for one in found])
    contrasts = [one._replace(p=p) for one, p in zip(found, adjusted, strict=True)]
    sizes = [size for run in runs if (size := run.metrics.get("", {}).get("rmse_m")) is not None]
    unit = SHOWN["rad"] if first.kind == "bearing" else length_unit(min(sizes, default=math.nan))
    table = _table_of_tracks(runs, unit)
    return [table, *([difference_table(first.name, contrasts, unit)] if contrasts else [])], contrasts


def _paired(first: Run, run: Run) -> Iterator[Contrast]:
    """The paired differences of a run from the first, over the tracks that both have."""
    if first.rows is None or run.rows is None:
        return
    for metric, difference in paired_differences(first.rows, run.rows).items():
        given = "_3d" in metric and all(shown_metric(of.metrics.get("", {}), metric) is None for of in (first, run))
        if math.isfinite(difference.value) and not given:
            yield Contrast(metric, run.name, difference, difference.p)


def _table_of_tracks(runs: Sequence[Run], unit: Unit) -> Section:
    """The main metrics, and the median, of every recording and run, without those that no run has."""
    subjects = list(dict.fromkeys(subject for run in runs for subject in run.metrics if subject))
    main = [column for column in COLUMNS if column.rank == 0 or column.name.startswith("median")]
    pairs = [(subject, run) for subject in (*subjects, *[""] * (len(subjects) > 1)) for run in runs]
    shown = [(subject, run, of) for subject, run in pairs if (of := run.metrics.get(subject))]
    columns = [column for column in main if any(shown_metric(of, column.name) is not None for *_, of in shown)]
    rows = [[subject or "all recordings", run.name, *cells(of, columns, unit)] for subject, run, of in shown]
    spatial = " and 3-D" * any("_3d" in column.name for column in columns)
    what = "Bearing" if runs[0].kind == "bearing" else f"Horizontal{spatial} position"
    head = ("recording", "run", *(title_of(column).replace("\n", " ").strip() for column in columns))
    return Section(f"{what} errors in {unit.name}", head, rows, 2)


def difference_table(first: str, contrasts: Sequence[Contrast], unit: Unit) -> Section:
    """The differences from the run `first`, with errors in this unit."""
    rows = []
    for contrast in contrasts:
        own, d = unit_of(contrast.metric, ()), contrast.difference
        of = unit if own.name in ("m", "°") else own
        p = MISSING if math.isnan(contrast.p) else "<0.001" if contrast.p < 0.001 else f"{contrast.p:.3f}"
        values = Value(d.first, math.nan, math.nan), Value(d.second, math.nan, math.nan), Value(d.value, d.low, d.high)
        shown = [with_interval(value, of) for value in values]
        rows.append([contrast.run, heading(contrast.metric, of), *shown, p, yes_no(contrast.differs)])
    pieces = sorted({contrast.difference.pieces for contrast in contrasts})
    known = sum(contrast.differs is not None for contrast in contrasts)
    count = " to ".join(map(str, dict.fromkeys((pieces[0], pieces[-1]))))
    note = f"Paired over {count} {contrasts[0].difference.kind}. p is adjusted for {known} comparisons (Holm)."
    if not known:
        note = "No intervals: the common recordings are too short for five pieces that are longer than errors last."
    head = ("run", "metric", first, "run's", "difference (95 %)", "p", "differs")
    return Section(f"Differences from {first}", head, rows, 2, note)


def lone_subjects(runs: Sequence[Run]) -> list[str]:
    """A line for each recording that some run lacks."""
    subjects = dict.fromkeys(subject for run in runs for subject in run.metrics)
    holders = {subject: [run.name for run in runs if subject in run.metrics] for subject in subjects}
    return [f"only in {listed(of)}: {subject}" for subject, of in holders.items() if len(of) < len(runs)]


def comparison_charts(runs: Sequence[Run]) -> list[Chart]:
    """The charts of the page, and of the files where these are asked for; none without truth."""
    tracks = {run.name: run.rows for run in runs if run.rows is not None}
    return [error_cdf(tracks), coverage(tracks)] if tracks else []


def write_comparison(
    path: Path, runs: Sequence[str], tables: Sequence[Section], charts: Sequence[Chart], command: Sequence[str],
    playback: str | None = None,
) -> Path:  # fmt: skip
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written.

    `playback`: the name of a page beside it that plays the runs back.
    """
    title = " and ".join(runs) if len(runs) == 2 else f"{len(runs)} runs: {', '.join(runs)}"
    link = Markup('<a href="{0}">{0}</a> plays the same runs back, with a selector of the tracker.').format(playback)
    sections = [*tables, Section("Figures", parts=[list(charts)])]
    return write_page(path, report_page("comparison", title, [link] if playback else [], sections, [typed(command)]))
