"""The data of a fit from recordings in folders or in arrays: segments, those held out, weights and the objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Batch, Recording, stack
from trackwright.trackers.core.errors import UnusableInput, require
from trackwright.trackers.core.run.requirements import check_input
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings import tracks
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker, folder_list
from trackwright.trackers.recordings.tracks import TrackerBatch, Trajectory, batches, segments
from trackwright.tuning.objectives import AbstractObjective, name_of, parse_objective
from trackwright.tuning.problem import Problem, is_stochastic

FLAT_M = 1.0  # most difference in height, m, of anchors in whose plane heights may be mirrored
Goal = str | AbstractObjective | None  # an objective, or its name; None: the default
SEGMENT_ROWS = 8000  # rows of the segments that long recordings are cut into, which are fitted side by side


def trajectory_weights(
    batches: Sequence[Batch], recordings: Sequence[Sequence[str]], needs_truth: bool
) -> list[Float[np.ndarray, " B"]]:
    """The weight of each trajectory of the batches, with which the rows of every recording add up to the same number.

    `recordings`: of each batch, the recording of each of its trajectories. Rows with known truth count where the
    objective `needs_truth`, else all rows. The weighted number of rows is the number of rows, so that
    recordings of one length have weight 1.
    """
    if not batches:
        return []
    names = [np.asarray(of_batch) for of_batch in recordings]
    rows = [_rows(batch, needs_truth) for batch in batches]
    joined, total = np.concatenate(names), np.concatenate(rows)
    distinct, index = np.unique(joined, return_inverse=True)
    by_recording = np.bincount(index.ravel(), total, minlength=len(distinct))
    counted = by_recording > 0
    say = np.where(counted, total.sum() / max(counted.sum(), 1) / np.maximum(by_recording, 1.0), 1.0)
    return np.split(say[index.ravel()], np.cumsum([len(of_batch) for of_batch in names])[:-1])


def _rows(batch: Batch, needs_truth: bool) -> Float[np.ndarray, " B"]:
    """The number of rows of each trajectory that an objective counts, none of one without any reading."""
    counted = np.asarray(batch.valid) & np.any([np.any(x.seen, axis=(0, 1)) for x in batch.readings.values()], axis=0)
    if needs_truth and batch.truth:
        counted = counted & np.any([np.asarray(known) for _, known in batch.truth.values()], axis=0)
    return counted.sum(axis=0).astype(float)


class FitRows(NamedTuple):
    """Batches of trajectories, and the recording and the weight of each trajectory of each of them."""

    batches: Sequence[Batch]
    recordings: Sequence[Sequence[str]]
    weights: list[Float[np.ndarray, " B"]]

    @classmethod
    def of(cls, batches: Sequence[Batch], recordings: Sequence[Sequence[str]], objective: AbstractObjective) -> FitRows:
        """The rows with weights for an objective."""
        return cls(batches, recordings, trajectory_weights(batches, recordings, objective.needs_truth))

    def recordings_of(self, problem: Problem) -> list[str]:
        """The recording of each trajectory of the problem, empty for padding."""
        pairs = zip(self.recordings, problem.sizes, strict=True)
        return [name for names, size in pairs for name in [*names, *[""] * (size - len(names))]]


@dataclass(frozen=True)
class FitData:
    """The trajectories of recording folders that a tracker is fitted to, those held out, and the objective.

    `named`: the objective's name. `planar`: whether only the position over the floor is estimated. `dimensions`: the
    components of a position that the objective judges. `unused`: recordings without the truth that it needs.
    """

    tracker: AbstractTracker
    objective: AbstractObjective
    named: str
    planar: bool
    dimensions: int
    training: list[Trajectory]
    held_out: list[Trajectory]
    unused: tuple[str, ...] = ()

    @cached_property
    def rows(self) -> FitRows:
        """The trajectories to fit to, in batches."""
        return self._in_batches(self.training)

    @cached_property
    def rows_apart(self) -> FitRows:
        """The trajectories held out, in batches."""
        return self._in_batches(self.held_out)

    def _in_batches(self, part: list[Trajectory]) -> FitRows:
        groups = batches(part) if part else []
        names = [[folder.name for folder in group.folders] for group, _ in groups]
        return FitRows.of([batch for _, batch in groups], names, self.objective)


def fit_data(
    batch: TrackerBatch, objective: Goal, held_out: Sequence[RecordingFolder] = (), dimensions: int | None = None
) -> FitData:
    """The data of a fit to the trajectories of one tracker, cut into segments; `held_out`: folders not fitted to.

    `objective`: None for `state-nll` where there is truth that it can judge, else `nll`. `dimensions`: 3 to judge the
    height too, where it is estimated; None for `judged_dimensions`. Raises UnusableInput for an objective that is not
    known, or that needs truth where there is none.
    """
    check_input(batch.tracker, batch.trajectories[0].recording, "fit")
    dimensions = dimensions or judged_dimensions(batch, objective)
    quantity, apart = _quantity(batch), {folder.name for folder in held_out}
    floor = quantity == "direction" or batch.planar or dimensions == 2
    whole: Sequence[Trajectory] = batch.trajectories
    if floor and quantity == "position":
        whole = [tracks.with_floor_truth(trajectory) for trajectory in whole]
    trajectories = [segment for trajectory in whole for segment in segments(trajectory, SEGMENT_ROWS)]
    known = [bool(trajectory.recording.truth[quantity][1].any()) for trajectory in trajectories]
    singular = batch.planar and bool(trajectories[0].station)
    if objective is None:
        with_truth = {t.folder.name for t, has in zip(trajectories, known, strict=True) if has}
        enough = bool(with_truth - apart) and (not apart or bool(with_truth & apart)) and not singular
        objective = _default_objective(batch.tracker, stack([trajectories[0].recording]), quantity, enough)
    goal = named_objective(objective, quantity, 2 if floor else 3)
    name = name_of(objective)
    if goal.needs_truth and singular:
        raise UnusableInput(
            f"objective {name}: azimuth and elevation of a tag in a flat array's own plane are singular; "
            "expected a tag above or below it; use the objective nll"
        )
    parts: tuple[list[Trajectory], list[Trajectory]] = ([], [])
    for trajectory, has_truth in zip(trajectories, known, strict=True):
        if not goal.needs_truth or has_truth:
            parts[trajectory.folder.name in apart].append(trajectory)
    for part, wanted, where in zip(parts, (True, bool(apart)), ("these recordings", "those held out"), strict=True):
        if wanted and not part:
            heights = "" if floor else " with z_m"
            raise UnusableInput(f"objective {name} needs truth{heights}, and {where} have none; use the objective nll")
    used = {trajectory.folder.name for part in parts for trajectory in part}
    unused = tuple(dict.fromkeys(t.folder.name for t in trajectories if t.folder.name not in used))
    return FitData(batch.tracker, goal, name, batch.planar, 2 if floor else 3, *parts, unused)


def judged_dimensions(batch: TrackerBatch, objective: Goal) -> int:
    """3 where the height is estimated, every truth has heights and `state-nll` is judged, or chosen by default; else 2.

    An RMSE in space would be a badly determined height's, and near the plane of level anchors one is mirrored.
    """
    weighted = objective is None or objective == "state-nll"
    if not weighted or batch.planar or _quantity(batch) != "position":
        return 2
    rigs = {trajectory.folder.name: trajectory.folder.rig for trajectory in batch.trajectories}
    if any(rig.anchors and np.ptp([place[2] for place in rig.anchors.values()]) <= FLAT_M for rig in rigs.values()):
        return 2
    if _components(batch.tracker, stack([batch.trajectories[0].recording]), "position") < 3:
        return 2
    known = [bool(trajectory.recording.truth["position"][1].any()) for trajectory in batch.trajectories]
    lacking = [trajectory for trajectory, has in zip(batch.trajectories, known, strict=True) if not has]
    over_floor = any(tracks.with_floor_truth(one).recording.truth["position"][1].any() for one in lacking)
    return 3 if any(known) and not over_floor else 2


def _components(tracker: AbstractTracker, batch: Batch, quantity: str) -> int:
    """The number of components of a quantity that a tracker estimates."""
    first = batch.rows(slice(0, 2)).columns(0, 1)
    mean = jax.eval_shape(lambda: tracker.scan(first)[0]).mean
    return len(jax.tree_util.tree_leaves(getattr(mean, quantity, ())))


def _quantity(batch: TrackerBatch) -> str:
    """The quantity of the truth."""
    return next(iter(batch.trajectories[0].recording.truth))


def _default_objective(tracker: AbstractTracker, batch: Batch, quantity: str, known: bool) -> str:
    """`state-nll` where the true quantity is known and reported with a covariance, else `nll`.

    A particle filter has no gradient of the first.
    """
    judged = known and not is_stochastic(tracker) and _components(tracker, batch, quantity)
    return "state-nll" if judged else "nll"


def named_objective(objective: str | AbstractObjective, quantity: str, dimensions: int) -> AbstractObjective:
    """The objective by name, or as it is; raises UnusableInput for a name that is unknown."""
    if isinstance(objective, str):
        return parse_objective(objective, quantity, dimensions)
    require(isinstance(objective, AbstractObjective), "fit", objective, "an objective: a name or an object")
    return objective


Arrays = Recording | Batch | Sequence[Recording] | Sequence[Batch]
"""Recordings in arrays, as `AbstractTracker.run` takes them, or several batches of them."""


class FitArrays(NamedTuple):
    """As `FitData`, of recordings in arrays."""

    tracker: AbstractTracker
    objective: AbstractObjective
    rows: FitRows
    rows_apart: FitRows


def fit_arrays(
    tracker: Any, recordings: Any, objective: Goal, held_out: Any, dimensions: int | None = None
) -> FitData | FitArrays:
    """Tracker, batches and objective of a fit, from what `tuning.fit` takes; raises UnusableInput, a ValueError."""
    if isinstance(recordings, FitData):
        return recordings
    if isinstance(tracker, NamedTracker):
        if tracker.smoothed:
            raise UnusableInput(
                "a smoother has the filter's numbers: fit the filter, then use result.tracker.smoothing()"
            )
        training = folder_list(recordings)
        apart = folder_list(held_out) if held_out != () else []
        batch = tracker.only_batch([*training, *apart])
        return fit_data(batch, objective, apart, dimensions=dimensions)
    if not isinstance(tracker, AbstractTracker):
        raise UnusableInput(
            f"fit: found {type(tracker).__name__} for the tracker; expected a tracker of arrays or by name; usual fix: "
            "fit(tracker, recordings, objective), with a tracker as `range_tracker(4)` or `tw.tracker_for(folder)`"
        )
    batches = _batches(tracker, recordings)
    apart_batches = [] if isinstance(held_out, (tuple, list)) and not held_out else _batches(tracker, held_out)
    goal = _array_objective(objective, tracker, batches, apart_batches, dimensions)
    return FitArrays(tracker, goal, *(FitRows.of(part, _numbered(part), goal) for part in (batches, apart_batches)))


def _numbered(rows: Sequence[Batch]) -> list[list[str]]:
    """Numbers as names of trajectories in arrays, each of which is a recording."""
    ends = np.cumsum([0, *(batch.size for batch in rows)])
    return [[f"{n + 1}" for n in range(a, b)] for a, b in pairwise(ends)]


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


def _has_truth(batches: Sequence[Batch]) -> bool:
    return any(bool(np.any(known)) for batch in batches for _, known in batch.truth.values())


def _array_objective(
    objective: Goal, tracker: AbstractTracker, rows: Sequence[Batch], apart: Sequence[Batch], dimensions: int | None
) -> AbstractObjective:
    """The objective for recordings in arrays: by name of the quantity of their truth, in so many dimensions.

    `dimensions`: None for those that are estimated and have truth with `state-nll`, two with others. Raises
    UnusableInput for an unknown name, and where truth is needed and there is none in `rows` or `apart`.
    """
    quantity = next(iter(rows[0].truth), "position")
    if objective is None:
        known = all(_has_truth(part) for part in (rows, apart) if part)
        objective = _default_objective(tracker, rows[0], quantity, known)
    goal = named_objective(objective, quantity, 2)
    for part, where in ((rows, "the recordings"), (apart, "the held-out recordings")):
        if goal.needs_truth and part and not _has_truth(part):
            raise UnusableInput(
                f"fit: {where} have no known truth; expected some, which the objective {name_of(objective)} needs; "
                "usual fix: `truth=` where the recordings are made, or the objective nll"
            )
    if not (goal.needs_truth and isinstance(objective, str)):
        return goal
    estimated = _components(tracker, rows[0], quantity) or 2
    true = rows[0].truth[quantity][0].shape[1] if objective == "state-nll" else 2
    return named_objective(objective, quantity, min(dimensions or true, estimated))
