"""The end of `trackwright tune`: recordings before and after, and all files but the checkpoint."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.cli.console import FoldersInTurn
from trackwright.experiments.cli.options import TuneOptions, file_format
from trackwright.experiments.cli.runtime import write_manifest
from trackwright.experiments.cli.tuning_job import Fitted, cross_calibrated, fit_folders, fit_workers
from trackwright.experiments.pages.charts.tuning import objective_chart, parameter_chart
from trackwright.experiments.pages.reports.before_after import (
    MOST_PLANS,
    NO_PLANS,
    Compared,
    TrackChanges,
    compare,
    track_changes,
    tracked,
    with_truth,
)
from trackwright.experiments.pages.reports.pages import write_page
from trackwright.experiments.pages.reports.tuning import (
    collect,
    recording_names,
    traces_of,
    tuned_parameters,
    tuning_page,
)
from trackwright.experiments.text.tables import aligned
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.tuning.data import FitData
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.identifiability import IdentifiabilityIssue, identifiability_issues
from trackwright.tuning.intervals import Interval, intervals_of, left_out_blocks, left_out_values, without_intervals
from trackwright.tuning.parameters import component_names
from trackwright.tuning.tuned_file import tuned_content, write_tuned

INTERRUPTED = 130  # the exit code of a command that Ctrl-C ended, as shells have it


def tune_folders(
    folders: list[RecordingFolder] | FoldersInTurn, recordings: Sequence[Path], options: TuneOptions,
    started: datetime, clock: float, begin: Begin,
) -> tuple[int, dict[str, Any]]:  # fmt: skip
    """Fits to the first folders, writes all files and prints the table; exit code and content of tuned.toml."""
    count = len(recordings)
    if options.used.calibration is not None and not isinstance(folders, FoldersInTurn):
        parts = cross_calibrated(folders, options.used.calibration)
        count, folders = sum(map(len, parts[:count])), [part for of_folder in parts for part in of_folder]
    with fit_workers(options.cluster, options.out) as workers:
        fitted = fit_folders(folders, count, options, begin, workers)
        begin("leaving out recordings")
        before = tracked(fitted.named, fitted.shown)
        compared = judged(fitted, before)
        begin("comparing before and after")
        plans = NO_PLANS if options.figures == "none" else _plans(fitted, before)
        begin("report")
        content = _write_run(fitted, recordings, time.perf_counter() - clock, started, compared, plans)
    if fitted.result.uncertainty is None:
        notice("stopped: tuned.toml holds the best values so far; continue with the same command and --resume")
        return INTERRUPTED, content
    return int(options.check and compared.verdict.word == "worse"), content


def judged(fitted: Fitted, before: pl.DataFrame) -> Compared:
    """The recordings shown, `before` the fit and with values fitted without them, and the verdict."""
    result, data, shown = fitted.result, fitted.data, fitted.shown
    count, dimensions = len({trajectory.folder.name for trajectory in data.training}), data.dimensions
    about, why_not, parts = "held-out recordings", "", list[pl.DataFrame]()
    if not data.held_out:
        part = f"{len(shown)} of {count} " if len(shown) < count else ""
        about = f"{part}recording{'s' if count > 1 else ''} tuned on"
        # All are tracked with the values of each fold, by the one program that is compiled for them.
        if left_out := left_out_values(result):
            about += ", each with values fitted to the others"
            values_of = {folder.name: left_out.get(folder.name, result.values) for folder in shown}
            for values in {id(values): values for values in values_of.values()}.values():
                own = pl.col("recording").is_in([name for name, other in values_of.items() if other is values])
                parts.append(_with(fitted, values).run(shown).table.filter(own))
        elif blocks := left_out_blocks(result, data):
            about += f", each of {len(blocks)} blocks of time with values fitted without its truth"
            for start, stop, values in blocks:
                own = pl.col("t_s").is_between(start, stop, "left")
                parts.append(_with(fitted, values).run(shown).table.filter(own))
        elif data.objective.needs_truth:
            why_not = "the fit cannot leave a recording or a block of time out"
        else:
            about += ", whose truth the fit has not seen"
    if result.uncertainty is None:
        why_not = "the fit was interrupted"
    after = with_truth(pl.concat(parts), shown) if parts else tracked(_with(fitted, result.values), shown)
    return compare((before, after), shown, dimensions, about, why_not)


def _plans(fitted: Fitted, before: pl.DataFrame) -> TrackChanges:
    """The tracks with the values before and after the fit, of the recordings shown and of some others."""
    others = fitted.others[: max(MOST_PLANS - len(fitted.shown), 0)]
    held_out = {folder.name for folder in fitted.shown} if fitted.data.held_out else set()
    if others:
        before = pl.concat([before, tracked(fitted.named, others)], how="diagonal")
    folders = [*fitted.shown, *others]
    return track_changes(before, tracked(_with(fitted, fitted.result.values), folders), folders, held_out)


def _with(fitted: Fitted, values: Mapping[str, np.ndarray]) -> NamedTracker:
    """The tracker with the values by label."""
    by_name = {name: values[p.label] for p in fitted.result.parameters for name in p.names}
    return fitted.named.with_values(by_name, "the fit")


def _write_run(
    fitted: Fitted, recordings: Sequence[Path], seconds: float, started: datetime, compared: Compared,
    plans: TrackChanges,
) -> dict[str, Any]:  # fmt: skip
    """Writes all files to the folder, prints what they show, and returns the content of tuned.toml."""
    options, data, result, out = fitted.options, fitted.data, fitted.result, fitted.options.out
    objective, unit = str(options.objective), "rad" if data.training[0].station else "m"
    if options.prior != "flat" and data.objective.is_likelihood:
        objective += " + prior"
    intervals = intervals_of(result)
    calibration, average = options.used.calibration, options.used.average
    calibration_id = None
    if calibration is not None:
        from trackwright.trackers.recordings.input_file import identity

        calibration_id = identity(calibration)
    content = compared.content() | tuned_content(fitted.named.name, objective, result, intervals, calibration_id)
    write_tuned(out / "tuned.toml", content)
    drawn = _write_trace(out, result, objective, unit, file_format(options.figures))
    issues, cautions = list[IdentifiabilityIssue](), without_intervals(result.uncertainty, intervals)
    if result.uncertainty is not None:
        gradients, cautions = result.evaluation.term_gradients, [*result.cautions, *cautions]
        issues = identifiability_issues(result.uncertainty, gradients, bool(data.held_out))
    command = shlex.join(["trackwright", *sys.argv[1:]])
    use = f"trackwright track … --noise {out / 'tuned.toml'}"
    use += "" if calibration is None else f" --calibration {calibration}"
    use += "" if average is None else f" --average {average:g}"
    written = ["trace.csv", *drawn, "manifest.json"]
    if options.figures != "none":
        written.insert(0, "report.html")
        known = collect(result, fitted.reported, objective, intervals, issues)
        notes = [*_notes(data, result, fitted.reported), *known.notes]
        known = replace(
            known,
            training=recording_names(data.training),
            commands=(use, command),
            tracker=fitted.named.name,
            tracker_about=spec_of(fitted.named.name).about,
            seconds=seconds,
            compared=compared,
            plans=plans,
            cautions=tuple(cautions),
            notes=tuple(notes),
        )
        write_page(out / "report.html", tuning_page(known))
    extra = {"recordings": [str(p) for p in recordings], "filter_runs": result.filter_runs}
    write_manifest(out, sys.argv, options.config("resume", "check"), started, extra=extra)
    print(table(result, objective, intervals))
    for text in (*(issue.text for issue in issues), *cautions):
        print(f"notice: {text}")
    print(compared.text(), end="")
    print(f"wrote {out / 'tuned.toml'}, {', '.join(written)}; use it: {use}")
    return content


def _notes(data: FitData, result: FitResult, reported: FitData) -> Iterator[str]:
    if len(reported.training) < len(data.training):
        shown, total = (len(recording_names(part.training)) for part in (reported, data))
        yield f"Of the recordings tuned on, {shown} of {total} are shown."
    if result.uncertainty is None:
        yield "The fit was interrupted: the values are the best so far; --resume continues it."
    if result.n_excluded:
        yield f"{result.n_excluded} of {len(data.training)} segments were excluded."


def _write_trace(out: Path, result: FitResult, objective: str, unit: str, figure: str | None) -> list[str]:
    """Writes the table of the steps and, where asked for, its figures; returns the names of these."""
    traces, names = traces_of(result), component_names(result.parameters)
    columns = {objective: traces[0].objective, "gradient_norm": [step.gradient_norm for step in result.trace]}
    columns |= dict(zip(names, traces[0].values.T, strict=True))
    atomic_write(out / "trace.csv", pl.DataFrame(columns).write_csv)
    if figure is None:
        return []
    from trackwright.experiments.pages.charts.drawing import write_charts

    about = {"nll": "negative log-likelihood per measured number (nats)", "rmse": f"RMSE ({unit})"}
    units = [p.example.unit for p in result.parameters for _ in range(p.size)]
    charts = [parameter_chart(traces, k, *named) for k, named in enumerate(zip(names, units, strict=True))]
    return write_charts(out, [objective_chart(traces, about.get(objective, objective)), *charts], figure)


def table(result: FitResult, objective: str, intervals: Mapping[str, Interval]) -> str:
    """A table of the tuned parameters, and a line on the objective before and after."""
    rows = [("tunable", "before", "after", "95 % interval", "unit")]
    for p in tuned_parameters(result, intervals):
        interval = f"{p.low:.4g} to {p.high:.4g}" if np.isfinite(p.low) else "-"
        rows.append((p.name, f"{p.before:.4g}", f"{p.after:.4g}", interval, "" if p.unit == "1" else p.unit))
    return f"{aligned(rows)}\n{objective}: {result.start_value:.5g} -> {result.value:.5g}"
