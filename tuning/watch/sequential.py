"""The sequential test: a CUSUM (Page 1954) for every change that a source may have, all over and at each place.

Each adds up log-likelihood ratios of a change of the smallest size worth telling against none, and starts again at
zero. Where those are right, the mean time between false alarms of one with threshold h is at least exp(h) blocks
(Lorden 1971); so h = log(changes × blocks a day / alarms a day) keeps all of them together to a stated number a day. A
shift of less than half that size, as a constant error of the baseline that is not known better, lets none of them rise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from trackwright.tuning.watch.normal import Normal
from trackwright.tuning.watch.parity import Blocks
from trackwright.tuning.watch.readings import SLOT_S, Source

LEAST_M, LEAST_RAD = 0.1, np.radians(3.0)
"""The smallest changes worth telling: of a range, a difference or a position of an anchor, and of an angle."""

AT_PLACE = 2.0
"""Smallest change at one place, in units of those: less is common where a tag is carried another way round."""

STANDARD_ERRORS = 6.0
"""Standard errors of the baseline that a change is at least to be told."""

LARGEST = 3.0
"""Standard deviations of a block that count: errors have tails."""

DAY_S = 86400.0


@dataclass(frozen=True, eq=False)
class Bank:
    """The changes that are tested, K of them, both signs of each.

    `source` (K,): the number of the source; `unit` (P, K): the parameters of a unit change; `place` (K,): −1 for one
    all over; `least` (K,): its smallest size, m or rad; `scatter` (K,): as of `Normal`.
    """

    source: Int[np.ndarray, " K"]
    unit: Float[np.ndarray, "P K"]
    place: Int[np.ndarray, " K"]
    least: Float[np.ndarray, " K"]
    scatter: Float[np.ndarray, " K"]


@dataclass(frozen=True, eq=False)
class Course:
    """The statistics (B, 2K) of the test after each block, their threshold, and the first block above it, if any."""

    statistic: Float[np.ndarray, "B signs"]
    threshold: float
    alarm: int | None

    def onset(self, block: int, change: int) -> int:
        """The first block after the last one at which the statistic of a change was zero."""
        zero = np.flatnonzero(self.statistic[: block + 1, change] <= 0.0)
        return int(zero[-1]) + 1 if len(zero) else 0


def bank_of(sources: Sequence[Source], normal: Normal, blocks: Blocks, factor: float = 1.0) -> Bank:
    """The changes of the sources; `blocks`: of the baseline, corrected; `factor`: of the smallest sizes."""
    count = blocks.score.shape[1]
    place = normal.place_of(blocks)
    columns, of_source, at_place, least = list[np.ndarray](), list[int](), list[int](), list[float]()

    def add(number: int, unit: np.ndarray, size: float, where: int = -1) -> None:
        columns.append(unit)
        of_source.append(number)
        at_place.append(where)
        least.append(size * factor)

    for number, source in enumerate(sources):
        unit = np.eye(count)[source.first : source.first + len(source.parameters)]
        if source.table == "bearings":
            for k in range(2):
                add(number, unit[k], LEAST_RAD)
                for where in range(len(normal.places)):
                    add(number, unit[k], AT_PLACE * LEAST_RAD, where)
            continue
        add(number, unit[0], LEAST_M)
        for angle in np.pi / 4 * np.arange(4):
            add(number, np.cos(angle) * unit[1] + np.sin(angle) * unit[2], LEAST_M)
        add(number, unit[3], LEAST_M)
        for where in range(len(normal.places)):
            add(number, unit[0], AT_PLACE * LEAST_M, where)
    units, places = np.array(columns).T, np.array(at_place)
    scatter = (units**2 * normal.scatter[:, None]).sum(axis=0)
    known = np.einsum("bij,ik,jk->bk", blocks.information, units, units, optimize=True)
    known = np.where((places < 0) | (places == place[:, None]), known, 0.0).sum(axis=0)
    own = np.maximum(least, STANDARD_ERRORS * np.sqrt(scatter / np.maximum(known, 1e-12)))
    return Bank(np.array(of_source), units, places, own, scatter)


def course_of(blocks: Blocks, bank: Bank, normal: Normal, alarms_a_day: float) -> Course:
    """The course of the test over corrected blocks in the order of time, to its end."""
    place = normal.place_of(blocks)
    here = (bank.place < 0) | (bank.place == place[:, None])
    known = np.einsum("bij,ik,jk->bk", blocks.information, bank.unit, bank.unit, optimize=True)
    known = np.where(here, known, 0.0) / bank.scatter
    change = (blocks.score @ bank.unit) / bank.scatter / np.maximum(known, 1e-12)
    # A block is not known better than to half the smallest change: neither are its constants.
    sigma = np.maximum(1.0 / np.sqrt(np.maximum(known, 1e-12)), bank.least / 2.0)
    change = np.clip(change, -LARGEST * sigma, LARGEST * sigma)
    ratio = bank.least / sigma
    step = np.concatenate([sign * ratio * change / sigma - ratio**2 / 2.0 for sign in (1.0, -1.0)], axis=1)
    step = np.where(np.concatenate([known, known], axis=1) > 0.0, step, 0.0)
    statistic = np.zeros((len(step) + 1, step.shape[1]))
    for k, row in enumerate(step):
        np.maximum(statistic[k] + row, 0.0, out=statistic[k + 1])
    threshold = threshold_of(blocks, step.shape[1], alarms_a_day)
    above = np.flatnonzero((statistic[1:] > threshold).any(axis=1))
    return Course(statistic[1:], threshold, int(above[0]) if len(above) else None)


def threshold_of(blocks: Blocks, changes: int, alarms_a_day: float) -> float:
    """The threshold that keeps all changes together to so many false alarms a day."""
    slots = len(np.unique(np.stack([blocks.track, blocks.slot]), axis=1).T)
    tags_at_once = slots / max(len(np.unique(blocks.slot)), 1)
    a_day = DAY_S / SLOT_S * tags_at_once * len(blocks.slot) / max(slots, 1)
    return float(np.log(changes * a_day / alarms_a_day))
