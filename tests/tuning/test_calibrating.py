"""Calibrations of simulated worlds with known systematic errors, and of recordings that lack something; their pieces."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from scipy.optimize import minimize

from tests.tuning.calibration_worlds import RIG, lasting, ranged, recording, standardised, truth_of, walk, world
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.recordings.calibration import ANGLE_PRIOR, RANGE_PRIOR
from trackwright.trackers.recordings.columns import PIECE_M, PIECE_S
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.calibrating import LEAST_SLOPE, calibrate, calibration_pairs
from trackwright.tuning.clustered_regression import Regression, Rows, regressions, with_least_slope


@pytest.fixture(scope="module")
def found():
    known, folders = world(5)
    return known, calibrate(folders)


def test_known_terms_are_recovered_within_three_standard_errors(found):
    known, calibration = found
    angles, ranges = standardised(calibration, known)
    assert np.abs(angles).max() < 3.0
    assert np.abs(ranges).max() < 3.0
    # The gains of azimuth are known to a tenth, five times better than before the walks.
    assert all(np.sqrt(one.covariances[0, 1, 1]) < 0.1 for one in calibration.stations.values())
    assert calibration.recordings == ("walk 1", "walk 2", "walk 3")


def _coverage(worlds, **options):
    pairs = [world(100 + seed, **options) for seed in range(worlds)]
    errors = [standardised(calibrate(folders), known) for known, folders in pairs]
    angles, ranges = (np.stack(x) for x in zip(*errors, strict=True))
    return (np.abs(angles) < 1.96).mean(), (np.abs(ranges) < 1.96).mean()


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"recordings": 1, "seconds": 40.0}, {"outliers": 1.5}, {"by_place": True}])
def test_intervals_hold_90_to_97_percent_of_the_terms_of_200_worlds(options):
    angles, ranges = _coverage(200, **options)
    assert 0.90 <= angles <= 0.97
    if not options:
        assert 0.90 <= ranges <= 0.97


def test_each_recording_has_the_same_weight():
    rng = np.random.default_rng(3)
    first, second = world(1, 1)[0], world(2, 1)[0]
    short, long = recording(rng, "short", first, 60.0), recording(rng, "long", second, 400.0)
    both = calibrate([short, long]).stations
    for name, station in both.items():
        middle = 0.5 * (first.stations[name].coefficients + second.stations[name].coefficients)[0, 0]
        # Half of the standard error of a walk of one minute, 0.03 rad, and the share of the other terms.
        assert station.coefficients[0, 0] == pytest.approx(middle, abs=0.08)


def test_the_spread_of_ranges_is_the_scale_of_their_errors_however_large_the_biases():
    rng = np.random.default_rng(11)
    times, positions = walk(rng, 200.0)
    folder = ranged("walk", times, positions, lambda: 0.2 * rng.normal() + 0.05 * rng.standard_t(4.0, size=len(times)))
    assert calibrate(folder).range_spread == pytest.approx(0.05, rel=0.05)


def _standing(seconds, place):
    """A tag that stands still, with ranges whose errors are those of the place."""
    rng = np.random.default_rng(7)
    times = np.arange(0.0, seconds, 0.1)
    positions = np.tile([*place, 1.0], (len(times), 1))
    return ranged("still", times, positions, lambda: 0.1 + 0.05 * rng.normal() + 0.01 * rng.normal(size=len(times)))


def test_the_bias_of_a_tag_is_told_apart_from_those_of_the_anchors():
    _, folders = world(5, 2)
    parts = []
    for number, folder in enumerate(folders):
        table = folder.tables["ranges"]
        # Both walk everywhere; the second tag is 6 cm further than the first.
        other = table.with_columns(tag=pl.lit("2"), range_m=pl.col("range_m") + 0.06)
        truth = folder.tables["truth"]
        tables = {
            "ranges": pl.concat([table, other]).sort("t_s", maintain_order=True),
            "truth": pl.concat([truth, truth.with_columns(tag=pl.lit("2"))]),
        }
        parts.append(replace(folder, tables=tables, name=str(number)))
    both, alone = calibrate(parts), calibrate(folders)
    biases = {name: tag.bias for name, tag in both.tags.items()}
    # Equal errors of both tags leave the difference nearly exact; its prior shrinks it a little.
    assert biases == pytest.approx({"1": -0.03, "2": 0.03}, abs=0.004)
    for name, one in both.anchors.items():
        # The biases of anchors are those of the mean tag.
        expected = alone.anchors[name].coefficients[0] + 0.03
        assert one.coefficients[0] == pytest.approx(expected, abs=0.015)


def test_the_rows_of_a_tag_that_stands_still_count_as_one_sample_of_the_error():
    # The mean of 2000 rows has a standard error of 0.2 mm, but 5 cm of its error are those of the place.
    for one in calibrate(_standing(200.0, (3.0, 2.0))).anchors.values():
        assert np.sqrt(one.covariance[0, 0]) > 0.1


def test_terms_that_the_recordings_do_not_determine_stay_at_their_prior():
    # Of a tag at one place, bias and slope cannot be told apart.
    one = calibrate(_standing(100.0, (3.0, 2.0))).anchors["A"]
    assert one.coefficients[1] == pytest.approx(RANGE_PRIOR[0][1], abs=0.5 * RANGE_PRIOR[1][1])
    assert np.sqrt(one.covariance[1, 1]) == pytest.approx(RANGE_PRIOR[1][1], rel=0.1)


def test_an_angle_that_was_never_measured_stays_at_its_prior():
    _, (folder,) = world(5, 1)
    table = folder.tables["bearings"].with_columns(elevation_rad=pl.lit(None, pl.Float64))
    for one in calibrate(replace(folder, tables=folder.tables | {"bearings": table})).stations.values():
        np.testing.assert_array_equal(one.coefficients[1], ANGLE_PRIOR[0])
        np.testing.assert_allclose(one.covariances[1], np.diag(ANGLE_PRIOR[1] ** 2))


def test_a_calibrated_angle_increases_although_the_readings_turn_back():
    # Readings that fall again beyond 0.6 rad.
    times, positions = walk(np.random.default_rng(1), 200.0)
    station = RIG.stations["north"]
    true = station.angles(positions)
    azimuth = np.sin(2.6 * true[:, 0])
    columns = {"azimuth_rad": azimuth, "elevation_rad": true[:, 1]}
    bearings = pl.DataFrame({"t_s": times, "tag": "1", "station": "north", **columns})
    tables = {"bearings": bearings, "truth": truth_of(times, positions)}
    one = calibrate(RecordingFolder("turning", None, RIG, tables)).stations["north"]
    mesh = np.stack(np.meshgrid(np.linspace(-3.0, 3.0, 301), np.linspace(-1.5, 1.5, 13), indexing="ij"), axis=-1)
    slopes = np.diff(one.measured(mesh)[..., 0], axis=0) / (6.0 / 300)
    assert slopes.min() > 0.99 * LEAST_SLOPE


def test_azimuths_beyond_half_a_turn_are_compared_the_short_way_round():
    behind = Station(np.array([4.5, 3.0, 2.0]), RIG.stations["west"].rotation)
    rng = np.random.default_rng(2)
    times, positions = walk(rng, 100.0)
    angles = behind.angles(positions)
    azimuth = (angles[:, 0] + 0.2 + lasting(rng, times, positions, 0.02) + np.pi) % (2 * np.pi) - np.pi
    assert (np.abs(azimuth - angles[:, 0]) > np.pi).any()
    columns = {"azimuth_rad": azimuth, "elevation_rad": angles[:, 1]}
    bearings = pl.DataFrame({"t_s": times, "tag": "1", "station": "S", **columns})
    tables = {"bearings": bearings, "truth": truth_of(times, positions)}
    rig = replace(RIG, stations={"S": behind})
    one = calibrate(RecordingFolder("round", None, rig, tables)).stations["S"]
    assert one.coefficients[0, 0] == pytest.approx(0.2, abs=0.05)
    assert one.coefficients[0, 1] == pytest.approx(1.0, abs=0.1)


def test_a_truth_over_the_floor_is_completed_by_the_height_of_the_tag():
    _, folders = world(5, 1, seconds=30.0)
    truth = folders[0].tables["truth"]
    flat = replace(folders[0], tables=folders[0].tables | {"truth": truth.drop("z_m")})
    with pytest.raises(UnusableInput, match=r"or height_m of the tags in rig\.toml"):
        calibrate(flat)
    known = replace(flat, rig=replace(flat.rig, tags={"1": Tag(height=truth["z_m"][0])}))
    expected = calibrate(folders).stations["north"].coefficients
    np.testing.assert_array_equal(calibrate(known).stations["north"].coefficients, expected)


def test_too_few_rows_are_refused_and_stations_with_few_are_left_out():
    folder = world(5, 1, seconds=10.0)[1][0]
    north = pl.col("station") == "north"
    with pytest.raises(UnusableInput, match="fewer than 20 rows with truth in x, y and z for every"):
        calibrate(replace(folder, tables={name: table.head(40) for name, table in folder.tables.items()}))
    few = folder.tables["bearings"].filter(~north | (pl.col("t_s") < 3.0))
    assert set(calibrate(replace(folder, tables=folder.tables | {"bearings": few})).stations) == {"south", "west"}


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_terms_covariance_and_scale_have_the_unit_of_the_errors_outliers_included(unit):
    rng = np.random.default_rng(0)
    rows = 300
    x = np.column_stack([np.ones(rows), rng.uniform(-1, 1, rows)])
    y = x @ [0.3, -0.2] + 0.1 * rng.standard_t(2, rows)
    number = np.arange(rows)
    prior = np.array([0.05, 0.0]), np.array([0.5, 0.4])

    def fitted(scale):
        of_place = Rows(x, y * scale, number // 150, number // 10, number // 25)
        return regressions({"A": of_place}, prior[0] * scale, prior[1] * scale)["A"]

    one, other = fitted(1.0), fitted(unit)
    np.testing.assert_allclose(other.terms, one.terms * unit, rtol=1e-6)
    np.testing.assert_allclose(other.covariance, one.covariance * unit**2, rtol=1e-6)
    assert other.scale == pytest.approx(one.scale * unit, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_terms_of_too_small_a_slope_become_the_nearest_that_have_it(seed):
    rng = np.random.default_rng(seed)
    root, slopes = rng.normal(size=(3, 3)), rng.normal(size=(2, 3))
    found = Regression(rng.normal(size=3), root @ root.T + np.eye(3), 1.0)
    least = float(np.max(slopes @ found.terms)) + 0.3
    nearest = minimize(
        lambda d: d @ np.linalg.solve(found.covariance, d), np.zeros(3), method="SLSQP", options={"ftol": 1e-14},
        constraints={"type": "ineq", "fun": lambda d: slopes @ (found.terms + d) - least},
    )  # fmt: skip
    moved = with_least_slope(found, slopes, least)
    np.testing.assert_allclose(moved.terms, found.terms + nearest.x, atol=1e-5)
    assert with_least_slope(found, slopes, float(np.min(slopes @ found.terms))) is found


@pytest.mark.parametrize("first", ["moving", "still"])
def test_pieces_are_those_of_the_tag_that_moves_most_for_all_tags_of_a_body(first):
    times, speed = 0.5 * np.arange(121), 0.5
    moving = np.stack([speed * times, 0 * times, 0 * times], axis=1)
    places = {"moving": moving, "still": moving[:1] + 0 * moving}
    tags = dict(zip("ab", sorted(places, key=lambda name: name != first), strict=True))
    tables = {"truth": [], "ranges": []}
    for tag, name in tags.items():
        at = {"t_s": times, "tag": [tag] * len(times)}
        tables["truth"].append(pl.DataFrame(at | {f"{a}_m": places[name][:, k] for k, a in enumerate("xyz")}))
        far = np.linalg.norm(places[name] - [5.0, 9.0, 2.0], axis=1)
        tables["ranges"].append(pl.DataFrame(at | {"anchor": ["A"] * len(times), "range_m": far}))
    folder = RecordingFolder(
        "hall", None, Rig("hall", anchors={"A": np.array([5.0, 9.0, 2.0])}),
        {name: pl.concat(parts).sort("t_s", maintain_order=True) for name, parts in tables.items()},
    )  # fmt: skip
    pairs = calibration_pairs([folder], KINDS["ranges"])["A"]
    # 60 s at 0.5 m/s: a piece for every 5 s, in which the tag moves more than 1 m
    assert PIECE_S * speed > PIECE_M
    for tag in tags:
        assert len(np.unique(pairs.piece[pairs.tag == tag])) == pytest.approx(60 / PIECE_S, abs=1)
