"""Each mistake is named by `check` in its words, and no other error with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import (
    Make,
    about_z,
    arrays,
    differences,
    good,
    hall,
    height,
    only,
    rotated,
    together,
    with_anchors,
    with_columns,
    with_rows,
    with_stations,
)
from trackwright.sim import worlds
from trackwright.trackers.recordings.checks import format_results
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.folder import RecordingFolder

C, T, X, Y, Z = pl.col, *(pl.col(name) for name in ("t_s", "x_m", "y_m", "z_m"))
XYZ, R, AZ, EL = pl.col("x_m", "y_m", "z_m"), C("range_m"), C("azimuth_rad"), C("elevation_rad")
TD = C("range_difference_m")
V, W, A1 = C("speed_mps"), C("yaw_rate_radps"), C("anchor")
ACCEL, GYRO = ([f"{name}_{axis}_{unit}" for axis in "xyz"] for name, unit in (("accel", "mps2"), ("gyro", "radps")))
PHASES = [f"phase_{k}_rad" for k in range(1, 9)]
WILD = pl.Series(np.random.default_rng(1).uniform(0, 250, 1800))
ROW = pl.int_range(pl.len())


class Case(NamedTuple):
    """A mistake made on a world, and the level and words of the line that names it.

    `alone`: with no other error.
    """

    level: str
    words: str
    make: Make
    alone: bool = True


def _times(scale: float, shift: float) -> Make:
    return lambda folder: replace(
        folder, tables={name: table.with_columns(T * scale + shift) for name, table in folder.tables.items()}
    )


def _places(*places: list[float]) -> Make:
    return with_anchors(lambda anchors: dict(zip(anchors, np.array(places, float), strict=True)))


def _anchor(name: str, place: tuple[float, float, float]) -> Make:
    return with_anchors(lambda _: {name: np.array(place)})


def _exchanged(one: str, other: str) -> Make:
    return with_anchors(lambda anchors: {one: anchors[other], other: anchors[one]})


def _axes(names: list[str], *signs: int) -> list[pl.Expr]:
    return [C(name) * sign for name, sign in zip(names, signs, strict=True)]


def _exchange(names: list[str]) -> list[pl.Expr]:
    return [C(names[1]).alias(names[0]), C(names[0]).alias(names[1])]


def _offsets(change: Callable[[np.ndarray], np.ndarray]) -> Make:
    return lambda folder: replace(
        folder, rig=replace(folder.rig, tags={
            name: replace(tag, offset=change(np.asarray(tag.offset))) for name, tag in folder.rig.tags.items()
        }),
    )  # fmt: skip


def _phases(change: Callable[[pl.Expr], pl.Expr]) -> Make:
    return with_columns("phases", **{name: change(C(name)) for name in PHASES})


def _order(order: list[str]) -> Make:
    return with_columns("phases", **{name: C(other) for name, other in zip(PHASES, order, strict=True)})


def _antennas(factor: float | list[float]) -> Make:
    return with_stations(lambda station: replace(station, antennas=np.multiply(station.antennas, factor)))


def _wavelength(factor: float) -> Make:
    return with_stations(lambda station: replace(station, wavelength=factor * station.wavelength))


def _late(**by: float) -> pl.Expr:
    """What signals that are late at some anchors, by lengths, m, add to the differences."""
    first, second = (C(column).cast(pl.String).replace_strict(by, default=0.0) for column in ("anchor", "anchor_2"))
    return first - second


def _ids(one: str, other: str) -> Make:
    """Two anchors' ids exchanged in the table of differences."""
    names = {one: other, other: one}
    return with_columns("tdoa", *(C(x).cast(pl.String).replace(names).alias(x) for x in ("anchor", "anchor_2")))


FLIPPED, DOWN = _axes(GYRO, -1, -1, -1), [*_axes(ACCEL, 1, -1, -1), *_axes(GYRO, 1, -1, -1)]
SWAPPED = [*_exchange(ACCEL), *_exchange(GYRO)]
body = partial(worlds.body, n=1, rows=50)
drive = partial(worlds.body, n=1, tags=1, odometry=True, rows=200)
blind = only("ranges", "bearings")

WORLDS: dict[str, tuple[Callable[[], RecordingFolder], dict[str, Case]]] = {
    "good": (good, {
        "azimuth in degrees": Case("error", "azimuth_rad lie beyond ±3.14: looks like degrees", with_columns("bearings", AZ.degrees())),
        "phases in degrees": Case("error", "typical phases", with_columns("phases", C("^phase_.*$").degrees())),
        "ranges in millimetres": Case("error", "looks like centimetres or millimetres", with_columns("ranges", R * 1000)),
        "ranges in centimetres": Case("error", "centimetres", with_columns("ranges", R * 100)),
        "fixes in millimetres": Case("error", "fixes: typical distance from the rig", with_columns("fixes", XYZ * 1000)),
        "fixes without a height": Case(
            "warning", "fixes: neither z_m nor height_m in rig.toml: 1 of the tags ('T2'); track refuses them: give height_m under [tags.T2]",
            with_columns("fixes", z_m=pl.lit(None, pl.Float64)),
        ),
        "truth in millimetres": Case("error", "truth: typical distance", with_columns("truth", XYZ * 1000), False),
        "acceleration in g": Case("error", "multiples of g", with_columns("imu", C("^accel.*$") / 9.81)),
        "acceleration in thousandths of g": Case(
            "error", "typical acceleration is 1,000 m/s²: gravity in thousandths of g or cm/s²", with_columns("imu", C("^accel.*$") / 9.81e-3),
        ),
        "acceleration in counts": Case("error", "another unit", with_columns("imu", C("^accel.*$") / 9.81 * 16384)),
        "acceleration without gravity": Case("error", "gravity looks subtracted", with_columns("imu", C("accel_z_mps2") - 9.81)),
        "gravity beside quaternions": Case(
            "warning", "but quaternion columns imply none", with_columns("imu", qw=pl.lit(1.0), qx=pl.lit(0.0), qy=pl.lit(0.0), qz=pl.lit(0.0)),
        ),
        "turn rates in degrees": Case("error", "degrees per second", with_columns("imu", C("^gyro.*$") * 0 + 150)),
        "no value": Case("error", "range_m empty 1: all values are missing", with_columns("ranges", range_m=pl.lit(None, pl.Float64)), False),
        "an anchor that is silent": Case("warning", "anchors never observed: 1 of 4 (A3)", with_rows("ranges", A1 != "A3")),
        "truth of another time": Case("error", "covers 0 % of the measurements in time (40 to 44.9 s, and they 0 to 4.9 s", with_columns("truth", T + 40)),
        "truth of a part": Case("warning", "covers 20 %", with_rows("truth", T < 0.95)),
        "truth alone": Case("error", "no measurements, only truth", only("truth"), False),
        "one station": Case("info", "bearings: only station S1", with_rows("bearings", C("station") == "S1")),
        "anchors in millimetres": Case(
            "error", "rig.toml: anchors", with_anchors(lambda anchors: {key: 1000 * np.array(place) for key, place in anchors.items()}), False,
        ),
        "seconds since 1970": Case("warning", "seconds since 1970", _times(1, 1.7e9)),
        "milliseconds since 1970": Case("error", "milliseconds since 1970", _times(1e3, 1.7e12)),
        "microseconds since 1970": Case("error", "microseconds since 1970", _times(1e6, 1.7e15)),
        "nanoseconds since 1970": Case("error", "nanoseconds since 1970", _times(1e9, 1.7e18)),
        "milliseconds": Case("warning", "looks like milliseconds", _times(1e3, 0)),
        "a late start": Case("warning", "expected a start near 0", _times(1, 500)),
        "two clocks": Case(
            "error", ", and ranges 0 to 4.9 s; 4.722e+05 hours apart, as two time zones, or one counts from 1970; expected one clock",
            with_columns("bearings", T + 1.7e9),
        ),
        "two time zones": Case("error", "2 hours apart", with_columns("imu", T + 7200.0)),
        "anchors in one plane": Case("warning", "height is weakly determined", _places([0, 0, 2], [6, 0, 2], [6, 5, 2], [0, 5, 2.1])),
        "anchors on a line": Case("warning", "collinear", _places([0, 0, 2], [2, 0, 2], [4, 0, 2], [6, 0, 2.1]), False),
        "anchors on a wall": Case("warning", "vertical plane", _places([0, 0, 0], [0, 4, 0], [0, 4, 3], [0, 0, 3])),
        "anchors at one place": Case("warning", "A1 and A2 have the same position", _places([0, 0, .3], [0, 0, .3], [6, 5, .4], [0, 5, 2.9]), False),
        "a gap": Case("warning", "ranges: gaps longer than 1 s: 8", with_rows("ranges", ~T.is_between(1.0, 3.0))),
    }),
    "hall": (hall, {
        "height of another place": Case("error", "height_m of tag T is 11, but z of its truth is typically 1.10 m: one of the two", height(11.0), False),
        "height with the wrong sign": Case("error", "but z of its truth is typically 1.10 m: one of the two is wrong", height(-1.1), False),
        "truth in another frame": Case(
            "error", "again with --align-truth, or --transform -39.9",
            together(only("ranges", "truth"), with_columns("truth", x_m=0.8 * X - 0.6 * Y + 50.0, y_m=0.6 * X + 0.8 * Y)),
        ),
        "z of the truth down": Case("error", "x, y, z of the truth read as x, y, -z", with_columns("truth", z_m=-Z), False),
        "the frame before the height": Case(
            "error", "truth turned by -127.0",
            together(only("ranges", "truth"), with_columns("truth", x_m=-0.6 * X - 0.8 * Y + 10.0, y_m=0.8 * X - 0.6 * Y, z_m=Z + 1.5)),
        ),
        "a height above all ranges": Case("error", "with the height of the tags left free", together(height(17.0), only("ranges"))),
        "azimuths of a compass": Case("error", "with the azimuth its sign flipped and turned by -90°", with_columns("bearings", (-AZ + 1.5 * np.pi) % (2 * np.pi) - np.pi)),
        "angles swapped": Case(
            "error", "with azimuth and elevation swapped", together(only("bearings", "truth"), with_columns("bearings", azimuth_rad=EL, elevation_rad=AZ)),
        ),
        "azimuths from 0 to 2π": Case("warning", "from 0 to 2π", with_columns("bearings", AZ % (2 * np.pi))),
        "azimuths alone, of another sign": Case("error", "the sign of the azimuth flipped", with_columns("bearings", azimuth_rad=-AZ, elevation_rad=pl.lit(None, pl.Float64))),
        "an anchor wild in most readings": Case(
            "warning", "of anchor A2 are typically", with_columns("ranges", range_m=pl.when((A1 == "A2") & (ROW % 5 > 0)).then(WILD).otherwise(R)),
        ),
        "many wild readings": Case("warning", "outliers of range_m", with_columns("ranges", range_m=pl.when(WILD > 150).then(WILD - 200).otherwise(R))),
        "one time for all rows": Case("error", "lost their digits", with_columns("ranges", t_s=pl.lit(5.0))),
        "a clock that jumps by years": Case("warning", "the clock jumps by 52.", with_columns("ranges", t_s=T + pl.when(T > 30).then(1.66e9).otherwise(0.0)), False),
        "times of 0": Case("warning", "times of 0 in", with_columns("ranges", t_s=pl.when(ROW % 90 == 0).then(0.0).otherwise(T + 1.66e9)), False),
    }),
    "hall without truth": (lambda: blind(hall()), {
        "anchors swapped": Case("error", "anchors A2, A4 swapped for A4, A2: the ids of anchors", _exchanged("A2", "A4")),
        "anchors swapped, height unknown": Case("error", "anchors A2, A4 swapped for A4, A2", together(height(None), only("ranges"), _exchanged("A2", "A4"))),
        "feet": Case("error", "multiplied by 0.3048: ranges are feet", with_columns("ranges", R / 0.3048)),
        "feet of an anchor": Case(
            "warning", "of anchors A4, A5 are typically", with_columns("ranges", range_m=pl.when(A1 == "A4").then(R / 0.3048).otherwise(R)),
        ),
        "azimuths flipped": Case("error", "the sign of the azimuth flipped", with_columns("bearings", -AZ)),
        "elevations flipped": Case("error", "the sign of the elevation flipped", with_columns("bearings", -EL)),
        "angles swapped": Case("error", "azimuth and elevation swapped", with_columns("bearings", azimuth_rad=EL, elevation_rad=AZ)),
        "an anchor elsewhere": Case("warning", "of anchor A2 are typically", together(only("ranges"), _anchor("A2", (6.0, -6.0, 2.4)))),
        "a turned station": Case("warning", "of station S2 are typically", together(only("bearings"), rotated(lambda q: about_z(q, 40.0), ("S2",)))),
    }),
    "phases": (arrays, {"degrees": Case("error", "degrees", _phases(lambda phase: phase.degrees()))}),
    "differences": (differences, {
        "the sign": Case("error", "the tdoa multiplied by -1", with_columns("tdoa", -TD)),
        "ids exchanged": Case("error", "anchors A2, A7 swapped for A7, A2", _ids("A2", "A7")),
        "places exchanged": Case("error", "anchors A3, A4 swapped for A4, A3", _exchanged("A3", "A4")),
        "nanoseconds": Case("error", "nanoseconds or feet", with_columns("tdoa", TD / 0.299792458)),
        "seconds": Case("error", "looks like seconds", with_columns("tdoa", TD / 299792458)),
        "halved": Case("error", "tdoa are halved", with_columns("tdoa", TD / 2)),
        "a late anchor": Case("error", "of anchor A5 are typically 1 m, and 0.049 m with +1.5", with_columns("tdoa", TD + _late(A5=1.5))),
        "places in millimetres": Case("error", "the positions of the anchors multiplied by 0.001", with_anchors(lambda a: {k: 1000 * v for k, v in a.items()})),
        "z of the places flipped": Case("error", "read as x, y, -z", with_anchors(lambda a: {k: v * [1, 1, -1] for k, v in a.items()})),
        "x and y of the places": Case("error", "read as y, x, z", with_anchors(lambda a: {k: v[[1, 0, 2]] for k, v in a.items()})),
        "truth of another origin": Case("error", "the truth shifted by (2.00", with_columns("truth", X - 2)),
    }),
    "differences without truth": (lambda: only("tdoa")(differences()), {
        "rounded": Case("warning", "equal the previous row of the same tag and pair of anchors", with_columns("tdoa", TD.round(0)), False),
        "no value": Case("error", "range_difference_m empty 1: all values are missing", with_columns("tdoa", pl.lit(None, pl.Float64).alias("range_difference_m")), False),
    }),
}  # fmt: skip
MISTAKES = [(world, name) for world, (_, cases) in WORLDS.items() for name in cases]


@pytest.mark.parametrize(("world", "name"), MISTAKES)
def test_a_mistake_is_named_and_no_other_error(world, name):
    make, cases = WORLDS[world]
    level, words, change, alone = cases[name]
    made = change(make())
    made = replace(made, tables={k: table.sort("t_s", maintain_order=True) for k, table in made.tables.items()})
    results = check(made)
    assert any(one.level == level and words in f"{one.where}: {one.message}" for one in results), format_results(
        results
    )
    if alone:
        found = [one.message for one in results if one.level == "error"]
        assert len(found) == (level == "error"), found
        assert [one.message for one in quick_check(made) if one.level == "error"] == found


@pytest.mark.parametrize("world", WORLDS)
def test_no_mistake_is_named_where_nobody_made_one(world):
    make, _ = WORLDS[world]
    found = [one.message for one in check(make()) if one.level != "info"]
    known = "weakly determined", "never observed", "outliers of"
    assert [line for line in found if not any(words in line for words in known)] == []
