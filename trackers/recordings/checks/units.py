"""Checks of units by typical values: angles in radians, lengths in metres, accelerations with gravity."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import ELSEWHERE_M, Rig
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.columns import TableRows
from trackwright.trackers.recordings.kinds import KINDS, QUATERNION, Column, Kind, table_kinds

GRAVITY = 9.81
GRAVITY_SLACK = 0.15  # for the bias of a low-cost accelerometer and moderate motion
FAR_M = 500.0  # beyond the range of indoor radio
FAR_SIZES = 20.0  # times the size of the rig
FRAME_SPREAD = 0.05  # places of another frame are as far from the rig, up to this share of the distance
FAR_SIZES_MM = 150.0  # times the size of the rig, beyond which centimetres would be far away, too
BEYOND_ANCHORS = 0.1  # share of range differences larger than their anchors' distance; 1 % of a real flight
GRAVITY_IN = {"multiples of g": 1.0, "ft/s²": 32.2, "thousandths of g or cm/s²": 1000.0, "mm/s²": 9810.0}
NANOSECOND_M = 0.2998
LEAST_DIFFERENCE_M = 1e-5  # a difference in seconds is at most 1e-6 in 300 m; in metres some exceed their resolution
OTHER_UNIT = {
    "rad": "degrees, expected radians",
    "mps": "millimetres or centimetres per second, expected metres",
    "radps": "degrees per second, expected radians",
}
FASTEST_TURN = 35.0  # rad/s, the full scale of common gyroscopes

Found = tuple[Level, str]
"""A result of a table, without its name."""


def check_units(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Values of a size that suggests another unit than that of the column."""
    yield from _elsewhere(rig)
    yield from _anchor_lengths(rig, tables)
    size, kinds = _size(rig), table_kinds()
    for name, table in tables.items():
        kind = kinds[name]
        if kind.numbered:
            found = list(_phases(kind, table))
        elif kind.position:
            found = list(_lengths("distance from the rig", _from_rig(table, rig), size, from_rig=True))
        elif kind.unit == "mps2":
            found = [*_accelerations(table), *_turn_rates(table)]
        else:
            found = [line for column in kind.columns for line in _values(column, table[column.name], size)]
            if kind.difference and not found:
                found = list(_differences(kind, table, rig))
        yield from (CheckResult(level, name, message) for level, message in found)


def _differences(kind: Kind, table: pl.DataFrame, rig: Rig) -> Iterator[Found]:
    """Differences of distances that exceed the distance of their anchors, which no place explains."""
    measured, column = kind.measured(rig, TableRows(table)), kind.columns[0]
    places, number = measured.sensors.places, measured.sensors.number
    apart = np.linalg.norm(places[number[:, 0]] - places[number[:, 1]], axis=1)
    sizes = np.abs(measured.values[:, 0])
    largest = np.nanmax(sizes, initial=0.0)
    if np.isnan(sizes).all():
        return
    if largest < LEAST_DIFFERENCE_M:
        yield "error", f"{column.name} is at most {largest:.2g}: looks like seconds, expected metres"
        return
    share, in_ns = (float(np.nanmean(factor * sizes > apart + column.bias)) for factor in (1.0, NANOSECOND_M))
    if share > BEYOND_ANCHORS:
        unit = "centimetres or millimetres, or other anchors" if in_ns > BEYOND_ANCHORS else "nanoseconds or feet"
        exceed = f"{100 * share:.0f} % of {column.name} exceed the distance of their anchors"
        yield "error", f"{exceed}: looks like {unit}, expected metres"


def _phases(kind: Kind, table: pl.DataFrame) -> Iterator[Found]:
    sizes = pl.concat([table[c].abs().alias("size") for c in kind.layout(table.columns).values]).drop_nulls()
    if len(sizes) and _median(sizes) > 2 * math.pi:
        typical = f"{kind.name} are typically {_median(sizes):.3g}"
        yield "error", f"{typical}: looks like degrees, expected radians wrapped to (-π, π]"
    elif int((sizes > math.pi + 1e-3).sum()) > 0.01 * len(sizes):
        yield "warning", f"{kind.name} are not wrapped to (-π, π]; harmless, since trackers wrap phase differences"


def _values(column: Column, values: pl.Series, size: float | None) -> Iterator[Found]:
    """Angles, speeds and rates beyond their bound, and lengths that are large beside the rig, whose `size` is in m."""
    if column.unit == "m":
        yield from _lengths(column.name.removesuffix("_m").replace("_", " "), values.abs(), size)
    elif column.unit in OTHER_UNIT and (values.abs().quantile(0.9) or 0.0) > column.bound:
        beyond = f"10 % of {column.name} lie beyond ±{column.bound:.3g}"
        yield "error", f"{beyond}: looks like {OTHER_UNIT[column.unit]}"


def _lengths(what: str, lengths: pl.Series, size: float | None, from_rig: bool = False) -> Iterator[Found]:
    if not lengths.count():
        return
    typical = _median(lengths)
    what = f"a typical {what} is {significant(typical, 4)} m"
    if typical > FAR_M and (size is None or typical > FAR_SIZES * size):
        unit = "millimetres" if size is None or typical > FAR_SIZES_MM * size else "centimetres"
        # Places in millimetres are as far from one another as from the rig; those of another frame are not.
        if from_rig and size is not None and float(lengths.std() or 0.0) < FRAME_SPREAD * typical:  # type: ignore[arg-type]
            yield "error", f"{what}: looks like another frame than the rig's, or {unit}, expected metres"
        else:
            yield "error", f"{what}: looks like {unit}, expected metres"
    elif size is not None and typical > FAR_SIZES * max(size, 1.0):
        across = f"{what}, the rig is {significant(size, 3)} m across"
        yield "error", f"{across}: looks like centimetres or millimetres, expected metres"


def _elsewhere(rig: Rig) -> Iterator[CheckResult]:
    """Anchors, stations and knots of the path too far from the others for one site."""
    names = [*(f"anchor {name}" for name in rig.anchors), *(f"station {name}" for name in rig.stations)]
    knots = np.zeros((0, 2)) if rig.path_knots is None else rig.path_knots
    names += ["path_knots"] * len(knots)
    places = np.array([*(place[:2] for place in rig.places()), *knots]).reshape(-1, 2)
    far = np.abs(places - np.median(places, axis=0)).max(axis=1) > ELSEWHERE_M if len(places) > 1 else []
    for name in dict.fromkeys(np.array(names)[far].tolist()):
        yield CheckResult("error", "rig.toml", f"{name}: more than 100 km from the others; correct its coordinates")


def _anchor_lengths(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Anchors much further apart than the distances to the tags."""
    distances = [
        tables[name][kind.columns[0].name].abs().rename("distance")
        for name, kind in KINDS.items()
        if name in tables and kind.distance
    ]
    if len(rig.anchors) < 2 or not any(column.count() for column in distances):
        return
    positions = np.stack(list(rig.anchors.values()))
    between = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    nearest = float(np.median(np.where(np.eye(len(positions), dtype=bool), np.inf, between).min(axis=1)))
    typical = _median(pl.concat(distances))
    if nearest >= max(100 * typical, FAR_M):
        apart = f"anchors {significant(nearest, 4)} m apart, ranges of {significant(typical, 3)} m"
        yield CheckResult("error", "rig.toml", f"{apart}: looks like millimetres, expected metres")


def _accelerations(table: pl.DataFrame) -> Iterator[Found]:
    axes = [f"accel_{axis}_mps2" for axis in "xyz"]
    norms = table.select(pl.sum_horizontal(pl.col(axes) ** 2, ignore_nulls=False).sqrt()).to_series()
    if not norms.count():
        return
    typical = _median(norms)
    is_typical = f"typical acceleration is {significant(typical, 3)}"
    unit = next((unit for unit, size in GRAVITY_IN.items() if abs(typical - size) <= GRAVITY_SLACK * size), None)
    gravity = abs(typical - GRAVITY) <= GRAVITY_SLACK * GRAVITY
    if set(QUATERNION) <= set(table.columns):  # the format's sign that the sensor subtracts gravity
        if gravity:
            yield "warning", f"{is_typical} m/s²: with gravity, but quaternion columns imply none"
    elif gravity:
        yield "info", f"measured gravity is {typical:.4g} m/s²"
    elif unit is not None:
        yield "error", f"{is_typical}: looks like {unit}, expected m/s² with gravity (9.81)"
    else:
        message = f"{is_typical} m/s², expected {GRAVITY} ± {100 * GRAVITY_SLACK:g} % with gravity"
        if typical < GRAVITY / 2:
            message += "; it looks subtracted: export the raw acceleration, or the attitude too, as qw, qx, qy, qz"
        elif typical > 2 * GRAVITY:
            message += "; it looks like another unit: `trackwright import` converts the common ones"
        yield "warning" if GRAVITY / 2 <= typical <= 2 * GRAVITY else "error", message


def _turn_rates(table: pl.DataFrame) -> Iterator[Found]:
    sizes = pl.concat([table[f"gyro_{axis}_radps"].abs().alias("size") for axis in "xyz"]).drop_nulls()
    large = sizes.quantile(0.95) or 0.0
    if large > FASTEST_TURN:
        yield (
            "error",
            f"turn rates reach {significant(large, 3)} rad/s: looks like degrees per second, expected radians",
        )


def _size(rig: Rig) -> float | None:
    """Diagonal of the bounding box of anchors, stations and path, m; None with fewer than two points."""
    places = [place[:2] for place in rig.places()] + ([] if rig.path_knots is None else list(rig.path_knots))
    return float(np.linalg.norm(np.ptp(np.stack(places), axis=0))) if len(places) > 1 else None


def _from_rig(table: pl.DataFrame, rig: Rig) -> pl.Series:
    centre = np.mean(rig.places() or [np.zeros(3)], axis=0)
    squares = ((pl.col(c) - float(at)) ** 2 for c, at in zip(("x_m", "y_m"), centre[:2], strict=True))
    return table.select(pl.sum_horizontal(*squares, ignore_nulls=False).sqrt()).to_series()


def _median(values: pl.Series) -> float:
    return float(values.median() or 0.0)  # type: ignore[arg-type]
