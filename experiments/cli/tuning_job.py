"""What `trackwright tune` does with recordings that were read: tracker and data, here or on a cluster, and the fit."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from trackwright.experiments.cli.console import FoldersInTurn, notice_unused_calibration, output_folder
from trackwright.experiments.cli.options import TrackerOptions, TuneOptions
from trackwright.experiments.cli.tracking import mirror_lines
from trackwright.experiments.pages.reports.before_after import MOST_PLANS
from trackwright.experiments.pages.reports.tuning import recording_names
from trackwright.experiments.text.terminal import Advance, Begin, notice
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.tunable import tunables
from trackwright.trackers.recordings.folder import RecordingFolder, refuse_same_names
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.recordings.trajectories import Trajectory, mapped
from trackwright.tuning import checkpoint
from trackwright.tuning.batches import Weigh
from trackwright.tuning.data import FitData, fit_data, fit_segments, judged_dimensions, segments_data
from trackwright.tuning.fitting import FitOptions, FitResult, Place, fit
from trackwright.tuning.guessing import first_guess
from trackwright.tuning.identifiability import cautions
from trackwright.tuning.optimisation import FitState
from trackwright.tuning.optimisers import LBFGS, Adam
from trackwright.tuning.parameters import (
    Parameter,
    flatten,
    parse_bounds,
    require_start_within,
    select_parameters,
    tuned_by_default,
)
from trackwright.tuning.parts import Keep, LocalParts

# What a cluster or a calibration needs is imported where one is given.
if TYPE_CHECKING:
    from trackwright.experiments.jobs.held_parts import FitWorkers
    from trackwright.trackers.recordings.calibration import Calibration

PARTS = ".tune-parts"  # the folder of the rows, within the results', while the command runs


@dataclass(frozen=True)
class Fitted:
    """A finished fit. `reported`: what the report is made of, on a cluster a part of the data. `shown`: the recordings
    whose errors are shown: those held out, or else those fitted to; `others`: those fitted to if some were held out."""

    options: TuneOptions
    named: NamedTracker
    data: FitData
    result: FitResult
    reported: FitData
    shown: Sequence[RecordingFolder]
    others: Sequence[RecordingFolder]


def fit_folders(
    folders: list[RecordingFolder] | FoldersInTurn, count: int, options: TuneOptions, begin: Begin,
    workers: FitWorkers | None = None,
) -> Fitted:  # fmt: skip
    """Fits the tracker to the first `count` recordings, the others held out; with `workers`, which hold the rows."""
    first = folders if workers is None else folders[:1]
    named = tracker_for_folders(first, options)
    for line in mirror_lines(named, first):
        notice(f"notice: {line}")
    goal = options.objective
    how = (options.piece_rows, options.dimensions, options.weigh)
    if workers is None:
        data = fit_data(named.only_batch(folders), goal, folders[count:], *how)
    else:
        data = data_in_turn(named, folders, count, workers.folder, goal, *how)
    by_default = goal is None
    tune = options.tune
    tune = tuned_by_default(data.tracker, data.objective.needs_truth) if tune is None else tune
    options = replace(options, tracker=named.name, objective=data.named, tune=tune)
    parameters, bounds = checked_options(data, tune, options)
    for text in cautions(data.tracker, parameters, data.objective):
        notice(f"notice: {text}")
    output_folder(options.out)
    keep: Keep = LocalParts
    if workers is not None:
        from trackwright.experiments.jobs.held_parts import HeldParts

        keep = partial(HeldParts, workers, named)
    result = _fitted(data, parameters, options, bounds, begin, by_default, keep)
    if not isinstance(folders, FoldersInTurn):
        shown, others = (folders[count:], folders[:count]) if folders[count:] else (folders, [])
        return Fitted(options, named, data, result, data, shown, others)
    some = reported(data)
    fitted_to, apart = (folders.named(recording_names(part)) for part in (some.training, some.held_out))
    shown, others = (apart, fitted_to) if apart else (fitted_to, [])
    return Fitted(options, named, data, result, some, shown, others)


def tracker_for_folders(folders: Sequence[RecordingFolder], options: TrackerOptions) -> NamedTracker:
    """The tracker, named, of the options' file or chosen by the tables, with the values of the file and of `--set`."""
    of_file = None if options.tuned is None else options.tuned.tracker
    name = options.tracker or of_file or fitting(folders[0])
    if options.tracker is None:
        notice(f"tracker: {name}{f', by {options.file}' if of_file else ''}; choose another with --tracker")
    named = build(name, folders, options.free_height, options.side)
    notice_unused_calibration(folders, name, named.spec.table)
    return options.valued(named)


def checked_options(
    data: FitData, tune: Sequence[str], options: TuneOptions
) -> tuple[list[Parameter], dict[str, tuple[float, float]]]:
    """Parameters and bounds of the options; raises UnusableInput where the tracker's tunables don't fit."""
    freeze, bound = options.freeze, options.bound
    option = f"--tune {' '.join(tune)}" + (f" --freeze {' '.join(freeze)}" if freeze else "")
    try:
        parameters = select_parameters(data.tracker, tune, freeze)
        option = f"--bound {' '.join(bound)}"
        bounds = parse_bounds(bound)
        require_start_within(parameters, bounds)
    except ValueError as error:
        raise UnusableInput(f"{option}: {error}") from error
    return parameters, bounds


@contextmanager
def fit_workers(cluster: str | None, out: Path) -> Iterator[FitWorkers | None]:
    """The workers of a cluster with the folder of their files, emptied first; None for no cluster."""
    if cluster is None:
        yield None
        return
    from trackwright.experiments.jobs.executors import cluster_client
    from trackwright.experiments.jobs.held_parts import FitWorkers

    folder = output_folder(out) / PARTS
    shutil.rmtree(folder, ignore_errors=True)
    try:
        with cluster_client(cluster) as (client, expected):
            yield FitWorkers(client, expected, output_folder(folder))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):
            out.rmdir()  # if nothing was written


def data_in_turn(
    named: NamedTracker, folders: Sequence[RecordingFolder], count: int, place: Path, objective: str | None,
    segment_rows: int, dimensions: int | None, weigh: Weigh,
) -> FitData:  # fmt: skip
    """As `fit_data` of the first `count` recordings, the others held out; the rows are in files in the folder `place`.
    Raises UnusableInput as that, and where the recordings need several trackers."""
    names, trajectories = list[str](), list[Trajectory]()
    batch: TrackerBatch | None = None

    def each() -> Iterator[RecordingFolder]:
        for folder in folders:
            names.append(folder.name)
            yield folder

    for batch in named.batch_by_batch(each()):
        dimensions = dimensions or judged_dimensions(batch, objective)
        segments = fit_segments(batch, segment_rows, dimensions)
        trajectories += mapped(segments, place / f"rows-{len(names)}")
    refuse_same_names(names)
    if batch is None:
        raise UnusableInput(f"tracker '{named.name}': no trajectory in the recordings; expected one tag at least")
    joined = replace(batch, tracker=named.tracker, trajectories=trajectories)
    return segments_data(joined, objective, set(names[count:]), dimensions or 2, weigh, stacked=False)


def reported(data: FitData) -> FitData:
    """The data of at most `MOST_PLANS` recordings tuned on, and of all held out: what a report is made of here."""
    names = list(dict.fromkeys(trajectory.folder.name for trajectory in data.training))[:MOST_PLANS]
    return replace(data, training=[segment for segment in data.training if segment.folder.name in names], stacked=True)


def cross_calibrated(folders: Sequence[RecordingFolder], file: Path) -> list[list[RecordingFolder]]:
    """For each recording, itself, or what a fit takes in its place where the calibration `file` is from it.
    These are calibrated on the others among them, or, if there are none, each half on the other half: a fit with the
    file's calibration would see smaller errors than new recordings have."""
    from trackwright.trackers.recordings.calibration import read_calibration

    whole = read_calibration(file)
    seen = [folder for folder in folders if folder.name in whole.recordings]
    parts = [_without_itself(folder, seen, file) if folder in seen else [folder] for folder in folders]
    if seen and whole.bearing_map is not None:
        # Each recording would have a map, and a tracker, of its own.
        notice(f"notice: {file}: for the fit without its map of bearings, which has seen {seen[0].name}")
        whole = replace(whole, bearing_map=None)
    return [[_spread_of(whole, part) for part in of_folder] for of_folder in parts]


def _spread_of(whole: Calibration, part: RecordingFolder) -> RecordingFolder:
    """The recording with the file's spreads; a map of bearings only where it has one."""
    if part.calibration is None:
        return part
    differences = replace(part.calibration.differences, spread=whole.differences.spread)
    by_place = None if whole.bearing_map is None else part.calibration.bearing_map
    own = replace(part.calibration, range_spread=whole.range_spread, differences=differences)
    return replace(part, calibration=replace(own, bearing_map=by_place))


def _without_itself(folder: RecordingFolder, seen: Sequence[RecordingFolder], file: Path) -> list[RecordingFolder]:
    """The recording calibrated on the others of `seen`, or its halves; as it is, with a notice, without truth."""
    from trackwright.tuning.calibrating import by_halves, by_others

    path = folder.path or folder.name
    try:
        if len(seen) > 1:
            calibrated = [by_others(folder, seen)]
            how = f"calibrated on {listed(other.name for other in seen if other is not folder)}"
        else:
            calibrated, how = by_halves(folder), "each half calibrated on the other half"
    except (UnusableInput, KeyError) as error:
        notice(f"notice: {path}: not cross-fitted ({error}): noise levels fitted to it are too small for others")
        return [folder]
    notice(f"notice: {path}: for the fit {how}, instead of by {file}")
    return calibrated


def _fitted(
    data: FitData, parameters: Sequence[Parameter], options: TuneOptions, bounds: Mapping[str, tuple[float, float]],
    begin: Begin, by_default: bool, keep: Keep,
) -> FitResult:  # fmt: skip
    """The fit, with a checkpoint after every step; raises UnusableInput where the objective is never finite.
    `by_default`: whether the objective was chosen by the data. `keep`: takes the rows to where they are computed."""
    training, held_out = data.batches(), data.batches(held_out=True)
    # The place where a fit is computed does not change it.
    config = {name: value for name, value in options.config("resume").items() if name not in ("cluster", "check")}
    fingerprint = checkpoint.fingerprint(
        config, [*training, *held_out], flatten(select_parameters(data.tracker, "*", thresholds=True))
    )
    saved = checkpoint.load(options.out, fingerprint) if options.resume else None
    if options.resume and saved is None:
        notice(f"notice: {options.out}: no checkpoint found; the fit starts from the beginning")
    if by_default:
        why = "truth" if data.objective.needs_truth else "no truth that the estimates can be judged by"
        notice(f"objective: {data.named}, since there is {why}; choose another with --objective")
    if data.unused:
        notice(f"notice: without truth, and not used: {listed(data.unused)}")
    steps, starts = options.steps, options.starts
    tuned = {name for parameter in parameters for name in parameter.names}
    kept = [name for name in tunables(data.tracker) if name not in tuned]
    begin("searching for starts" if starts > 1 else "first evaluation")
    advance: Advance | None = None

    def keep_step(state: FitState) -> None:
        """Saves the state and advances the bar of the steps, which begins after the first evaluation."""
        nonlocal advance
        checkpoint.save(options.out, checkpoint.to_arrays(state), fingerprint)
        best, number = int(state.best_scores.argmin()), int(state.number)
        first = advance is None
        advance = advance or begin("step", steps)
        now = f"objective {state.best_scores[best]:.5g}, gradient {state.past_norms[-1, best]:.2g}"
        advance(number if first else 1, now)

    try:
        result = fit(
            data.tracker,
            data,
            data.objective,
            options.tune,
            FitOptions(
                frozen=options.freeze,
                bounds=bounds,
                optimiser={"auto": None, "lbfgs": LBFGS(), "adam": Adam(steps)}[options.optimiser],
                steps=steps,
                starts=starts,
                prior=options.prior,
                guesses=[first_guess(data.tracker, training, kept)] if starts > 1 and saved is None else [],
            ),
            Place(keep=keep, resume=saved, report=keep_step, stage=begin),
        )
    except FloatingPointError as error:
        raise UnusableInput(f"{error}; run `trackwright check` on the recordings") from error
    if result.n_excluded == len(data.training):
        words = "has finite gradients: repeated identical readings drive the noise to zero; give --bound"
        raise UnusableInput(f"at the best point ({options.objective} {result.value:.4g}) no segment {words}")
    if result.n_excluded:
        why = "non-finite likelihood, or gradients over 1000 x the median"
        notice(f"notice: {result.n_excluded} of {len(data.training)} segments were excluded: {why}")
    return result
