"""Steps and repetitions of the readings of a tracker.

Readings that a source repeats until it has a new one are given to trackers
once. A coarse grid repeats readings by chance, which are new ones. The chance is bounded by the changes after a clear
change, when the tag or its readings move: of a log-concave distribution of the change, in steps, P(0) ≤ P(1)²/P(2).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatch

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.recordings.checks.readings import (
    LEAST_PAIRS,
    MANY,
    Readings,
    changes,
    quantisation_step,
    readings,
    repeated_share,
)
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, distinct, duplicates_line, std_column, wrapped

MOST_ROWS = 20_000
"""Rows of a sensor that are looked at."""

REPEATED = 0.5
"""Share of repeated readings from which on they are not independent."""

MOST_SOURCES = 64
"""Stations or anchors that readings of a channel are told apart by."""

HELD = 0.5
"""Least share of the repeats that chance does not explain where a source repeats its readings."""

CLEAR = 1.5
"""Least size of a clear change, in steps."""


@dataclass(frozen=True)
class ReadingGrid:
    """The readings of one unit of a sensor: their quantisation step, NaN without one, and the share that repeats.

    `repeated`: readings equal in all their channels to the reading before of the same station or anchor. `change`: the
    median difference of a reading from the one before where it is another, NaN without any.
    """

    sensor: str
    unit: str
    step: float
    repeated: float
    change: float

    @property
    def floor(self) -> float:
        """The standard deviation of the rounding to steps, step/√12; NaN without a step."""
        return self.step / math.sqrt(12.0)

    @property
    def lowest(self) -> float:
        """The least noise level that a fit may find: `floor`, or from the changes where most readings repeat.

        A reading that is held is off by part of the change to the next, as a rounded one is by part of a step.
        """
        change = self.change if self.repeated > REPEATED else math.nan
        return float(np.fmax(self.step, change)) / math.sqrt(12.0)

    def limits(self, name: str, tunable: object) -> bool:
        """Whether the tunable of this name is a noise level of these readings."""
        return (
            isinstance(tunable, Scale) and tunable.unit == self.unit and fnmatch(name, f"sensors.{self.sensor}.sigma*")
        )


def reading_grids(tracker: AbstractTracker, batches: Iterable[Batch]) -> list[ReadingGrid]:
    """The steps and repetitions of the readings of each sensor and unit; none for a tracker without sensors.

    `batches`: looked through once for each sensor, as far as its first `MOST_ROWS` rows.
    """
    grids: list[ReadingGrid] = []
    for name, sensor in tracker.sensors.items() if isinstance(tracker, Tracker) else ():
        read = _readings(name, sensor, (batch for batch in batches if name in batch.readings))
        if read is None:
            continue
        repeated = float(np.nan_to_num(repeated_share(read)))
        for unit in dict.fromkeys(channel.unit for channel in sensor.channels):
            of_unit = [k for k, channel in enumerate(sensor.channels) if channel.unit == unit]
            steps = [step for k in of_unit if (step := quantisation_step(read, k)) is not None]
            changes = [change for k in of_unit if (change := _typical_change(read, k)) > 0.0]
            step, change = (min(numbers, default=math.nan) for numbers in (steps, changes))
            grids.append(ReadingGrid(name, unit, step, repeated, change))
    return grids


def _typical_change(read: Readings, column: int) -> float:
    """The median difference of successive readings of a stream that differ; 0 without any."""
    x, stream = read.values[:, column], read.stream
    seen = np.isfinite(x)
    x, stream = x[seen], stream[seen]
    differences = np.abs(wrapped(np.diff(x)[:, None], (read.columns[column],))[:, 0][stream[1:] == stream[:-1]])
    differences = differences[differences > 0.0]
    return float(np.median(differences)) if len(differences) else 0.0


def with_rounding(folder: RecordingFolder, names: Collection[str]) -> RecordingFolder:
    """The recording with the standard deviation of their rounding, step/√12, for readings that report none.

    Tables of these names without standard deviations. Averages have the step of the readings averaged.
    """
    tables = dict[str, pl.DataFrame]()
    for name, kind in KINDS.items():
        table = folder.tables.get(name)
        if table is None or name not in names or not kind.averaged:
            continue
        if any(std_column(column) in table.columns for column in kind.least):
            continue
        read = readings(folder.unaveraged or folder, name)
        steps = ((column, quantisation_step(read, k)) for k, column in enumerate(read.columns))
        spreads = {std_column(column): pl.lit(step / math.sqrt(12.0)) for column, step in steps if step is not None}
        if spreads:
            tables[name] = table.with_columns(**spreads)
    return replace(folder, tables={**folder.tables, **tables}) if tables else folder


def _readings(name: str, sensor: AbstractSensor, batches: Iterable[Batch]) -> Readings | None:
    """The readings of a sensor by trajectory, and by station or anchor; None without any."""
    inputs, values, streams = [each.name for each in sensor.inputs], list[np.ndarray](), list[np.ndarray]()
    for batch in batches:
        if sum(len(x) for x in values) == MOST_ROWS:
            break
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
    joined = np.concatenate(values)
    return Readings(columns, np.concatenate(streams), joined)


def _sources(inputs: Float[np.ndarray, "n i"]) -> np.ndarray:
    """A number for each different row of inputs; one for all where there are too many, as with moving inputs."""
    different, index = np.unique(inputs, axis=0, return_inverse=True)
    return index.ravel() if len(different) <= MOST_SOURCES else np.zeros(len(inputs), int)


def counted_once(folder: RecordingFolder, names: Collection[str]) -> tuple[RecordingFolder, list[str]]:
    """The recording without duplicate rows, and without the values that a source only repeats in the tables of `names`.

    Also a line for each table with repeats, and with duplicates that the folder's notices do not count. Rows of
    repeated values stay, without a value, and so do all in a recording with an interval of averages, zero included.
    """
    tables, lines = dict[str, pl.DataFrame](), list[str]()
    for name, kind in KINDS.items():
        if name not in folder.tables:
            continue
        rows = distinct(folder.tables[name], kind)
        if duplicates := folder.tables[name].height - rows.height:
            tables[name], line = rows, duplicates_line(name, duplicates)
            lines += [f"{folder.name}: {line}"] * (line not in folder.notices)
    folder = replace(folder, tables={**folder.tables, **tables}) if tables else folder
    tables = {}
    for name, kind in KINDS.items():
        if folder.average_s is not None or not kind.averaged or name not in names or name not in folder.tables:
            continue
        if not source_repeats(readings(folder, name)):
            continue
        table, layout = folder.tables[name], kind.layout(folder.tables[name].columns)
        values = [pl.col(column) for column in layout.values]
        same = pl.all_horizontal(x.eq_missing(x.forward_fill().shift().over(layout.ids)) for x in values)
        held = table.select(same & pl.any_horizontal(x.is_not_null() for x in values)).to_series()
        tables[name] = table.with_columns(pl.when(~held).then(x) for x in values)
        lines.append(
            f"{folder.name}: {name}: {held.sum()} of {table.height} rows repeat the value before of the same "
            f"{' and '.join(layout.ids)}, more than by chance; each value is used once (every row: --average 0)"
        )
    return (replace(folder, tables={**folder.tables, **tables}) if tables else folder), lines


def source_repeats(read: Readings) -> bool:
    """Whether readings repeat the one before so often that most repeats are no new readings."""
    if not repeated_share(read) >= MANY:
        return False
    follows, moved = changes(read)
    steps = np.array([quantisation_step(read, k) or 0.0 for k in range(len(read.columns))])
    clear = (np.abs(moved) > CLEAR * steps).any(axis=1)
    # A change follows the one before where the rows of both have a predecessor in one stream.
    after = np.flatnonzero(follows[1:] & follows[:-1] & clear[:-1]) + 1
    if len(after) < LEAST_PAIRS:
        return False
    share = float(np.mean((moved[after] == 0.0).all(axis=1)))
    # All columns repeat at most as often as each of them.
    chance = min((chance_of_repeat(moved[after, k], step) for k, step in enumerate(steps)), default=0.0)
    return share >= MANY and share - chance > HELD * share


def chance_of_repeat(moved: np.ndarray, step: float) -> float:
    """A bound of the probability that a change (n,) in steps of `step` is zero by chance; 0 without steps."""
    if step == 0.0:
        return 0.0
    one, two = (np.count_nonzero(np.round(np.abs(moved) / step) == k) / 2 for k in (1, 2))
    return one**2 / max(two, 1.0) / len(moved)
