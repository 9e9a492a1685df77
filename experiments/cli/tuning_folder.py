"""The files of a tuning run: tuned.toml, trace.csv, tuning.png (or .pdf), report.html and manifest.json."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from experiments.cli.manifest import write_manifest
from experiments.cli.tuning_refusals import in_words, refusals
from experiments.pages.plots.objective import tuning_trace
from experiments.pages.reports.recordings_compared import Compared
from experiments.pages.reports.tracks_compared import TrackChanges
from experiments.pages.reports.tuning import write_tuning_report
from experiments.pages.reports.tuning_collect import Request, collect, recording_names
from experiments.text.tables import aligned
from trackers.catalogue import spec_of
from trackers.recordings.atomic import atomic_write
from trackers.recordings.calibration_file import identity
from tuning import FitResult
from tuning.data import FitData
from tuning.identifiability import IdentifiabilityIssue, identifiability_issues
from tuning.intervals import Interval, intervals_of
from tuning.tuned_file import tuned_content, write_tuned


@dataclass(frozen=True)
class Run:
    """A finished run: the tracker's name, the options, the recordings' folders, when it started, how long it took.

    `figures`: their ending, None for none. `report`: whether it is written.
    """

    tracker: str
    options: Mapping[str, Any]
    recordings: Sequence[Path]
    seconds: float
    started: datetime
    command: Sequence[str]
    figures: str | None
    report: bool


class Written(NamedTuple):
    """The lines to print, the content of tuned.toml, and why that file was not written, empty where it was."""

    lines: list[str]
    content: dict[str, Any]
    refused: str


def write_run(
    out: Path,
    data: FitData,
    result: FitResult,
    run: Run,
    compared: Compared,
    plans: TrackChanges | None,
    reported: FitData,
) -> Written:
    """Writes all files to the folder, tuned.toml only without `refusals` or with the option `force`.

    `plans`: the tracks before and after. `reported`: the data that the report looks at, or a part of them.
    """
    objective, unit = run.options["objective"], "rad" if data.training[0].station else "m"
    if run.options["prior"]:
        objective += " + prior"
    intervals = intervals_of(result, run.options["intervals"])
    calibration = run.options["calibration"]
    found = None if calibration is None else identity(calibration)
    content = tuned_content(run.tracker, objective, result, intervals, found)
    reasons = [] if run.options["force"] else refusals(result, compared, bool(data.held_out))
    refused = f"{out / 'tuned.toml'} is not written: {in_words(reasons)}" if reasons else ""
    if refused:
        (out / "tuned.toml").unlink(missing_ok=True)
    else:
        write_tuned(out / "tuned.toml", content)
    _write_trace(out, result, objective, unit, run.figures)
    issues = _issues(result, bool(data.held_out))
    cautions = [] if result.uncertainty is None else result.cautions
    notices = [f"notice: {text}" for text in (*(issue.text for issue in issues), *cautions)]
    lines = [*table(result, objective, intervals), *notices, compared.text().rstrip("\n")]
    command = shlex.join(["trackwright", *run.command[1:]])
    use = f"trackwright track … --noise {out / 'tuned.toml'}"
    use += "" if calibration is None else f" --calibration {calibration}"
    use += "" if run.options["average"] is None else f" --average {run.options['average']:g}"
    request = Request(
        command=command,
        next_commands=(f"{command} --force" if refused else use, command),
        tracker=run.tracker,
        tracker_about=spec_of(run.tracker).about,
        objective=objective,
        seconds=run.seconds,
        notes=(*([refused] if refused else []), *_notes(data, result, reported)),
    )
    written = ["trace.csv", "manifest.json"]
    if run.figures is not None:
        written.insert(1, f"tuning.{run.figures}")
    if run.report:
        written.insert(0, "report.html")
        known = collect(request, result, reported, intervals, issues, compared, plans, cautions)
        write_tuning_report(out / "report.html", replace(known, training=recording_names(data.training)))
    extra = {"recordings": [str(p) for p in run.recordings], "filter_runs": result.filter_runs}
    write_manifest(out, run.command, run.options, run.started, extra=extra)
    files = ", ".join(written)
    last = f"wrote {out}: {files}" if refused else f"wrote {out / 'tuned.toml'}, {files}; use it: {use}"
    return Written([*lines, last], content, refused)


def _notes(data: FitData, result: FitResult, reported: FitData) -> Iterator[str]:
    if len(reported.training) < len(data.training):
        some, every = (len(recording_names(own.training)) for own in (reported, data))
        yield f"What is shown of the recordings tuned on is that of {some} of all {every}."
    if result.uncertainty is None:
        yield "The fit was interrupted: the values are the best so far; --resume continues it."
    if result.n_excluded:
        yield f"{result.n_excluded} of {len(data.training)} segments were excluded."


def _issues(result: FitResult, held_out: bool) -> list[IdentifiabilityIssue]:
    if result.uncertainty is None:
        return []
    return identifiability_issues(result.uncertainty, result.evaluation.term_gradients, held_out)


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


def table(result: FitResult, objective: str, intervals: Mapping[str, Interval]) -> list[str]:
    """The lines of a table of the tuned parameters, and of the objective before and after."""
    first = result.starts[0][0].values
    rows: list[tuple[str, ...]] = [("tunable", "before", "after", "95 % interval", "unit")]
    for parameter in result.parameters:
        name = parameter.label
        nothing = np.full(np.shape(result.values[name]), np.nan)
        low, high = intervals.get(name, (nothing, nothing))
        parts = zip(*(np.ravel(x) for x in (first[name], result.values[name], low, high)), strict=True)
        for k, (before, after, a, b) in enumerate(parts):
            label = name if np.ndim(result.values[name]) == 0 else f"{name}.{k}"
            interval = f"{a:.4g} to {b:.4g}" if np.isfinite([a, b]).all() else "-"
            rows.append((label, f"{before:.4g}", f"{after:.4g}", interval, parameter.example.unit))
    return [*aligned(rows).splitlines(), f"{objective}: {result.start_value:.5g} -> {result.value:.5g}"]
