"""Objectives by name: what a command is told to make small, and all of them at once for a report."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np

from trackers.core.chunks import CHUNK, as_dtype, chunks, run_chunks
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from tuning.consistency import Consistency
from tuning.objectives import (
    AbstractObjective,
    MissingQuantityError,
    NegativeLogLikelihood,
    RootMeanSquareError,
    StateLogLikelihood,
    Weighted,
)

OBJECTIVES: Mapping[str, Callable[[str, int], AbstractObjective]] = MappingProxyType(
    {
        "nll": lambda quantity, dimensions: NegativeLogLikelihood(),
        "rmse": RootMeanSquareError,
        "state-nll": StateLogLikelihood,
        "nis-shape": lambda quantity, dimensions: Consistency("nis"),
        "nees-shape": lambda quantity, dimensions: Consistency("nees", quantity, dimensions),
    }
)
"""An objective's maker by its name: of a quantity, and of how many of its components."""

SUMMAND = re.compile(r"\s*(?:([0-9.]+(?:[eE][+-]?[0-9]+)?)\s*\*\s*)?([a-z][a-z-]*)\s*")


def parse_objective(text: str, quantity: str = "position", dimensions: int = 2) -> AbstractObjective:
    """The objective that a text as `nll`, `0.1*rmse + nll` or `nll+5*nees-shape` names.

    Raises ValueError for an unknown name, one that comes twice, and a weight that isn't above zero.
    """
    parts: dict[str, AbstractObjective] = {}
    weights, at = [], 0
    while True:
        found = SUMMAND.match(text, at)
        if found is None or found[2] not in OBJECTIVES or found[2] in parts:
            names = ", ".join(OBJECTIVES)
            raise ValueError(f"'{text}' is no objective; expected some of {names}, each once, as 'nll+0.1*rmse'")
        try:
            weights.append(float(found[1] or 1.0))
        except ValueError as error:
            raise ValueError(f"'{text}': the weight '{found[1]}' is not a number") from error
        parts[found[2]] = OBJECTIVES[found[2]](quantity, dimensions)
        at = found.end()
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
    chunk: int = CHUNK,
) -> dict[str, float]:
    """All objectives of a tracker over batches, in one pass, whatever was made small.

    By the names of `OBJECTIVES`, and `rmse-3d` for a position in space: there `rmse` is the error over the floor. NaN
    where there is none: truth or a covariance is missing. What isn't finite of a trajectory has no say in that figure.
    """
    batches = [batches] if isinstance(batches, Batch) else list(batches)
    judges = _judges(tracker, batches, quantity, dimensions)
    try:
        found = _figures(tracker, batches, judges, chunk)
    except MissingQuantityError:
        judges = {name: judge for name, judge in judges.items() if not judge.needs_truth}
        found = _figures(tracker, batches, judges, chunk)
    return dict.fromkeys([*OBJECTIVES, "rmse-3d"], math.nan) | found


def _figures(
    tracker: AbstractTracker, batches: Sequence[Batch], judges: Mapping[str, AbstractObjective], chunk: int
) -> dict[str, float]:
    every = Weighted(tuple(judges.values()), (1.0,) * len(judges)).informed(tracker)
    model = as_dtype((tracker, every), batches[0].dt.dtype)
    parts = run_chunks(_sums, [(model, part) for batch in batches for part in chunks(batch, chunk)])
    sums = np.concatenate([np.asarray(part, float) for part in parts], axis=-1)
    figures = {}
    for name, judge, own in zip(judges, every.parts, every.shares(sums), strict=True):
        total = own[:, np.isfinite(own).all(axis=0)].sum(axis=-1)
        if total[-1] > 0:  # every objective's last sum is how much it counted
            figures[name] = float(judge.value(jnp.asarray(total)))
    return figures


def _sums(model: Any, batch: Batch) -> Any:
    tracker, every = model
    return jnp.stack(tracker.accumulate(batch, every.terms))


def _judges(
    tracker: AbstractTracker, batches: Sequence[Batch], quantity: str, dimensions: int
) -> dict[str, AbstractObjective]:
    """The objectives that there can be: without truth of the quantity those that need none."""
    floor = min(dimensions, 2)
    judges = {name: make(quantity, floor if name == "rmse" else dimensions) for name, make in OBJECTIVES.items()}
    if dimensions == 3:
        judges["rmse-3d"] = RootMeanSquareError(quantity, 3)
    try:
        judges["nis-shape"].informed(tracker)
    except ValueError:
        del judges["nis-shape"]
    named = all(quantity in batch.truth for batch in batches)
    known = named and any(np.any(batch.truth[quantity][1]) for batch in batches)
    return {name: judge for name, judge in judges.items() if known or not judge.needs_truth}
