"""The tracker, bounds and priors that the options of `tune` and `sweep` describe."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.cli.console import notice, notice_unused_calibration
from trackers.catalogue import build, fitting
from trackers.core.errors import UnusableInput
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.named_tracker import NamedTracker
from tuning.data import FitData
from tuning.parameters import parse_bounds, require_start_within, select_parameters
from tuning.priors import Prior, parse_prior, require_fitting
from tuning.tuned_file import read_tuned


def tracker_for_folders(
    folders: Sequence[RecordingFolder], tracker: str | None, noise: Path | None, free_height: bool
) -> NamedTracker:
    """The tracker, named or chosen by the tables, with the values of a tuned.toml."""
    name = tracker or fitting(folders[0])
    if tracker is None:
        notice(f"tracker: {name}; choose another with --tracker")
    named = build(name, folders, free_height)
    notice_unused_calibration(folders, name, named.spec.table)
    return named if noise is None else named.with_values(read_tuned(noise), noise)


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
        require_fitting(priors, parameters, data.objective.is_likelihood and not data.objective.tempered)
    except ValueError as error:
        raise UnusableInput(f"{option}: {error}") from error
    return bounds, priors
