"""Bias, spread, slope, delay and outliers of the readings of each anchor, station or tag against truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trackers.recordings.checks.check_result import CheckResult
from trackers.recordings.checks.compared import Compared

OUTLIER = 5.0
"""Robust standard deviations beyond which a reading is an outlier."""

SHOWN = 24
"""Most anchors, stations or tags that get a line each."""

LAG_S = 0.1
"""Half the time over which the rate of a predicted reading is taken, s."""

CORRELATED = 10
"""Readings that weigh as one, for the standard errors of slope and delay: errors last."""


class Residuals(NamedTuple):
    """The errors of one column of a group against truth, in m or rad.

    `rows`: their number. `bias`: their median. `spread`: their robust standard deviation. `slope`: the change of the
    error per unit of the true value. `delay`: s, by which readings come late. `outliers`: the share beyond `OUTLIER`
    spreads of the bias. NaN where the readings do not determine a number.
    """

    group: str
    column: str
    rows: int
    bias: float
    spread: float
    slope: float
    delay: float
    outliers: float


def residuals(view: Compared) -> list[Residuals]:
    """The errors of each group and column against truth."""
    true, errors = view.predicted(), view.errors()
    after, before = (view.later(lag).predicted() for lag in (-LAG_S, LAG_S))
    rates = np.unwrap(np.stack([before, after]), axis=0) if view.table == "bearings" else np.stack([before, after])
    rate = np.diff(rates, axis=0)[0] / (2 * LAG_S)
    found = []
    for k, name in enumerate(view.ids):
        own = view.group == k
        for c, column in enumerate(view.columns):
            known = own & np.isfinite(errors[:, c])
            e, x, v = errors[known, c], true[known, c], np.nan_to_num(rate[known, c])
            if not len(e):
                continue
            bias = float(np.median(e))
            spread = 1.4826 * float(np.median(np.abs(e - bias)))
            inside = np.abs(e - bias) <= max(OUTLIER * spread, 1e-9)
            slope, delay = _slope_and_delay(e[inside], x[inside], v[inside], view.table)
            found.append(Residuals(name, column, len(e), bias, spread, slope, delay, 1.0 - float(inside.mean())))
    return found


def _slope_and_delay(e: np.ndarray, true: np.ndarray, rate: np.ndarray, table: str) -> tuple[float, float]:
    """The slope of errors over true values and the delay, NaN within three standard errors of zero."""
    regressors = np.stack([np.ones(len(e)), true - true.mean(), -rate], axis=1)
    if table == "fixes":
        regressors[:, 1] = 0.0
    scale = np.sqrt(np.mean(regressors**2, axis=0))
    used = scale > np.array([0.0, 0.2, 0.02])
    if len(e) < 3 * CORRELATED or not used[1:].any():
        return math.nan, math.nan
    A = regressors[:, used]
    fit = np.linalg.lstsq(A, e, rcond=None)[0]
    variance = float(np.mean((e - A @ fit) ** 2))
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(A.T @ A)), 0.0) * variance * CORRELATED)
    values = np.full(3, np.nan)
    values[used] = np.where(np.abs(fit) > 3 * errors, fit, np.nan)
    return float(values[1]), float(values[2])


def check_residuals(view: Compared) -> list[CheckResult]:
    """A line for each anchor, station or tag; the range of their biases where there are many."""
    found = residuals(view)
    if len(view.ids) > SHOWN:
        lines = [_of_many([one for one in found if one.column == column], view) for column in view.columns]
    else:
        lines = [_line([one for one in found if one.group == name], view) for name in view.ids]
    return [CheckResult("info", view.table, line) for line in lines]


def _line(rows: Sequence[Residuals], view: Compared) -> str:
    parts = []
    for one in rows:
        quantity = one.column.rpartition("_")[0]
        name = "" if len(view.columns) == 1 else f"{quantity} "
        parts.append(f"{name}bias {_size(one.bias, view, '+')}, spread {_size(one.spread, view)}")
        if math.isfinite(one.slope):
            parts[-1] += f", slope {100 * one.slope:+.2g} %"
    delays = [one.delay for one in rows if math.isfinite(one.delay)]
    if delays:
        delay = float(np.median(delays))
        parts.append(f"{'late' if delay > 0 else 'early'} by {abs(delay):.2g} s")
    parts.append(f"outliers {100 * max(one.outliers for one in rows):.2g} %")
    return f"{view.noun} {rows[0].group} against truth: {'; '.join(parts)}"


def _of_many(rows: Sequence[Residuals], view: Compared) -> str:
    bias, spread = (np.array([getattr(one, name) for one in rows]) for name in ("bias", "spread"))
    sizes = (_size(x, view, sign) for x, sign in ((bias.min(), "+"), (bias.max(), "+"), (np.median(spread), "")))
    low, high, typical = sizes
    return (
        f"{rows[0].column} of {len(rows)} {view.noun}s against truth: bias {low} to {high}, median spread {typical}, "
        f"outliers {100 * float(np.mean([one.outliers for one in rows])):.2g} %"
    )


def _size(x: float, view: Compared, sign: str = "") -> str:
    return f"{np.degrees(x):{sign}.1f}°" if view.table == "bearings" else f"{x:{sign}.2f} m"
