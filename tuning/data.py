"""The data of a fit: from recordings, in folders or arrays, to the batches and the objective that a fit works on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from trackers.core.errors import UnusableInput
from trackers.core.recording import Batch, Recording, stack
from trackers.core.requirements import check_input
from trackers.core.tracker import AbstractTracker
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.named_tracker import NamedTracker, folder_list
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks import batches
from trackers.recordings.trajectories import Trajectory, segments, with_floor_truth
from tuning.named_objectives import parse_objective
from tuning.objectives import AbstractObjective

SEGMENT_ROWS = 8000
"""Rows of the segments that long recordings are cut into, which are fitted side by side."""

Arrays = Recording | Batch | Sequence[Recording] | Sequence[Batch]
"""Recordings in arrays, as `AbstractTracker.run` takes them, or several batches of them."""


@dataclass(frozen=True)
class FitData:
    """The trajectories of recording folders that a tracker is fitted to, those held out, and the objective.

    `planar`: whether only the position over the floor is estimated.
    """

    tracker: AbstractTracker
    objective: AbstractObjective
    planar: bool
    training: list[Trajectory]
    held_out: list[Trajectory]

    def rows(self, held_out: bool = False) -> list[Batch]:
        """The rows of the trajectories to fit to, or of those held out, as a fit takes them."""
        trajectories = self.held_out if held_out else self.training
        return [batch for _, batch in batches(trajectories)] if trajectories else []


def fit_data(
    batch: TrackerBatch,
    objective: str | AbstractObjective,
    held_out: Sequence[RecordingFolder] = (),
    segment_rows: int = SEGMENT_ROWS,
) -> FitData:
    """The data of a fit to the trajectories of one tracker, cut into segments; `held_out`: folders not fitted to.

    Raises UnusableInput for an objective that is not known, or that needs truth where there is none.
    """
    whole: Sequence[Trajectory] = batch.trajectories
    quantity = next(iter(whole[0].recording.truth))
    floor = quantity == "direction" or batch.planar
    if quantity == "position" and floor:
        whole = _over_the_floor(whole)
    trajectories = [segment for trajectory in whole for segment in segments(trajectory, segment_rows)]
    goal = _objective(objective, batch.tracker, quantity, 2 if floor else 3)
    if goal.needs_truth and batch.planar and trajectories[0].station:
        raise UnusableInput(
            f"objective {objective}: azimuth and elevation of a tag in a flat array's own plane are singular; "
            "expected a tag above or below it; use the objective nll"
        )
    apart = {folder.name for folder in held_out}
    parts: tuple[list[Trajectory], list[Trajectory]] = ([], [])
    for trajectory in trajectories:
        if not goal.needs_truth or trajectory.recording.truth[quantity][1].any():
            parts[trajectory.folder.name in apart].append(trajectory)
    for part, wanted, where in zip(parts, (True, bool(apart)), ("these recordings", "those held out"), strict=True):
        if wanted and not part:
            if not floor and any(t.recording.truth["position"][1].any() for t in _over_the_floor(whole)):
                raise UnusableInput(
                    f"objective {objective} needs truth with z_m, since the height is estimated, and {where} have x_m "
                    "and y_m alone; give height_m of the tags in rig.toml, or use the objective nll"
                )
            raise UnusableInput(f"objective {objective} needs truth, and {where} have none; use the objective nll")
    return FitData(batch.tracker, goal, batch.planar, *parts)


def _over_the_floor(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """The trajectories with true positions over the floor, as `evaluate` judges them, with or without heights."""
    return [with_floor_truth(trajectory) for trajectory in trajectories]


class FitArrays(NamedTuple):
    """A tracker, the batches to fit it to and to hold out, and the objective: what the optimisation works on."""

    tracker: AbstractTracker
    training: list[Batch]
    held_out: list[Batch]
    objective: AbstractObjective


def fit_arrays(
    tracker: AbstractTracker | NamedTracker, recordings: Any, objective: str | AbstractObjective, held_out: Any
) -> FitArrays:
    """Tracker, batches and objective of a fit, from what `tuning.fit` takes; raises UnusableInput, a ValueError."""
    if isinstance(tracker, NamedTracker):
        if tracker.smoothed:
            raise UnusableInput(
                "a smoother has the filter's numbers: fit the filter, then use result.tracker.smoothing()"
            )
        training = folder_list(recordings)
        apart = folder_list(held_out) if held_out != () else []
        data = fit_data(tracker.only_batch([*training, *apart]), objective, apart)
        return FitArrays(data.tracker, data.rows(), data.rows(held_out=True), data.objective)
    if not isinstance(tracker, AbstractTracker):
        raise UnusableInput(
            f"fit: found {type(tracker).__name__} for the tracker; expected a tracker of arrays or by name; usual fix: "
            "fit(tracker, recordings, objective), with a tracker as `range_tracker(4)` or `tw.tracker_for(folder)`"
        )
    batches = _batches(tracker, recordings)
    apart_batches = [] if isinstance(held_out, (tuple, list)) and not held_out else _batches(tracker, held_out)
    goal = _array_objective(objective, tracker, batches, apart_batches)
    return FitArrays(tracker, batches, apart_batches, goal)


def _batches(tracker: AbstractTracker, recordings: Arrays) -> list[Batch]:
    """Recordings in arrays as batches; raises UnusableInput for anything else, and where the tracker lacks an input."""
    if isinstance(recordings, (tuple, list)) and not isinstance(recordings, Batch):
        batches = [x for x in recordings if isinstance(x, Batch)]
        if batches and len(batches) == len(recordings):
            for batch in batches:
                check_input(tracker, batch, "fit")
            return batches
    checked = check_input(tracker, recordings, "fit")
    if isinstance(checked, Batch):
        return [checked]
    return [stack([checked] if isinstance(checked, Recording) else checked)]


def _check_truth(objective: str | AbstractObjective, batches: Sequence[Batch], where: str) -> None:
    """Raises UnusableInput for batches without any row whose truth is known."""
    if batches and not any(np.any(known) for batch in batches for _, known in batch.truth.values()):
        name = objective if isinstance(objective, str) else type(objective).__name__
        raise UnusableInput(
            f"fit: {where} have no known truth; expected some, which the objective {name} needs; usual fix: `truth=` "
            "where the recordings are made, or the objective nll"
        )


def _array_objective(
    objective: str | AbstractObjective, tracker: AbstractTracker, rows: Sequence[Batch], apart: Sequence[Batch]
) -> AbstractObjective:
    """The objective for recordings in arrays: by name of the quantity of their truth, in the state's dimensions.

    Raises UnusableInput for an unknown name, and where truth is needed and there is none in `rows` or `apart`.
    """
    quantity = next(iter(rows[0].truth), "position")
    goal = _objective(objective, tracker, quantity, 2)
    if goal.needs_truth:
        _check_truth(objective, rows, "the recordings")
        _check_truth(objective, apart, "the held-out recordings")
    if not (goal.needs_truth and isinstance(objective, str)):
        return goal
    first = rows[0].rows(slice(0, 2)).columns(0, 1)
    mean = jax.eval_shape(lambda: tracker.scan(first)[0]).mean
    dimensions = len(jax.tree_util.tree_leaves(getattr(mean, quantity, ()))) or 2
    return _objective(objective, tracker, quantity, dimensions)


def _objective(
    objective: str | AbstractObjective, tracker: AbstractTracker, quantity: str, dimensions: int
) -> AbstractObjective:
    if not isinstance(objective, str):
        return objective
    try:
        goal = parse_objective(objective, quantity, dimensions)
        goal.for_tracker(tracker)
    except ValueError as error:
        raise UnusableInput(f"objective {objective}: {error}") from error
    return goal
