"""What `trackwright tune` and `sweep` do with recordings that were read: tracker, data, the fit or grid, all files."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import polars as pl

import trackwright as tw
from trackwright.experiments.cli.console import chosen_tracker, notices, output_folder, write_manifest
from trackwright.experiments.cli.options import Numbers, TuneOptions, settings
from trackwright.experiments.pages import tuning as pages
from trackwright.experiments.pages.chart import write
from trackwright.experiments.pages.report import typed, write_page
from trackwright.experiments.text.tables import sections_text
from trackwright.experiments.text.terminal import Advance, Begin, notice
from trackwright.trackers.core.errors import listed
from trackwright.trackers.recordings.files import atomic_write, identity
from trackwright.tuning import checkpoint
from trackwright.tuning.data import FitData, fit_data
from trackwright.tuning.fit_warnings import cautions, without_intervals
from trackwright.tuning.fitting import Progress, fit
from trackwright.tuning.optimisation import FitState
from trackwright.tuning.parameters import (
    component_names,
    flatten,
    parse_bounds,
    require_start_within,
    select_parameters,
    tuned_by_default,
)
from trackwright.tuning.problem import is_stochastic
from trackwright.tuning.sweeping import grid_vectors, swept_parameters
from trackwright.tuning.tuned_file import tuned_content

INTERRUPTED = 130  # the exit code of a command that Ctrl-C ended, as shells have it
REPEATS = 10  # runs of a particle filter per point of a sweep, with different random numbers


def tune_folders(folders: Sequence[tw.RecordingFolder], count: int, options: TuneOptions, begin: Begin) -> int:
    """Fits to the first `count` recordings, the others held out, writes all files and prints the table; exit code."""
    training, held_out = folders[:count], folders[count:]
    named = options.numbers.build(chosen_tracker(folders, options.numbers), [*folders])
    data = fit_data(named.only_batch(folders), options.objective, held_out)
    result = _fit(data, options, begin)
    begin("leaving out recordings")
    compared = pages.compare_left_out(result, data, named, training, held_out)
    begin("report")
    objective = data.named + " + prior" * (options.prior != "flat" and data.objective.is_likelihood)
    intervals, issues, used, out = result.intervals, result.issues, options.used, options.out
    calibrated = None if used.calibration is None else identity(used.calibration)
    content = tuned_content(named.name, objective, result, intervals, calibrated)
    tw.write_tuned(out / "tuned.toml", compared.content() | content)
    components, values = component_names(result.parameters), pages.traces_of(result)[0]
    trace = {objective: values.objective, "gradient_norm": [step.gradient_norm for step in result.trace]}
    trace |= dict(zip(components, values.values.T, strict=True))
    atomic_write(out / "trace.csv", pl.DataFrame(trace).write_csv)
    lines = [] if result.uncertainty is None else [*result.cautions]
    lines += without_intervals(result.uncertainty, intervals)
    use = f"trackwright track … --noise {out / 'tuned.toml'}"
    use += f" --calibration {used.calibration}" * (used.calibration is not None)
    use += "" if used.average is None else f" --average {used.average:g}"
    if options.figures != "none":
        page = pages.tuning_page(
            result, data, objective, compared, intervals, issues, tracker=named.name, cautions=lines,
            commands=(use, typed(sys.argv)),
        )  # fmt: skip
        write_page(out / "report.html", page)
    trained = [str(folder.path) for folder in training]
    write_manifest(out, tracker=named.name, recordings=trained, filter_runs=result.filter_runs)
    print(sections_text([pages.parameters_section(pages.tuned_parameters(result, intervals, issues))], 120), end="")
    print(f"{objective}: {result.start_value:.5g} -> {result.value:.5g}")
    for text in (*(issue.text for issue in issues), *lines):
        print(f"notice: {text}")
    print(compared.text(), end="")
    page = ", report.html" * (options.figures != "none")
    print(f"wrote {out / 'tuned.toml'}{page}, trace.csv, manifest.json; use it: {use}")
    if result.uncertainty is None:
        notice("stopped: tuned.toml holds the best values so far; continue with the same command and --resume")
        return INTERRUPTED
    return 0


def _fit(data: FitData, options: TuneOptions, begin: Begin) -> tw.FitResult:
    """The fit, with a checkpoint in the output folder after every step.

    Raises UnusableInput for another fit's checkpoint, and where the objective or all gradients are not finite.
    """
    if options.objective is None:
        notice(f"objective: {data.named}, by the truth there is; choose another with --objective")
    if data.unused:
        notice(f"notice: without truth, and not used: {listed(data.unused)}")
    tune = options.tune or tuned_by_default(data.tracker, data.objective.needs_truth)
    option = " ".join(["--tune", *tune, *(["--freeze"] * bool(options.freeze)), *options.freeze])
    try:
        parameters = select_parameters(data.tracker, tune, options.freeze)
        option = f"--bound {' '.join(options.bound)}"
        bounds = parse_bounds(options.bound)
        require_start_within(parameters, bounds)
    except ValueError as error:
        raise tw.UnusableInput(f"{option}: {error}") from error
    notices(cautions(data.tracker, parameters, data.objective))
    steps, starts, advance = options.steps, options.starts, list[Advance]()
    begin("searching for starts" if starts > 1 else "first evaluation")
    out, depends = output_folder(options.out), {"options": settings(options, resume=False, figures="page")}
    start = flatten(select_parameters(data.tracker, "*", thresholds=True))
    fingerprint = checkpoint.fingerprint(depends, [*data.rows.batches, *data.rows_apart.batches], start)
    saved = checkpoint.load(out, fingerprint) if options.resume else None
    if options.resume and saved is None:
        notices([f"{out}: no checkpoint found; the fit starts from the beginning"])

    def report(state: FitState) -> None:
        """Keeps the state, and advances the bar of the steps, which begins after the first evaluation."""
        checkpoint.save(out, checkpoint.to_arrays(state), fingerprint)
        best, done = int(state.best_scores.argmin()), 1 if advance else int(state.number)
        advance.extend([] if advance else [begin("step", steps)])
        advance[0](done, f"objective {state.best_scores[best]:.5g}, gradient {state.past_norms[-1, best]:.2g}")

    how = tw.FitOptions(frozen=options.freeze, bounds=bounds, steps=steps, starts=starts, prior=options.prior)
    try:
        progress = Progress(resume=saved, report=report, stage=begin)
        result = fit(data.tracker, data, data.objective, tune, how, progress)
    except FloatingPointError as error:
        raise tw.UnusableInput(f"{error}; run `trackwright check` on the recordings") from error
    if result.n_excluded == len(data.training):
        words = "has finite gradients: repeated identical readings drive the noise to zero; give --bound"
        raise tw.UnusableInput(f"at the best point ({data.named} {result.value:.4g}) no segment {words}")
    if result.n_excluded:
        why = "non-finite likelihood, or gradients over 1000 x the median"
        notices([f"{result.n_excluded} of {len(data.training)} segments were excluded: {why}"])
    return result


def sweep_folders(
    folders: Sequence[tw.RecordingFolder], grids: Mapping[str, np.ndarray], objective: str, numbers: Numbers, out: Path,
    begin: Begin,
) -> None:  # fmt: skip
    """Evaluates the objective on the grid, writes all files and prints the best point."""
    named = numbers.build(chosen_tracker(folders, numbers), [*folders])
    group = named.only_batch(folders)
    data = fit_data(group, objective, dimensions=2)
    try:
        points = grid_vectors(swept_parameters(group.tracker, list(grids)), list(grids.values()))
    except ValueError as error:
        raise tw.UnusableInput(f"--over {' --over '.join(grids)}: {error}") from error
    output_folder(out)
    advance = begin("grid point", len(points) * (REPEATS if is_stochastic(group.tracker) else 1))
    swept = tw.sweep(group.tracker, data.rows.batches, data.objective, grids, REPEATS, advance, data.rows.weights)
    if not np.isfinite(swept.mean).any():
        raise tw.UnusableInput("the objective is not finite at any grid point; see `trackwright check` on recordings")
    atomic_write(out / "sweep.csv", swept.to_polars(objective).write_csv)
    unit = "rad" if group.trajectories[0].station else "m"
    write(pages.sweep_chart(swept, f"RMSE ({unit})" if objective == "rmse" else objective), out / "sweep.png")
    write_manifest(out, tracker=named.name, recordings=[str(folder.path) for folder in folders], best=swept.best)
    print(swept.text(objective, unit if objective == "rmse" else ""))
    print(f"{swept.filter_runs} trajectories filtered; wrote {out / 'sweep.csv'}, sweep.png and manifest.json")
