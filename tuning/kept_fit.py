"""A fit to recordings with a checkpoint after every step, from which it goes on with the same bits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.tunable import tunables
from trackwright.tuning import checkpoint
from trackwright.tuning.data import FitData
from trackwright.tuning.fitting import FitOptions, FitResult, Place, fit
from trackwright.tuning.guessing import first_guess
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
    place: Place,
    folder: Path,
    config: Mapping[str, Any],
    resume: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> FitResult:
    """As `fit`, with a checkpoint in `folder` after every step, and first guesses where there are several starts.

    `config`: what the fit depends on beside its data. `resume`: go on from the checkpoint, of the same fit. Raises
    UnusableInput for another fit's, and where the objective or all gradients are not finite.
    """
    training = data.batches()
    start = flatten(select_parameters(data.tracker, "*", thresholds=True))
    fingerprint = checkpoint.fingerprint(config, [*training, *data.batches(held_out=True)], start)
    saved = checkpoint.load(folder, fingerprint) if resume else None
    if resume and saved is None:
        say(f"{folder}: no checkpoint found; the fit starts from the beginning")
    if options.starts > 1 and saved is None:
        tuned = {
            name for parameter in select_parameters(data.tracker, tune, options.frozen) for name in parameter.names
        }
        kept = [name for name in tunables(data.tracker) if name not in tuned]
        options = replace(options, guesses=[first_guess(data.tracker, training, kept)])

    def keep(state: FitState) -> None:
        checkpoint.save(folder, checkpoint.to_arrays(state), fingerprint)
        place.report(state)

    try:
        result = fit(data.tracker, data, data.objective, tune, options, replace(place, resume=saved, report=keep))
    except FloatingPointError as error:
        raise UnusableInput(f"{error}; run `trackwright check` on the recordings") from error
    if result.n_excluded == len(data.training):
        words = "has finite gradients: repeated identical readings drive the noise to zero; give --bound"
        raise UnusableInput(f"at the best point ({data.named} {result.value:.4g}) no segment {words}")
    if result.n_excluded:
        why = "non-finite likelihood, or gradients over 1000 x the median"
        say(f"{result.n_excluded} of {len(data.training)} segments were excluded: {why}")
    return result
