"""What `trackwright tune` and `sweep` do with recordings that were read: tracker, data, the fit or grid, all files."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import trackwright as tw
from trackwright.experiments.cli import console
from trackwright.experiments.cli.console import Run, notices, output_folder, write_manifest
from trackwright.experiments.cli.options import SweepOptions, TuneOptions, WithNumbers, config, file_format
from trackwright.experiments.jobs.fits import checked_bounds, cross_fitted, kept_fit, left_out_estimates
from trackwright.experiments.pages import tuning as pages
from trackwright.experiments.pages.chart import write
from trackwright.experiments.pages.report import typed, write_page
from trackwright.experiments.text.tables import aligned
from trackwright.experiments.text.terminal import Advance, notice
from trackwright.trackers.catalogue import fitting
from trackwright.trackers.core.errors import listed
from trackwright.trackers.evaluation.cautions import mirror_cautions
from trackwright.trackers.evaluation.evaluate import with_truth
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.input_file import identity
from trackwright.tuning import parameters as numbers
from trackwright.tuning.data import FitData, fit_data
from trackwright.tuning.fitting import Place
from trackwright.tuning.identifiability import cautions, identifiability_issues
from trackwright.tuning.intervals import Interval, intervals_of, without_intervals
from trackwright.tuning.optimisation import FitState
from trackwright.tuning.problem import is_stochastic
from trackwright.tuning.sweeping import grid_vectors, swept_parameters
from trackwright.tuning.tuned_file import tuned_content

INTERRUPTED = 130  # the exit code of a command that Ctrl-C ended, as shells have it


@dataclass(frozen=True)
class Fitted:
    """A finished fit. `shown`: the recordings whose errors are shown: those held out, or else those fitted to."""

    options: TuneOptions
    named: tw.NamedTracker
    data: FitData
    result: tw.FitResult
    shown: Sequence[tw.RecordingFolder]


def tune_folders(folders: Sequence[tw.RecordingFolder], paths: Sequence[Path], options: TuneOptions, run: Run) -> int:
    """Fits to the first recordings, the others held out, writes all files and prints the table; the exit code."""
    count = len(paths) - len(options.held_out)
    calibration = options.used.read_calibration()
    if calibration is not None:
        parts, lines = cross_fitted(folders, calibration)
        notices(lines)
        count, folders = sum(map(len, parts[:count])), [part for of_folder in parts for part in of_folder]
    fitted = fit_folders(folders, count, options, run)
    run.begin("leaving out recordings")
    before = pages.tracked(fitted.named, fitted.shown)
    compared = judged(fitted, before)
    run.begin("report")
    content = _write_run(fitted, paths[: len(paths) - len(options.held_out)], run, compared)
    run.put(content)
    if fitted.result.uncertainty is None:
        notice("stopped: tuned.toml holds the best values so far; continue with the same command and --resume")
        return INTERRUPTED
    return int(options.check and compared.verdict.word == "worse")


def tracker_for_folders(folders: Sequence[tw.RecordingFolder], options: WithNumbers) -> tw.NamedTracker:
    """The tracker, named, of the options' file or chosen by the tables, with the values of the file and of `--set`."""
    name, given = options.named or fitting(folders[0]), options.numbers
    if given.tracker is None:
        notice(f"tracker: {name}{f', by {options.file}' if options.named else ''}; choose another with --tracker")
    named = tw.build(name, folders, given.free_height, given.side)
    console.notice_unused_calibration(folders, name, named.spec.table)
    return options.valued(named)


def fit_folders(folders: Sequence[tw.RecordingFolder], count: int, options: TuneOptions, run: Run) -> Fitted:
    """Fits the tracker to the first `count` recordings, the others held out."""
    named, goal, by_default = tracker_for_folders(folders, options), options.objective, options.objective is None
    notices(mirror_cautions(named, folders))
    how = (options.piece_rows, options.dimensions, options.weigh)
    data = fit_data(named.only_batch(folders), goal, folders[count:], *how)
    tune = options.tune or numbers.tuned_by_default(data.tracker, data.objective.needs_truth)
    options = replace(options, numbers=replace(options.numbers, tracker=named.name), objective=data.named, tune=tune)
    bounds = checked_bounds(data, tune, options.freeze, options.bound)
    parameters = numbers.select_parameters(data.tracker, tune, options.freeze)
    notices(cautions(data.tracker, parameters, data.objective))
    result = _fit(data, options, bounds, run, by_default)
    return Fitted(options, named, data, result, folders[count:] or folders)


def _fit(
    data: FitData, options: TuneOptions, bounds: Mapping[str, tuple[float, float]], run: Run, by_default: bool
) -> tw.FitResult:
    """The fit, with a checkpoint after every step. `by_default`: whether the objective was chosen by the data."""
    if by_default:
        why = "truth" if data.objective.needs_truth else "no truth that the estimates can be judged by"
        notice(f"objective: {data.named}, since there is {why}; choose another with --objective")
    if data.unused:
        notice(f"notice: without truth, and not used: {listed(data.unused)}")
    steps, advance = options.steps, list[Advance]()

    def report(state: FitState) -> None:
        """Advances the bar of the steps, which begins after the first evaluation."""
        best, done = int(state.best_scores.argmin()), 1 if advance else int(state.number)
        advance.extend([] if advance else [run.begin("step", steps)])
        advance[0](done, f"objective {state.best_scores[best]:.5g}, gradient {state.past_norms[-1, best]:.2g}")

    optimiser = {"auto": None, "lbfgs": tw.LBFGS(), "adam": tw.Adam(steps)}[options.optimiser]
    how = tw.FitOptions(
        frozen=options.freeze,
        bounds=bounds,
        optimiser=optimiser,
        steps=steps,
        starts=options.starts,
        prior=options.prior,
    )
    run.begin("searching for starts" if options.starts > 1 else "first evaluation")
    depends, place = config(options, "resume", "check"), Place(report=report, stage=run.begin)
    out, say = output_folder(options.out), lambda line: notices([line])
    return kept_fit(data, options.tune or (), how, place, out, depends, options.resume, say)


def judged(fitted: Fitted, before: pl.DataFrame) -> pages.Compared:
    """The recordings shown, `before` the fit and with values fitted without them, and the verdict."""
    result, data, shown = fitted.result, fitted.data, fitted.shown
    table, about = left_out_estimates(result, data, fitted.named, shown, before)
    why_not = "" if about else "the fit cannot leave a recording or a block of time out"
    if result.uncertainty is None:
        why_not = "the fit was interrupted"
    count = len(pages.recording_names(data.training))
    part = f"{len(shown)} of {count} " if len(shown) < count else ""
    about = "held-out recordings" if data.held_out else f"{part}recording{'s' if count > 1 else ''} tuned on{about}"
    return pages.compare((before, with_truth(table, shown)), shown, data.dimensions, about, why_not)


def _write_run(fitted: Fitted, recordings: Sequence[Path], run: Run, compared: pages.Compared) -> dict[str, Any]:
    """Writes all files, prints what they show, and returns the content of tuned.toml."""
    options, data, result, out = fitted.options, fitted.data, fitted.result, fitted.options.out
    name, uncertainty, used = fitted.named.name, fitted.result.uncertainty, options.used
    objective = data.named
    if options.prior != "flat" and data.objective.is_likelihood:
        objective += " + prior"
    intervals = intervals_of(result)
    calibrated = None if used.calibration is None else identity(used.calibration)
    content = compared.content() | tuned_content(name, objective, result, intervals, calibrated)
    tw.write_tuned(out / "tuned.toml", content)
    drawn = _write_trace(out, result, objective, file_format(options.figures))
    issues, lines = [], without_intervals(uncertainty, intervals)
    if uncertainty is not None:
        issues = identifiability_issues(uncertainty, result.evaluation.term_gradients, bool(data.held_out))
        lines = [*result.cautions, *lines]
    use = f"trackwright track … --noise {out / 'tuned.toml'}"
    use += "" if used.calibration is None else f" --calibration {used.calibration}"
    use += "" if used.average is None else f" --average {used.average:g}"
    written = ["trace.csv", *drawn, "manifest.json"]
    if options.figures != "none":
        written.insert(0, "report.html")
        page = pages.tuning_page(
            result, data, objective, compared, intervals, issues, tracker=name, cautions=lines,
            notes=[*_notes(data, result)], commands=(use, typed(sys.argv)),
        )  # fmt: skip
        write_page(out / "report.html", page)
    about = config(options, "resume", "check")
    write_manifest(
        out, about, run.started, recordings=[str(path) for path in recordings], filter_runs=result.filter_runs
    )
    print(table(result, objective, intervals))
    for text in (*(issue.text for issue in issues), *lines):
        print(f"notice: {text}")
    print(compared.text(), end="")
    print(f"wrote {out / 'tuned.toml'}, {', '.join(written)}; use it: {use}")
    return content


def _notes(data: FitData, result: tw.FitResult) -> Iterator[str]:
    if result.uncertainty is None:
        yield "The fit was interrupted: the values are the best so far; --resume continues it."
    if result.n_excluded:
        yield f"{result.n_excluded} of {len(data.training)} segments were excluded."
    if data.held_out:
        yield "The held-out recordings were used to select the best point and to stop the fit."


def _write_trace(out: Path, result: tw.FitResult, objective: str, figure: str | None) -> list[str]:
    """Writes the table of the steps and, where asked for, its figure; returns the name of that."""
    traces, names = pages.traces_of(result), numbers.component_names(result.parameters)
    columns = {objective: traces[0].objective, "gradient_norm": [step.gradient_norm for step in result.trace]}
    columns |= dict(zip(names, traces[0].values.T, strict=True))
    atomic_write(out / "trace.csv", pl.DataFrame(columns).write_csv)
    if figure is None:
        return []
    from trackwright.experiments.pages.chart import write_charts

    return write_charts(out, [pages.objective_chart(traces, objective)], figure)


def table(result: tw.FitResult, objective: str, intervals: Mapping[str, Interval]) -> str:
    """A table of the tuned parameters, and a line on the objective before and after."""
    rows = [("tunable", "before", "after", "95 % interval", "unit")]
    for p in pages.tuned_parameters(result, intervals):
        interval = f"{p.low:.4g} to {p.high:.4g}" if np.isfinite(p.low) else "-"
        rows.append((p.name, f"{p.before:.4g}", f"{p.after:.4g}", interval, "" if p.unit == "1" else p.unit))
    return f"{aligned(rows)}\n{objective}: {result.start_value:.5g} -> {result.value:.5g}"


def sweep_folders(folders: Sequence[tw.RecordingFolder], options: SweepOptions, run: Run) -> None:
    """Evaluates the objective on the grid, writes all files and prints the best point."""
    objective, grids, out = options.objective, options.grids, options.out
    named = tracker_for_folders(folders, options)
    group = named.only_batch(folders)
    data = fit_data(group, objective, (), dimensions=options.dimensions, weigh=options.weigh)
    try:
        points = grid_vectors(swept_parameters(group.tracker, list(grids)), list(grids.values()))
    except ValueError as error:
        hint = "; start the grid at a small positive value" if "is positive" in str(error) else ""
        raise tw.UnusableInput(f"--over {' --over '.join(options.over)}: {error}{hint}") from error
    output_folder(out)
    advance = run.begin("grid point", len(points) * (options.repeats if is_stochastic(group.tracker) else 1))
    swept = tw.sweep(group.tracker, data.batches(), data.objective, grids, options.repeats, advance, data.weights())
    run.begin("figure")
    if not np.isfinite(swept.mean).any():
        raise tw.UnusableInput(
            "the objective is not finite at any grid point; run `trackwright check` on the recordings"
        )
    atomic_write(out / "sweep.csv", swept.to_polars(objective).write_csv)
    unit = "rad" if group.trajectories[0].station else "m"
    drawn = out / f"sweep.{options.figures}"
    write(pages.sweep_chart(swept, f"RMSE ({unit})" if objective == "rmse" else objective), drawn)
    result = {"best": swept.best, "least": float(swept.mean[swept.best_index]), "filter_runs": swept.filter_runs}
    result["seconds"] = run.seconds
    about = config(options) | {"tracker": named.name}
    write_manifest(out, about, run.started, recordings=[str(folder.path) for folder in folders], **result)
    print(swept.text(objective, unit if objective == "rmse" else ""))
    print(f"{swept.filter_runs} trajectories filtered in {run.seconds:.1f} s")
    print(f"wrote {out / 'sweep.csv'}, {drawn.name} and manifest.json")
    run.put(result)
