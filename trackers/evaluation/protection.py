"""Protection levels: the horizontal radius that holds the true position with a stated probability, with its evidence.

    PL = K σ        σ  the largest horizontal standard deviation that an estimate reports, m (RTCA DO-229, d_major)

K is no quantile of a normal distribution but that of |error| / σ in other recordings of the site, by hierarchical
conformal prediction (Lee, Barber and Willett 2023) over blocks of at least `PIECE_S` and `PIECE_M`, within which errors
last: a row of the next block is held with the stated probability on average, if it is as those of the evidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.evaluation.evaluate import associate
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.tracks_table import PROTECTION, is_bearing
from trackwright.trackers.recordings.truth import independent_pieces

if TYPE_CHECKING:
    from trackwright.trackers.core.data.estimates import Estimates
    from trackwright.trackers.evaluation.evaluate import OneOrMore
    from trackwright.trackers.recordings.tracks import Tracks

WORSE = 3.1
"""Standard errors by which a recording left out is held too seldom: 0.1 % one-sided."""


@dataclass(frozen=True)
class Protection:
    """A factor K on σ that holds the truth with `probability`, and its evidence.

    `held`: by recording, the share of its blocks' rows that the factor of the other recordings holds. `rows`, `blocks`:
    numbers of rows and of independent blocks.
    """

    probability: float
    factor: float
    held: Mapping[str, float]
    rows: int
    blocks: int

    def applied(self, tracks: pl.DataFrame, changed: Mapping[str, float] | None = None) -> pl.DataFrame:
        """The table of estimates with the column `pl_m`, m, null where no covariance is reported.

        `changed`: by recording, the time, s, from which on its site is not that of the evidence: levels are infinite.
        """
        levels = self.factor * largest_sigma(tracks)
        if changed:
            since = np.array([changed.get(name, math.inf) for name in tracks["recording"].to_list()])
            levels = np.where(float_column(tracks, "t_s") >= since, math.inf * levels, levels)
        return tracks.with_columns(pl.Series(PROTECTION, levels).fill_nan(None))

    def __str__(self) -> str:
        shares = ", ".join(f"{name} {100 * share:.4g} %" for name, share in self.held.items())
        return (
            f"protection level: {self.factor:.3g} times the largest standard deviation, for {100 * self.probability:g} "
            f"%; from {counted(self.rows, 'row')} in {counted(self.blocks, 'independent block')} of "
            f"{counted(len(self.held), 'recording')}; left out in turn, held: {shares}"
        )


def protection(
    estimates: Tracks | Estimates | pl.DataFrame | Association, recordings: OneOrMore, probability: float = 0.999
) -> Protection:
    """The protection level that recordings with truth support, tracked as those that it is for.

    `estimates`, `recordings`: as of `evaluate`; none of them may have helped to calibrate or to tune what tracked it.
    Raises UnusableInput for bearings, a single recording, too few blocks for the probability even without the recording
    that has most, and where a recording is held too seldom by the factor of the others.
    """
    if not 0.5 <= probability < 1.0:
        raise UnusableInput(f"probability {probability:g}: expected a number from 0.5 to below 1, as 0.999")
    association = estimates if isinstance(estimates, Association) else associate(estimates, recordings)
    if is_bearing(association.rows):
        raise UnusableInput("protection level: the estimates are bearings; expected positions")
    ratios = _ratios_by_block(association)
    counts = {name: len(blocks) for name, blocks in ratios.items()}
    if len(counts) < 2:
        raise UnusableInput(
            f"protection level: {counted(len(counts), 'recording')} with truth and covariances; expected two at least, "
            "of different sessions, so that what changes between these is seen"
        )
    total, most = sum(counts.values()), max(counts, key=lambda name: counts[name])
    least = math.ceil(probability / (1.0 - probability) - 1e-9)
    if total - counts[most] < least:
        supported = (total - counts[most]) / (total - counts[most] + 1)
        found = ", ".join(f"{name} {n}" for name, n in counts.items())
        raise UnusableInput(
            f"protection level: {100 * probability:g} % takes {least} independent blocks (5 s and 1 m each) beside "
            f"those of {most}; found {found}; give more recordings, or a probability of {_floor(supported):g} at most"
        )
    held = {}
    for name, blocks in ratios.items():
        others = [block for other in ratios if other != name for block in ratios[other]]
        of_others = conformal_factor(others, probability)
        shares = np.array([np.mean(block <= of_others) for block in blocks])
        held[name] = float(shares.mean())
        # Of the shares of this recording's blocks, and of the factor by those of the others.
        variance = shares.var(ddof=1) * (1.0 / len(shares) + 1.0 / len(others)) if len(shares) > 1 else math.inf
        if held[name] + WORSE * math.sqrt(variance) < probability:
            raise UnusableInput(
                f"protection level: the factor of the other recordings holds {100 * held[name]:.3g} % of {name}, "
                f"expected {100 * probability:g} %: sessions differ by more than the estimates' covariances; calibrate "
                "each on the others, or give recordings that are alike"
            )
    everything = [block for blocks in ratios.values() for block in blocks]
    factor = conformal_factor(everything, probability)
    return Protection(probability, factor, held, sum(map(len, everything)), total)


def conformal_factor(blocks: Sequence[np.ndarray], probability: float) -> float:
    """The quantile of the next block's rows by those of `blocks`, (m,) each, every block with the same weight.

    Infinite for fewer than p/(1 - p) blocks (Lee, Barber and Willett 2023, hierarchical conformal prediction).
    """
    values = np.concatenate(blocks) if blocks else np.zeros(0)
    weights = np.concatenate([np.full(len(b), 1.0 / len(b)) for b in blocks]) if blocks else np.zeros(0)
    order = np.argsort(values)
    # Sums of many weights differ in their last digits.
    reached = np.cumsum(weights[order]) / (len(blocks) + 1) >= probability - 1e-9
    return float(values[order][np.argmax(reached)]) if reached.any() else math.inf


def largest_sigma(rows: pl.DataFrame) -> np.ndarray:
    """The largest horizontal standard deviation (n,), m, NaN where a row reports none."""
    x, y = float_column(rows, "std_x_m") ** 2, float_column(rows, "std_y_m") ** 2
    xy = np.nan_to_num(float_column(rows, "cov_xy_m2"))
    sigma: np.ndarray = np.sqrt(0.5 * (x + y) + np.hypot(0.5 * (x - y), xy))
    return np.where(sigma > 0.0, sigma, np.nan)


def _ratios_by_block(association: Association) -> dict[str, list[np.ndarray]]:
    """|error| / σ of the scored rows, by recording and block."""
    result: dict[str, list[np.ndarray]] = {}
    for name in association.rows["recording"].unique(maintain_order=True).to_list():
        part = association.of_recording(name)
        errors = [float_column(part.rows, f"{axis}_m") - part.truth[:, k] for k, axis in enumerate("xy")]
        ratio, times = np.hypot(*errors) / largest_sigma(part.rows), float_column(part.rows, "t_s")
        known = part.scored & np.isfinite(ratio)
        pieces = independent_pieces(times, part.truth[:, :2], part.starts, part.scored)[known]
        if known.any():
            result[name] = [ratio[known][pieces == k] for k in np.unique(pieces)]
    return result


def _floor(share: float) -> float:
    """The share rounded down to two digits of what it lacks to one."""
    lack = 1.0 - share
    step = 10.0 ** (math.floor(math.log10(lack)) - 1)
    return 1.0 - math.ceil(lack / step - 1e-9) * step
