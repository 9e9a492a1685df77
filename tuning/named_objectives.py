"""Objectives by name: parsing a text such as `nll+0.1*rmse`, and all objectives of a tracker at once."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.tuning.objectives import (
    AbstractObjective,
    MissingQuantityError,
    NegativeLogLikelihood,
    RootMeanSquareError,
    StateLogLikelihood,
    Weighted,
)
from trackwright.tuning.problem import Problem

HEIGHT_WEIGHT = 0.5
"""Weight of an estimated height beside each coordinate of the plane in `state-nll`.

Noise levels that act on the height alone are fitted to it all the same; those that it shares with the plane follow the
plane's two coordinates, four times as heavy.
"""

OBJECTIVES: Mapping[str, Callable[[str, int], AbstractObjective]] = MappingProxyType(
    {
        "nll": lambda quantity, dimensions: NegativeLogLikelihood(),
        "rmse": RootMeanSquareError,
        "state-nll": lambda quantity, dimensions: StateLogLikelihood(
            quantity, dimensions, HEIGHT_WEIGHT if dimensions == 3 else 1.0
        ),
    }
)
"""Constructors by name, each of a quantity and its number of components."""

SUMMAND = re.compile(r"\s*(?:([0-9.]+(?:[eE][+-]?[0-9]+)?)\s*\*\s*)?([a-z][a-z-]*)\s*")


def parse_objective(text: str, quantity: str = "position", dimensions: int = 2) -> AbstractObjective:
    """The objective of a text such as `nll`, or `0.1*rmse + nll`.

    Raises ValueError for an unknown or duplicate name, and for a weight that isn't positive.
    """
    parts: dict[str, AbstractObjective] = {}
    weights, at = [], 0
    while True:
        match = SUMMAND.match(text, at)
        if match is None or match[2] not in OBJECTIVES or match[2] in parts:
            names = ", ".join(OBJECTIVES)
            raise ValueError(f"'{text}' is no objective; expected some of {names}, each once, as 'nll+0.1*rmse'")
        try:
            weights.append(float(match[1] or 1.0))
        except ValueError as error:
            raise ValueError(f"'{text}': the weight '{match[1]}' is not a number") from error
        parts[match[2]] = OBJECTIVES[match[2]](quantity, dimensions)
        at = match.end()
        if at == len(text):
            break
        if text[at] != "+":
            raise ValueError(f"'{text}': found '{text[at:]}' where '+' and another objective were expected")
        at += 1
    only = list(parts.values())
    return only[0] if len(only) == 1 and weights == [1.0] else Weighted(tuple(only), tuple(weights))


def all_metrics(
    tracker: AbstractTracker,
    batches: Batch | Sequence[Batch],
    quantity: str = "position",
    dimensions: int = 2,
    weights: Sequence[Float[np.ndarray, " B"]] | None = None,
) -> dict[str, float]:
    """All objectives of a tracker over batches by name, in one pass; `weights`: of the trajectories of each batch.

    `rmse` of a position is horizontal, `rmse-3d` in space. NaN without truth or covariance. Each metric is over
    the trajectories for which it is finite.
    """
    batches = [batches] if isinstance(batches, Batch) else list(batches)
    objectives = _available(batches, quantity, dimensions)
    try:
        metrics = _evaluated(tracker, batches, objectives, weights)
    except MissingQuantityError:
        without_truth = {name: objective for name, objective in objectives.items() if not objective.needs_truth}
        metrics = _evaluated(tracker, batches, without_truth, weights)
    return dict.fromkeys([*OBJECTIVES, "rmse-3d"], math.nan) | metrics


def _evaluated(
    tracker: AbstractTracker,
    batches: Sequence[Batch],
    objectives: Mapping[str, AbstractObjective],
    weights: Sequence[Float[np.ndarray, " B"]] | None,
) -> dict[str, float]:
    together = Weighted(tuple(objectives.values()), (1.0,) * len(objectives))
    (sums,) = Problem(tracker, batches, together, [], weights=weights).terms(np.zeros((1, 0)))
    metrics = {}
    for name, objective, terms in zip(objectives, together.parts, together.split(sums), strict=True):
        total = terms[:, np.isfinite(terms).all(axis=0)].sum(axis=-1)
        if total[-1] > 0:  # the last sum of every objective counts what it is over
            metrics[name] = float(objective.value(jnp.asarray(total)))
    return metrics


def _available(batches: Sequence[Batch], quantity: str, dimensions: int) -> dict[str, AbstractObjective]:
    """The objectives by name; without truth of the quantity those that need none."""
    horizontal = min(dimensions, 2)
    objectives = {n: OBJECTIVES[n](quantity, horizontal if n == "rmse" else dimensions) for n in OBJECTIVES}
    if dimensions == 3:
        objectives["rmse-3d"] = RootMeanSquareError(quantity, 3)
    in_truth = all(quantity in batch.truth for batch in batches)
    known = in_truth and any(np.any(batch.truth[quantity][1]) for batch in batches)
    return {name: objective for name, objective in objectives.items() if known or not objective.needs_truth}
