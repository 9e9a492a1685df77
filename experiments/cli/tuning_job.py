"""The recordings, tracker and objective of a tuning run, from the options of a command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from experiments.cli.console import notice, read_with_notices
from trackers.catalogue import fitting, spec_of
from trackers.core.errors import UnusableInput
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from trackers.core.tunable import with_values
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks import batches
from trackers.recordings.trajectories import Trajectory, segments
from tuning.named_objectives import parse_objective
from tuning.objectives import AbstractObjective
from tuning.parameters import parse_bounds, require_start_within, select_parameters
from tuning.priors import Prior, parse_prior, require_fitting
from tuning.tuned_file import read_tuned


@dataclass(frozen=True)
class Job:
    """A tracker, the objective to minimise, and the trajectories to tune on and those held out."""

    tracker: AbstractTracker
    objective: AbstractObjective
    planar: bool
    training: list[Trajectory]
    held_out: list[Trajectory]

    def rows(self, held_out: bool = False) -> list[Batch]:
        """The trajectories as batches for a fit."""
        trajectories = self.held_out if held_out else self.training
        return [batch for _, batch in batches(trajectories)] if trajectories else []


def only_group(
    recordings: Sequence[Path], tracker: str | None, noise: Path | None, free_height: bool
) -> tuple[str, TrackerBatch]:
    """The tracker's name, given or by the tables, and its trajectories of the recordings, with values of a tuned.toml.

    Raises UnusableInput for recordings that need several trackers, which have no parameters in common.
    """
    folders = read_with_notices(recordings)
    name = tracker or fitting(folders[0])
    if tracker is None:
        notice(f"tracker: {name}; choose another with --tracker")
    found = spec_of(name).batches(folders, name, free_height)
    if len(found) > 1:
        raise UnusableInput(
            f"the recordings need {len(found)} different '{name}' trackers (other geometry, or heights known for some "
            "tags only); expected one; tune them separately, or give --free-height"
        )
    group = found[0]
    if noise is not None:
        group = replace(group, tracker=with_values(group.tracker, read_tuned(noise), noise))
    return name, group


def job_of(group: TrackerBatch, objective: str, held_out: Sequence[Path], segment_rows: int) -> Job:
    """The job of a group's trajectories, cut into segments; raises UnusableInput for an objective they don't allow."""
    cut = [segment for trajectory in group.trajectories for segment in segments(trajectory, segment_rows)]
    quantity = next(iter(cut[0].recording.truth))
    two_dimensional = quantity == "direction" or group.planar
    try:
        parsed = parse_objective(objective, quantity, 2 if two_dimensional else 3)
        parsed.for_tracker(group.tracker)
    except ValueError as error:
        raise UnusableInput(f"--objective {objective}: {error}") from error
    if parsed.needs_truth and group.planar and cut[0].station:
        raise UnusableInput(
            f"--objective {objective}: azimuth and elevation of a tag in a flat array's own plane are singular; "
            "expected a tag above or below it; use --objective nll"
        )
    held_out_paths = {path.resolve() for path in held_out}
    training_part: list[Trajectory] = []
    held_out_part: list[Trajectory] = []
    for segment in cut:
        if not parsed.needs_truth or segment.recording.truth[quantity][1].any():
            path = segment.folder.path
            is_held_out = path is not None and path.resolve() in held_out_paths
            (held_out_part if is_held_out else training_part).append(segment)
    for part, wanted, where in (
        (training_part, True, "these recordings"),
        (held_out_part, bool(held_out), "those held out"),
    ):
        if wanted and not part:
            raise UnusableInput(f"--objective {objective} needs truth, and {where} have none; use --objective nll")
    return Job(group.tracker, parsed, group.planar, training_part, held_out_part)


def checked_options(
    job: Job, tune: Sequence[str], freeze: Sequence[str], bound: Sequence[str], prior: Sequence[str]
) -> tuple[dict[str, tuple[float, float]], list[Prior]]:
    """Bounds and priors of the options; raises UnusableInput for those that don't fit the tracker's tunables."""
    option = f"--tune {' '.join(tune)}" + (f" --freeze {' '.join(freeze)}" if freeze else "")
    try:
        parameters = select_parameters(job.tracker, tune, freeze)
        option = f"--bound {' '.join(bound)}"
        bounds = parse_bounds(bound)
        require_start_within(parameters, bounds)
        option = f"--prior {' '.join(prior)}"
        priors = [parse_prior(text) for text in prior]
        require_fitting(priors, parameters, job.objective.is_likelihood)
    except ValueError as error:
        raise UnusableInput(f"{option}: {error}") from error
    return bounds, priors
