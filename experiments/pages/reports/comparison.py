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
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.monte_carlo.declaration import short
from trackwright.experiments.pages.charts.distributions import Curve, distribution
from trackwright.experiments.pages.charts.floor import plan, track_paths, true_path
from trackwright.experiments.pages.charts.residuals import boxes
from trackwright.experiments.pages.charts.style import LINES, Chart, Line
from trackwright.experiments.pages.reports.pages import report_page, typed, write_page
from trackwright.experiments.pages.scored_tracks import ScoredTracks, drawn_of, rmse_by
from trackwright.experiments.text.evaluation_text import COLUMNS, cells, title_of
from trackwright.experiments.text.expectations import Value, with_interval
from trackwright.experiments.text.tables import Section
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
from trackwright.trackers.evaluation.comparison import Difference, holm, main_size, paired_differences
from trackwright.trackers.evaluation.metrics import METRICS
from trackwright.trackers.evaluation.rows import is_scored, scored_rows
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.tracks_table import EVALUATION, TRACKS, read_tracks, source_paths

RESULTS = "results.json"
LEVEL, WIDTH = 0.05, 150
MOST_PLANS, MOST_TAGS = 3, 4
"""Recordings with floor plans, of more the worst, the median and the best by the first run; and tags of a plan."""

Key = tuple[str, str]
"""A subject and a metric: a recording, or the world, point and tracker of a study; "" for all recordings."""


@dataclass(frozen=True)
class Run:
    """A study, or tracks of recordings: its metrics by subject and name, with intervals where they are known.

    `bearing`: whether tracks are of bearings. `recordings`: the tracked ones, by name; None of a study. `rows`: the
    `scored_rows`, None of a study, and where no recording with truth can be read.
    """

    name: str
    folder: Path
    metrics: Mapping[Key, Value]
    bearing: bool = False
    recordings: Mapping[str, RecordingFolder] | None = None
    rows: pl.DataFrame | None = None

    def of(self, subject: str) -> dict[str, float]:
        """The metrics of a subject by name."""
        return {metric: value.value for (name, metric), value in self.metrics.items() if name == subject}


class Contrast(NamedTuple):
    """A metric of a run against the first run's.

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


def read_runs(folders: Sequence[Path]) -> tuple[list[Run], list[str]]:
    """The runs in these folders, and notices; raises UnusableInput for one folder twice, and for runs of two kinds."""
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise UnusableInput("evaluate: a folder is given more than once; expected different runs; remove one")
    # The last parts of the paths, as few as tell them apart.
    parts = [folder.resolve().parts for folder in folders]
    names = ([os.sep.join(path[-length:]) for path in parts] for length in range(1, max(map(len, parts)) + 1))
    read = [_read(folder) for folder in folders]
    if len(kinds := dict(zip((kind for kind, _ in read), folders, strict=True))) > 1:
        found = ", ".join(f"{folder} holds {kind}" for kind, folder in kinds.items())
        raise UnusableInput(f"{found}; expected runs of one kind: studies, or tracks of positions, or of bearings")
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
        rows = None if rows is None or not is_scored(rows).any() else rows
        runs.append(Run(name, folder, metrics, kind == "bearings", None if kind == RESULTS else known, rows))
    return runs, notices


def _read(folder: Path) -> tuple[str, dict[Key, Value]]:
    """What a folder holds, a study's results, positions or bearings, and the metrics; raises UnusableInput."""
    name = next((name for name in (RESULTS, EVALUATION) if (folder / name).is_file()), None)
    if name is None:
        fix = "expected a folder of `trackwright study` or `trackwright track`"
        fix = f"write it with `trackwright evaluate {folder}`" if (folder / TRACKS).is_file() else fix
        raise UnusableInput(f"{folder}: no {RESULTS} and no {EVALUATION}; {fix}")
    try:
        content = json.loads(file_bytes(folder / name))
        if name == RESULTS:
            return name, dict(_of_study(content))
        rows = {"": content["overall"]} | {str(row["recording"]): row for row in content["recordings"]}
        metrics = {
            (subject, key): Value(float(value), math.nan, math.nan)
            for subject, row in rows.items()
            for key, value in row.items()
            if value is not None and key != "recording"
        }
        return "bearings" if content.get("kind") == "bearing" else "positions", metrics
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        fix = "run the study or `evaluate` again"
        raise UnusableInput(f"{folder / name}: cannot be read as JSON of ours; {fix}") from error


def _of_study(content: Mapping[str, Any]) -> Iterator[tuple[Key, Value]]:
    for cell in content["cells"]:
        point = ", ".join(f"{short(k)} {v}" for k, v in cell["point"].items())
        subject = ", ".join(x for x in (cell["world"], point, cell["tracker"]) if x)
        for metric, value in cell["figures"].items():
            numbers = (math.nan if value[k] is None else float(value[k]) for k in Value._fields)
            yield (subject, metric), Value(*numbers)


def comparison(runs: Sequence[Run]) -> tuple[list[Section], list[Contrast]]:
    """The tables of a comparison and the contrasts behind them; raises UnusableInput without a common metric."""
    first, *others = runs
    if first.recordings is None:
        found = [one for run in others for one in _independent(first, run)]
        main = [one for one in found if one.metric in METRICS and METRICS[one.metric].page]
        contrasts = adjusted(main or found)
        if not contrasts:
            names = " and ".join(str(run.folder) for run in runs)
            raise UnusableInput(f"{names} have no metric of the same world and tracker in common")
        return [_table_of_studies(runs, contrasts)], contrasts
    contrasts = adjusted([one for run in others for one in _paired(first, run)])
    sizes = [run.metrics["", "rmse_m"].value for run in runs if ("", "rmse_m") in run.metrics]
    unit = SHOWN["rad"] if first.bearing else length_unit(min(sizes, default=math.nan))
    table = _table_of_tracks(runs, unit)
    return [table, *([difference_table(first.name, contrasts, unit)] if contrasts else [])], contrasts


def _paired(first: Run, run: Run) -> Iterator[Contrast]:
    """The paired differences of a run from the first, over the tracks that both have."""
    if first.rows is None or run.rows is None:
        return
    for metric, difference in paired_differences(first.rows, run.rows).items():
        given = "_3d" in metric and all(shown_metric(both.of(""), metric) is None for both in (first, run))
        if math.isfinite(difference.value) and not given:
            yield Contrast("", metric, run.name, difference, difference.p)


def _independent(first: Run, run: Run) -> Iterator[Contrast]:
    """The differences of a study from the first, by the widths of their intervals; conservative for common noise."""
    for (subject, metric), before in first.metrics.items():
        if after := run.metrics.get((subject, metric)):
            half = math.hypot(before.high - before.low, after.high - after.low) / 2
            value, p = after.value - before.value, math.nan
            if math.isfinite(half):
                p = math.erfc(abs(value) / (half / 1.959964) / math.sqrt(2)) if half > 0 else float(value == 0)
            difference = Difference(before.value, after.value, value - half, value + half, p, 0)
            yield Contrast(subject, metric, run.name, difference, p)


def adjusted(contrasts: Sequence[Contrast]) -> list[Contrast]:
    """The contrasts with p-values for their number."""
    return [one._replace(p=p) for one, p in zip(contrasts, holm([one.p for one in contrasts]), strict=True)]


def _table_of_tracks(runs: Sequence[Run], unit: Unit) -> Section:
    """The main metrics, and the median, of every recording and run, without those that no run has."""
    subjects = list(dict.fromkeys(subject for run in runs for subject, _ in run.metrics if subject))
    main = [column for column in COLUMNS if column.rank == 0 or column.name.startswith("median")]
    pairs = [(subject, run) for subject in (*subjects, *[""] * (len(subjects) > 1)) for run in runs]
    shown = [(subject, run, of) for subject, run in pairs if (of := run.of(subject))]
    columns = [column for column in main if any(shown_metric(of, column.name) is not None for *_, of in shown)]
    rows = [[subject or "all recordings", run.name, *cells(of, columns, unit)] for subject, run, of in shown]
    spatial = " and 3-D" * any("_3d" in column.name for column in columns)
    what = "Bearing" if runs[0].bearing else f"Horizontal{spatial} position"
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


def _table_of_studies(runs: Sequence[Run], contrasts: Sequence[Contrast]) -> Section:
    """The metrics of every world, tracker and study, and whether they differ from the first."""
    rows = []
    for contrast in contrasts:
        d, unit = contrast.difference, unit_of(contrast.metric, [contrast.difference.first])
        key = contrast.subject, contrast.metric
        both = [run.metrics[key] for run in runs if run.name in (runs[0].name, contrast.run)]
        shown = [with_interval(value, unit) for value in both]
        ratio = f"{d.second / d.first:.3f}" if d.first else MISSING
        words = [contrast.subject, heading(contrast.metric, unit), contrast.run]
        rows.append([*words, *shown, ratio, yes_no(contrast.differs)])
    head = ("", "metric", "study", runs[0].name, "the study's", "ratio", "differ?")
    note = f"In brackets 95 % intervals. Differences are corrected for {len(contrasts)} comparisons (Holm)."
    return Section("Metrics", head, rows, 3, note)


def lone_subjects(runs: Sequence[Run]) -> list[str]:
    """A line for each recording, or world and tracker, that some run lacks."""
    held = {run.name: dict.fromkeys(subject for subject, _ in run.metrics if subject) for run in runs}
    return [
        f"only in {listed([name for name, subjects in held.items() if subject in subjects])}: {subject}"
        for subject in dict.fromkeys(subject for subjects in held.values() for subject in subjects)
        if not all(subject in subjects for subjects in held.values())
    ]


def comparison_charts(runs: Sequence[Run]) -> list[Chart]:
    """The charts of the page, and of the files where these are asked for."""
    tracks = [run for run in runs if run.rows is not None]
    if not tracks:
        return []
    # The tail of one run alone shall not set the axis.
    p95, p99 = (sorted(float(np.quantile(all_errors(run), share)) for run in tracks) for share in (0.95, 0.99))
    furthest = 1.02 * max(p95[-1], p99[-2:][0])
    unit, curves, groups = SHOWN["rad"] if tracks[0].bearing else length_unit(furthest / 2), list[Curve](), list[Line]()
    what, end = "angle to the true direction" if tracks[0].bearing else "horizontal error", unit.factor * furthest
    quantity = f"{what} ({unit.name})"
    for k, run in enumerate(tracks):
        own, colour = unit.factor * all_errors(run), LINES[k % len(LINES)]
        beyond = 100 * np.mean(own > end)
        curves.append(Curve.of(run.name + (f", {beyond:.1f} % beyond" if beyond >= 0.1 else ""), own))
        groups += boxes([own[:0]] * k + [own], "", colour)
        groups.append(Line([k], [np.sqrt(np.mean(own**2))], "", colour, 0.0, marker="diamond", size=7))
    names, words = {k: run.name for k, run in enumerate(tracks)}, "box: quartiles, strokes: 5 and 95 %, diamond: RMSE"
    distributions = distribution("errors", "Distribution of errors", curves, quantity, end)
    wide = -0.7, len(names) - 0.3
    compared = Chart("boxes", "Boxes of errors", words, quantity, groups, wide, (0.0, end), xticks=names)
    return [distributions, compared, *_plans([run for run in tracks if not run.bearing])]


def all_errors(run: Run) -> np.ndarray:
    """The sorted horizontal errors, m, of all tracks, or the angles, rad, of bearings."""
    assert run.rows is not None
    return np.sort(run.rows[main_size(run.rows)].drop_nulls().to_numpy())


def _plans(runs: Sequence[Run]) -> Iterator[Chart]:
    """Floor plans of some recordings by each run, in its colour, around the truth: the worst run sets no axes."""
    scored = [run.rows.filter(pl.col("why").is_null()) for run in runs if run.rows is not None]
    first = scored[0]["recording"].unique(maintain_order=True) if scored else ()
    names = [name for name in first if all(name in of["recording"] for of in scored)]
    rmse = rmse_by(scored[0].filter(pl.col("recording").is_in(names)), "recording") if names else np.zeros(0)
    for place, why in drawn_of(rmse, False, MOST_PLANS).items():
        for k, run in enumerate(runs):
            assert run.rows is not None
            assert run.recordings is not None
            (one,) = ScoredTracks(run.rows, [run.recordings[names[place]]], ()).recordings
            look, tags = LINES[k % len(LINES)], range(len(one.rmse))[:MOST_TAGS]
            paths = [path for j in tags for path in track_paths([one], j, [("" if j else "estimates", look, "")], 0)]
            truths = [truth for j in tags for truth in true_path(one, j)]
            title = ", ".join(filter(None, (run.name, names[place], why and f"{why} by {runs[0].name}")))
            yield plan(f"floor_plan-{names[place]}-{run.name}", title, paths, truths, one.folder.rig, False, width=5.0)


def write_comparison(
    path: Path, runs: Sequence[str], tables: Sequence[Section], charts: Sequence[Chart], command: Sequence[str]
) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written."""
    title = " and ".join(runs) if len(runs) == 2 else f"{len(runs)} runs: {', '.join(runs)}"
    sections = [*tables, Section("Figures", parts=[list(charts)])]
    return write_page(path, report_page("comparison", title, [], sections, [typed(command)]))
