"""The end of `trackwright tune`: recordings before and after, what is refused, and all files but the checkpoint."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.cli.console import FoldersInTurn
from trackwright.experiments.cli.options import TuneOptions
from trackwright.experiments.cli.runtime import write_manifest
from trackwright.experiments.cli.tuning_job import Fitted, cross_calibrated, fit_folders, fit_workers
from trackwright.experiments.pages.charts.tuning import tuning_trace
from trackwright.experiments.pages.reports.before_after import (
    MOST_PLANS,
    Compared,
    TrackChanges,
    compare,
    track_changes,
    tracked,
)
from trackwright.experiments.pages.reports.tuning import write_tuning_report
from trackwright.experiments.pages.reports.tuning_data import collect, recording_names
from trackwright.experiments.text.tables import aligned
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.tuning.data import FitData
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.identifiability import IdentifiabilityIssue, identifiability_issues
from trackwright.tuning.intervals import Interval, intervals_of, left_out_values, without_intervals
from trackwright.tuning.tuned_file import tuned_content, write_tuned

INTERRUPTED = 130
"""The exit code of a command that Ctrl-C ended, as shells have it."""

REFUSED = 1
"""The exit code where the values of a fit are not written."""


def tune_folders(
    folders: list[RecordingFolder] | FoldersInTurn,
    recordings: Sequence[Path],
    options: TuneOptions,
    started: datetime,
    clock: float,
    begin: Begin,
) -> tuple[int, dict[str, Any]]:
    """Fits to the first folders, those of `recordings`, writes all files and prints the table.

    Returns the exit code, and the content of tuned.toml. With the code `REFUSED` that file is not written, and the
    content has the reason as `refused`. `started`, `clock`: when the command began. `begin`: of a stage.
    """
    count = len(recordings)
    if options.used.calibration is not None and not isinstance(folders, FoldersInTurn):
        parts = cross_calibrated(folders, options.used.calibration)
        count, folders = sum(map(len, parts[:count])), [part for of_folder in parts for part in of_folder]
    with fit_workers(options.cluster, options.out) as workers:
        fitted = fit_folders(folders, count, options, begin, workers)
        result, held_out = fitted.result, bool(fitted.data.held_out)
        names = {name for name in result.recordings if name}
        if len(names) > 1 and not held_out:
            begin(f"leaving out each of {len(names)} recordings")
        left_out = {} if held_out else left_out_values(result)
        begin("comparing before and after")
        compared, plans = _compared(fitted, left_out, not options.no_report)
        begin("report")
        reasons = [] if options.force else refusals(result, compared, held_out)
        refused = f"{options.out / 'tuned.toml'} is not written: {in_words(reasons)}" if reasons else ""
        content = _write_run(fitted, recordings, time.perf_counter() - clock, started, compared, plans, refused)
    if refused:
        notice(refused)
        return REFUSED, content | {"refused": refused}
    if result.uncertainty is None:
        notice("stopped: tuned.toml holds the best values so far; continue with the same command and --resume")
        return INTERRUPTED, content
    return 0, content


def _compared(
    fitted: Fitted, left_out: Mapping[str, Mapping[str, np.ndarray]], report: bool
) -> tuple[Compared, TrackChanges | None]:
    """The recordings shown, tracked with the values before and after the fit; `report`: with plans, of others too.

    `left_out`: by recording, the values fitted to the others, with which the table shows it.
    """
    result = fitted.result

    def named(values: Mapping[str, np.ndarray]) -> NamedTracker:
        by_name = {name: values[p.label] for p in result.parameters for name in p.names}
        return fitted.named.with_values(by_name, "the fit")

    room = max(MOST_PLANS - len(fitted.shown), 0) if report else 0
    folders = [*fitted.shown, *fitted.others[:room]]
    before, after = (tracked(side, folders) for side in (fitted.named, named(result.values)))
    others = [tracked(named(left_out.get(folder.name, result.values)), [folder]) for folder in fitted.shown if left_out]
    count = len({trajectory.folder.name for trajectory in fitted.data.training})
    part = f"{len(fitted.shown)} of {count} " if len(fitted.shown) < count else ""
    about = "held-out recordings" if fitted.data.held_out else f"{part}recordings tuned on"
    about += ", each with values fitted to the others" if left_out else ""
    held_out = {folder.name for folder in fitted.shown} if fitted.data.held_out else set()
    plans = track_changes(before, after, folders, held_out) if report else None
    judged = Association.joined(others) if left_out else after
    return compare((before, judged), fitted.shown, fitted.data.dimensions, about), plans


def _write_run(
    fitted: Fitted,
    recordings: Sequence[Path],
    seconds: float,
    started: datetime,
    compared: Compared,
    plans: TrackChanges | None,
    refused: str,
) -> dict[str, Any]:
    """Writes all files to the folder, prints what they show, and returns the content of tuned.toml.

    `seconds`: that the command took. `plans`: the tracks before and after. `refused`: why tuned.toml is not written;
    empty where it is.
    """
    options, data, result, out = fitted.options, fitted.data, fitted.result, fitted.options.out
    objective, unit = str(options.objective), "rad" if data.training[0].station else "m"
    if options.prior:
        objective += " + prior"
    intervals = intervals_of(result, options.intervals)
    calibration, average = options.used.calibration, options.used.average
    calibration_id = None
    if calibration is not None:
        from trackwright.trackers.recordings.input_file import identity

        calibration_id = identity(calibration)
    content = tuned_content(fitted.named.name, objective, result, intervals, calibration_id)
    if refused:
        (out / "tuned.toml").unlink(missing_ok=True)
    else:
        write_tuned(out / "tuned.toml", content)
    figures = None if options.no_figures else options.format
    _write_trace(out, result, objective, unit, figures)
    issues, cautions = list[IdentifiabilityIssue](), without_intervals(result.uncertainty, intervals)
    if result.uncertainty is not None:
        gradients, cautions = result.evaluation.term_gradients, [*result.cautions, *cautions]
        issues = identifiability_issues(result.uncertainty, gradients, bool(data.held_out))
    command = shlex.join(["trackwright", *sys.argv[1:]])
    use = f"trackwright track … --noise {out / 'tuned.toml'}"
    use += "" if calibration is None else f" --calibration {calibration}"
    use += "" if average is None else f" --average {average:g}"
    written = ["trace.csv", "manifest.json"]
    if figures is not None:
        written.insert(1, f"tuning.{figures}")
    if not options.no_report:
        written.insert(0, "report.html")
        known = collect(result, fitted.reported, objective, intervals, issues)
        notes = [*([refused] if refused else []), *_notes(data, result, fitted.reported), *known.notes]
        known = replace(
            known,
            training=recording_names(data.training),
            command=command,
            next_commands=(f"{command} --force" if refused else use, command),
            tracker=fitted.named.name,
            tracker_about=spec_of(fitted.named.name).about,
            seconds=seconds,
            compared=compared,
            plans=plans,
            cautions=tuple(cautions),
            notes=tuple(notes),
        )
        write_tuning_report(out / "report.html", known)
    extra = {"recordings": [str(p) for p in recordings], "filter_runs": result.filter_runs}
    write_manifest(out, sys.argv, options.config("resume"), started, extra=extra)
    print(table(result, objective, intervals))
    for text in (*(issue.text for issue in issues), *cautions):
        print(f"notice: {text}")
    print(compared.text(), end="")
    files = ", ".join(written)
    print(f"wrote {out}: {files}" if refused else f"wrote {out / 'tuned.toml'}, {files}; use it: {use}")
    return content


def _notes(data: FitData, result: FitResult, reported: FitData) -> Iterator[str]:
    if len(reported.training) < len(data.training):
        shown, total = (len(recording_names(part.training)) for part in (reported, data))
        yield f"What is shown of the recordings tuned on is that of {shown} of all {total}."
    if result.uncertainty is None:
        yield "The fit was interrupted: the values are the best so far; --resume continues it."
    if result.n_excluded:
        yield f"{result.n_excluded} of {len(data.training)} segments were excluded."


def _write_trace(out: Path, result: FitResult, objective: str, unit: str, figure: str | None) -> None:
    trace = result.trace
    columns: dict[str, list[float]] = {
        objective: [s.value for s in trace],
        "gradient_norm": [s.gradient_norm for s in trace],
    }
    units: dict[str, str] = {}
    drawn: dict[str, np.ndarray] = {}
    for parameter in result.parameters:
        values = np.stack([np.asarray(s.values[parameter.label]) for s in trace])
        parts = values.reshape(len(trace), -1)
        for k in range(parts.shape[1]):
            label = parameter.label + (f".{k}" if values.ndim > 1 else "")
            columns[label] = parts[:, k].tolist()
            drawn[label], units[label] = parts[:, k], parameter.example.unit
    atomic_write(out / "trace.csv", pl.DataFrame(columns).write_csv)
    if figure is None:
        return
    names = {"nll": "negative log-likelihood per measured number (nats)", "rmse": f"RMSE ({unit})"}
    tuning_trace(out / f"tuning.{figure}", np.array(columns[objective]), drawn, units, names.get(objective, objective))


def table(result: FitResult, objective: str, intervals: Mapping[str, Interval]) -> str:
    """A table of the tuned parameters, and a line on the objective before and after."""
    first = result.starts[0][0].values
    rows: list[tuple[str, ...]] = [("tunable", "before", "after", "95 % interval", "unit")]
    for parameter in result.parameters:
        name, unit = parameter.label, "" if parameter.example.unit == "1" else parameter.example.unit
        nothing = np.full(np.shape(result.values[name]), np.nan)
        low, high = intervals.get(name, (nothing, nothing))
        parts = zip(*(np.ravel(x) for x in (first[name], result.values[name], low, high)), strict=True)
        for k, (before, after, a, b) in enumerate(parts):
            label = name if np.ndim(result.values[name]) == 0 else f"{name}.{k}"
            interval = f"{a:.4g} to {b:.4g}" if np.isfinite([a, b]).all() else "-"
            rows.append((label, f"{before:.4g}", f"{after:.4g}", interval, unit))
    return f"{aligned(rows)}\n{objective}: {result.start_value:.5g} -> {result.value:.5g}"


class Refusal(NamedTuple):
    """What is wrong with the values of a fit, in a clause, and the usual fix."""

    text: str
    fix: str


def refusals(result: FitResult, compared: Compared, held_out: bool) -> list[Refusal]:
    """The reasons not to use the values; none for a fit that was interrupted, of which the user knows."""
    if result.uncertainty is None:
        return []
    reasons = [Refusal(text, "--freeze it or --bound it, or --average repeats") for text in result.collapsed]
    if not (held_out or result.at_optimum):
        reasons.append(Refusal("the fit ended before its optimum", "more --steps or --starts"))
    return reasons + [Refusal(text, "--tune fewer numbers, or more recordings") for text in compared.worse]


def in_words(reasons: Sequence[Refusal]) -> str:
    """All reasons and what to do, in one line."""
    fixes = dict.fromkeys(reason.fix for reason in reasons)
    texts = "; ".join(reason.text for reason in reasons)
    return f"{texts}. Usual fix: {', or '.join(fixes)}; --force writes it all the same"
