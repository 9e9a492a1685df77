"""A comparison of any number of runs: their metrics side by side, and which of them differ from the first run.

Differences are significant at 5 % for the whole table: p-values are adjusted for the number of comparisons (Holm).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.console import RenderableType

from trackwright.experiments.pages.reports.pages import page, write_page
from trackwright.experiments.pages.reports.runs import StudyRun, TrackRun
from trackwright.experiments.text.evaluation_text import COLUMNS, cells, title_of
from trackwright.experiments.text.expectations import Value, with_interval
from trackwright.experiments.text.tables import compact_table, rendered, terminal_width
from trackwright.experiments.text.wording import (  # fmt: skip
    MISSING,
    Unit,
    heading,
    length_unit,
    shown_metric,
    units_of,
    yes_no,
)
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.evaluation.comparison import METRICS, Difference, holm, paired_differences
from trackwright.trackers.evaluation.metrics import Metric

if TYPE_CHECKING:
    from trackwright.experiments.pages.charts.style import Chart

SHOWN = (
    "rmse_m", "median_m", "p95_m", "rmse_3d_m", "p95_3d_m", "rmse_direction_rad", "nees_mean", "nees_ratio",
    "coverage_50", "coverage_90", "coverage_95", "coverage_99", "nis_ratio", "nis_correlation_100ms",
    "nis_correlation_1s", "nis_correlation_5s", "lost_fraction", "diverged",
)  # fmt: skip
"""The metrics of studies that are shown where any is common; else all."""

BEARING_NAMES = {"rmse_m": "rmse_direction_rad", "median_m": "median_direction_rad", "p95_m": "p95_direction_rad"}
LEVEL = 0.05
WIDTH = 150
ALL = "all recordings"


class Table(NamedTuple):
    """A table for a terminal and for a page: a title, its columns, of which `n_text` are text, rows, and a note."""

    title: str
    head: tuple[str, ...]
    n_text: int
    rows: list[list[str]]
    note: str = ""

    @property
    def classes(self) -> list[str]:
        """The classes of the columns on a page."""
        return ["text"] * self.n_text + [""] * (len(self.head) - self.n_text)


class Contrast(NamedTuple):
    """A metric of a run against that of the first run.

    `subject`: the world and tracker of studies, else empty. `p`: adjusted for the number of contrasts, NaN if unknown.
    """

    subject: str
    metric: str
    run: str
    difference: Difference
    p: float

    @property
    def differs(self) -> bool | None:
        """Whether the runs differ; None where that is unknown."""
        return None if math.isnan(self.p) else self.p <= LEVEL


def track_contrasts(runs: Sequence[TrackRun]) -> list[Contrast]:
    """The paired differences of every run from the first, over the tracks that both have."""
    contrasts = []
    for run in runs[1:]:
        differences = paired_differences(runs[0].errors, run.errors)
        for metric in METRICS:
            difference = differences.get(metric)
            given = "_3d" in metric and all(shown_metric(both.metrics[""], metric) is None for both in (runs[0], run))
            if difference is not None and math.isfinite(difference.value) and not given:
                name = BEARING_NAMES.get(metric, metric) if run.bearing else metric
                contrasts.append(Contrast("", name, run.name, difference, difference.p))
    return adjusted(contrasts)


def study_contrasts(runs: Sequence[StudyRun], metrics: Collection[str]) -> list[Contrast]:
    """The differences of every study from the first, as independent ones, by the widths of their intervals.

    Conservative for studies with the same random numbers.
    """
    contrasts = []
    for subject, metric in runs[0].metrics:
        for run in runs[1:]:
            before, after = runs[0].metrics[subject, metric], run.metrics.get((subject, metric))
            if metric in metrics and after is not None:
                difference = _independent(before, after)
                contrasts.append(Contrast(subject, metric, run.name, difference, difference.p))
    return adjusted(contrasts)


def _independent(before: Value, after: Value) -> Difference:
    half = math.hypot(before.high - before.low, after.high - after.low) / 2
    value, p = after.value - before.value, math.nan
    if math.isfinite(half):
        p = math.erfc(abs(value) / (half / 1.959964) / math.sqrt(2)) if half > 0 else float(value == 0)
    return Difference(before.value, after.value, value - half, value + half, p, 0)


def adjusted(contrasts: Sequence[Contrast]) -> list[Contrast]:
    """The contrasts with p-values for their number."""
    return [one._replace(p=p) for one, p in zip(contrasts, holm([one.p for one in contrasts]), strict=True)]


def tables_of_tracks(runs: Sequence[TrackRun], contrasts: Sequence[Contrast]) -> list[Table]:
    """The metrics of every recording and run, and the differences from the first run."""
    unit = _unit(runs)
    names = [name for name in dict.fromkeys(name for run in runs for name in run.metrics) if name]
    shown = names if len(names) == 1 else [*names, ""]
    columns = _columns(runs)
    rows = [
        [name or ALL, run.name, *cells(run.metrics[name], columns, unit)]
        for name in shown
        for run in runs
        if name in run.metrics
    ]
    spatial = " and 3-D" if any("_3d" in column.name for column in columns) else ""
    what = "Bearing errors in degrees" if runs[0].bearing else f"Horizontal{spatial} position errors in {unit.name}"
    head = ("recording", "run", *(title_of(column).replace("\n", " ").strip() for column in columns))
    tables = [Table(what, head, 2, rows)]
    if contrasts:
        tables.append(difference_table(runs[0].name, contrasts, unit))
    return tables


def difference_table(first: str, contrasts: Sequence[Contrast], unit: Unit) -> Table:
    """The differences from the run `first`, with errors in this unit."""
    rows = []
    for contrast in contrasts:
        of = Unit("%", 100.0) if contrast.metric.startswith("coverage") else unit
        d = contrast.difference
        interval = Value(d.value, d.low, d.high)
        p = MISSING if math.isnan(contrast.p) else "<0.001" if contrast.p < 0.001 else f"{contrast.p:.3f}"
        values = (with_interval(Value(x, math.nan, math.nan), of) for x in (d.first, d.second))
        text = [heading(contrast.metric, of), *values, with_interval(interval, of), p, yes_no(contrast.differs)]
        rows.append([contrast.run, *text])
    pieces = sorted({contrast.difference.pieces for contrast in contrasts})
    known = sum(contrast.differs is not None for contrast in contrasts)
    count = " to ".join(map(str, dict.fromkeys((pieces[0], pieces[-1]))))
    note = f"Paired over {count} {contrasts[0].difference.kind}. p is adjusted for {known} comparisons (Holm)."
    if not known:
        note = "No intervals: the common recordings are too short for five pieces that are longer than errors last."
    head = ("run", "metric", first, "run's", "difference (95 %)", "p", "differs")
    return Table(f"Differences from {first}", head, 2, rows, note)


def _unit(runs: Sequence[TrackRun]) -> Unit:
    if runs[0].bearing:
        return Unit("°", 180 / math.pi)
    sizes = [run.metrics[""]["rmse_m"] for run in runs if run.metrics[""].get("rmse_m") is not None]
    return length_unit(min(sizes, default=math.nan))


def _columns(runs: Sequence[TrackRun]) -> list[Metric]:
    """The main columns, and the median, with a value in any run."""
    return [
        column
        for column in COLUMNS
        if (column.rank == 0 or column.name.startswith("median"))
        and any(shown_metric(one, column.name) is not None for run in runs for one in run.metrics.values())
    ]


def tables_of_studies(runs: Sequence[StudyRun], contrasts: Sequence[Contrast]) -> list[Table]:
    """The metrics of every world, tracker and study, and which studies differ from the first."""
    by_row: dict[tuple[str, str], list[Contrast]] = {}
    for contrast in contrasts:
        by_row.setdefault((contrast.subject, contrast.metric), []).append(contrast)
    values: dict[str, list[float]] = {}
    for subject, metric in by_row:
        of_runs = [run.metrics[subject, metric].value for run in runs if (subject, metric) in run.metrics]
        values.setdefault(metric, []).extend(of_runs)
    units = units_of(values)
    rows = []
    for (subject, metric), others in by_row.items():
        unit, missing = units[metric], Value(math.nan, math.nan, math.nan)
        values_of_runs = [with_interval(run.metrics.get((subject, metric), missing), unit) for run in runs]
        ratios = [_ratio(contrast.difference) for contrast in others]
        rows.append([subject, heading(metric, unit), *values_of_runs, ", ".join(ratios), _which(others, len(runs))])
    head = ("", "metric", *(run.name for run in runs), f"over {runs[0].name}", "differ?")
    note = f"In brackets 95 % intervals. Differences are corrected for {len(contrasts)} comparisons (Holm)."
    return [Table("Metrics", head, 2, rows, note)]


def _ratio(difference: Difference) -> str:
    ratio = difference.second / difference.first if difference.first else math.nan
    return f"{ratio:.3f}" if math.isfinite(ratio) else MISSING


def _which(contrasts: Sequence[Contrast], runs: int) -> str:
    """Yes or no for two studies; of more, the names of those that differ from the first."""
    if runs == 2:
        return yes_no(contrasts[0].differs)
    return ", ".join(contrast.run for contrast in contrasts if contrast.differs) or yes_no(False)


def comparison(runs: Sequence[StudyRun] | Sequence[TrackRun]) -> tuple[list[Table], list[Contrast]]:
    """The tables of a comparison and the contrasts behind them; raises UnusableInput without a common metric."""
    if isinstance(runs[0], TrackRun):
        tracks = [run for run in runs if isinstance(run, TrackRun)]
        contrasts = track_contrasts(tracks)
        return tables_of_tracks(tracks, contrasts), contrasts
    studies = [run for run in runs if isinstance(run, StudyRun)]
    common = {key[1] for key in studies[0].metrics if any(key in run.metrics for run in studies[1:])}
    if not common:
        names = " and ".join(str(run.folder) for run in studies)
        raise UnusableInput(f"{names} have no metric of the same world and tracker in common")
    contrasts = study_contrasts(studies, common & {*SHOWN} or common)
    return tables_of_studies(studies, contrasts), contrasts


def lone_subjects(runs: Sequence[StudyRun] | Sequence[TrackRun]) -> list[str]:
    """A line for each recording, or world and tracker, that some run lacks."""
    subjects: list[list[str]] = [
        [name for name in run.metrics if name] if isinstance(run, TrackRun) else [subject for subject, _ in run.metrics]
        for run in runs
    ]
    all_subjects = dict.fromkeys(subject for held in subjects for subject in held)
    names = [run.name for run in runs]
    return [
        f"only in {listed([name for name, held in zip(names, subjects, strict=True) if subject in held])}: {subject}"
        for subject in all_subjects
        if not all(subject in held for held in subjects)
    ]


def comparison_text(tables: Sequence[Table]) -> str:
    """The tables for a terminal."""
    parts: list[RenderableType] = []
    for table in tables:
        made = compact_table(table.title, table.head[: table.n_text], table.head[table.n_text :])
        for row in table.rows:
            made.add_row(*row)
        parts += [made, *([table.note] if table.note else [])]
    return rendered(terminal_width(WIDTH), *parts)


def write_comparison(
    path: Path,
    runs: Sequence[str],
    tables: Sequence[Table],
    charts: Sequence[Chart],
    command: Sequence[str],
    playback: str | None = None,
) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written.

    `playback`: the name of a page beside it that plays the runs back.
    """
    text = page(
        "comparison.html",
        command,
        title=" and ".join(runs) if len(runs) == 2 else f"{len(runs)} runs: {', '.join(runs)}",
        tables=tables,
        charts=charts,
        playback=playback,
    )
    return write_page(path, text)
