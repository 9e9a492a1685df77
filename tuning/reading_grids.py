"""Steps and repetitions of the readings that a tracker is fitted to: what limits a noise level from below."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch

import numpy as np
from jaxtyping import Float

from trackers.core.recording import Batch
from trackers.core.sensor import AbstractSensor
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.core.tunable import Scale
from trackers.recordings.checks.quantisation import quantisation_step
from trackers.recordings.checks.readings import Readings
from trackers.recordings.checks.repeats import repeated_share
from tuning.parameters import Parameter

MOST_ROWS = 20_000
"""Rows of a sensor that are looked at."""

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
        read = _readings(name, sensor, [batch for batch in batches if name in batch.readings])
        if read is None:
            continue
        repeated = float(np.nan_to_num(repeated_share(read)))
        for unit in dict.fromkeys(channel.unit for channel in sensor.channels):
            own = [k for k, channel in enumerate(sensor.channels) if channel.unit == unit]
            steps = [step for k in own if (step := quantisation_step(read, k)) is not None]
            found.append(ReadingGrid(name, unit, min(steps, default=math.nan), repeated))
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


def _readings(name: str, sensor: AbstractSensor, batches: Sequence[Batch]) -> Readings | None:
    """The readings of a sensor by trajectory, and by station or anchor; None without any."""
    inputs, values, streams = [each.name for each in sensor.inputs], list[np.ndarray](), list[np.ndarray]()
    for batch in batches:
        read, seen = (np.asarray(x) for x in batch.readings[name][:2])
        for k in range(batch.size):
            rows = np.flatnonzero(seen[:, :, k].any(axis=1))[: MOST_ROWS - sum(len(x) for x in values)]
            if not len(rows):
                continue
            given = [np.asarray(batch.inputs[i])[rows, ..., k] for i in inputs if i in batch.inputs]
            source = _sources(np.concatenate([x.reshape(len(rows), -1) for x in given], axis=1)) if given else 0 * rows
            order = np.argsort(source, kind="stable")
            values.append(np.where(seen[rows, :, k], read[rows, :, k].astype(float), np.nan)[order])
            streams.append(len(streams) * MOST_SOURCES + source[order])
    if not any(len(x) for x in values):
        return None
    # The column of an angle is named so that its wraps are known.
    columns = tuple(f"{channel.name}_{channel.unit}" for channel in sensor.channels)
    every = np.concatenate(values)
    return Readings(columns, np.concatenate(streams), np.zeros(len(every)), every, np.full(every.shape, np.nan))


def _sources(inputs: Float[np.ndarray, "n i"]) -> np.ndarray:
    """A number for each different row of inputs; one for all where there are too many, as with moving inputs."""
    different, index = np.unique(inputs, axis=0, return_inverse=True)
    return index.ravel() if len(different) <= MOST_SOURCES else np.zeros(len(inputs), int)
