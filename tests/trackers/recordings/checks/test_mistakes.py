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
    tool,
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
        "ranges in millimetres": Case("error", "looks like millimetres", with_columns("ranges", R * 1000)),
        "ranges in centimetres": Case("error", "centimetres", with_columns("ranges", R * 100)),
        "fixes in millimetres": Case("error", "fixes: typical distance from the rig", with_columns("fixes", XYZ * 1000)),
        "fixes without a height": Case(
            "warning", "fixes: neither z_m nor height_m in rig.toml: 1 tag ('T2'); track refuses them: give height_m under [tags.T2]",
            with_columns("fixes", z_m=pl.lit(None, pl.Float64)),
        ),
        "truth in millimetres": Case("error", "truth: typical distance", with_columns("truth", XYZ * 1000), False),
        "acceleration in g": Case("error", "multiples of g", with_columns("imu", C("^accel.*$") / 9.81)),
        "acceleration in thousandths of g": Case(
            "error", "typical acceleration is 1,000 m/s²: looks like thousandths of g or cm/s²", with_columns("imu", C("^accel.*$") / 9.81e-3),
        ),
        "acceleration in counts": Case("error", "another unit", with_columns("imu", C("^accel.*$") / 9.81 * 16384)),
        "acceleration without gravity": Case("error", "gravity looks subtracted", with_columns("imu", C("accel_z_mps2") - 9.81)),
        "gravity beside quaternions": Case(
            "warning", "but quaternion columns imply none", with_columns("imu", qw=pl.lit(1.0), qx=pl.lit(0.0), qy=pl.lit(0.0), qz=pl.lit(0.0)),
        ),
        "turn rates in degrees": Case("error", "degrees per second", with_columns("imu", C("^gyro.*$") * 0 + 150)),
        "no value": Case("error", "ranges: all values are missing", with_columns("ranges", range_m=pl.lit(None, pl.Float64)), False),
        "an anchor that is silent": Case("warning", "anchors never observed: 1 of 4 (A3)", with_rows("ranges", A1 != "A3")),
        "truth of another time": Case("error", "no measurement lies inside", with_columns("truth", T + 40)),
        "truth of a part": Case("warning", "covers 20 %", with_rows("truth", T < 0.95)),
        "a hole in the truth": Case("warning", "holes longer than 1 s with motion: 2, the longest 2.2 s after t_s 0.9", with_rows("truth", ~T.is_between(0.95, 3.05))),
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
            "error", ", and ranges 0 to 4.9 s; one of them counts from 1970, the other from its own zero; expected one clock for all tables",
            with_columns("bearings", T + 1.7e9),
        ),
        "two time zones": Case("error", "2 hours apart, as two time zones", with_columns("imu", T + 7200.0)),
        "anchors in one plane": Case("warning", "height is weakly determined", _places([0, 0, 2], [6, 0, 2], [6, 5, 2], [0, 5, 2.1])),
        "anchors on a line": Case("warning", "collinear", _places([0, 0, 2], [2, 0, 2], [4, 0, 2], [6, 0, 2.1]), False),
        "anchors on a wall": Case("warning", "vertical plane", _places([0, 0, 0], [0, 4, 0], [0, 4, 3], [0, 0, 3])),
        "anchors at one place": Case("warning", "A1 and A2 have the same position", _places([0, 0, .3], [0, 0, .3], [6, 5, .4], [0, 5, 2.9]), False),
        "a gap": Case("warning", "ranges: gaps longer than 1 s: 8", with_rows("ranges", ~T.is_between(1.0, 3.0))),
    }),
    "hall": (hall, {
        "height of another place": Case("error", "height_m of tag T is 11, but z of its truth is typically 1.10 m: one of the two", height(11.0), False),
        "height with the wrong sign": Case("error", "but z of its truth is typically 1.10 m: height_m has the wrong sign", height(-1.1), False),
        "truth in another frame": Case(
            "error", "again with --align-truth, which fits the clock as well, or --transform -39.9",
            together(only("ranges", "truth"), with_columns("truth", x_m=0.8 * X - 0.6 * Y + 50.0, y_m=0.6 * X + 0.8 * Y)),
        ),
        "z of the truth down": Case("error", "the sign of z of the truth flipped", with_columns("truth", z_m=-Z), False),
        "z of the truth down, height unknown": Case(
            "error", "with the sign of z of the truth flipped",
            together(height(None), only("ranges", "truth"), with_columns("truth", z_m=-Z)),
        ),
        "the frame before the height": Case(
            "error", "truth turned by -127.0",
            together(only("ranges", "truth"), with_columns("truth", x_m=-0.6 * X - 0.8 * Y + 10.0, y_m=0.8 * X - 0.6 * Y, z_m=Z + 1.5)),
        ),
        "a height above all ranges": Case("error", "height_m of tag T is 17, but 100% of its ranges are shorter", together(height(17.0), only("ranges"))),
        "azimuths of a compass": Case("error", "with the azimuth turned and its sign flipped", with_columns("bearings", (-AZ + 1.5 * np.pi) % (2 * np.pi) - np.pi)),
        "stations turned by ten degrees": Case("warning", "bearings: azimuths of all stations are off by about +10.", with_columns("bearings", AZ + np.radians(10.0))),
        "angles swapped": Case(
            "error", "azimuth and elevation are swapped; rename both", together(only("bearings", "truth"), with_columns("bearings", azimuth_rad=EL, elevation_rad=AZ)),
        ),
        "azimuths from 0 to 2π": Case("warning", "from 0 to 2π", with_columns("bearings", AZ % (2 * np.pi))),
        "azimuths alone, of another sign": Case("error", "flip its sign", with_columns("bearings", azimuth_rad=-AZ, elevation_rad=pl.lit(None, pl.Float64))),
        "an anchor wild in most readings": Case(
            "warning", "of anchor A2 are typically", with_columns("ranges", range_m=pl.when((A1 == "A2") & (ROW % 5 > 0)).then(WILD).otherwise(R)),
        ),
        "many wild readings": Case("warning", "outliers of range_m", with_columns("ranges", range_m=pl.when(WILD > 150).then(WILD - 200).otherwise(R))),
        "one time for all rows": Case("error", "lost their digits", with_columns("ranges", t_s=pl.lit(5.0))),
        "a clock that jumps by years": Case("warning", "the clock jumps by 52.", with_columns("ranges", t_s=T + pl.when(T > 30).then(1.66e9).otherwise(0.0)), False),
        "times of 0": Case("warning", "times of 0 in", with_columns("ranges", t_s=pl.when(ROW % 90 == 0).then(0.0).otherwise(T + 1.66e9)), False),
    }),
    "hall without truth": (lambda: blind(hall()), {
        "anchors swapped": Case("error", "anchors A2 and A4 swapped: the ids of anchors", _exchanged("A2", "A4")),
        "anchors swapped, height unknown": Case("error", "anchors A2 and A4 swapped", together(height(None), only("ranges"), _exchanged("A2", "A4"))),
        "feet": Case("error", "multiplied by 0.3048: ranges are feet", with_columns("ranges", R / 0.3048)),
        "feet of an anchor": Case(
            "error", "the ranges multiplied by 0.3048 of anchor A4", with_columns("ranges", range_m=pl.when(A1 == "A4").then(R / 0.3048).otherwise(R)),
        ),
        "sign of z": Case("warning", "0.074 m without anchor A2", _anchor("A2", (6.0, 0.0, -2.4))),
        "azimuths flipped": Case("error", "the sign of the azimuth flipped", with_columns("bearings", -AZ)),
        "elevations flipped": Case("error", "the sign of the elevation flipped", with_columns("bearings", -EL)),
        "angles swapped": Case("error", "azimuth and elevation swapped", with_columns("bearings", azimuth_rad=EL, elevation_rad=AZ)),
        "azimuths turned": Case("error", "the azimuth turned by 180°", with_columns("bearings", AZ - np.pi * AZ.sign())),
        "azimuths of a station": Case(
            "error", "the sign of the azimuth flipped of station S2", with_columns("bearings", azimuth_rad=pl.when(C("station") == "S2").then(-AZ).otherwise(AZ)),
        ),
        "two anchors elsewhere": Case(
            "warning", "no change of units, signs or ids explains it", together(_anchor("A1", (9.0, 9.0, 2.7)), _anchor("A5", (3.0, 2.0, 2.7))),
        ),
        "an anchor behind a wall": Case("warning", "without anchor A3", with_columns("ranges", range_m=pl.when(A1 == "A3").then(R + 1.0).otherwise(R))),
        "an anchor elsewhere": Case("warning", "without anchor A2", together(only("ranges"), _anchor("A2", (6.0, -1.2, 2.4)))),
        "a turned station": Case("warning", "without station S2", together(only("bearings"), rotated(lambda q: about_z(q, 40.0), ("S2",)))),
    }),
    "phases": (arrays, {
        "the sign": Case("error", "sign of the phases flipped", _phases(lambda phase: -phase)),
        "degrees": Case("error", "degrees", _phases(lambda phase: phase.degrees())),
        "turns": Case("error", "phases in turns", _phases(lambda phase: phase / (2 * np.pi))),
        "two antennas swapped": Case("error", "phases 2 and 5 exchanged", _order([PHASES[{1: 4, 4: 1}.get(k, k)] for k in range(8)])),
        "antennas in reverse order": Case("error", "antennas in reverse order", _order(PHASES[::-1])),
        "antennas counted from another": Case("error", "phase_1_rad as that of antenna 2", _order([*PHASES[1:], PHASES[0]])),
        "a wavelength 1.3 times too long": Case("error", "wavelength_m", _wavelength(1.3)),
        "half the wavelength": Case("error", "another wavelength", _wavelength(0.5)),
        "the wavelength in millimetres": Case("error", "wavelength_m or antennas_m in another unit", _wavelength(1000)),
        "antennas in centimetres": Case("error", "antennas_m in centimetres", _antennas(100)),
        "antennas seen from behind": Case("error", "x of antennas_m flipped", _antennas([-1.0, 1.0])),
        "quaternions as x, y, z, w": Case("error", "x, y, z, w", rotated(lambda q: np.roll(q, -1))),
        "quaternions inverted": Case("error", "inverted", rotated(lambda q: q * [1, -1, -1, -1], ("2", "3"))),
        "one station turned": Case("error", "station 2 (by -40°)", rotated(lambda q: about_z(q, 40.0), ("2",))),
        "truth of another origin": Case("error", "truth shifted by (-1.5", with_columns("truth", X + 1.5)),
    }),
    "imu": (tool, {
        "signs of the gyro": Case("error", "rad/s with the signs of x, y, z of the turn rates flipped", with_columns("imu", *FLIPPED)),
        "x and y swapped": Case("error", "rad/s with x and y of the turn rates swapped", with_columns("imu", *SWAPPED), False),
        "x and y of the gyro swapped": Case("error", "rad/s with x and y of the turn rates swapped", with_columns("imu", *_exchange(GYRO))),
        "x and y of the accelerometer swapped": Case("error", "only with x and y of the turn rates swapped", with_columns("imu", *_exchange(ACCEL))),
        "upside down": Case("warning", "rad/s with the signs of y, z of the turn rates flipped", with_columns("imu", *DOWN)),
        "turn rates in rpm": Case("error", "another unit or scale (times 0.105)", with_columns("imu", C(GYRO) * 9.5493)),
        "half the full scale": Case("error", "another unit or scale (times 2)", with_columns("imu", C(GYRO) * 0.5)),
        "clock 0.5 s late": Case("warning", "come 0.50 s late", with_columns("imu", T + 0.5)),
        "clock 2 s early": Case("error", "come 2.00 s early", with_columns("imu", T - 2.0)),
        "quaternions as x, y, z, w": Case("error", "its quaternions read as x, y, z, w", with_columns(
            "truth", qw=C("qx"), qx=C("qy"), qy=C("qz"), qz=C("qw"))),
        "quaternions as z, w, x, y": Case("error", "quaternions read as z, w, x, y", with_columns("truth", qw=C("qz"), qx=C("qw"), qy=C("qx"), qz=C("qy"))),
        "quaternions inverted": Case("error", "its quaternions inverted", with_columns("truth", -C("qx", "qy", "qz"))),
    }),
    "imu without truth": (lambda: replace(tool(), tables={k: v for k, v in tool().tables.items() if k != "truth"}), {
        "signs of the gyro": Case("error", "with the signs of x, y, z of the turn rates flipped, or two axes of both", with_columns("imu", *FLIPPED)),
        "x and y swapped": Case("error", "with the signs of x, y, z of the turn rates flipped, or two axes of both", with_columns("imu", *SWAPPED)),
        "x and y of the gyro swapped": Case("error", "with x and y of the turn rates swapped (", with_columns("imu", *_exchange(GYRO))),
        "upside down": Case("warning", "the IMU is upside down", with_columns("imu", *DOWN)),
    }),
    "body": (lambda: body().folder(), {
        "offsets in millimetres": Case("error", "offset_m of tag 0-2 is 559 m long: looks like millimetres", together(only("ranges"), _offsets(lambda p: 1000.0 * p))),
        "offsets three times as long": Case("error", "offset_m of tags 0 and 0-2 are 1.68 m apart, their true positions typically 0.56 m", _offsets(lambda p: 3.0 * p)),
        "a tag on the other side": Case("error", "offset_m of tags 0-2 and 0-3 are 1.00 m apart", _offsets(lambda p: -p if p[1] < 0 else p)),
    }),
    "odometry": (lambda: drive().folder(), {
        "millimetres": Case("error", "looks like millimetres", with_columns("odometry", V * 1e3)),
        "degrees": Case("error", "looks like degrees per second", with_columns("odometry", W.degrees())),
        "km/h": Case("error", "tag 0, speed_mps: errors against truth are typically 1.2 m/s, and 0.0075 m/s with another unit or scale (times 0.27", with_columns("odometry", V * 3.6)),
        "speeds flipped": Case("error", "speed_mps: errors against truth are typically 0.94 m/s, and 0.0073 m/s with the sign of the odometry flipped", with_columns("odometry", -V)),
        "yaw rates flipped": Case("error", "with the sign of the odometry flipped", with_columns("odometry", -W)),
        "another scale of yaw rates": Case("error", "another unit or scale (times 0.067)", with_columns("odometry", W.degrees() / 4)),
    }),
    "differences": (differences, {
        "the sign": Case("error", "the sign of the tdoa flipped", with_columns("tdoa", -TD)),
        "ids exchanged": Case("error", "anchors A2 and A7 swapped", _ids("A2", "A7")),
        "places exchanged": Case("error", "anchors A3 and A4 swapped", _exchanged("A3", "A4")),
        "nanoseconds": Case("error", "nanoseconds or feet", with_columns("tdoa", TD / 0.299792458)),
        "centimetres": Case("error", "centimetres or millimetres, or other anchors", with_columns("tdoa", TD * 100)),
        "seconds": Case("error", "looks like seconds", with_columns("tdoa", TD / 299792458)),
        "halved": Case("error", "halved distances", with_columns("tdoa", TD / 2)),
        "a late anchor": Case("error", "of anchor A5 (+1.5", with_columns("tdoa", TD + _late(A5=1.5))),
        "places in millimetres": Case("error", "the positions of the anchors multiplied by 0.001", with_anchors(lambda a: {k: 1000 * v for k, v in a.items()})),
        "z of the places flipped": Case("error", "the sign of z of the truth flipped", with_anchors(lambda a: {k: v * [1, 1, -1] for k, v in a.items()})),
        "x and y of the places": Case("error", "x and y of the truth swapped", with_anchors(lambda a: {k: v[[1, 0, 2]] for k, v in a.items()})),
        "truth of another origin": Case("error", "the truth shifted by (2.00", with_columns("truth", X - 2)),
    }),
    "differences without truth": (lambda: only("tdoa")(differences()), {
        "the sign": Case("error", "the sign of the tdoa flipped", with_columns("tdoa", -TD)),
        "ids exchanged": Case("error", "anchors A2 and A7 swapped", _ids("A2", "A7")),
        "places exchanged": Case("error", "anchors A3 and A4 swapped", _exchanged("A3", "A4")),
        "nanoseconds": Case("error", "nanoseconds or feet", with_columns("tdoa", TD / 0.299792458)),
        "an anchor elsewhere": Case("warning", "without anchor A6: what rig.toml says of it is wrong", with_anchors(lambda a: {"A6": a["A6"] + [1.5, 0.0, 0.0]})),
        "rounded": Case("warning", "equal the previous row of the same tag and pair of anchors", with_columns("tdoa", TD.round(0)), False),
        "no value": Case("error", "tdoa: all values are missing", with_columns("tdoa", pl.lit(None, pl.Float64).alias("range_difference_m")), False),
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
