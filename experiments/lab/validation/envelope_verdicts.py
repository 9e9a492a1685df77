"""What single precision makes of a cell of the envelope, beside double precision and the truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import binom

from trackers.core.estimates import STATUS_WORDS, Status

AGREES, OFF, WIDER, FEW = 1.0, 6.0, 1.5, 0.05
"""Most standard deviations between single and double precision; from the truth, beyond which an estimate is off; ratio
of standard deviations from which on an estimate counts as coarser; greatest share of tracks that part."""

CHANCE = 1e-4
"""Probability of so many more tracks off in single than in double precision, below which it is not by chance."""

NONSENSE = "SILENT NONSENSE"


class Run(NamedTuple):
    """Positions, their standard deviations and the truth (n, T, d), m; statuses (n, T), and which claim a track."""

    positions: np.ndarray
    sigmas: np.ndarray
    truth: np.ndarray
    status: np.ndarray
    usable: np.ndarray

    def off(self) -> np.ndarray:
        """Estimates that claim a track (n, T), and are not within six standard deviations of the truth."""
        with np.errstate(all="ignore"):
            return self.usable & ~(np.max(np.abs(self.positions - self.truth) / self.sigmas, axis=-1) <= OFF)


class Verdict(NamedTuple):
    """What becomes of a cell, in words.

    `difference`: the largest one of both precisions in reported standard deviations, without the tracks that part.
    `parted`: their number. `off`: the numbers of tracks that are off in single and in double precision.
    """

    words: str
    difference: float = np.nan
    parted: int = 0
    off: tuple[int, int] = (0, 0)


def judged(single: Run, double: Run) -> Verdict:
    """What single precision makes of a cell, beside double precision and the truth."""
    known = np.isfinite(single.positions).all(axis=-1) & (np.isfinite(single.sigmas) & (single.sigmas > 0)).all(axis=-1)
    impossible = (single.usable & ~known).sum()
    if impossible:
        return Verdict(f"{NONSENSE}: no numbers in {impossible} of {known.size} rows")
    lost, exact_lost = single.off(), double.off()
    off = int(lost.any(axis=1).sum()), int(exact_lost.any(axis=1).sum())
    if 2 * off[1] > len(lost):
        return Verdict("off the model", np.nan, 0, off)
    # A sign test: where only the model does not hold, as many tracks are worse in either precision.
    worse, better = ((a.sum(axis=1) > b.sum(axis=1)).sum() for a, b in ((lost, exact_lost), (exact_lost, lost)))
    if worse and binom.sf(worse - 1, worse + better, 0.5) < CHANCE:
        return Verdict(f"{NONSENSE}: worse in {worse}, better in {better} of {len(lost)} tracks", np.nan, 0, off)
    if not single.usable.any():
        return Verdict(STATUS_WORDS[Status(int(np.bincount(single.status.ravel()).argmax()))])
    sound = single.usable & double.usable & ~lost & ~exact_lost
    if not sound.any():
        return Verdict("differs", np.nan, len(lost), off)
    with np.errstate(all="ignore"):
        apart = np.where(sound, np.max(np.abs(single.positions - double.positions) / single.sigmas, axis=-1), 0.0)
        # An estimate that makes less of the readings differs from the best by the root of the difference of variances.
        most = AGREES + OFF * np.sqrt(np.maximum(1.0 - np.min(double.sigmas / single.sigmas, axis=-1) ** 2, 0.0))
        wider = np.median(np.max(single.sigmas / double.sigmas, axis=-1)[sound])
    parted = (sound & ~(apart <= most)).any(axis=1)
    if parted.mean() > FEW:
        return Verdict("differs", float(np.max(apart)), int(parted.sum()), off)
    words = "coarser" if wider > WIDER else "agrees"
    return Verdict(words, float(np.max(apart[~parted])), int(parted.sum()), off)
