"""Recordings from arrays: what is masked, which heights they carry, and reported noise as variances."""

import numpy as np
import pytest

import trackwright as tw
from trackers.parts.fixes import FIXES
from trackers.parts.ranges import RANGES

TIMES = np.array([0.0, 0.5, 2.0])
PATH = np.array([[1.0, 2.0, 3.0], [np.nan, 2.5, 3.5], [1.5, np.nan, np.nan]])


@pytest.mark.parametrize(
    ("positions", "height", "expected"),
    [
        (PATH, None, None),
        (PATH, 1.2, 1.2),
        # Without any z the tag is taken to be on the floor; y alone may be missing in three dimensions.
        (PATH[:, :2], None, 0.0),
        (np.where([True, True, False], PATH, np.nan), None, 0.0),
        (np.where([True, False, True], PATH, np.nan), None, None),
        (PATH[:, :2], 1.2, 1.2),
    ],
)
def test_fixes_carry_the_height_of_the_tag_or_zero_without_any_z(positions, height, expected):
    recording = tw.fix_recording(TIMES, positions, height=height)
    if expected is None:
        assert "height" not in recording.inputs
    else:
        np.testing.assert_array_equal(recording.inputs["height"], expected)
    fixes, n = recording.readings[FIXES], positions.shape[1]
    there = np.pad(np.isfinite(positions), ((0, 0), (0, 3 - n))) & [True, True, height is None]
    np.testing.assert_array_equal(fixes.seen, there)
    np.testing.assert_array_equal(fixes.values[:, :n], np.nan_to_num(positions))


def test_reported_standard_deviations_of_fixes_become_variances():
    std = np.array([[0.1, 0.2, 0.3], [np.nan, 0.2, 0.3], [0.4, 0.2, 0.3]])
    reported = tw.fix_recording(TIMES, PATH, std=std).readings[FIXES].reported
    np.testing.assert_allclose(reported, [[0.01, 0.04, 0.09], [0.0, 0.04, 0.09], [0.16, 0.04, 0.09]])
    np.testing.assert_array_equal(tw.fix_recording(TIMES, PATH).readings[FIXES].reported, 0.0)


def test_a_table_of_ranges_becomes_a_row_for_each_that_is_there():
    anchors = np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [0.0, 4.0, 2.0]])
    ranges = np.array([[3.0, 4.0, np.nan], [np.nan, 4.5, -1.0], [3.5, np.nan, 5.0]])
    std, truth = np.arange(9.0).reshape(3, 3) / 10, PATH[[0, 0, 0]] + TIMES[:, None]
    recording = tw.range_recording(TIMES, ranges, anchors, std=std, height=1.0, truth=truth)
    np.testing.assert_array_equal(recording.times, [0.0, 0.0, 0.5, 0.5, 2.0, 2.0])
    measured = recording.readings[RANGES]
    np.testing.assert_array_equal(measured.values[:, 0], [3.0, 4.0, 4.5, -1.0, 3.5, 5.0])
    # A range below zero is none.
    np.testing.assert_array_equal(measured.seen[:, 0], [True, True, True, False, True, True])
    np.testing.assert_allclose(measured.reported[:, 0], np.array([0.0, 0.1, 0.4, 0.5, 0.6, 0.8]) ** 2)
    np.testing.assert_array_equal(recording.inputs["anchor"][:, 0], [0, 1, 1, 2, 0, 2])
    np.testing.assert_array_equal(recording.inputs["anchors"], anchors[[0, 1, 1, 2, 0, 2]])
    np.testing.assert_array_equal(recording.inputs["height"], 1.0)
    np.testing.assert_array_equal(recording.truth["position"][0], truth[[0, 0, 1, 1, 2, 2]])
