"""What a tuning run works on: the tracker, the rows it is fitted to and judged on, and what it is to make small."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.cli.console import notice, read_with_notices
from trackers.catalogue import fitting, spec_of
from trackers.core.errors import UnusableInput
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from trackers.core.tunable import tunables, with_values
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks import batches
from trackers.recordings.trajectories import Trajectory, segments
from tuning.identifiability import names_of
from tuning.metrics import parse_objective
from tuning.objectives import AbstractObjective
from tuning.parameters import flatten, limits, physical_vector, select_parameters
from tuning.priors import Prior, parse_prior, penalty
from tuning.tuned_file import read_tuned


@dataclass(frozen=True)
class Job:
    """A tracker to be tuned on the rows of some trajectories for the least `goal`, and judged on those of others."""

    tracker: AbstractTracker
    goal: AbstractObjective
    planar: bool
    training: list[Trajectory]
    held_out: list[Trajectory]

    def rows(self, held_out: bool = False) -> list[Batch]:
        """The trajectories' rows, as a fit takes them."""
        trajectories = self.held_out if held_out else self.training
        return [batch for _, batch in batches(trajectories)] if trajectories else []


def only_group(
    recordings: Sequence[Path], tracker: str | None, noise: Path | None, free_height: bool
) -> tuple[str, TrackerBatch]:
    """The recordings' trajectories for one tracker, named or what fits, with numbers from a tuned.toml; and its name.

    Raises UnusableInput where they need several trackers: those have no numbers in common.
    """
    folders = read_with_notices(recordings)
    name = tracker or fitting(folders[0])
    if tracker is None:
        notice(f"tracker: {name}; choose another with --tracker")
    found = spec_of(name).batches(folders, name, free_height)
    if len(found) > 1:
        raise UnusableInput(
            f"the recordings need {len(found)} different '{name}' trackers (other geometry, or heights known for some "
            "tags only); expected one; take them apart, or give --free-height"
        )
    group = found[0]
    if noise is not None:
        group = replace(group, tracker=with_values(group.tracker, read_tuned(noise), noise))
    return name, group


def job_of(group: TrackerBatch, objective: str, held_out: Sequence[Path], piece_rows: int) -> Job:
    """The job of a group's trajectories, cut into pieces; raises UnusableInput for an objective that they can't be put to."""
    trajectories = [piece for trajectory in group.trajectories for piece in segments(trajectory, piece_rows)]
    quantity = next(iter(trajectories[0].recording.truth))
    floor = quantity == "direction" or group.planar
    try:
        goal = parse_objective(objective, quantity, 2 if floor else 3)
        goal.informed(group.tracker)
    except ValueError as error:
        raise UnusableInput(f"--objective {objective}: {error}") from error
    if goal.needs_truth and group.planar and trajectories[0].station:
        raise UnusableInput(
            f"--objective {objective}: azimuth and elevation of a tag in a flat array's own plane are singular; "
            "expected a tag above or below it; use --objective nll"
        )
    apart = {path.resolve() for path in held_out}

    def is_apart(trajectory: Trajectory) -> bool:
        return trajectory.folder.path is not None and trajectory.folder.path.resolve() in apart

    parts: tuple[list[Trajectory], list[Trajectory]] = ([], [])
    for trajectory in trajectories:
        if not goal.needs_truth or trajectory.recording.truth[quantity][1].any():
            parts[is_apart(trajectory)].append(trajectory)
    for part, wanted, where in zip(parts, (True, bool(held_out)), ("these recordings", "those held out"), strict=True):
        if wanted and not part:
            raise UnusableInput(f"--objective {objective} needs truth, and {where} have none; use --objective nll")
    return Job(group.tracker, goal, group.planar, *parts)


def bounds_of(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Bounds by pattern, from texts as `sensors.*.sigma_p=0.01:1`; raises UnusableInput."""
    found = {}
    for text in texts:
        pattern, _, numbers = text.partition("=")
        low, _, high = numbers.partition(":")
        if pattern in found:
            raise UnusableInput(f"--bound {text}: '{pattern}' is bounded twice; expected once")
        try:
            found[pattern] = float(low), float(high)
        except ValueError as error:
            raise UnusableInput(
                f"--bound {text}: expected PATTERN=LOWEST:HIGHEST, as 'sensors.*.sigma_p=0.01:1'"
            ) from error
    return found


def checked(
    job: Job, tune: Sequence[str], freeze: Sequence[str], bounds: dict[str, tuple[float, float]], prior: Sequence[str]
) -> list[Prior]:
    """The priors, with all that is tuned looked at; raises UnusableInput where patterns, bounds or priors don't fit."""
    option = f"--tune {' '.join(tune)}" + (f" --freeze {' '.join(freeze)}" if freeze else "")
    try:
        parameters = select_parameters(job.tracker, tune, freeze)
        option = "--bound"
        low, high = limits(parameters, bounds)
        vector = flatten(parameters)
        outside = (vector < low) | (vector > high)
        if outside.any():
            name, value = names_of(parameters)[outside.argmax()], physical_vector(parameters, vector)[outside.argmax()]
            raise ValueError(f"{name} begins outside, at {value:.4g}; give another starting value with --start")
        option = f"--prior {' '.join(prior)}"
        priors = [parse_prior(text) for text in prior]
        penalty(priors, parameters, vector)
        if priors and not job.goal.is_likelihood:
            raise ValueError("a prior is weighed against a likelihood; use --objective nll, or --bound")
    except ValueError as error:
        raise UnusableInput(f"{option}: {error}") from error
    return priors


def anomalies(job: Job, tune: Sequence[str], freeze: Sequence[str]) -> Iterator[str]:
    """What a user may not expect of the numbers to be tuned: where tied ones begin, and what no likelihood can tell."""
    own = tunables(job.tracker)
    for parameter in select_parameters(job.tracker, tune, freeze):
        values = [np.asarray(own[name].value) for name in parameter.names]
        if not all(np.array_equal(value, values[0]) for value in values):
            listed = ", ".join(f"{float(value):.4g}" for value in values if value.ndim == 0)
            yield f"{parameter.label}: tied numbers all begin as the first of them{f', of {listed}' if listed else ''}"
        alone = len(getattr(job.tracker, "sensors", ())) == 1
        if parameter.label.endswith(".latency") and alone and not job.goal.needs_truth:
            yield (
                f"{parameter.label}: fixes alone do not tell how late they are, a tag that was there later looks the "
                "same; give recordings with truth and --objective rmse"
            )
