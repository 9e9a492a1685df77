"""Do the numbers look like SI units: angles, lengths, gravity. Judged by typical values, not by single ones."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import polars as pl

from trackers.core.rig import Rig
from trackers.recordings.checks.findings import Finding, Level
from trackers.recordings.tables import QUATERNION, layout

GRAVITY = 9.81
GRAVITY_SLACK = 0.15  # of a cheap accelerometer's bias and of a little motion
FAR_M = 500.0  # beyond the reach of indoor radio
FAR_SIZES = 20.0  # times the rig's size
FASTEST_TURN = 35.0  # rad/s, the full scale of common gyroscopes
_FAST_DEGREES = 100.0  # a median turn rate above it, in rad/s, is more than any scale


def check_units(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> list[Finding]:
    """Findings on values whose size says that they are in another unit than the column's name."""
    findings = _anchor_lengths(rig, tables)
    size = _size(rig)
    for name, table in tables.items():
        if name in ("bearings", "phases"):
            findings += _angles(name, table)
        elif name == "ranges":
            findings += _lengths(name, table["range_m"].abs(), size)
        elif name in ("fixes", "truth"):
            findings += _lengths(name, _from_rig(table, rig), size)
        elif name == "imu":
            findings += _accelerations(table) + _turn_rates(table)
    return findings


def _angles(name: str, table: pl.DataFrame) -> list[Finding]:
    findings = []
    if name == "phases":
        values = layout(name, table.columns).values
        sizes = pl.concat([table[c].abs().alias("size") for c in values]).drop_nulls()
        if len(sizes) and _median(sizes) > 2 * math.pi:
            message = f"phases are typically {_median(sizes):.3g}: looks like degrees, expected wrapped radians"
            findings.append(Finding("error", name, message))
        elif int((sizes > math.pi + 1e-3).sum()) > 0.01 * len(sizes):
            message = "phases are not wrapped to (-π, π]; harmless, since a tracker wraps the differences it takes"
            findings.append(Finding("warning", name, message))
        return findings
    for column, limit in (("azimuth_rad", math.pi), ("elevation_rad", math.pi / 2)):
        large = table[column].abs().quantile(0.9)
        if large is not None and large > limit:
            message = f"one {column} in ten lies beyond ±{large:.3g}: looks like degrees, expected radians"
            findings.append(Finding("error", name, message))
    return findings


def _lengths(name: str, lengths: pl.Series, size: float | None) -> list[Finding]:
    if not lengths.count():
        return []
    typical = _median(lengths)
    what = f"a typical {'range' if name == 'ranges' else 'distance from the rig'} is {typical:.4g} m"
    if typical > FAR_M and (size is None or typical > FAR_SIZES * size):
        return [Finding("error", name, f"{what}: looks like millimetres, expected metres")]
    if size is not None and typical > FAR_SIZES * max(size, 1.0):
        message = f"{what}, the rig is {size:.3g} m across: looks like centimetres or millimetres, expected metres"
        return [Finding("error", name, message)]
    return []


def _anchor_lengths(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> list[Finding]:
    """Anchors much further from each other than from the tags they range to."""
    if "ranges" not in tables or len(rig.anchors) < 2 or not tables["ranges"]["range_m"].count():
        return []
    positions = np.stack(list(rig.anchors.values()))
    between = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    nearest = float(np.median(np.where(np.eye(len(positions), dtype=bool), np.inf, between).min(axis=1)))
    typical = _median(tables["ranges"]["range_m"].abs())
    if nearest < 100 * typical or nearest < FAR_M:
        return []
    message = f"anchors {nearest:.4g} m apart, ranges of {typical:.3g} m: looks like millimetres, expected metres"
    return [Finding("error", "rig.toml", message)]


def _accelerations(table: pl.DataFrame) -> list[Finding]:
    axes = [f"accel_{axis}_mps2" for axis in "xyz"]
    norms = table.select(pl.sum_horizontal(pl.col(axes) ** 2, ignore_nulls=False).sqrt()).to_series()
    if not norms.count():
        return []
    typical = _median(norms)
    gravity = abs(typical - GRAVITY) <= GRAVITY_SLACK * GRAVITY
    if set(QUATERNION) <= set(table.columns):  # the format's sign that the sensor took gravity out itself
        if not gravity:
            return []
        message = f"typical acceleration is {typical:.3g} m/s²: with gravity, but quaternion columns say without"
        return [Finding("warning", "imu", message)]
    if gravity:
        return [Finding("info", "imu", f"gravity reads {typical:.4g} m/s²")]
    if abs(typical - 1) <= GRAVITY_SLACK:
        message = f"typical acceleration is {typical:.3g}: looks like multiples of g, expected m/s² with gravity (9.81)"
        return [Finding("error", "imu", message)]
    message = f"typical acceleration is {typical:.3g} m/s², expected {GRAVITY} ± {100 * GRAVITY_SLACK:g} % with gravity"
    return [Finding("warning", "imu", message)]


def _turn_rates(table: pl.DataFrame) -> list[Finding]:
    sizes = pl.concat([table[f"gyro_{axis}_radps"].abs().alias("size") for axis in "xyz"]).drop_nulls()
    if len(sizes) == 0:
        return []
    large = float(sizes.quantile(0.95) or 0)
    if large <= FASTEST_TURN:
        return []
    level: Level = "error" if _median(sizes) > _FAST_DEGREES else "warning"
    return [Finding(level, "imu", f"turn rates reach {large:.3g} rad/s: looks like degrees a second, expected radians")]


def _size(rig: Rig) -> float | None:
    """The diagonal of the box round everything that stands still, m; None where nothing is known."""
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
