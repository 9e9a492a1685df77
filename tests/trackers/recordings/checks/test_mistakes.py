"""Each mistake is named by `check` in its words, and no other error with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from tests.trackers.recordings.checks.made import (
    Make,
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
)
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.folder import RecordingFolder

C, T, X, Y, Z = pl.col, *(pl.col(name) for name in ("t_s", "x_m", "y_m", "z_m"))
XYZ, R, AZ = pl.col("x_m", "y_m", "z_m"), C("range_m"), C("azimuth_rad")
TD, A1 = C("range_difference_m"), C("anchor")
WILD = pl.Series(np.random.default_rng(1).uniform(0, 250, 1800))
ROW = pl.int_range(pl.len())


class Case(NamedTuple):
    """A mistake made on a world, and the level and words of the line that names it, `alone` where no error is beside."""

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


def _exchanged(one: str, other: str) -> Make:
    return with_anchors(lambda anchors: {one: anchors[other], other: anchors[one]})


def _late(**by: float) -> pl.Expr:
    """What signals that are late at some anchors, by lengths, m, add to the differences."""
    first, second = (C(column).cast(pl.String).replace_strict(by, default=0.0) for column in ("anchor", "anchor_2"))
    return first - second


def _ids(one: str, other: str) -> Make:
    """Two anchors' ids exchanged in the table of differences."""
    names = {one: other, other: one}
    return with_columns("tdoa", *(C(x).cast(pl.String).replace(names).alias(x) for x in ("anchor", "anchor_2")))


def _crossed(of: RecordingFolder) -> RecordingFolder:
    """A second tag on the same way backwards, whose truth is taken for that of the first one."""
    ranges, truth, back, other = (
        of.tables["ranges"],
        of.tables["truth"],
        (59.8 - T).alias("t_s"),
        pl.lit("U").alias("tag"),
    )
    both = {
        "ranges": [ranges, ranges.with_columns(back, other)],
        "truth": [truth.with_columns(other), truth.with_columns(back)],
    }
    return replace(of, rig=replace(of.rig, tags={}), tables={name: pl.concat(two) for name, two in both.items()})  # fmt: skip


def _tilted(q: np.ndarray) -> np.ndarray:
    return (Rotation.from_euler("y", -30, True) * Rotation.from_quat(q, scalar_first=True)).as_quat(scalar_first=True)


blind = only("ranges", "bearings")

WORLDS: dict[str, tuple[Callable[[], RecordingFolder], dict[str, Case]]] = {
    "good": (good, {
        "azimuth in degrees": Case("error", "azimuth_rad lie beyond ±3.14: looks like degrees", with_columns("bearings", AZ.degrees())),
        "phases in degrees": Case("error", "typical phases", with_columns("phases", C("^phase_.*$").degrees())),
        "ranges in millimetres": Case("error", "looks like centimetres, millimetres or another frame", with_columns("ranges", R * 1000)),
        "fixes in millimetres": Case("error", "fixes: typical distance from the rig", with_columns("fixes", XYZ * 1000)),
        "fixes without a height": Case(
            "warning", "fixes: neither z_m nor height_m in rig.toml: 1 of the tags ('T2'); track needs one: give height_m under [tags.T2]",
            with_columns("fixes", z_m=pl.lit(None, pl.Float64)),
        ),
        "acceleration in thousandths of g": Case(
            "error", "typical acceleration is 1,000 m/s²: gravity in thousandths of g or cm/s²", with_columns("imu", C("^accel.*$") / 9.81e-3),
        ),
        "turn rates in degrees": Case("error", "degrees per second", with_columns("imu", C("^gyro.*$") * 0 + 150)),
        "no value": Case("error", "ranges: 400 rows, 10 Hz, range_m 100 % empty", with_columns("ranges", range_m=pl.lit(None, pl.Float64)), False),
        "an anchor that is silent": Case("warning", "anchors never observed: 1 of 4 (A3)", with_rows("ranges", A1 != "A3")),
        "truth of another time": Case("error", "covers 0 % of the measurements in time (40 to 44.9 s, and they 0 to 4.9 s", with_columns("truth", T + 40)),
        "truth of a part": Case("warning", "covers 20 %", with_rows("truth", T < 0.95)),
        "truth alone": Case("error", "no measurements, only truth", only("truth"), False),
        "one station": Case("info", "stations observed: 1, expected 2", together(only("bearings"), with_rows("bearings", C("station") == "S1"))),
        "anchors in millimetres": Case(
            "error", "A2, A3, A4: far from all others", with_anchors(lambda anchors: {key: 1000 * np.array(place) for key, place in anchors.items()}), False,
        ),
        "seconds since 1970": Case("info", "from 2023-11-14 22:13:20 UTC to", _times(1, 1.7e9)),
        "milliseconds since 1970": Case("error", "milliseconds since 1970", _times(1e3, 1.7e12)),
        "milliseconds": Case("warning", "looks like milliseconds", _times(1e3, 0)),
        "two clocks": Case(
            "error", ", and ranges 0 to 4.9 s; 4.722e+05 hours apart, as two time zones, or clocks of different zeros; expected one",
            with_columns("bearings", T + 1.7e9),
        ),
        "two time zones": Case("error", "2 hours apart", with_columns("imu", T + 7200.0)),
        "anchors on a line": Case("warning", "collinear", _places([0, 0, 2], [2, 0, 2], [4, 0, 2], [6, 0, 2.1]), False),
        "anchors at one place": Case("warning", "A1 and A2 have the same position", _places([0, 0, .3], [0, 0, .3], [6, 5, .4], [0, 5, 2.9]), False),
        "zenith angles": Case("error", "angles from the vertical", with_columns("bearings", elevation_rad=1.8 - ROW / 1e3)),
        "truth at zero": Case("warning", "truth: jumps of the truth beyond 1 m and 30 m/s: 1", with_columns("truth", X * ~T.is_between(1, 2)), False),
        "fixes from nowhere": Case("warning", "and no change explains them: compare", with_columns("fixes", XYZ * 0 + 9.0 * (ROW % 7))),
        "two tags as one": Case("warning", "several tags as one", with_columns("ranges", t_s=T - T % 0.2), False),
        "a gap": Case("warning", "ranges: gaps longer than 1 s: 8", with_rows("ranges", ~T.is_between(1.0, 3.0))),
    }),
    "hall": (hall, {
        "height of another place": Case("error", "height_m of tag T is 11, but z of its truth is typically 1.10 m: one of the two", height(11.0), False),
        "truth in another frame": Case(
            "error", "again with --align-truth, or --transform -39.9",
            together(only("ranges", "truth"), with_columns("truth", x_m=0.8 * X - 0.6 * Y + 50.0, y_m=0.6 * X + 0.8 * Y)),
        ),
        "z of the truth down": Case("error", "x, y, z of the truth read as x, y, -z", with_columns("truth", z_m=-Z), False),
        "the frame before the height": Case(
            "error", "truth turned by -12",
            together(only("ranges", "truth"), with_columns("truth", x_m=-0.6 * X - 0.8 * Y + 10.0, y_m=0.8 * X - 0.6 * Y, z_m=Z + 1.5)),
        ),
        "azimuths of a compass": Case("error", "with the azimuth its sign flipped and turned by -90°", with_columns("bearings", (-AZ + 1.5 * np.pi) % (2 * np.pi) - np.pi)),
        "azimuths from 0 to 2π": Case("warning", "from 0 to 2π", with_columns("bearings", AZ % (2 * np.pi))),
        "azimuths alone, of another sign": Case("error", "the sign of the azimuth flipped", with_columns("bearings", azimuth_rad=-AZ, elevation_rad=pl.lit(None, pl.Float64))),
        "an anchor wild in most readings": Case(
            "warning", "of anchor A2 are typically", with_columns("ranges", range_m=pl.when((A1 == "A2") & (ROW % 5 > 0)).then(WILD).otherwise(R)),
        ),
        "many wild readings": Case("warning", "outliers of range_m", with_columns("ranges", range_m=pl.when(WILD > 150).then(WILD - 200).otherwise(R))),
        "a stuck anchor": Case("warning", "A5 are typically", with_columns("ranges", range_m=pl.when(A1 == "A5").then(5.0).otherwise(R))),
        "an offset beside a truth": Case("error", "with +1.0", together(only("ranges", "truth"), with_columns("ranges", R + 0.95))),
        "a station that looks up": Case("error", "S1 are typically 26°, and 1.2° with the station turned by (-1, 29, 0)°", rotated(_tilted, ["S1"])),
        "truth of another walk": Case("warning", "and no change explains them", together(only("ranges", "truth"), with_columns("truth", x_m=6 + 4 * (T * 0.83).cos(), y_m=4 + 2.5 * (T * 0.61).sin()))),
        "axes of a truth without heights": Case("error", "read as y, x, z", together(only("ranges", "truth"), with_columns("truth", x_m=Y, y_m=X, z_m=pl.lit(None, pl.Float64)))),
        "truths exchanged": Case("error", "the truth of tags T and U exchanged", _crossed),
        "an offset that turns heights": Case("error", "with +1.3", together(only("ranges", "truth"), with_columns("ranges", R + 1.25))),
        "truth that stands still": Case("warning", "no change explains them", together(only("ranges", "truth"), with_columns("truth", x_m=3.0 + 0 * X, y_m=3.0 + 0 * Y))),
        "truth in milliseconds": Case("error", "in which 1 of 300 rows lie: looks like another unit of time", with_columns("truth", T * 1000)),
        "one time for all rows": Case("error", "lost their digits", with_columns("ranges", t_s=pl.lit(5.0))),
        "a clock that jumps by years": Case("warning", "the clock jumps by 52.", with_columns("ranges", t_s=T + pl.when(T > 30).then(1.66e9).otherwise(0.0)), False),
        "times of 0": Case("warning", "times of 0 in", with_columns("ranges", t_s=pl.when(ROW % 90 == 0).then(0.0).otherwise(T + 1.66e9)), False),
    }),
    "hall without truth": (lambda: blind(hall()), {
        "feet": Case("error", "with the ranges multiplied by 0.3048", with_columns("ranges", R / 0.3048)),
        "places in centimetres": Case("error", "multiplied by 0.01: rig.toml is in", with_anchors(lambda a: {k: 100 * v for k, v in a.items()})),
        "height of the tag": Case("error", "correct height_m", lambda one: replace(one, rig=replace(one.rig, tags={"T": Tag(height=11.0)}))),
        "ids exchanged": Case("error", "with anchors A2 and A5 swapped", _exchanged("A2", "A5")),
        "feet of an anchor": Case(
            "warning", "m without anchor A4", with_columns("ranges", range_m=pl.when(A1 == "A4").then(R / 0.3048).otherwise(R)),
        ),
        "a broken anchor": Case("warning", "without anchor A5", with_columns("ranges", range_m=pl.when((A1 == "A5") & (T > 10)).then(5.0).otherwise(R))),
        "an anchor elsewhere": Case("warning", "without anchor A2", together(only("ranges"), with_anchors(lambda _: {"A2": np.array([6.0, -6.0, 2.4])}))),
        "half a second": Case("info", "from 0 to 0.4 s", lambda one: replace(one, tables={k: t.filter(T < 0.5) for k, t in one.tables.items()})),
        "an offset of all": Case("error", "m subtracted: an offset of the ranges", with_columns("ranges", R + 1.5)),
        "azimuths alone without a height": Case(
            "warning", "neither elevation_rad nor height_m", together(height(None), only("bearings"), with_columns("bearings", elevation_rad=pl.lit(None, pl.Float64))),
        ),
        "azimuths the other way": Case("error", "the sign of the azimuth flipped", together(only("bearings"), with_columns("bearings", -AZ))),
    }),
    "differences": (differences, {
        "the sign": Case("error", "the tdoa multiplied by -1", with_columns("tdoa", -TD)),
        "ids exchanged": Case("error", "anchors A2, A7 swapped for A7, A2", _ids("A2", "A7")),
        "places exchanged": Case("error", "anchors A3, A4 swapped for A4, A3", _exchanged("A3", "A4")),
        "seconds": Case("error", "looks like seconds", with_columns("tdoa", TD / 299792458)),
        "a late anchor": Case("error", "of anchor A5 are typically 1.5 m, and 0.05 m with +1.5", with_columns("tdoa", TD + _late(A5=1.5))),
        "places in millimetres": Case("error", "the positions of the anchors multiplied by 0.001", with_anchors(lambda a: {k: 1000 * v for k, v in a.items()})),
        "x and y of the places": Case("error", "read as y, x, z", with_anchors(lambda a: {k: v[[1, 0, 2]] for k, v in a.items()})),
        "truth of another origin": Case("error", "the truth shifted by (2.00", with_columns("truth", X - 2)),
    }),
    "differences without truth": (lambda: only("tdoa")(differences()), {
        "the order of the anchors": Case("error", "m with the tdoa multiplied by -1", with_columns("tdoa", -TD)),
        "rounded": Case("warning", "equal the previous row of the same tag and sensor", with_columns("tdoa", TD.round(0)), False),
    }),
}  # fmt: skip
SLOW = {"azimuths of a compass", "azimuths alone, of another sign", "places in millimetres", "x and y of the places",
        "the sign", "truth of another origin", "ids exchanged", "places exchanged"}  # fmt: skip
"""Mistakes of a kind that another one shows, and whose fits take seconds."""

MISTAKES = [
    pytest.param(world, name, marks=pytest.mark.slow if name in SLOW else ())
    for world, (_, cases) in WORLDS.items()
    for name in cases
]


@pytest.mark.parametrize(("world", "name"), MISTAKES)
def test_a_mistake_is_named_and_no_other_error(world, name):
    make, cases = WORLDS[world]
    level, words, change, alone = cases[name]
    made = change(make())
    made = replace(made, tables={k: table.sort("t_s", maintain_order=True) for k, table in made.tables.items()})
    results = check(made)
    said = [f"{one.level} {one.where}: {one.message}" for one in results]
    assert any(one.startswith(level) and words in one for one in said), said
    if alone:
        found = [one.message for one in results if one.level == "error"]
        assert len(found) == (level == "error"), found
        assert [one.message for one in quick_check(made) if one.level == "error"] == found


@pytest.mark.parametrize("world", WORLDS)
def test_no_mistake_is_named_where_nobody_made_one(world):
    make, _ = WORLDS[world]
    found = [one.message for one in check(make()) if one.level != "info"]
    known = "weakly determined", "never observed"
    assert [line for line in found if not any(words in line for words in known)] == []
