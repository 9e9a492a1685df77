"""A site in normal operation: the constant errors of its sources by place, and how far scores scatter about them.

Both are of the baseline recordings. The scatter is that of sums over stretches of many lengths, about constants that
other recordings gave, or other parts of the only one: errors that last, that return with the place and that differ from
one session to the next widen it, as they do in the recordings that are watched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from jaxtyping import Float, Int
from scipy.stats import chi2

from trackwright.tuning.watch.parity import Blocks
from trackwright.tuning.watch.readings import SLOT_S, Readings, Source

OFFSET_SIGMA, PLACE_SIGMA = 0.3, 0.1
"""Standard deviations of constant errors of a source, and of those of a place beyond it, m and rad."""

STRETCHES = (1, 2, 4, 8, 16, 32, 64)
"""Blocks whose scores are summed for their scatter."""

LEAST_STRETCHES, CONFIDENCE = 6, 0.2
"""Fewest stretches of a length, and the quantile of χ² with which few of them count as scatter that is larger."""

PLACES_M, MOST_PLACES, OFTEN = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 14.0, 20.0), 20, 0.9
"""Sizes of places, m, their most, and the share of the baseline that is in places that are watched."""

LEAST_BLOCKS, PARTS = 4, 4
"""Fewest blocks of a place that is watched, and parts of a single baseline recording."""


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal operation of a site.

    `offsets` (P_o,): the numbers of the parameters that are constant errors; `places` (C, 2): the cells that are
    watched; `constants` (C, P_o); `scatter` (P,): the long-run variance of scores of each parameter, in units of its
    information; `information` (P,): that of the baseline.
    """

    offsets: Int[np.ndarray, " o"]
    places: Int[np.ndarray, "C 2"]
    constants: Float[np.ndarray, "C o"]
    scatter: Float[np.ndarray, " P"]
    information: Float[np.ndarray, "P P"]

    def place_of(self, blocks: Blocks) -> Int[np.ndarray, " B"]:
        """The number of the place of each block, −1 for one that the baseline has not seen."""
        return place_numbers(blocks.cell, self.places)

    def corrected(self, blocks: Blocks) -> Blocks:
        """The blocks in known places with the constant errors removed."""
        place = self.place_of(blocks)
        return _without(blocks.chosen(place >= 0), self.constants[place[place >= 0]], self.offsets)


def place_numbers(cells: Int[np.ndarray, "B 2"], places: Int[np.ndarray, "C 2"]) -> Int[np.ndarray, " B"]:
    """The number in `places` of each cell, −1 for one that is not there."""
    known = np.concatenate([places, cells])
    _, first, number = np.unique(known, axis=0, return_index=True, return_inverse=True)
    found = first[number.ravel()[len(places) :]]
    return np.where(found < len(places), found, -1)


def place_size(readings: Mapping[str, Readings]) -> float:
    """The smallest size of places, m, with which nearly all of the baseline is in few places that are seen often."""
    slots = pl.concat(
        pl.DataFrame(
            {"track": r.track, "slot": np.floor(r.times / SLOT_S), "x": r.positions[:, 0], "y": r.positions[:, 1]}
        )
        for r in readings.values()
    )
    for size in PLACES_M:
        cell = [(pl.col(axis) / size).floor() for axis in ("x", "y")]
        visits = slots.select("track", "slot", *cell).unique().group_by("x", "y").len()["len"]
        often = visits.filter(visits >= LEAST_BLOCKS)
        if len(often) <= MOST_PLACES and float(often.sum()) >= OFTEN * float(visits.sum()):
            return size
    return PLACES_M[-1]


def normal_of(blocks: Blocks, run: Int[np.ndarray, " B"], sources: Sequence[Source]) -> Normal:
    """Normal operation from the blocks of the baseline; `run` (B,): the recording of each."""
    cells, number = np.unique(blocks.cell, axis=0, return_inverse=True)
    slots = [
        len(np.unique(np.stack([blocks.track, blocks.slot])[:, number.ravel() == k], axis=1).T)
        for k in range(len(cells))
    ]
    places = cells[np.array(slots) >= LEAST_BLOCKS]
    offsets = np.array([k for source in sources for k in source.offsets], int)
    place = place_numbers(blocks.cell, places)
    known = blocks.chosen(place >= 0)
    place, run = place[place >= 0], run[place_numbers(blocks.cell, places) >= 0]
    scatter = scatter_of(known.score, known.information)
    fold = _folds(known, run)
    for _ in range(2):
        left = np.zeros_like(known.score)
        usable = np.zeros(len(place), bool)
        for k in np.unique(fold):
            out, rest = fold == k, fold != k
            constants = _constants(known.chosen(rest), place[rest], len(places), offsets, scatter)
            seen = out & np.isin(place, np.unique(place[rest]))
            left[seen] = _without(known.chosen(seen), constants[place[seen]], offsets).score
            usable |= seen
        order = np.lexsort((known.slot[usable], run[usable], fold[usable]))
        scatter = scatter_of(left[usable][order], known.information[usable][order])
    constants = _constants(known, place, len(places), offsets, scatter)
    information = known.information.sum(axis=0)
    return Normal(offsets, places, constants, scatter, information)


def _folds(blocks: Blocks, run: np.ndarray) -> np.ndarray:
    """The part (B,) of the baseline that each block belongs to: its recording, or a quarter of the only one."""
    if len(np.unique(run)) > 1:
        return run
    return np.argsort(np.argsort(blocks.slot, kind="stable"), kind="stable") * PARTS // len(run)


def _without(blocks: Blocks, constants: np.ndarray, offsets: np.ndarray) -> Blocks:
    """The blocks with the constant errors (B, P_o) of each removed from the scores."""
    change = np.einsum("bpo,bo->bp", blocks.information[:, :, offsets], constants)
    of_energy = np.einsum("bo,bo->b", constants, change[:, offsets] - 2.0 * blocks.score[:, offsets])
    return blocks._replace(score=blocks.score - change, energy=blocks.energy + of_energy)


def _constants(
    blocks: Blocks, place: np.ndarray, places: int, offsets: np.ndarray, scatter: np.ndarray
) -> Float[np.ndarray, "C o"]:
    """The constant errors in each place: those of sources, and of places beyond, both with their priors."""
    count = len(offsets)
    weight = 1.0 / float(np.median(scatter[offsets]))
    system = np.zeros((places + 1, count, places + 1, count))
    right = np.zeros((places + 1, count))
    for k in range(places):
        here = place == k
        F = weight * blocks.information[here][:, offsets][:, :, offsets].sum(axis=0)
        g = weight * blocks.score[here][:, offsets].sum(axis=0)
        for row in (k, places):
            right[row] += g
            for column in (k, places):
                system[row, :, column] += F
    sigma = np.append(np.full(places * count, PLACE_SIGMA), np.full(count, OFFSET_SIGMA))
    fitted = np.linalg.solve(system.reshape(len(sigma), -1) + np.diag(1.0 / sigma**2), right.ravel()).reshape(
        places + 1, count
    )
    return fitted[:-1] + fitted[-1]


def scatter_of(score: np.ndarray, information: np.ndarray) -> np.ndarray:
    """The long-run variance (P,) of scores, relative to their information: the largest over stretches of blocks."""
    own = np.einsum("bpp->bp", information)
    largest = np.ones(score.shape[1])
    for length in STRETCHES:
        starts = np.arange(0, len(score) - length + 1, length)
        if len(starts) < LEAST_STRETCHES:
            break
        sums = np.add.reduceat(score[: starts[-1] + length], starts, axis=0)
        expected = np.add.reduceat(own[: starts[-1] + length], starts, axis=0)
        few = len(starts) / chi2.ppf(CONFIDENCE, len(starts))
        largest = np.maximum(largest, few * (sums**2).sum(axis=0) / np.maximum(expected.sum(axis=0), 1e-12))
    return largest
