"""Checks of units by typical values: angles in radians, lengths in metres, accelerations with gravity."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import ELSEWHERE_M, Rig
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.checks.sampling import not_wrapped
from trackwright.trackers.recordings.columns import TableRows
from trackwright.trackers.recordings.kinds import KINDS, QUATERNION, Kind, table_kinds

FAR_M = 500.0  # beyond the range of indoor radio
GRAVITY_IN = {"multiples of g": 1.0, "ft/s²": 32.2, "thousandths of g or cm/s²": 1000.0, "mm/s²": 9810.0}
NANOSECOND_M = 0.2998

Found = tuple[Level, str]
"""A result of a table, without its name."""

X = pl.col("size")


class Rule(NamedTuple):
    """A number of the sizes of values, reported by `message` where it is above `above`."""

    level: Level
    number: pl.Expr
    above: float
    message: str


BEYOND = X.gt(pl.col("bound") + 1e-3).mean()
_BEYOND = "{share:.0f} % of {name} lie beyond ±{bound:.3g}: looks like "
_DEGREES = ": looks like degrees, expected radians wrapped to (-π, π]"
_UNWRAPPED = "{name} are not wrapped to (-π, π]; harmless, since trackers wrap phase differences"
_TURNS = "turn rates reach {size} rad/s: looks like degrees per second, expected radians"
RULES = {
    "phases": (
        Rule("error", X.median(), 2 * math.pi, "{name} are typically {n:.3g}" + _DEGREES),
        Rule("warning", X.gt(math.pi + 1e-3).mean(), 0.01, _UNWRAPPED),
    ),
    "gyro": (Rule("error", X.quantile(0.95), 35.0, _TURNS),),  # the full scale of common gyroscopes
    "rad": (Rule("error", BEYOND, 0.1, _BEYOND + "degrees, expected radians"),),
    "mps": (Rule("error", BEYOND, 0.1, _BEYOND + "millimetres or centimetres per second, expected metres"),),
    "radps": (Rule("error", BEYOND, 0.1, _BEYOND + "degrees per second, expected radians"),),
}
"""By unit; the first that is broken is reported."""


def check_units(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Values of a size that suggests another unit than the column's."""
    yield from _elsewhere(rig)
    yield from _anchor_lengths(rig, tables)
    kinds, places = table_kinds(), [place[:2] for place in rig.places()] + list(_knots(rig))
    size = float(np.linalg.norm(np.ptp(np.stack(places), axis=0))) if len(places) > 1 else None
    for name, table in tables.items():
        for level, message in _of_table(kinds[name], table, rig, size):
            yield CheckResult(level, name, message)


def _of_table(kind: Kind, table: pl.DataFrame, rig: Rig, size: float | None) -> Iterator[Found]:
    """What sizes of the values say; `size` of the rig: the diagonal of its bounding box, m, None for fewer than two."""
    if kind.numbered:
        yield from _broken("phases", kind.name, math.pi, *table[kind.layout(table.columns).values])
    elif kind.position:
        x, y, *_ = np.mean(rig.places() or [np.zeros(3)], axis=0)
        yield from _lengths("distance from the rig", ((table["x_m"] - x) ** 2 + (table["y_m"] - y) ** 2).sqrt(), size)
    elif kind.unit == "mps2":
        yield from _accelerations(table)
        yield from _broken("gyro", kind.name, math.inf, *table["gyro_x_radps", "gyro_y_radps", "gyro_z_radps"])
    else:
        found = list[Found]()
        for column in kind.columns:
            if column.unit == "m":
                what = column.name.removesuffix("_m").replace("_", " ")
                found += _lengths(what, table[column.name].abs(), size)
            elif column.unit != "rad" or not not_wrapped(table[column.name], column.bound):
                found += _broken(column.unit, column.name, column.bound, table[column.name])
        yield from found or (_differences(kind, table, rig) if kind.difference else ())


def _broken(of: str, name: str, bound: float, *columns: pl.Series) -> Iterator[Found]:
    """The first broken rule of values in one or several columns."""
    sizes = pl.concat([column.abs().alias("size") for column in columns]).drop_nulls().to_frame()
    sizes = sizes.with_columns(bound=bound)
    for level, number, above, message in RULES.get(of, ()):
        n = sizes.select(number).item() or 0.0
        if n > above:
            yield level, message.format(name=name, n=n, share=100 * n, size=significant(n, 3), bound=bound)
            return


def _differences(kind: Kind, table: pl.DataFrame, rig: Rig) -> Iterator[Found]:
    """Differences of distances that exceed the distance of their anchors, which no place explains."""
    measured, column = kind.measured(rig, TableRows(table)), kind.columns[0]
    first, second = measured.sensors.places[measured.sensors.number].swapaxes(0, 1)
    apart, sizes = np.linalg.norm(first - second, axis=1), np.abs(measured.values[:, 0])
    if np.isnan(sizes).all():
        return
    # One in seconds is at most 1e-6 in 300 m; in metres some exceed their resolution.
    if (largest := np.nanmax(sizes)) < 1e-5:
        yield "error", f"{column.name} is at most {largest:.2g}: looks like seconds, expected metres"
        return
    share, in_ns = (float(np.nanmean(factor * sizes > apart + column.bias)) for factor in (1.0, NANOSECOND_M))
    if share > 0.1:  # 1 % of a real flight
        unit = "centimetres or millimetres, or other anchors" if in_ns > 0.1 else "nanoseconds or feet"
        exceed = f"{100 * share:.0f} % of {column.name} exceed the distance of their anchors"
        yield "error", f"{exceed}: looks like {unit}, expected metres"


def _lengths(what: str, lengths: pl.Series, size: float | None) -> Iterator[Found]:
    """Lengths of more than 20 times the size of the rig, or far away beside one that is not known."""
    typical, across = _median(lengths), math.nan if size is None else size
    if typical > max(FAR_M, 20 * across if size else 0.0):
        unit = "centimetres" if typical <= 150 * across else "millimetres"
        # Places in millimetres are as far from one another as from the rig; places in another frame are not.
        if "from" in what and size is not None and float(lengths.std() or 0.0) < 0.05 * typical:  # type: ignore[arg-type]
            unit = f"another frame than the rig's, or {unit}"
        yield "error", f"a typical {what} is {significant(typical, 4)} m: looks like {unit}, expected metres"
    elif typical > 20 * max(across, 1.0):
        found = f"a typical {what} is {significant(typical, 4)} m, the rig is {significant(across, 3)} m across"
        yield "error", f"{found}: looks like centimetres or millimetres, expected metres"


def _knots(rig: Rig) -> np.ndarray:
    return np.zeros((0, 2)) if rig.path_knots is None else np.asarray(rig.path_knots)


def _elsewhere(rig: Rig) -> Iterator[CheckResult]:
    """Anchors, stations and knots of the path too far from the others for one site."""
    names = [*(f"anchor {name}" for name in rig.anchors), *(f"station {name}" for name in rig.stations)]
    names += ["path_knots"] * len(_knots(rig))
    places = np.array([*(place[:2] for place in rig.places()), *_knots(rig)]).reshape(-1, 2)
    far = np.abs(places - np.median(places, axis=0)).max(axis=1) > ELSEWHERE_M if len(places) > 1 else []
    for name in dict.fromkeys(np.array(names)[far].tolist()):
        yield CheckResult("error", "rig.toml", f"{name}: more than 100 km from the others; correct its coordinates")


def _anchor_lengths(rig: Rig, tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Anchors much further apart than the distances to the tags."""
    names = [(name, kind.columns[0].name) for name, kind in KINDS.items() if name in tables and kind.distance]
    distances = [tables[name][column].abs().rename("distance").drop_nulls() for name, column in names]
    if len(rig.anchors) < 2 or not any(map(len, distances)):
        return
    positions = np.stack(list(rig.anchors.values()))
    between = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    nearest = float(np.median((between + np.diag([np.inf] * len(positions))).min(axis=1)))
    typical = _median(pl.concat(distances))
    if nearest >= max(100 * typical, FAR_M):
        apart = f"anchors {significant(nearest, 4)} m apart, ranges of {significant(typical, 3)} m"
        yield CheckResult("error", "rig.toml", f"{apart}: looks like millimetres, expected metres")


def _accelerations(table: pl.DataFrame) -> Iterator[Found]:
    """The typical acceleration, 9.81 m/s² to 15 %: room for the bias of a low-cost sensor and moderate motion."""
    norms = table.select(pl.sum_horizontal(pl.col("^accel_[xyz]_mps2$") ** 2, ignore_nulls=False).sqrt()).to_series()
    if not norms.count():
        return
    typical = _median(norms)
    found, gravity = f"typical acceleration is {significant(typical, 3)}", abs(typical - 9.81) <= 0.15 * 9.81
    if {*QUATERNION} <= {*table.columns}:  # the format's sign that the sensor subtracts gravity
        if gravity:
            yield "warning", f"{found} m/s²: with gravity, but quaternion columns imply none"
    elif gravity:
        yield "info", f"measured gravity is {typical:.4g} m/s²"
    elif unit := next((unit for unit, size in GRAVITY_IN.items() if abs(typical - size) <= 0.15 * size), None):
        yield "error", f"{found}: looks like {unit}, expected m/s² with gravity (9.81)"
    else:
        cause = ""
        if typical < 9.81 / 2:
            cause = "; it looks subtracted: export the raw acceleration, or the attitude too, as qw, qx, qy, qz"
        elif typical > 2 * 9.81:
            cause = "; it looks like another unit: `trackwright import` converts the common ones"
        yield "error" if cause else "warning", f"{found} m/s², expected 9.81 ± 15 % with gravity{cause}"


def _median(values: pl.Series) -> float:
    return float(values.median() or 0.0)  # type: ignore[arg-type]
