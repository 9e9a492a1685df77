"""A comparison of any number of runs: their metrics side by side, and which of them differ from the first run.

Differences are significant at 5 % for the whole table: p-values are adjusted for the number of comparisons (Holm).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from trackwright.experiments.pages.reports.pages import page, write_page
from trackwright.experiments.pages.reports.runs import StudyRun, TrackRun
from trackwright.experiments.text.evaluation_text import COLUMNS, cells, title_of
from trackwright.experiments.text.expectations import Value, with_interval
from trackwright.experiments.text.tables import Section
from trackwright.experiments.text.wording import (
    MISSING,
    Unit,
    heading,
    length_unit,
    shown_metric,
    unit_of,
    units_of,
    yes_no,
)
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.evaluation.comparison import Difference, holm, paired_differences

if TYPE_CHECKING:
    from trackwright.experiments.pages.charts.style import Chart

SHOWN = (
    "rmse_m", "median_m", "p95_m", "rmse_3d_m", "p95_3d_m", "rmse_direction_rad", "nees_mean", "nees_ratio",
    "regret", "coverage_50", "coverage_90", "coverage_95", "coverage_99", "nis_ratio", "lost_fraction", "diverged",
)  # fmt: skip
"""The metrics of studies that are shown where any is common; else all."""

LEVEL = 0.05
WIDTH = 150
ALL = "all recordings"


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
        if runs[0].rows is None or run.rows is None:
            continue
        for metric, difference in paired_differences(runs[0].rows, run.rows).items():
            given = "_3d" in metric and all(shown_metric(both.metrics[""], metric) is None for both in (runs[0], run))
            if math.isfinite(difference.value) and not given:
                contrasts.append(Contrast("", metric, run.name, difference, difference.p))
    return adjusted(contrasts)


def study_contrasts(runs: Sequence[StudyRun], metrics: Collection[str]) -> list[Contrast]:
    """The differences of every study from the first, as independent ones, by the widths of their intervals.

    Conservative for studies with the same random numbers.
    """
    contrasts = []
    for (subject, metric), before in runs[0].metrics.items():
        for run in runs[1:]:
            after = run.metrics.get((subject, metric))
            if metric in metrics and after is not None:
                half = math.hypot(before.high - before.low, after.high - after.low) / 2
                value, p = after.value - before.value, math.nan
                if math.isfinite(half):
                    p = math.erfc(abs(value) / (half / 1.959964) / math.sqrt(2)) if half > 0 else float(value == 0)
                difference = Difference(before.value, after.value, value - half, value + half, p, 0)
                contrasts.append(Contrast(subject, metric, run.name, difference, p))
    return adjusted(contrasts)


def adjusted(contrasts: Sequence[Contrast]) -> list[Contrast]:
    """The contrasts with p-values for their number."""
    return [one._replace(p=p) for one, p in zip(contrasts, holm([one.p for one in contrasts]), strict=True)]


def tables_of_tracks(runs: Sequence[TrackRun], contrasts: Sequence[Contrast]) -> list[Section]:
    """The metrics of every recording and run, and the differences from the first run."""
    sizes = [run.metrics[""]["rmse_m"] for run in runs if run.metrics[""].get("rmse_m") is not None]
    unit = Unit("°", 180 / math.pi) if runs[0].bearing else length_unit(min(sizes, default=math.nan))
    names = [name for name in dict.fromkeys(name for run in runs for name in run.metrics) if name]
    # The main columns, and the median, with a value in any run.
    held = [one for run in runs for one in run.metrics.values()]
    main = [column for column in COLUMNS if column.rank == 0 or column.name.startswith("median")]
    columns = [column for column in main if any(shown_metric(one, column.name) is not None for one in held)]
    rows = [
        [name or ALL, run.name, *cells(run.metrics[name], columns, unit)]
        for name in (names if len(names) == 1 else [*names, ""])
        for run in runs
        if name in run.metrics
    ]
    spatial = " and 3-D" if any("_3d" in column.name for column in columns) else ""
    what = "Bearing errors in degrees" if runs[0].bearing else f"Horizontal{spatial} position errors in {unit.name}"
    head = ("recording", "run", *(title_of(column).replace("\n", " ").strip() for column in columns))
    return [Section(what, head, rows, 2), *([difference_table(runs[0].name, contrasts, unit)] if contrasts else [])]


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


def tables_of_studies(runs: Sequence[StudyRun], contrasts: Sequence[Contrast]) -> list[Section]:
    """The metrics of every world, tracker and study, and which studies differ from the first."""
    by_row: dict[tuple[str, str], list[Contrast]] = {}
    for contrast in contrasts:
        by_row.setdefault((contrast.subject, contrast.metric), []).append(contrast)
    values: dict[str, list[float]] = {}
    for key in by_row:
        values.setdefault(key[1], []).extend(run.metrics[key].value for run in runs if key in run.metrics)
    units, missing, rows = units_of(values), Value(math.nan, math.nan, math.nan), []
    for (subject, metric), others in by_row.items():
        shown = [with_interval(run.metrics.get((subject, metric), missing), units[metric]) for run in runs]
        ratios = [d.second / d.first if d.first else math.nan for d in (contrast.difference for contrast in others)]
        ratio = ", ".join(f"{x:.3f}" if math.isfinite(x) else MISSING for x in ratios)
        # Of more than two studies those that differ from the first are named.
        differ = ", ".join(contrast.run for contrast in others if contrast.differs) or yes_no(False)
        which = yes_no(others[0].differs) if len(runs) == 2 else differ
        rows.append([subject, heading(metric, units[metric]), *shown, ratio, which])
    head = ("", "metric", *(run.name for run in runs), f"over {runs[0].name}", "differ?")
    note = f"In brackets 95 % intervals. Differences are corrected for {len(contrasts)} comparisons (Holm)."
    return [Section("Metrics", head, rows, 2, note)]


def comparison(runs: Sequence[StudyRun] | Sequence[TrackRun]) -> tuple[list[Section], list[Contrast]]:
    """The tables of a comparison and the contrasts behind them; raises UnusableInput without a common metric."""
    tracks, studies = [r for r in runs if isinstance(r, TrackRun)], [r for r in runs if isinstance(r, StudyRun)]
    if tracks:
        contrasts = track_contrasts(tracks)
        return tables_of_tracks(tracks, contrasts), contrasts
    common = {key[1] for key in studies[0].metrics if any(key in run.metrics for run in studies[1:])}
    if not common:
        names = " and ".join(str(run.folder) for run in studies)
        raise UnusableInput(f"{names} have no metric of the same world and tracker in common")
    contrasts = study_contrasts(studies, common & {*SHOWN} or common)
    return tables_of_studies(studies, contrasts), contrasts


def lone_subjects(runs: Sequence[StudyRun] | Sequence[TrackRun]) -> list[str]:
    """A line for each recording, or world and tracker, that some run lacks."""
    held: dict[str, list[str]] = {
        run.name: [name for name in (key if isinstance(key, str) else key[0] for key in run.metrics) if name]
        for run in runs
    }
    return [
        f"only in {listed([name for name, subjects in held.items() if subject in subjects])}: {subject}"
        for subject in dict.fromkeys(subject for subjects in held.values() for subject in subjects)
        if not all(subject in subjects for subjects in held.values())
    ]


def write_comparison(
    path: Path,
    runs: Sequence[str],
    tables: Sequence[Section],
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
        sections=tables,
        charts=charts,
        playback=playback,
    )
    return write_page(path, text)
