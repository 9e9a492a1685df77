"""Whether the noise of ranges follows a column of signal quality: the one that recordings left out confirm.

The errors that a calibration leaves are of Student's t, with log σ = log σ_anchor + slope · z, where z is the quality
in standard deviations about its mean. All anchors share the slope. Its variance is that of sums of scores over pieces
of time, whose errors count as independent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import t as student_t

from trackwright.trackers.recordings.calibration import Calibration
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.trackers.recordings.range_quality import RangeQuality
from trackwright.tuning.calibration_pairs import calibration_pairs
from trackwright.tuning.clustered_regression import DOF, SMALLEST

SIGNIFICANT = 2.0
"""Least size of a slope, in its standard errors."""

_STEPS, _CONVERGED = 50, 1e-6


class Errors(NamedTuple):
    """Errors of N ranges about a calibration, m: the number of the anchor in the calibration, weight and piece of time.

    `quality` (N,): by column.
    """

    error: Float[np.ndarray, " N"]
    anchor: Int[np.ndarray, " N"]
    weight: Float[np.ndarray, " N"]
    piece: Int[np.ndarray, " N"]
    quality: Mapping[str, Float[np.ndarray, " N"]]


class Scales(NamedTuple):
    """log σ, m, of each anchor (A,), the slope in the standardised quality, and the slope's standard error."""

    logarithms: Float[np.ndarray, " A"]
    slope: float
    standard_error: float


def confirmed(whole: Errors, folds: Sequence[tuple[Errors, Errors]]) -> RangeQuality | None:
    """The column of quality with which ranges left out are more probable, by most; None where there is none.

    `folds`: the errors of recordings about their own calibration, and those of the ones left out about the same. All of
    these must be more probable, and the slope, of the `whole`, at least two standard errors from zero.
    """
    found, without = [], np.array([_left_out_density(*fold, None) for fold in folds])
    for column, values in whole.quality.items():
        known = values[np.isfinite(values)]
        if len(known) == 0 or np.ptp(known) == 0.0:
            continue
        quality = RangeQuality(column, float(known.mean()), float(known.std()), 0.0, 0.0, 0.0)
        gains = np.array([_left_out_density(*fold, quality) for fold in folds]) - without
        scales = fitted_scales(whole, quality)
        if gains.min() > 0.0 and abs(scales.slope) > SIGNIFICANT * scales.standard_error:
            gain = float(gains.mean())
            found.append(quality._replace(slope=scales.slope, standard_error=scales.standard_error, gain=gain))
    return max(found, key=lambda quality: quality.gain, default=None)


def errors_about(calibration: Calibration, folders: Sequence[RecordingFolder], columns: Sequence[str]) -> Errors:
    """The errors of ranges to the anchors of a calibration, with these columns of quality.

    Each recording has the same weight.
    """
    pairs, anchors = calibration_pairs(folders, KINDS["ranges"], columns), list(calibration.anchors)
    parts = [[np.zeros(0), *np.zeros((3, 0), int), np.zeros((0, len(columns)))]]
    for number, p in ((anchors.index(name), p) for name, p in pairs.items() if name in anchors):
        tags, tag = np.unique(p.tag, return_inverse=True)
        of_anchor = np.full(len(tag), number)
        distances, _ = calibration.of_ranges(anchors, of_anchor, tags.tolist(), tag.ravel(), p.measured[:, 0])
        parts.append([distances - p.true[:, 0], of_anchor, p.piece, p.recording, p.quality])
    error, anchor, piece, recording, quality = map(np.concatenate, zip(*parts, strict=True))
    seen = np.isfinite(error)
    error, anchor, piece, recording, quality = (x[seen] for x in (error, anchor, piece, recording, quality))
    weight = len(recording) / np.bincount(recording)[recording]
    return Errors(error, anchor, weight, piece, dict(zip(columns, quality.T, strict=True)))


def fitted_scales(errors: Errors, quality: RangeQuality | None) -> Scales:
    """The most probable scales by Fisher's scoring, with a slope in the quality, or without one."""
    anchors = np.arange(errors.anchor.max() + 1)
    x = np.column_stack([errors.anchor[:, None] == anchors, _standardised(errors, quality)]).astype(float)
    # A slope without a quality keeps its value.
    ridge = 1e-9 * len(x) * np.eye(x.shape[1])
    values = np.append(np.full(len(anchors), np.log(np.median(np.abs(errors.error)) + SMALLEST)), 0.0)
    weighted = x * errors.weight[:, None]
    expected = 2.0 * DOF / (DOF + 3.0) * weighted.T @ x + ridge
    for _ in range(_STEPS):
        squares = (errors.error * np.exp(-x @ values)) ** 2
        scores = weighted * ((DOF + 1.0) * squares / (DOF + squares) - 1.0)[:, None]
        step = np.linalg.solve(expected, scores.sum(axis=0))
        values = values + step
        if np.abs(step).max() < _CONVERGED:
            break
    curvature = 2.0 * DOF * (DOF + 1.0) * squares / (DOF + squares) ** 2
    inverse = np.linalg.inv((weighted * curvature[:, None]).T @ x + ridge)
    pieces = np.unique(errors.piece, return_inverse=True)[1].ravel()
    of_pieces = np.stack([np.bincount(pieces, column) for column in scores.T], axis=1)
    covariance = inverse @ (of_pieces.T @ of_pieces) @ inverse
    return Scales(values[:-1], float(values[-1]), float(np.sqrt(covariance[-1, -1])))


def log_density(errors: Errors, scales: Scales, quality: RangeQuality | None) -> Float[np.ndarray, " N"]:
    """The log density of errors; the scales have all their anchors."""
    sigma = np.exp(scales.logarithms[errors.anchor] + scales.slope * _standardised(errors, quality))
    density: np.ndarray = student_t.logpdf(errors.error / sigma, DOF) - np.log(sigma)
    return density


def _standardised(errors: Errors, quality: RangeQuality | None) -> np.ndarray:
    return np.zeros(len(errors.error)) if quality is None else quality.standardised(errors.quality[quality.column])


def _left_out_density(fitted: Errors, left_out: Errors, quality: RangeQuality | None) -> float:
    """The mean log density of the errors left out by the scales of others; zero where there are none."""
    return float(log_density(left_out, fitted_scales(fitted, quality), quality).mean()) if len(left_out.error) else 0.0
