"""Checks of units by typical values: angles in radians, lengths in metres, accelerations with gravity."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.checks.check_result import CheckResult
from trackwright.trackers.recordings.columns import TableRows
from trackwright.trackers.recordings.kinds import KINDS, QUATERNION, Column, Kind, table_kinds

GRAVITY = 9.81
GRAVITY_SLACK = 0.15  # for the bias of a low-cost accelerometer and moderate motion
FAR_M = 500.0  # beyond the range of indoor radio
FAR_SIZES = 20.0  # times the size of the rig
FAR_SIZES_MM = 150.0  # times the size of the rig, beyond which centimetres would be far away, too
BEYOND_ANCHORS = 0.1  # share of range differences larger than their anchors' distance; 1 % of a real flight
NANOSECOND_M = 0.2998
LEAST_DIFFERENCE_M = 1e-5  # a difference in seconds is at most 1e-6 in 300 m; in metres some exceed their resolution
OTHER_UNIT = {
    "rad": "degrees, expected radians",
    "mps": "millimetres or centimetres per second, expected metres",
    "radps": "degrees per second, expected radians",
}
FASTEST_TURN = 35.0  # rad/s, the full scale of common gyroscopes


def check_units(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """Values of a size that suggests another unit than that of the column."""
    results = _anchor_lengths(rig, tables)
    size = _size(rig)
    kinds = table_kinds()
    for name, table in tables.items():
        kind = kinds[name]
        if kind.numbered:
            results += _phases(kind, table)
        elif kind.position:
            results += _lengths(name, "distance from the rig", _from_rig(table, rig), size)
        elif kind.unit == "mps2":
            results += _accelerations(table) + _turn_rates(table)
        else:
            sizes = [result for column in kind.columns for result in _values(name, column, table[column.name], size)]
            results += sizes or _differences(kind, table, rig)
    return results


def _differences(kind: Kind, table: pl.DataFrame, rig: Rig) -> list[CheckResult]:
    """Differences of distances that exceed the distance of their anchors, which no place explains."""
    if not kind.difference:
        return []
    measured = kind.measured(rig, TableRows(table))
    places, number = measured.sensors.places, measured.sensors.number
    apart = np.linalg.norm(places[number[:, 0]] - places[number[:, 1]], axis=1)
    sizes = np.abs(measured.values[:, 0])
    largest = np.nanmax(sizes, initial=0.0)
    if largest < LEAST_DIFFERENCE_M:
        message = f"{kind.columns[0].name} is at most {largest:.2g}: looks like seconds, expected metres"
        return [CheckResult("error", kind.name, message)]
    share, in_ns = (float(np.nanmean(factor * sizes > apart + kind.columns[0].bias)) for factor in (1.0, NANOSECOND_M))
    if not share > BEYOND_ANCHORS:
        return []
    unit = "centimetres or millimetres, or other anchors" if in_ns > BEYOND_ANCHORS else "nanoseconds or feet"
    message = (
        f"{100 * share:.0f} % of {kind.columns[0].name} exceed the distance of their anchors: looks like {unit}, "
        "expected metres"
    )
    return [CheckResult("error", kind.name, message)]


def _phases(kind: Kind, table: pl.DataFrame) -> list[CheckResult]:
    values = kind.layout(table.columns).values
    sizes = pl.concat([table[c].abs().alias("size") for c in values]).drop_nulls()
    if len(sizes) and _median(sizes) > 2 * math.pi:
        message = (
            f"{kind.name} are typically {_median(sizes):.3g}: looks like degrees, expected radians wrapped to (-π, π]"
        )
        return [CheckResult("error", kind.name, message)]
    if int((sizes > math.pi + 1e-3).sum()) > 0.01 * len(sizes):
        message = f"{kind.name} are not wrapped to (-π, π]; harmless, since trackers wrap phase differences"
        return [CheckResult("warning", kind.name, message)]
    return []


def _values(name: str, column: Column, values: pl.Series, size: float | None) -> list[CheckResult]:
    """Angles, speeds and rates beyond their bound, and lengths that are large beside the rig, whose `size` is in m."""
    if column.unit == "m":
        return _lengths(name, column.name.removesuffix("_m").replace("_", " "), values.abs(), size)
    large = values.abs().quantile(0.9)
    if column.unit not in OTHER_UNIT or large is None or large <= column.bound:
        return []
    message = f"10 % of {column.name} lie beyond ±{column.bound:.3g}: looks like {OTHER_UNIT[column.unit]}"
    return [CheckResult("error", name, message)]


def _lengths(name: str, what: str, lengths: pl.Series, size: float | None) -> list[CheckResult]:
    if not lengths.count():
        return []
    typical = _median(lengths)
    what = f"a typical {what} is {typical:.4g} m"
    if typical > FAR_M and (size is None or typical > FAR_SIZES * size):
        unit = "millimetres" if size is None or typical > FAR_SIZES_MM * size else "centimetres"
        return [CheckResult("error", name, f"{what}: looks like {unit}, expected metres")]
    if size is not None and typical > FAR_SIZES * max(size, 1.0):
        message = f"{what}, the rig is {size:.3g} m across: looks like centimetres or millimetres, expected metres"
        return [CheckResult("error", name, message)]
    return []


def _anchor_lengths(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """Anchors much further apart than the distances to the tags."""
    distances = [
        tables[name][kind.columns[0].name].abs().rename("distance")
        for name, kind in KINDS.items()
        if name in tables and kind.distance
    ]
    if len(rig.anchors) < 2 or not any(column.count() for column in distances):
        return []
    positions = np.stack(list(rig.anchors.values()))
    between = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    nearest = float(np.median(np.where(np.eye(len(positions), dtype=bool), np.inf, between).min(axis=1)))
    typical = _median(pl.concat(distances))
    if nearest < 100 * typical or nearest < FAR_M:
        return []
    message = f"anchors {nearest:.4g} m apart, ranges of {typical:.3g} m: looks like millimetres, expected metres"
    return [CheckResult("error", "rig.toml", message)]


def _accelerations(table: pl.DataFrame) -> list[CheckResult]:
    axes = [f"accel_{axis}_mps2" for axis in "xyz"]
    norms = table.select(pl.sum_horizontal(pl.col(axes) ** 2, ignore_nulls=False).sqrt()).to_series()
    if not norms.count():
        return []
    typical = _median(norms)
    gravity = abs(typical - GRAVITY) <= GRAVITY_SLACK * GRAVITY
    if set(QUATERNION) <= set(table.columns):  # the format's sign that the sensor subtracts gravity
        if not gravity:
            return []
        message = f"typical acceleration is {typical:.3g} m/s²: with gravity, but quaternion columns imply none"
        return [CheckResult("warning", "imu", message)]
    if gravity:
        return [CheckResult("info", "imu", f"measured gravity is {typical:.4g} m/s²")]
    if abs(typical - 1) <= GRAVITY_SLACK:
        message = f"typical acceleration is {typical:.3g}: looks like multiples of g, expected m/s² with gravity (9.81)"
        return [CheckResult("error", "imu", message)]
    message = f"typical acceleration is {typical:.3g} m/s², expected {GRAVITY} ± {100 * GRAVITY_SLACK:g} % with gravity"
    if typical < GRAVITY / 2:
        message += "; it looks subtracted: export the raw acceleration, or the attitude too, as qw, qx, qy, qz"
    return [CheckResult("error" if typical < GRAVITY / 2 else "warning", "imu", message)]


def _turn_rates(table: pl.DataFrame) -> list[CheckResult]:
    sizes = pl.concat([table[f"gyro_{axis}_radps"].abs().alias("size") for axis in "xyz"]).drop_nulls()
    if len(sizes) == 0:
        return []
    large = float(sizes.quantile(0.95) or 0)
    if large <= FASTEST_TURN:
        return []
    message = f"turn rates reach {large:.3g} rad/s: looks like degrees per second, expected radians"
    return [CheckResult("error", "imu", message)]


def _size(rig: Rig) -> float | None:
    """Diagonal of the bounding box of anchors, stations and path, m; None with fewer than two points."""
    places = [np.asarray(p)[:2] for p in (*rig.anchors.values(), *(s.position for s in rig.stations.values()))]
    places += [] if rig.path_knots is None else list(rig.path_knots)
    return float(np.linalg.norm(np.ptp(np.stack(places), axis=0))) if len(places) > 1 else None


def _from_rig(table: pl.DataFrame, rig: Rig) -> pl.Series:
    places = [*rig.anchors.values(), *(station.position for station in rig.stations.values())]
    centre = np.mean(places, axis=0) if places else np.zeros(3)
    squares = ((pl.col(c) - float(at)) ** 2 for c, at in zip(("x_m", "y_m"), centre[:2], strict=True))
    return table.select(pl.sum_horizontal(*squares, ignore_nulls=False).sqrt()).to_series()


def _median(values: pl.Series) -> float:
    return float(values.median() or 0.0)  # type: ignore[arg-type]
