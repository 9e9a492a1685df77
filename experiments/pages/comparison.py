"""A comparison of runs: their metrics side by side, which differ from the first run, and charts of their errors.

Differences are significant at 5 % for the whole table: p-values are adjusted for the number of comparisons (Holm).
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import polars as pl

from trackwright.experiments.pages.chart import Chart
from trackwright.experiments.pages.charts import coverage, error_cdf
from trackwright.experiments.pages.report import report_page, typed, write_page
from trackwright.experiments.text.expectations import Value, with_interval
from trackwright.experiments.text.tables import (
    COLUMNS,
    MISSING,
    SHOWN,
    Section,
    Unit,
    cells,
    heading,
    length_unit,
    shown_metric,
    title_of,
    unit_of,
    yes_no,
)
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.evaluation.comparison import Difference, holm, paired_differences
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.trackers.recordings.folder import read_recording
from trackwright.trackers.recordings.tracks_table import TRACKS, is_bearing, read_tracks, source_paths

LEVEL, WIDTH = 0.05, 150

Runs = Mapping[str, pl.DataFrame]
"""The `scored_rows` of runs by name."""


class Contrast(NamedTuple):
    """A metric of a run against the first run's; `p`: adjusted for the number of contrasts, NaN if unknown."""

    metric: str
    run: str
    difference: Difference
    p: float


def read_runs(folders: Sequence[Path]) -> tuple[dict[str, pl.DataFrame], list[str]]:
    """The runs in these folders by name, and notices; raises UnusableInput for what is no run, or of another kind."""
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise UnusableInput("evaluate: a folder is given more than once; expected different runs; remove one")
    for folder in folders:
        if not (folder / TRACKS).is_file():
            raise UnusableInput(f"{folder}: no {TRACKS}; expected a folder of `trackwright track`")
    truths, stations, notices = dict[str, pl.DataFrame](), {}, list[str]()
    for path in dict.fromkeys(path for folder in folders for path in source_paths(folder)):
        try:
            recording = read_recording(path)
        except UnusableInput as problem:
            notices.append(f"{problem}; no errors of it")
            continue
        stations[recording.name] = recording.rig.stations
        truths |= {recording.name: recording.tables["truth"]} if "truth" in recording.tables else {}
    # The last parts of the paths, as few as tell them apart.
    parts = [folder.resolve().parts for folder in folders]
    names = ([os.sep.join(path[-length:]) for path in parts] for length in range(1, max(map(len, parts)) + 1))
    tables = [read_tracks(folder) for folder in folders]
    if len({*map(is_bearing, tables)}) > 1:
        raise UnusableInput(f"{listed([*map(str, folders)])}: found positions and bearings; expected runs of one kind")
    rows = [scored_rows(table, truths, stations) for table in tables]
    return dict(zip(next(of for of in names if len({*of}) == len(of)), rows, strict=True)), notices


def comparison(runs: Runs) -> tuple[list[Section], list[Contrast]]:
    """The tables of a comparison and the contrasts behind them."""
    found = {name: Evaluation.of(rows) for name, rows in runs.items()}
    (first, rows), *others = runs.items()
    contrasts = list[Contrast]()
    for name, other in others:
        for metric, difference in paired_differences(rows, other).items():
            given = "_3d" in metric and all(shown_metric(found[of].overall, metric) is None for of in (first, name))
            if math.isfinite(difference.value) and not given:
                contrasts.append(Contrast(metric, name, difference, difference.p))
    adjusted = holm([one.p for one in contrasts])
    contrasts = [one._replace(p=p) for one, p in zip(contrasts, adjusted, strict=True)]
    sizes = [of.overall["rmse_m"] for of in found.values() if of.overall["rmse_m"] is not None]
    unit = SHOWN["rad"] if is_bearing(rows) else length_unit(min(sizes, default=math.nan))
    table = _table_of_metrics(found, unit)
    return [table, *([difference_table(first, contrasts, unit)] if contrasts else [])], contrasts


def _table_of_metrics(runs: Mapping[str, Evaluation], unit: Unit) -> Section:
    """The main metrics, and the median, of every recording and run, without those that no run has."""
    by_name = {name: {metrics["recording"]: metrics for metrics in run.recordings} for name, run in runs.items()}
    subjects = list(dict.fromkeys(subject for of in by_name.values() for subject in of))
    shown = [(subject, name, of[subject]) for subject in subjects for name, of in by_name.items() if subject in of]
    if len(subjects) > 1:
        shown += [("all recordings", name, run.overall) for name, run in runs.items()]
    main = [column for column in COLUMNS if column.rank == 0 or column.name.startswith("median")]
    columns = [column for column in main if any(shown_metric(of, column.name) is not None for *_, of in shown)]
    rows = [[subject, name, *cells(of, columns, unit)] for subject, name, of in shown]
    spatial = " and 3-D" * any("_3d" in column.name for column in columns)
    what = "Bearing" if unit == SHOWN["rad"] else f"Horizontal{spatial} position"
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
        differs = "" if math.isnan(contrast.p) else yes_no(contrast.p <= LEVEL)
        rows.append([contrast.run, heading(contrast.metric, of), *shown, p, differs])
    pieces = sorted({contrast.difference.pieces for contrast in contrasts})
    known = sum(not math.isnan(contrast.p) for contrast in contrasts)
    count = " to ".join(map(str, dict.fromkeys((pieces[0], pieces[-1]))))
    note = f"Paired over {count} {contrasts[0].difference.kind}. p is adjusted for {known} comparisons (Holm)."
    if not known:
        note = "No intervals: the common recordings are too short for five pieces that are longer than errors last."
    head = ("run", "metric", first, "run's", "difference (95 %)", "p", "differs")
    return Section(f"Differences from {first}", head, rows, 2, note)


def lone_subjects(runs: Runs) -> list[str]:
    """A line for each recording that some run lacks."""
    held = {name: rows["recording"].unique(maintain_order=True).to_list() for name, rows in runs.items()}
    subjects = dict.fromkeys(subject for of in held.values() for subject in of)
    holders = {subject: [name for name, of in held.items() if subject in of] for subject in subjects}
    return [f"only in {listed(of)}: {subject}" for subject, of in holders.items() if len(of) < len(runs)]


def comparison_charts(runs: Runs) -> list[Chart]:
    """The charts of the page, and of the files where these are asked for; none without truth."""
    scored = {name: rows for name, rows in runs.items() if rows["why"].is_null().any()}
    return [error_cdf(scored), coverage(scored)] if scored else []


def write_comparison(
    path: Path, runs: Sequence[str], tables: Sequence[Section], charts: Sequence[Chart], command: Sequence[str]
) -> Path:  # fmt: skip
    """Writes the page; returns the path."""
    title = " and ".join(runs) if len(runs) == 2 else f"{len(runs)} runs: {', '.join(runs)}"
    sections = [*tables, Section("Figures", parts=[list(charts)])]
    return write_page(path, report_page("comparison", title, [], sections, [typed(command)]))
