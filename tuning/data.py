"""The data of a fit from recordings in folders: segments of trajectories, those held out, weights and the objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Batch, stack
from trackwright.trackers.core.errors import UnusableInput, require
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.recordings.tracks import batches
from trackwright.trackers.recordings.trajectories import Trajectories, Trajectory, segments, with_floor_truth
from trackwright.tuning.named_objectives import parse_objective
from trackwright.tuning.objectives import (
    AbstractObjective,
    Loss,
    MeanLoss,
    MissingQuantityError,
    StateLogLikelihood,
    name_of,
)
from trackwright.tuning.problem import is_stochastic
from trackwright.tuning.unstacked import AnyBatch, Unstacked, unstacked
from trackwright.tuning.weights import Weigh, trajectory_weights

SEGMENT_ROWS = 8000
"""Rows of the segments that long recordings are cut into, which are fitted side by side."""


@dataclass(frozen=True)
class FitData:
    """The trajectories of recording folders that a tracker is fitted to, those held out, and the objective.

    `named`: the objective's name. `planar`: whether only the position over the floor is estimated. `dimensions`: the
    components of a position that the objective judges. `unused`: recordings without the truth that it needs. `stacked`:
    whether all rows are stacked at once, not piece by piece where they are needed.
    """

    tracker: AbstractTracker
    objective: AbstractObjective
    named: str
    planar: bool
    dimensions: int
    training: list[Trajectory]
    held_out: list[Trajectory]
    weigh: Weigh
    unused: tuple[str, ...] = ()
    stacked: bool = True

    def rows(self, held_out: bool = False) -> list[Batch]:
        """The rows of the trajectories to fit to, or of those held out, in batches."""
        return [batch for _, batch in (self._held_out_groups if held_out else self._training_groups)]

    def batches(self, held_out: bool = False) -> Sequence[AnyBatch]:
        """The batches of `rows` as a fit takes them, `stacked` or not."""
        return self.rows(held_out) if self.stacked else self._unstacked(held_out)

    def weights(self, held_out: bool = False) -> list[Float[np.ndarray, " B"]]:
        """The weight of each trajectory of `rows`."""
        names = self.recordings(held_out)
        return trajectory_weights(self.batches(held_out), names, self.weigh, self.objective.needs_truth)

    def recordings(self, held_out: bool = False) -> list[list[str]]:
        """The name of the recording of each trajectory of `rows`."""
        return [[t.folder.name for t in batch.trajectories] for batch in self._unstacked(held_out)]

    def _unstacked(self, held_out: bool) -> list[Unstacked]:
        return unstacked(self.held_out if held_out else self.training)

    @cached_property
    def _training_groups(self) -> list[tuple[Trajectories, Batch]]:
        return batches(self.training)

    @cached_property
    def _held_out_groups(self) -> list[tuple[Trajectories, Batch]]:
        return batches(self.held_out) if self.held_out else []


def fit_data(
    batch: TrackerBatch,
    objective: str | AbstractObjective | Loss | None,
    held_out: Sequence[RecordingFolder] = (),
    segment_rows: int = SEGMENT_ROWS,
    dimensions: int | None = None,
    weigh: Weigh = "recordings",
) -> FitData:
    """The data of a fit to the trajectories of one tracker, cut into segments; `held_out`: folders not fitted to.

    `objective`: None for `state-nll` where there is truth that it can judge, else `nll`. `dimensions`: 3 to judge the
    height too, where it is estimated; None for `judged_dimensions`. Raises UnusableInput for an objective that is not
    known, or that needs truth where there is none.
    """
    dimensions = dimensions or judged_dimensions(batch, objective)
    own = replace(batch, trajectories=fit_segments(batch, segment_rows, dimensions))
    return segments_data(own, objective, {folder.name for folder in held_out}, dimensions, weigh)


def judged_dimensions(batch: TrackerBatch, objective: str | AbstractObjective | Loss | None) -> int:
    """3 where the height is estimated, every truth has heights and `state-nll` is judged, or chosen by default; else 2.

    An RMSE in space would be that of a badly determined height.
    """
    weighted = objective is None or (isinstance(objective, str) and "state-nll" in objective)
    if not weighted or batch.planar or _quantity(batch) != "position":
        return 2
    first = stack([batch.trajectories[0].recording]).rows(slice(0, 2)).columns(0, 1)
    mean = jax.eval_shape(lambda: batch.tracker.scan(first)[0]).mean
    if len(jax.tree_util.tree_leaves(getattr(mean, "position", ()))) < 3:
        return 2
    known = [bool(one.recording.truth["position"][1].any()) for one in batch.trajectories]
    lacking = [one for one, has in zip(batch.trajectories, known, strict=True) if not has]
    over_floor = any(bool(with_floor_truth(one).recording.truth["position"][1].any()) for one in lacking)
    return 3 if any(known) and not over_floor else 2


def fit_segments(batch: TrackerBatch, rows: int, dimensions: int) -> list[Trajectory]:
    """The trajectories as a fit takes them: segments of about so many rows, with the truth that it judges."""
    whole: Sequence[Trajectory] = batch.trajectories
    if _quantity(batch) == "position" and _over_floor(batch, dimensions):
        whole = [with_floor_truth(trajectory) for trajectory in whole]
    return [segment for trajectory in whole for segment in segments(trajectory, rows)]


def segments_data(
    batch: TrackerBatch,
    objective: str | AbstractObjective | Loss | None,
    apart: set[str],
    dimensions: int,
    weigh: Weigh,
    stacked: bool = True,
) -> FitData:
    """As `fit_data`, of `fit_segments`; `apart`: names of the recordings not fitted to; `stacked`: see `FitData`."""
    trajectories, quantity, floor = list(batch.trajectories), _quantity(batch), _over_floor(batch, dimensions)
    known = [bool(trajectory.recording.truth[quantity][1].any()) for trajectory in trajectories]
    if objective is None:
        with_truth = {t.folder.name for t, has in zip(trajectories, known, strict=True) if has}
        enough = bool(with_truth - apart) and (not apart or bool(with_truth & apart))
        objective = _default_objective(batch, trajectories, quantity) if enough else "nll"
    goal = named_objective(objective, batch.tracker, quantity, 2 if floor else 3)
    name = name_of(objective)
    if goal.needs_truth and batch.planar and trajectories[0].station:
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
            over_floor = () if floor else map(with_floor_truth, trajectories)
            if any(t.recording.truth["position"][1].any() for t in over_floor):
                raise UnusableInput(
                    f"objective {name} in three dimensions needs truth with z_m, and {where} have x_m and y_m "
                    "alone; judge two dimensions (--dimensions 2), or use the objective nll"
                )
            raise UnusableInput(f"objective {name} needs truth, and {where} have none; use the objective nll")
    used = {trajectory.folder.name for part in parts for trajectory in part}
    unused = tuple(dict.fromkeys(t.folder.name for t in trajectories if t.folder.name not in used))
    return FitData(batch.tracker, goal, name, batch.planar, 2 if floor else 3, *parts, weigh, unused, stacked)


def _quantity(batch: TrackerBatch) -> str:
    """The quantity of the truth."""
    return next(iter(batch.trajectories[0].recording.truth))


def _over_floor(batch: TrackerBatch, dimensions: int) -> bool:
    """Whether a position is judged over the floor alone."""
    return _quantity(batch) == "direction" or batch.planar or dimensions == 2


def _default_objective(batch: TrackerBatch, trajectories: Sequence[Trajectory], quantity: str) -> str:
    """`state-nll` where the tracker reports a covariance of the true quantity, else `nll`.

    A particle filter has no gradient of the first, and a direction in a flat array's own plane is singular.
    """
    if is_stochastic(batch.tracker) or (batch.planar and trajectories[0].station):
        return "nll"
    return "state-nll" if is_judged(batch.tracker, stack([trajectories[0].recording]), quantity) else "nll"


def is_judged(tracker: AbstractTracker, batch: Batch, quantity: str) -> bool:
    """Whether the tracker estimates the quantity with a covariance."""
    first = batch.rows(slice(0, 2)).columns(0, 1)
    try:
        goal = StateLogLikelihood(quantity, min(2, len(first.truth[quantity][0])))
        jax.eval_shape(lambda: tracker.accumulate(first, goal.terms))
    except MissingQuantityError:
        return False
    return True


def named_objective(
    objective: str | AbstractObjective | Loss, tracker: AbstractTracker, quantity: str, dimensions: int
) -> AbstractObjective:
    """The objective by name, as it is, or of a loss; raises UnusableInput for a name that is unknown or unfit."""
    if isinstance(objective, AbstractObjective):
        return objective
    if not isinstance(objective, str):
        require(callable(objective), "fit", objective, "an objective: a name, an AbstractObjective or a function")
        return MeanLoss(objective)
    try:
        goal = parse_objective(objective, quantity, dimensions)
        goal.for_tracker(tracker)
    except ValueError as error:
        raise UnusableInput(f"objective {objective}: {error}") from error
    return goal
