"""Bias, spread, slope, delay and outliers of the readings of each anchor, station or tag against truth.

And how the columns of signal quality go with the errors.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Bool, Float

from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.compared import Compared, compared
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, wrapped

OUTLIER, SHOWN = 5.0, 24
"""Robust standard deviations beyond which a reading is an outlier; most anchors, stations or tags with a line each."""

LAG_S, CORRELATED, LEAST_RATED = 0.1, 10, 40
"""Half the time over which the rate of a predicted reading is taken, s; readings that weigh as one for the standard
errors of slope and delay, since errors last; least number of readings with a true value and a quality."""


class Residuals(NamedTuple):
    """The errors of one column of a group against truth, in m or rad.

    `bias`: their median. `spread`: their robust standard deviation. `slope`: the change of the error per unit of the
    true value. `delay`: s, by which readings come late. `outliers`: the share beyond `OUTLIER` spreads of the bias. NaN
    where the readings do not determine a number.
    """

    group: str
    column: str
    bias: float
    spread: float
    slope: float
    delay: float
    outliers: float


def residuals(view: Compared) -> list[Residuals]:
    """The errors of each group and column against truth."""
    errors, result = view.errors(), []
    if view.kind.difference:
        errors = errors + view.medians(errors)[view.sensors.number[:, 1]]  # of the one anchor alone
    # The slope is of the errors after the delay: over the delay a reading does not change linearly.
    delays = np.zeros(errors.shape)
    for _ in range(2):
        fits = {key: _slope_and_delay(view, key, delays) for key in np.ndindex(len(view.ids), len(view.columns))}
        for (k, c), (_, delay) in fits.items():
            delays[view.group == k, c] = np.nan_to_num(delay)
    for (k, c), (slope, delay) in fits.items():
        e = errors[view.group == k, c]
        e = e[np.isfinite(e)]
        if len(e):
            bias, spread, outlying = _about_median(e)
            result.append(Residuals(view.ids[k], view.columns[c], bias, spread, slope, delay, float(outlying.mean())))
    return result


def _about_median(e: Float[np.ndarray, " n"]) -> tuple[float, float, Bool[np.ndarray, " n"]]:
    """The median of errors, their robust standard deviation, and which of them are outliers."""
    median = float(np.median(e))
    spread = 1.4826 * float(np.median(np.abs(e - median)))
    return median, spread, _outlying(e - median, spread)


def _outlying(e: Float[np.ndarray, " n"], spread: float) -> Bool[np.ndarray, " n"]:
    return np.asarray(np.abs(e) > max(OUTLIER * spread, 1e-9))


def _slope_and_delay(view: Compared, key: tuple[int, ...], delays: np.ndarray) -> tuple[float, float]:
    """Slope and delay of the readings of a group and column, NaN within three standard errors of zero.

    `delays` (N, m): those found before, about which the readings are linearised.
    """
    k, c = key
    of_group = view.group == k
    if not of_group.any():
        return math.nan, math.nan  # a sensor of other readings that has too few of its own
    part = view.of_rows(of_group)
    at = delays[of_group, c]
    true, before, after = (part.later(at + lag).predicted()[:, c] for lag in (0.0, LAG_S, -LAG_S))
    change = wrapped((after - before)[:, None], view.columns[c : c + 1])[:, 0]
    e = wrapped((part.values[:, c] - true)[:, None], view.columns[c : c + 1])[:, 0]
    known = np.isfinite(e) & np.isfinite(change)
    e, true, rate = e[known], true[known], change[known] / (2 * LAG_S)
    if len(e) < 3 * CORRELATED:
        return math.nan, math.nan
    inside = ~_about_median(e)[2]
    e, true, rate = e[inside], true[inside], rate[inside]
    regressors = np.stack([np.ones(len(e)), true - true.mean(), -rate], axis=1)
    if view.kind.position:
        regressors[:, 1] = 0.0
    used = np.sqrt(np.mean(regressors**2, axis=0)) > np.array([0.0, 0.2, 0.02])
    A = regressors[:, used]
    fit = np.linalg.lstsq(A, e, rcond=None)[0]
    variance = float(np.mean((e - A @ fit) ** 2))
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(A.T @ A)), 0.0) * variance * CORRELATED)
    values, sigmas = np.zeros(3), np.full(3, np.inf)
    values[used], sigmas[used] = fit, errors
    values[2] += float(at[0])
    slope, delay = (x if abs(x) > 3 * s else math.nan for x, s in zip(values[1:], sigmas[1:], strict=True))
    return float(slope), float(delay)


def typical_delay(view: Compared) -> float:
    """Seconds by which readings come late against truth, NaN where most groups and columns do not determine it."""
    delays = np.array([entry.delay for entry in residuals(view)])
    return float(np.nanmedian(delays)) if 2 * np.isfinite(delays).sum() > len(delays) else math.nan


def delay_against_truth(recording: RecordingFolder, table: str) -> float:
    """As `typical_delay`, of a table; NaN without truth."""
    view = compared(recording, table) if KINDS[table].averaged else None
    return math.nan if view is None else typical_delay(view)


def check_residuals(view: Compared) -> Iterator[CheckResult]:
    """A line for each anchor, station or tag; the range of their biases where there are many.

    A warning where the azimuths of all stations are off to one side by more than a station's own error.
    """
    kind = view.kind
    entries = [] if kind.numbered else residuals(view)
    turned = np.array([entry.bias for entry in entries if entry.column == "azimuth_rad"])
    one_side = len(turned) and abs(np.sign(turned).sum()) == len(turned)
    if one_side and np.abs(turned).min() >= kind.columns[0].bias:
        off = f"azimuths of all stations are off by about {_size(float(np.median(turned)), view, '+')}"
        fix = "turned against rig.toml; correct rotation_wxyz, or calibrate"
        yield CheckResult("warning", kind.name, f"{off}: {fix}")
    if kind.numbered:
        lines = [_of_array(view, k) for k in range(min(len(view.ids), SHOWN))]
    elif len(view.ids) > SHOWN:
        lines = [_of_many([entry for entry in entries if entry.column == column], view) for column in view.columns]
    else:
        lines = [_of_group(list(group), view) for _, group in groupby(entries, lambda entry: entry.group)]
    yield from (CheckResult("info", kind.name, line) for line in lines)


def _of_array(view: Compared, k: int) -> str:
    """The offsets of a station's antennas, and the spread and outliers of its phases about them."""
    e = view.errors()[view.group == k]
    e = e[:, np.isfinite(e).any(axis=0)]
    offset = np.nanmedian(e, axis=0)
    about = wrapped(e - offset, view.columns[: e.shape[1]])
    about = about[np.isfinite(about)]
    spread = 1.4826 * float(np.median(np.abs(about)))
    return (
        f"{view.kind.noun} {view.ids[k]} against truth: offsets of antennas {offset.min():+.2f} to {offset.max():+.2f} "
        f"rad, spread {spread:.2f} rad, outliers {100 * _outlying(about, spread).mean():.2g} %"
    )


def _of_group(entries: Sequence[Residuals], view: Compared) -> str:
    parts = []
    for entry in entries:
        name = "" if len(view.columns) == 1 else f"{entry.column.rpartition('_')[0]} "
        parts.append(f"{name}bias {_size(entry.bias, view, '+')}, spread {_size(entry.spread, view)}")
        if math.isfinite(entry.slope):
            parts[-1] += f", slope {100 * entry.slope:+.2g} %"
    delays = [entry.delay for entry in entries if math.isfinite(entry.delay)]
    if delays:
        delay = float(np.median(delays))
        parts.append(f"{'late' if delay > 0 else 'early'} by {abs(delay):.2g} s")
    parts.append(f"outliers {100 * max(entry.outliers for entry in entries):.2g} %")
    return f"{view.kind.noun} {entries[0].group} against truth: {'; '.join(parts)}"


def _of_many(entries: Sequence[Residuals], view: Compared) -> str:
    bias, spread, outliers = np.array([(entry.bias, entry.spread, entry.outliers) for entry in entries]).T
    biases = f"bias {_size(bias.min(), view, '+')} to {_size(bias.max(), view, '+')}"
    return (
        f"{entries[0].column} of {len(entries)} {view.kind.noun}s against truth: {biases}, "
        f"median spread {_size(np.median(spread), view)}, outliers {100 * outliers.mean():.2g} %"
    )


def _size(x: float, view: Compared, sign: str = "") -> str:
    return f"{np.degrees(x):{sign}.1f}°" if view.kind.unit == "rad" else f"{x:{sign}.2f} m"


def check_quality(recording: RecordingFolder, name: str) -> Iterator[CheckResult]:
    """A line for each column of quality of a table, on how errors go with it; none without truth."""
    kind = KINDS[name]
    columns = kind.layout(recording.tables[name].columns).quality
    if kind.predicted is None or not kind.averaged or "truth" not in recording.tables or not columns:
        return
    rows = recording.rows(name)
    measured = kind.measured(recording.rig, rows).usable
    errors = measured.errors(recording.paths.at(rows.tags, rows.starts, rows.times)[0])
    for sensor in np.unique(measured.sensors.number[:, 0]):
        part = measured.sensors.number[:, 0] == sensor
        errors[part] -= known_median(errors[part])
    unit, factor = kind.shown
    for column, quality in zip(columns, rows.floats(columns).T, strict=True):
        known = [np.isfinite(quality) & np.isfinite(e) for e in errors.T]
        parts = [
            f"{value} {_relation(quality[k], factor * e[k], unit)}"
            for value, k, e in zip(measured.columns, known, errors.T, strict=True)
            if k.sum() >= LEAST_RATED and np.ptp(quality[k]) > 0.0
        ]
        if parts:
            what = f"{column} and errors against truth less the median of each {kind.noun}"
            yield CheckResult("info", name, f"{what}: {'; '.join(parts)}")


def _relation(quality: Float[np.ndarray, " n"], errors: Float[np.ndarray, " n"], unit: str) -> str:
    # Ties have the mean of their ranks.
    of_quality, *of_errors = (pl.Series(x).rank().to_numpy() for x in (quality, np.abs(errors), errors))
    sized, signed = (float(np.corrcoef(of_quality, ranks)[0, 1]) for ranks in of_errors)
    # A root mean square would show a few wild values.
    low, high = np.quantile(quality, [0.25, 0.75])
    lowest, highest = (np.quantile(np.abs(errors[part]), 0.6827) for part in (quality <= low, quality >= high))
    return (
        f"rank correlation {sized:+.2f} (size), {signed:+.2f} (with sign), 68th percentile of the size "
        f"{lowest:.2g}{unit} in the lowest quarter, {highest:.2g}{unit} in the highest"
    )
