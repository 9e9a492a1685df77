"""Readings that a source repeats until it has a new one: each is given to trackers once.

A coarse grid repeats readings by chance, which are new ones. The chance is bounded by the changes after a clear change,
when the tag or its readings move: of a log-concave distribution of the change, in steps, P(0) ≤ P(1)²/P(2).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import polars as pl

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
from trackwright.trackers.recordings.kinds import KINDS

HELD = 0.5
"""Least share of the repeats that chance does not explain where a source repeats its readings."""

CLEAR = 1.5
"""Least size of a clear change, in steps."""


def counted_once(folder: RecordingFolder, names: Collection[str]) -> tuple[RecordingFolder, list[str]]:
    """The recording without the values that a source only repeats in the tables of these names, and a line for each.

    Rows stay, without a value. A recording with an interval of averages, zero included, is as it is.
    """
    tables, lines = dict[str, pl.DataFrame](), list[str]()
    for name, kind in KINDS.items():
        if folder.average_s is not None or not kind.averaged or name not in names or name not in folder.tables:
            continue
        if not source_repeats(readings(folder, name, errors=False)):
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
