"""Bias, spread, slope, delay and outliers of the readings of each anchor, station or tag against truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.compared import Compared
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.kinds import wrapped

OUTLIER, SHOWN, LAG_S, CORRELATED = 5.0, 24, 0.1, 10
"""Robust standard deviations beyond which a reading is an outlier; most sensors with a line each; half the time over
which the rate of a predicted reading is taken, s; readings that weigh as one for standard errors, since errors last."""


class Residuals(NamedTuple):
    """The errors of each group and column (G, m) against truth, in m or rad; NaN where readings do not determine one.

    `bias`: their median. `spread`: their robust standard deviation. `outliers`: the share beyond `OUTLIER` of these.
    `slope`: the change of the error per unit of the true value. `delay`: s, by which readings come late.
    """

    bias: Float[np.ndarray, "G m"]
    spread: Float[np.ndarray, "G m"]
    outliers: Float[np.ndarray, "G m"]
    slope: Float[np.ndarray, "G m"]
    delay: Float[np.ndarray, "G m"]


def residuals(view: Compared) -> Residuals:
    """The errors of each group and column against truth."""
    errors = view.errors()
    if view.kind.difference:
        errors = errors + view.medians(errors)[view.sensors.number[:, 1]]  # of the one anchor alone
    result = np.full((5, len(view.ids), errors.shape[1]), np.nan)
    for k in np.unique(view.group):  # of differences, a sensor of other readings may have too few of its own
        part, e = view.of_rows(view.group == k), errors[view.group == k]
        result[0, k] = known_median(e)
        result[1, k] = 1.4826 * known_median(np.abs(e - result[0, k]))
        away, seen = np.abs(e - result[0, k]) > np.maximum(OUTLIER * result[1, k], 1e-9), np.isfinite(e).sum(axis=0)
        result[2, k] = np.where(seen > 0, away.sum(axis=0) / np.maximum(seen, 1), np.nan)
        for c in range(0 if view.kind.common else e.shape[1]):
            result[3:, k, c] = _slope_and_delay(part, c)
    return Residuals(*result)


def _slope_and_delay(view: Compared, c: int) -> tuple[float, float]:
    """Slope and delay of the readings of a column of one group, NaN within three standard errors of zero.

    The slope is of the errors after the delay: over the delay a reading does not change linearly.
    """
    columns, delay = view.columns[c : c + 1], 0.0
    for _ in range(2):
        true, after, before = (
            view.kind.values_at(view.later(delay + lag).positions, view.sensors)[:, c] for lag in (0.0, -LAG_S, LAG_S)
        )
        e, change = (wrapped(x[:, None], columns)[:, 0] for x in (view.values[:, c] - true, after - before))
        known = np.isfinite(e) & np.isfinite(change)
        away = np.abs(e - np.median(e[known])) if known.any() else e
        known &= away <= OUTLIER * 1.4826 * np.median(away[known]) if known.any() else False
        if known.sum() < 3 * CORRELATED:
            return math.nan, math.nan
        true, e = true[known] - true[known].mean(), e[known]
        A = np.stack([np.ones(len(e)), true * (not view.kind.position), -change[known] / (2 * LAG_S)], axis=1)
        A *= np.sqrt(np.mean(A**2, axis=0)) > [0.0, 0.2, 0.02]
        fit = np.linalg.lstsq(A, e, rcond=None)[0]
        variance = CORRELATED * np.abs(np.diag(np.linalg.pinv(A.T @ A))) * np.mean((e - A @ fit) ** 2)
        fit[2] += delay
        slope, late = np.where((np.abs(fit) > 3 * np.sqrt(variance)) & A.any(axis=0), fit, np.nan)[1:]
        delay = float(np.nan_to_num(late))
    return float(slope), float(late)


def typical_delay(view: Compared) -> float:
    """Seconds by which readings come late against truth, NaN where most groups and columns do not determine it."""
    found = residuals(view)
    delays = found.delay[np.isfinite(found.bias)]
    return float(np.nanmedian(delays)) if 2 * np.isfinite(delays).sum() > len(delays) else math.nan


def check_residuals(view: Compared) -> Iterator[CheckResult]:
    """A line for each anchor, station or tag, or for all where there are many of them.

    A warning where the azimuths of all stations are off to one side by more than a station's own error.
    """
    kind, found = view.kind, residuals(view)
    (unit, factor), digits = kind.shown, 1 if kind.angles else 2
    bias, turned = factor * found.bias, found.bias[np.isfinite(found.bias[:, 0]), 0]
    one_side = kind.angles and len(turned) > 0 and abs(np.sign(turned).sum()) == len(turned)
    if one_side and np.abs(turned).min() >= kind.columns[0].bias:
        off = f"azimuths of all stations are off by about {np.degrees(np.median(turned)):+.1f}°"
        yield CheckResult("warning", kind.name, f"{off}: turned against rig.toml; correct rotation_wxyz, or calibrate")
    many = len(view.ids) > SHOWN
    for k in range(1 if many else len(view.ids)):
        of, parts = slice(None) if many else slice(k, k + 1), list[str]()
        for c in [c for c in range(1 if kind.numbered else len(view.columns)) if np.isfinite(bias[of, c]).any()]:
            # Of an array the columns are antennas.
            low, high = (f(bias[of] if kind.numbered else bias[of, c]) for f in (np.nanmin, np.nanmax))
            name = "" if kind.numbered or len(view.columns) == 1 else f"{view.columns[c].rpartition('_')[0]} "
            name += f"bias {low:+.{digits}f}" + (f" to {high:+.{digits}f}" if high > low else "")
            spread = factor * np.nanmedian(found.spread[of] if kind.numbered else found.spread[of, c])
            slope = "" if many or not np.isfinite(found.slope[k, c]) else f", slope {100 * found.slope[k, c]:+.2g} %"
            parts.append(f"{name}{unit}, spread {spread:.{digits}f}{unit}{slope}")
        if not many and np.isfinite(found.delay[k]).any():
            delay = float(np.nanmedian(found.delay[k]))
            parts.append(f"{'late' if delay > 0 else 'early'} by {abs(delay):.2g} s")
        if parts:
            whose = f"{len(view.ids)} {kind.noun}s" if many else f"{kind.noun} {view.ids[k]}"
            parts.append(f"outliers {100 * np.nanmax(found.outliers[of]):.2g} %")
            yield CheckResult("info", kind.name, f"{whose} against truth: {'; '.join(parts)}")
