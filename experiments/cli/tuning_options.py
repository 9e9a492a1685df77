"""The tracker, bounds and priors that the options of `tune` and `sweep` describe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.cli.console import notice_unused_calibration
from experiments.text.terminal import notice
from trackers.catalogue import build, fitting
from trackers.core.errors import UnusableInput
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.named_tracker import NamedTracker
from tuning.data import FitData
from tuning.parameters import parse_bounds, require_start_within, select_parameters
from tuning.priors import Prior, parse_prior, require_fitting
from tuning.tuned_file import Tuned


def tracker_for_folders(
    folders: Sequence[RecordingFolder],
    tracker: str | None,
    noise: Path | None,
    tuned: Tuned | None,
    values: Mapping[str, Any],
    free_height: bool,
) -> NamedTracker:
    """The tracker, named, of the file `noise` or chosen by the tables, with the file's values and then `values`.

    `tuned`: the content of the file.
    """
    of_file = None if tuned is None else tuned.tracker
    name = tracker or of_file or fitting(folders[0])
    if tracker is None:
        notice(f"tracker: {name}{f', that of {noise}' if of_file else ''}; choose another with --tracker")
    named = build(name, folders, free_height)
    notice_unused_calibration(folders, name, named.spec.table)
    if tuned is not None:
        named = named.with_values(tuned.values, noise)
    return named.with_values(values, "--set") if values else named


def checked_options(
    data: FitData, tune: Sequence[str], freeze: Sequence[str], bound: Sequence[str], prior: Sequence[str]
) -> tuple[dict[str, tuple[float, float]], list[Prior]]:
    """Bounds and priors of the options; raises UnusableInput for those that don't fit the tracker's tunables."""
    option = f"--tune {' '.join(tune)}" + (f" --freeze {' '.join(freeze)}" if freeze else "")
    try:
        parameters = select_parameters(data.tracker, tune, freeze)
        option = f"--bound {' '.join(bound)}"
        bounds = parse_bounds(bound)
        require_start_within(parameters, bounds)
        option = f"--prior {' '.join(prior)}"
        priors = [parse_prior(text) for text in prior]
        require_fitting(priors, parameters, data.objective.is_likelihood)
    except ValueError as error:
        raise UnusableInput(f"{option}: {error}") from error
    return bounds, priors
