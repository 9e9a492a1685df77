"""The data of a fit from recordings in arrays, or in folders, as arrays: batches, weights and the objective."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Batch, Recording, stack
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.run.requirements import check_input
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker, folder_list
from trackwright.tuning.data import FitData, fit_data, is_judged, named_objective
from trackwright.tuning.objectives import AbstractObjective, Loss, name_of
from trackwright.tuning.problem import Problem, is_stochastic
from trackwright.tuning.unstacked import AnyBatch
from trackwright.tuning.weights import Weigh, trajectory_weights

Arrays = Recording | Batch | Sequence[Recording] | Sequence[Batch]
"""Recordings in arrays, as `AbstractTracker.run` takes them, or several batches of them."""


class FitArrays(NamedTuple):
    """A tracker, the batches to fit it to and to hold out with their weights, and the objective.

    `folders`: of the recordings fitted to, none of those in arrays.
    """

    tracker: AbstractTracker
    training: Sequence[AnyBatch]
    held_out: Sequence[AnyBatch]
    objective: AbstractObjective
    weights: list[Float[np.ndarray, " B"]]
    held_out_weights: list[Float[np.ndarray, " B"]]
    recordings: list[list[str]]
    folders: Sequence[RecordingFolder] = ()

    def recordings_of(self, problem: Problem) -> list[str]:
        """The recording of each trajectory of the problem, empty for padding."""
        pairs = zip(self.recordings, problem.sizes, strict=True)
        return [name for own, size in pairs for name in [*own, *[""] * (size - len(own))]]

    @classmethod
    def of(cls, data: FitData) -> FitArrays:
        """The arrays of recording folders."""
        weights = (data.weights(), data.weights(held_out=True))
        groups = data.batches(), data.batches(held_out=True)
        folders = list({id(one.folder): one.folder for one in data.training}.values())
        return cls(data.tracker, *groups, data.objective, *weights, data.recordings(), folders)


def fit_arrays(
    tracker: AbstractTracker | NamedTracker,
    recordings: Any,
    objective: str | AbstractObjective | Loss | None,
    held_out: Any,
    dimensions: int | None = None,
    weigh: Weigh = "recordings",
) -> FitArrays:
    """Tracker, batches and objective of a fit, from what `tuning.fit` takes; raises UnusableInput, a ValueError."""
    if isinstance(recordings, FitData):
        return FitArrays.of(recordings)
    if isinstance(tracker, NamedTracker):
        if tracker.smoothed:
            raise UnusableInput(
                "a smoother has the filter's numbers: fit the filter, then use result.tracker.smoothing()"
            )
        training = folder_list(recordings)
        apart = folder_list(held_out) if held_out != () else []
        batch = tracker.only_batch([*training, *apart])
        return FitArrays.of(fit_data(batch, objective, apart, dimensions=dimensions, weigh=weigh))
    if not isinstance(tracker, AbstractTracker):
        raise UnusableInput(
            f"fit: found {type(tracker).__name__} for the tracker; expected a tracker of arrays or by name; usual fix: "
            "fit(tracker, recordings, objective), with a tracker as `range_tracker(4)` or `tw.tracker_for(folder)`"
        )
    batches = _batches(tracker, recordings)
    apart_batches = [] if isinstance(held_out, (tuple, list)) and not held_out else _batches(tracker, held_out)
    goal = _array_objective(objective, tracker, batches, apart_batches, dimensions)
    names, apart_names = (_numbered(rows) for rows in (batches, apart_batches))
    weights = trajectory_weights(batches, names, weigh, goal.needs_truth)
    apart_weights = trajectory_weights(apart_batches, apart_names, weigh, goal.needs_truth)
    return FitArrays(tracker, batches, apart_batches, goal, weights, apart_weights, names)


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


def _check_truth(objective: str | AbstractObjective | Loss, batches: Sequence[Batch], where: str) -> None:
    """Raises UnusableInput for batches without any row whose truth is known."""
    if batches and not _has_truth(batches):
        raise UnusableInput(
            f"fit: {where} have no known truth; expected some, which the objective {name_of(objective)} needs; usual "
            "fix: `truth=` where the recordings are made, or the objective nll"
        )


def _has_truth(batches: Sequence[Batch]) -> bool:
    return any(bool(np.any(known)) for batch in batches for _, known in batch.truth.values())


def _array_objective(
    objective: str | AbstractObjective | Loss | None,
    tracker: AbstractTracker,
    rows: Sequence[Batch],
    apart: Sequence[Batch],
    dimensions: int | None,
) -> AbstractObjective:
    """The objective for recordings in arrays: by name of the quantity of their truth, in so many dimensions.

    `dimensions`: None for those that are estimated and have truth with `state-nll`, two with others. Raises
    UnusableInput for an unknown name, and where truth is needed and there is none in `rows` or `apart`.
    """
    quantity = next(iter(rows[0].truth), "position")
    if objective is None:
        known = all(_has_truth(part) for part in (rows, apart) if part)
        judged = known and not is_stochastic(tracker) and is_judged(tracker, rows[0], quantity)
        objective = "state-nll" if judged else "nll"
    goal = named_objective(objective, tracker, quantity, 2)
    if goal.needs_truth:
        _check_truth(objective, rows, "the recordings")
        _check_truth(objective, apart, "the held-out recordings")
    if not (goal.needs_truth and isinstance(objective, str)):
        return goal
    first = rows[0].rows(slice(0, 2)).columns(0, 1)
    mean = jax.eval_shape(lambda: tracker.scan(first)[0]).mean
    estimated = len(jax.tree_util.tree_leaves(getattr(mean, quantity, ()))) or 2
    true = rows[0].truth[quantity][0].shape[1] if "state-nll" in objective else 2
    return named_objective(objective, tracker, quantity, min(dimensions or true, estimated))
