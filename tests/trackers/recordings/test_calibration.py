"""Calibrations: forward model, inverse, behaviour beyond the span, and their removal from bearings and ranges."""

from dataclasses import replace

import numpy as np
import pytest

from tests.faulty import write_good
from trackwright.trackers.aoa.fusion import BEARINGS
from trackwright.trackers.aoa.rows import bearing_trajectories
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.recordings.calibration import (
    TAG_SIGMA,
    AnchorCalibration,
    Calibration,
    StationCalibration,
    TagCalibration,
)
from trackwright.trackers.recordings.folder import read_recording

SPANS = np.array([[-0.9, 1.0], [-0.6, 0.5]])
TERMS = np.array([[0.08, 0.7, -0.06, 0.1], [-0.05, 1.1, 0.2, -0.08]])
COVARIANCES = np.stack([np.diag([4e-4, 1e-4, 1e-4, 1e-4]), np.diag([9e-4, 1e-4, 1e-4, 4e-4])])
STATION = StationCalibration(TERMS, COVARIANCES, SPANS)
ANCHOR = AnchorCalibration(np.array([0.15, 0.02]), np.array([[1e-4, -1e-5], [-1e-5, 4e-6]]), np.array([0.5, 8.0]))


@pytest.fixture
def good(tmp_path):
    write_good(tmp_path / "good")
    return read_recording(tmp_path / "good")


def _polynomial(a, b, terms):
    offset, gain, cubic, cross = terms
    return offset + gain * a + cubic * a**3 + cross * a * b


def test_within_the_span_the_measured_angles_are_the_polynomials():
    rng = np.random.default_rng(0)
    true = rng.uniform(*SPANS.T, (200, 2))
    a, e = true.T
    expected = np.stack([_polynomial(a, e, TERMS[0]), _polynomial(e, a, TERMS[1])], axis=1)
    np.testing.assert_allclose(STATION.measured(true), expected, atol=1e-14)


def test_the_true_angles_are_found_from_the_measured_ones_within_and_beyond_the_span():
    true = np.stack(np.meshgrid(np.linspace(-2.0, 2.0, 41), np.linspace(-1.2, 1.2, 25)), axis=-1)
    np.testing.assert_allclose(STATION.true(STATION.measured(true)), true, atol=1e-9)


def test_the_added_variance_is_that_of_terms_drawn_from_the_covariance():
    rng, true = np.random.default_rng(1), np.array([[0.4, -0.3], [1.4, 0.2]])
    calibration = Calibration({"S": STATION})
    _, found, variances = calibration.of_bearings(["S"], np.zeros(2, int), STATION.measured(true))
    np.testing.assert_allclose(found, true, atol=1e-9)
    drawn = np.stack([rng.multivariate_normal(t, c, 20000) for t, c in zip(TERMS, COVARIANCES, strict=True)], axis=1)
    many = np.stack([StationCalibration(t, COVARIANCES, SPANS).measured(true) for t in drawn])
    # The relative standard error of a variance of 20000 draws is 1 %.
    np.testing.assert_allclose(variances, many.var(axis=0), rtol=0.05)


def test_bearings_of_a_calibrated_station_have_its_terms_and_more_variance_and_others_are_as_measured(good):
    plain = bearing_trajectories(good, False)[0].recording
    found = bearing_trajectories(good.calibrated(Calibration({"S1": STATION})), False)[0].recording
    assert "calibration" not in plain.inputs
    first = (good.tables["bearings"].filter(tag="T1")["station"] == "S1").to_numpy()
    values, reported = found.readings[BEARINGS].values, found.readings[BEARINGS].reported
    np.testing.assert_array_equal(values, plain.readings[BEARINGS].values)
    expected = np.concatenate([TERMS.ravel(), SPANS.ravel()])
    np.testing.assert_array_equal(found.inputs["calibration"][first], np.tile(expected, (first.sum(), 1)))
    assert (reported[first][:, [0, 2]] > 0.0).all()
    assert not reported[~first].any()
    assert (found.inputs["calibration"][~first][:, :8] == [0, 1, 0, 0, 0, 1, 0, 0]).all()


def test_ranges_are_without_bias_and_slope_and_have_the_variance_of_both(good):
    number, distances = np.array([0, 1, 0]), np.array([2.0, 3.0, 7.0])
    measured = np.where(number == 0, distances * 1.02 + 0.15, distances)
    tags = np.zeros(3, int)
    found, variances = Calibration(anchors={"A": ANCHOR}).of_ranges(["A", "B"], number, ["1"], tags, measured)
    np.testing.assert_allclose(found, distances, rtol=1e-12)
    expected = [(1e-4 - 2e-5 * d + 4e-6 * d * d) / 1.02**2 for d in (2.0, 7.0)]
    np.testing.assert_allclose(variances, [expected[0], 0.0, expected[1]], rtol=1e-12)


def test_a_tag_adds_its_bias_and_an_unknown_one_its_uncertainty_at_calibrated_anchors_alone():
    tags = {"1": TagCalibration(0.04, 0.01), "2": TagCalibration(-0.04, 0.02)}
    calibration = Calibration(anchors={"A": replace(ANCHOR, covariance=np.zeros((2, 2)))}, tags=tags)
    number, tag = np.array([0, 0, 0, 1]), np.array([0, 1, 2, 0])
    found, variances = calibration.of_ranges(["A", "B"], number, ["1", "2", "3"], tag, np.full(4, 5.0))
    np.testing.assert_allclose(found, [(5 - 0.19) / 1.02, (5 - 0.11) / 1.02, (5 - 0.15) / 1.02, 5.0])
    np.testing.assert_allclose(np.sqrt(variances), [0.01 / 1.02, 0.02 / 1.02, TAG_SIGMA / 1.02, 0.0])


def test_stations_and_anchors_that_moved_are_uncalibrated(good):
    station, anchor = good.rig.stations["S1"], good.rig.anchors["A1"]
    turned = Station(station.position, np.asarray(station.rotation) + [0.05, -0.05, 0.05, -0.05])
    for mounted, place, left in (
        (station, anchor, ["anchor A2", "anchor A3", "anchor A4", "station S2"]),
        (replace(station, position=station.position + 0.5), anchor + 0.01, ["anchor A2", "station S1"]),
        (turned, anchor + 0.2, ["anchor A1", "station S1"]),
    ):
        calibration = Calibration({"S1": replace(STATION, mounted=mounted)}, {"A1": replace(ANCHOR, position=place)})
        assert set(left) <= set(good.calibrated(calibration).uncalibrated())
    elsewhere = good.calibrated(Calibration({}, {"A1": replace(ANCHOR, position=anchor + 0.2), "B": ANCHOR}))
    assert elsewhere.notices[-1].startswith("not calibrated: the calibration has none of its stations and anchors, or ")
