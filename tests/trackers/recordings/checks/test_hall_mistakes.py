"""Mistakes in a simulated hall that are named, with truth and without, and none where nobody made one."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import polars as pl
import pytest
from scipy.optimize import least_squares

from tests.trackers.recordings.checks.made import Make, only, with_anchors, with_columns
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.exchange.truth_frame import parsed_placement
from trackwright.trackers.recordings.checks import closing
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.checks.closing import moments
from trackwright.trackers.recordings.folder import RecordingFolder

ANCHORS = {
    "A1": (0.0, 0.0, 2.7), "A2": (6.0, 0.0, 2.4), "A3": (12.0, 0.0, 2.7),
    "A4": (12.0, 8.0, 2.7), "A5": (6.0, 8.0, 2.4), "A6": (0.0, 8.0, 2.7),
}  # fmt: skip
AXES = ("x_m", "y_m", "z_m")


def _facing(x: float, y: float) -> Station:
    """A level station 2.5 m high that looks at the middle of the hall."""
    boresight = np.array([6.0 - x, 4.0 - y, 0.0]) / np.hypot(6.0 - x, 4.0 - y)
    up = np.array([0.0, 0.0, 1.0])
    R = np.stack([np.cross(up, boresight), up, boresight], axis=1)
    w = np.sqrt(1 + np.trace(R)) / 2
    q = np.array([w, *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))])
    return Station(np.array([x, y, 2.5]), q)


@cache
def _hall() -> RecordingFolder:
    """A walk of 60 s at 1.1 m with ranges of six anchors and bearings of three stations, at 5 Hz, and its truth."""
    rng, t = np.random.default_rng(4), 0.2 * np.arange(300)
    true = np.stack([6 + 4 * np.sin(0.31 * t), 4 + 2.5 * np.cos(0.47 * t), np.full_like(t, 1.1)], axis=1)
    stations = {"S1": _facing(0.0, 1.0), "S2": _facing(12.0, 2.0), "S3": _facing(5.0, 8.0)}
    ranges, bearings = [], []
    for anchor, place in ANCHORS.items():
        r = np.linalg.norm(true - place, axis=1) + rng.normal(0.05, 0.08, len(t))
        ranges.append(pl.DataFrame({"t_s": t, "tag": "T", "anchor": anchor, "range_m": r}))
    for name, station in stations.items():
        angles = np.asarray(station.angles(true)) + rng.normal(0, 0.03, (len(t), 2))
        head = {"t_s": t, "tag": "T", "station": name}
        bearings.append(pl.DataFrame(head | {"azimuth_rad": angles[:, 0], "elevation_rad": angles[:, 1]}))
    tables = {
        "ranges": pl.concat(ranges).sort("t_s"), "bearings": pl.concat(bearings).sort("t_s"),
        "truth": pl.DataFrame({"t_s": t, "tag": "T"} | dict(zip(AXES, true.T, strict=True))),
    }  # fmt: skip
    anchors = {key: np.array(place) for key, place in ANCHORS.items()}
    return RecordingFolder("hall", None, Rig("hall", anchors, stations, {"T": Tag(height=1.1)}), tables)


def _height(height: float | None) -> Make:
    return lambda folder: replace(folder, rig=replace(folder.rig, tags={"T": Tag(height=height)}))


def _anchor(name: str, place: tuple[float, float, float]) -> Make:
    return with_anchors(lambda _: {name: np.array(place)})


def _lines(folder: RecordingFolder, *levels: str) -> list[str]:
    return [f"{one.where}: {one.message}" for one in check(folder) if one.level in levels]


@pytest.mark.parametrize("height", [1.1, None])
@pytest.mark.parametrize("tables", [("ranges", "bearings", "truth"), ("ranges", "bearings")])
def test_no_mistake_is_named_in_the_hall(tables, height):
    lines = _lines(_height(height)(only(*tables)(_hall())), "error", "warning")
    assert [line for line in lines if "weakly determined" not in line] == []


WITH_TRUTH = {
    "height of another place": (_height(11.0), "rig.toml: height_m of tag T is 11, but z of its truth is typically 1.10 m: one of the two"),
    "height with the wrong sign": (_height(-1.1), "rig.toml: height_m of tag T is -1.1, but z of its truth is typically 1.10 m: height_m has"),
    "truth in another frame": (
        with_columns("truth", x_m=0.8 * pl.col("x_m") - 0.6 * pl.col("y_m") + 50.0, y_m=0.6 * pl.col("x_m") + 0.8 * pl.col("y_m")),
        "import it again with --align-truth, which fits the clock as well, or --transform -40.0",
    ),
    "z of the truth down": (with_columns("truth", z_m=-pl.col("z_m")), "z of the truth points down; flip"),
}  # fmt: skip


@pytest.mark.parametrize("name", WITH_TRUTH)
def test_a_mistake_is_named_with_truth(name):
    make, words = WITH_TRUTH[name]
    errors = [f"{one.where}: {one.message}" for one in quick_check(make(_hall()))]
    assert any(words in line for line in errors), errors


def test_the_truth_with_z_down_is_named_where_the_height_is_not_known():
    folder = _height(None)(with_columns("truth", z_m=-pl.col("z_m"))(only("ranges", "truth")(_hall())))
    (error,) = quick_check(folder)
    assert "with the sign of z of the truth flipped: z of the truth points down" in error.message


def test_a_height_above_all_ranges_is_named_without_truth():
    (error,) = quick_check(_height(17.0)(only("ranges")(_hall())))
    assert "height_m of tag T is 17, but 100 % of its ranges are shorter" in error.message


def test_a_wrong_place_of_an_anchor_is_corrected_to_the_side_on_which_rig_toml_has_it():
    (error,) = quick_check(_anchor("A4", (12.0, 3.0, 2.7))(_hall()))
    place = [float(x) for x in error.message.partition("at (")[2].partition(")")[0].split(",")]
    np.testing.assert_allclose(place, ANCHORS["A4"], atol=0.4)


def test_stations_all_turned_by_ten_degrees_are_a_warning():
    turned = with_columns("bearings", azimuth_rad=pl.col("azimuth_rad") + np.radians(10.0))(_hall())
    (warning,) = _lines(turned, "warning")
    assert warning.startswith("bearings: azimuths of all stations are off by about +10.")


def test_a_truth_somewhat_late_is_a_warning_with_the_option_that_shifts_it():
    for table, late in (("ranges", 0.35), ("ranges", -0.25), ("bearings", 0.35)):
        (warning,) = quick_check(with_columns("truth", t_s=pl.col("t_s") + late)(only(table, "truth")(_hall())))
        assert (warning.level, warning.where) == ("warning", table)
        assert "again with --align-truth, or --transform 0.000,0.000,0.000,0.000," in warning.message
        assert float(warning.message.rpartition(",")[2]) == pytest.approx(-late, abs=0.03)


@pytest.mark.parametrize("turn", [(0.8, 0.6), (1.0, 0.0)])
def test_a_truth_in_another_frame_and_late_is_named_with_the_numbers_that_bring_it_over(turn):
    x, y, (c, s) = pl.col("x_m"), pl.col("y_m"), turn
    moved = with_columns("truth", x_m=c * x - s * y + 50.0, y_m=s * x + c * y, t_s=pl.col("t_s") + 0.35)
    folder = moved(only("ranges", "truth")(_hall()))
    (error,) = quick_check(folder)
    placement = parsed_placement(error.message.rpartition(" ")[2])
    assert placement.later == pytest.approx(-0.35, abs=0.02)
    truth = placement.of_table(folder.tables["truth"])
    assert quick_check(replace(folder, tables={**folder.tables, "truth": truth})) == []


def test_fixes_late_by_the_delay_of_their_filter_are_no_mistake_and_early_ones_are():
    truth = _hall().tables["truth"]
    for late, levels in ((0.4, []), (-0.4, ["warning"])):
        fixes = truth.with_columns(t_s=pl.col("t_s") + late)
        assert [one.level for one in quick_check(replace(_hall(), tables={"fixes": fixes, "truth": truth}))] == levels


def test_angles_that_are_swapped_are_one_mistake_and_no_turned_stations():
    folder = only("bearings", "truth")(_hall())
    swapped = with_columns("bearings", azimuth_rad=pl.col("elevation_rad"), elevation_rad=pl.col("azimuth_rad"))(folder)
    (line,) = _lines(swapped, "error", "warning")
    assert line.endswith("azimuth and elevation are swapped; rename both")


_swapped = with_anchors(lambda anchors: {"A2": anchors["A4"], "A4": anchors["A2"]})
A, E = pl.col("azimuth_rad"), pl.col("elevation_rad")
ALONE = {
    "anchors swapped": ("ranges", ("anchors A2 and A4 swapped", "ids of anchors"), _swapped),
    "feet": ("ranges", ("0.3048", "feet"), with_columns("ranges", range_m=pl.col("range_m") / 0.3048)),
    "feet of an anchor": (
        "ranges", ("the ranges multiplied by 0.3048 of anchor A4",),
        with_columns("ranges", range_m=pl.when(pl.col("anchor") == "A4").then(pl.col("range_m") / 0.3048).otherwise(pl.col("range_m"))),
    ),
    "sign of z": ("ranges", ("the sign of z of anchor A2 flipped",), with_anchors(lambda _: {"A2": np.array([6.0, 0.0, -2.4])})),
    "azimuths flipped": ("bearings", ("the sign of the azimuth flipped",), with_columns("bearings", azimuth_rad=-A)),
    "elevations flipped": ("bearings", ("the sign of the elevation flipped",), with_columns("bearings", elevation_rad=-E)),
    "angles swapped": (
        "bearings", ("azimuth and elevation swapped",), with_columns("bearings", azimuth_rad=E, elevation_rad=A)
    ),
    "azimuths turned": ("bearings", ("the azimuth turned by 180°",), with_columns("bearings", azimuth_rad=A - np.pi * A.sign())),
    "azimuths of a station": (
        "bearings", ("the sign of the azimuth flipped of station S2",),
        with_columns("bearings", azimuth_rad=pl.when(pl.col("station") == "S2").then(-A).otherwise(A)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ALONE)
def test_a_mistake_is_named_without_truth_by_readings_that_contradict_each_other(name):
    table, words, make = ALONE[name]
    (error,) = quick_check(make(only("ranges", "bearings")(_hall())))
    assert (error.level, error.where) == ("error", table)
    assert all(word in error.message for word in words), error.message
    assert "e+" not in error.message


def test_changes_that_explain_contradictions_alike_have_the_causes_of_all(monkeypatch):
    changes = closing._changes
    monkeypatch.setattr(
        closing,
        "_changes",
        lambda found: [(words, cause, one) for words, _, one in changes(found) for cause in ("one cause", "another")],
    )
    (error,) = quick_check(_swapped(only("ranges")(_hall())))
    assert error.message.endswith(": another; or one cause")


def test_swapped_anchors_are_named_without_truth_and_without_the_height():
    (error,) = quick_check(_swapped(_height(None)(only("ranges")(_hall()))))
    assert "anchors A2 and A4 swapped" in error.message


def test_contradictions_that_no_change_explains_are_a_warning():
    two = _anchor("A1", (9.0, 9.0, 2.7))(_anchor("A5", (3.0, 2.0, 2.7))(only("ranges")(_hall())))
    (found,) = quick_check(two)
    assert found.level == "warning"
    assert "no change of units, signs or ids explains it" in found.message


@pytest.mark.parametrize(("name", "height"), [("A1", 1.1), ("A2", None), ("A4", None), ("A5", 1.1)])
def test_an_anchor_that_stands_elsewhere_is_named_without_truth(name, height):
    # Across the line of sight a shift hardly changes a range.
    away = np.array(ANCHORS[name]) - np.array([6.0, 4.0, 2.7])
    moved = np.array(ANCHORS[name]) + 1.2 * away / np.linalg.norm(away)
    (found,) = quick_check(_anchor(name, tuple(moved))(_height(height)(only("ranges")(_hall()))))
    assert found.level == "warning"
    assert ": its place in rig.toml is wrong" in found.message
    where = re.search(rf"anchor {name} 1\.\d m elsewhere, at \((\S+), (\S+), ", found.message)
    if where:
        np.testing.assert_allclose([float(where[1]), float(where[2])], ANCHORS[name][:2], atol=0.2)
    else:
        # The walk does not see where it is.
        assert f"without anchor {name}:" in found.message


def test_the_place_that_fits_best_is_that_of_least_squares_over_all_positions():
    # Weights of moments are nearly alike where only noise is left.
    folder = _anchor("A2", (6.9, -0.8, 2.4))(only("ranges")(_hall()))
    found = moments(folder, "ranges")
    place = closing.moved(found, 1)
    at = found.fitted()[0]

    def errors(x):
        places = found.places.copy()
        places[1] = x[-3:]
        flat = np.column_stack([x[:-3].reshape(-1, 2), np.full(len(at), 1.1)])
        return (np.linalg.norm(flat[:, None] - places, axis=2) - found.values[..., 0]).ravel()

    best = least_squares(errors, np.append(at[:, :2].ravel(), found.places[1])).x[-3:]
    np.testing.assert_allclose(place[:2], best[:2], atol=0.1)


def test_an_anchor_behind_a_wall_is_a_warning_and_no_error():
    far = pl.when(pl.col("anchor") == "A3").then(pl.col("range_m") + 1.0).otherwise(pl.col("range_m"))
    (found,) = quick_check(with_columns("ranges", range_m=far)(only("ranges")(_hall())))
    assert found.level == "warning"
    assert "anchor A3 1." in found.message
    assert "or its readings are" in found.message


def test_a_turned_station_is_a_warning_that_says_by_how_much():
    folder = only("bearings")(_hall())
    stations, c, s = folder.rig.stations, np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
    w, x, y, z = stations["S2"].rotation
    about = np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
    rig = replace(folder.rig, stations={**stations, "S2": replace(stations["S2"], rotation=about)})
    (found,) = quick_check(replace(folder, rig=rig))
    assert found.level == "warning"
    assert "with station S2 turned by -40° about the vertical" in found.message


def test_anchors_at_one_place_explain_nothing():
    assert moments(with_anchors(lambda anchors: dict.fromkeys(anchors, np.ones(3)))(_hall()), "ranges") is None


def test_ranges_close_to_zero_where_they_are_exact_and_bearings_likewise():
    folder = _hall()
    truth = folder.tables["truth"].select(*AXES).to_numpy()
    t = folder.tables["truth"]["t_s"].to_numpy()
    for table, noun, names in (("ranges", "anchor", ANCHORS), ("bearings", "station", folder.rig.stations)):
        rows = []
        for name in names:
            head = {"t_s": t, "tag": "T", noun: name}
            if table == "ranges":
                rows.append(pl.DataFrame(head | {"range_m": np.linalg.norm(truth - ANCHORS[name], axis=1)}))
            else:
                azimuth, elevation = np.asarray(folder.rig.stations[name].angles(truth)).T
                rows.append(pl.DataFrame(head | {"azimuth_rad": azimuth, "elevation_rad": elevation}))
        exact = replace(_height(None)(folder), tables={table: pl.concat(rows).sort("t_s")})
        assert moments(exact, table).closing() < 2e-3
