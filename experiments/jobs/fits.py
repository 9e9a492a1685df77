"""Fits as `tune` makes them: with a checkpoint after every step, cross-fitted calibrations, recordings left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.recordings.calibration import Calibration
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.tuning import checkpoint
from trackwright.tuning.calibrating import by_halves, by_others
from trackwright.tuning.data import FitData
from trackwright.tuning.fitting import FitOptions, FitResult, Progress, fit, left_out_blocks, left_out_values
from trackwright.tuning.optimisation import FitState
from trackwright.tuning.parameters import flatten, parse_bounds, require_start_within, select_parameters


def checked_bounds(
    data: FitData, tune: Sequence[str], freeze: Sequence[str], bound: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """The bounds in texts, for the tunables that patterns select; raises UnusableInput where they do not fit."""
    option = " ".join(["--tune", *tune, *(["--freeze"] * bool(freeze)), *freeze])
    try:
        parameters = select_parameters(data.tracker, tune, freeze)
        option = f"--bound {' '.join(bound)}"
        bounds = parse_bounds(bound)
        require_start_within(parameters, bounds)
    except ValueError as error:
        raise UnusableInput(f"{option}: {error}") from error
    return bounds


def kept_fit(
    data: FitData,
    tune: Sequence[str],
    options: FitOptions,
    progress: Progress,
    folder: Path,
    config: Mapping[str, Any],
    resume: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> FitResult:
    """As `fit`, with a checkpoint in `folder` after every step.

    `config`: what the fit depends on beside its data. `resume`: go on from the checkpoint, of the same fit. Raises
    UnusableInput for another fit's, and where the objective or all gradients are not finite.
    """
    training = data.batches()
    start = flatten(select_parameters(data.tracker, "*", thresholds=True))
    fingerprint = checkpoint.fingerprint(config, [*training, *data.batches(held_out=True)], start)
    saved = checkpoint.load(folder, fingerprint) if resume else None
    if resume and saved is None:
        say(f"{folder}: no checkpoint found; the fit starts from the beginning")

    def keep(state: FitState) -> None:
        checkpoint.save(folder, checkpoint.to_arrays(state), fingerprint)
        progress.report(state)

    try:
        result = fit(data.tracker, data, data.objective, tune, options, replace(progress, resume=saved, report=keep))
    except FloatingPointError as error:
        raise UnusableInput(f"{error}; run `trackwright check` on the recordings") from error
    if result.n_excluded == len(data.training):
        words = "has finite gradients: repeated identical readings drive the noise to zero; give --bound"
        raise UnusableInput(f"at the best point ({data.named} {result.value:.4g}) no segment {words}")
    if result.n_excluded:
        why = "non-finite likelihood, or gradients over 1000 x the median"
        say(f"{result.n_excluded} of {len(data.training)} segments were excluded: {why}")
    return result


def cross_fitted(
    folders: Sequence[RecordingFolder], calibration: Calibration
) -> tuple[list[list[RecordingFolder]], list[str]]:
    """For each recording, itself, or what a fit takes in its place where `calibration` is from it; and notices.

    These are calibrated on the others among them, or, if there are none, each half on the other half: a fit with the
    calibration itself would see smaller errors than new recordings have.
    """
    seen = [folder for folder in folders if folder.name in calibration.recordings]
    parts, lines = [], list[str]()
    for folder in folders:
        of_folder, path = [folder], folder.path or folder.name
        try:
            if folder in seen and len(seen) > 1:
                of_folder = [by_others(folder, seen)]
                others = listed(other.name for other in seen if other is not folder)
                lines.append(f"{path}: for the fit calibrated on {others}, instead of by the calibration given")
            elif folder in seen:
                of_folder = by_halves(folder)
                lines.append(f"{path}: for the fit each half calibrated on the other half, not by the one given")
        except (UnusableInput, KeyError) as error:
            lines.append(f"{path}: not cross-fitted ({error}): noise levels fitted to it are too small for others")
        parts.append(of_folder)
    return [[_spread_of(calibration, part) for part in of_folder] for of_folder in parts], lines


def _spread_of(whole: Calibration, part: RecordingFolder) -> RecordingFolder:
    """The recording with the spread of the ranges of a calibration."""
    if part.calibration is None:
        return part
    return replace(part, calibration=replace(part.calibration, range_spread=whole.range_spread))


def with_fitted(named: NamedTracker, result: FitResult, values: Mapping[str, np.ndarray] | None = None) -> NamedTracker:
    """The tracker with the fitted values, or with others by label."""
    numbers = result.values if values is None else values
    by_name = {name: numbers[p.label] for p in result.parameters for name in p.names}
    return named.with_values(by_name, "the fit")


def left_out_estimates(
    result: FitResult, data: FitData, named: NamedTracker, folders: Sequence[RecordingFolder], before: pl.DataFrame
) -> tuple[pl.DataFrame, str]:
    """The estimates of recordings with values fitted without them, and how, in words; empty where the fit has seen
    their truth, whose estimates have the fitted values.

    `before`: their estimates before the fit, by whose rows blocks of time are cut: a fitted latency moves times.
    """
    parts, words = list[tuple[Mapping[str, np.ndarray], pl.Expr]](), ", whose truth the fit has not seen"
    if data.held_out:
        pass
    # All are tracked with the values of each fold, by the one program that is compiled for them.
    elif left_out := left_out_values(result):
        words = ", each with values fitted to the others"
        values_of = {folder.name: left_out.get(folder.name, result.values) for folder in folders}
        for values in {id(values): values for values in values_of.values()}.values():
            names = [name for name, other in values_of.items() if other is values]
            parts.append((values, pl.col("recording").is_in(names)))
    elif blocks := left_out_blocks(result, data):
        words = f", each of {len(blocks)} blocks of time with values fitted without its truth"
        starts = [-np.inf, *(start for start, _, _ in blocks[1:]), np.inf]
        for (start, stop), (_, _, values) in zip(pairwise(starts), blocks, strict=True):
            parts.append((values, pl.col("t_s").is_between(start, stop, "left")))
    elif data.objective.needs_truth:
        words = ""
    if not parts:
        return with_fitted(named, result).run(folders).table, words
    tables = [
        with_fitted(named, result, values)
        .run(folders)
        .table.with_row_index("row")
        .filter(before.select(own).to_series())
        for values, own in parts
    ]
    return pl.concat(tables).sort("row").drop("row"), words
