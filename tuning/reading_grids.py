"""Steps and repetitions of the readings that a tracker is fitted to: what limits a noise level from below."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch

import numpy as np
from jaxtyping import Bool, Float

from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.core.tunable import Scale
from tuning.parameters import Parameter

MOST_VALUES = 20_000
"""Values of a channel that are looked at, the first ones."""

MIN_VALUES = 100
"""Values of a channel below which no step is looked for."""

MAX_OFF_GRID = 0.1
"""Deviation from multiples of the step, in steps, up to which values lie on a grid."""

MOST_SOURCES = 64
"""Stations or anchors that readings of a channel are told apart by."""


@dataclass(frozen=True)
class ReadingGrid:
    """The readings of one unit of a sensor: their quantisation step, NaN without one, and the share that repeats.

    `repeated`: readings equal in all their channels to the reading before of the same station or anchor.
    """

    sensor: str
    unit: str
    step: float
    repeated: float

    @property
    def floor(self) -> float:
        """The standard deviation of the rounding to steps, step/√12; NaN without a step."""
        return self.step / math.sqrt(12.0)


def reading_grids(tracker: AbstractTracker, batches: Sequence[Batch]) -> list[ReadingGrid]:
    """The steps and repetitions of the readings of each sensor and unit; none for a tracker without sensors."""
    found: list[ReadingGrid] = []
    for name, sensor in tracker.sensors.items() if isinstance(tracker, Tracker) else ():
        parts = [batch for batch in batches if name in batch.readings]
        columns = [_columns(batch, name) for batch in parts]
        repeated = _repeated(parts, name, [each.name for each in sensor.inputs])
        for unit in dict.fromkeys(channel.unit for channel in sensor.channels):
            own = [k for k, channel in enumerate(sensor.channels) if channel.unit == unit]
            steps = [_step(np.concatenate([values[k] for values in columns])[:MOST_VALUES]) for k in own if columns]
            step = min((s for s in steps if math.isfinite(s)), default=math.nan)
            found.append(ReadingGrid(name, unit, step, repeated))
    return found


def floors(
    grids: Sequence[ReadingGrid], parameters: Sequence[Parameter], bounds: Mapping[str, tuple[float, float]]
) -> Float[np.ndarray, " p"]:
    """The lowest unconstrained vector (p,) with no noise level below the rounding of its readings; -inf elsewhere.

    Parameters that the user's `bounds` name have none.
    """
    low = [np.full(parameter.size, -np.inf) for parameter in parameters]
    for parameter, part in zip(parameters, low, strict=True):
        named = any(fnmatch(name, pattern) for pattern in bounds for name in (*parameter.names, parameter.label))
        grid = None if named else grid_of(grids, parameter)
        if grid is not None and math.isfinite(grid.floor):
            part[:] = math.log(grid.floor)
    return np.concatenate(low)


def grid_of(grids: Sequence[ReadingGrid], parameter: Parameter) -> ReadingGrid | None:
    """The readings whose noise level a parameter is, the finest of several tied ones; None for other parameters."""
    if not isinstance(parameter.example, Scale):
        return None
    own = [
        grid
        for grid in grids
        if grid.unit == parameter.example.unit
        and any(fnmatch(name, f"sensors.{grid.sensor}.sigma*") for name in parameter.names)
    ]
    return min(own, key=lambda grid: grid.floor if math.isfinite(grid.floor) else 0.0, default=None)


def _columns(batch: Batch, name: str) -> list[Float[np.ndarray, " _"]]:
    """The values seen in each channel, trajectory by trajectory."""
    values, seen = (np.asarray(x) for x in batch.readings[name][:2])
    return [values[:, k].T[seen[:, k].T].astype(float) for k in range(values.shape[1])]


def _step(values: Float[np.ndarray, " n"]) -> float:
    """The step of the grid that the values lie on; NaN where they lie on none, or hardly share values."""
    different = np.unique(values)
    if len(values) < MIN_VALUES or len(different) < 3 or len(different) > len(values) / 2:
        return math.nan
    gaps = np.diff(different)
    # Differences far below the others are rounding of one and the same value.
    gaps = gaps[gaps > 1e-3 * float(np.median(gaps))]
    step = float(gaps.min())
    for _ in range(3):
        counts = np.round((different - different[0]) / step)
        step = float(np.polyfit(counts, different, 1)[0]) if counts[-1] > 0 else math.nan
        if not step > 0:
            return math.nan
    offset = float(np.median(different - counts * step))
    off = np.abs(different - offset - counts * step) / step
    return step if float(np.quantile(off, 0.99)) <= MAX_OFF_GRID else math.nan


def _repeated(batches: Sequence[Batch], name: str, inputs: Sequence[str]) -> float:
    """The share of readings that are equal to the last one of the same trajectory and of the same `inputs`."""
    repeated = total = 0
    for batch in batches:
        values, seen = (np.asarray(x) for x in batch.readings[name][:2])
        for k in range(batch.size):
            rows = np.flatnonzero(seen[:, :, k].any(axis=1))[:MOST_VALUES]
            if len(rows) < 2 or total > MOST_VALUES:
                continue
            where = [
                np.asarray(batch.inputs[i])[rows, ..., k].reshape(len(rows), -1) for i in inputs if i in batch.inputs
            ]
            group = _sources(np.concatenate(where, axis=1)) if where else np.zeros(len(rows), int)
            order = np.argsort(group, kind="stable")
            shown = np.where(seen[rows, :, k], values[rows, :, k], 0.0)[order]
            same: Bool[np.ndarray, " n"] = (shown[1:] == shown[:-1]).all(axis=1)
            same &= (seen[rows, :, k][order][1:] == seen[rows, :, k][order][:-1]).all(axis=1)
            follows = group[order][1:] == group[order][:-1]
            repeated, total = repeated + int((same & follows).sum()), total + int(follows.sum())
    return repeated / total if total else 0.0


def _sources(inputs: Float[np.ndarray, "n i"]) -> np.ndarray:
    """A number for each different row of inputs; one for all where there are too many, as with moving inputs."""
    different, index = np.unique(inputs, axis=0, return_inverse=True)
    return index.ravel() if len(different) <= MOST_SOURCES else np.zeros(len(inputs), int)
