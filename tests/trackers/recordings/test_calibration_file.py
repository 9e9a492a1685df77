"""calibration.toml: written and read back, and refused in one line where its content is not that of `calibrate`."""

import re

import numpy as np
import pytest

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.recordings.calibration import (
    AnchorCalibration,
    Calibration,
    StationCalibration,
    TagCalibration,
    read_calibration,
    write_calibration,
)

_RNG = np.random.default_rng(0)


def _covariance(size):
    factor = _RNG.normal(size=(size, size))
    return factor @ factor.T


CALIBRATION = Calibration(
    {
        "S 1": StationCalibration(
            _RNG.normal(size=(2, 4)),
            np.stack([_covariance(4)] * 2),
            np.array([[-1.0, 0.9], [-0.4, 0.3]]),
            812,
            Station(np.array([0.0, 3.0, 2.3]), np.array([0.5, 0.5, 0.5, 0.5])),
        ),
        "S 2": StationCalibration(_RNG.normal(size=(2, 4)), np.zeros((2, 4, 4)), np.array([[-1.0, 0.9], [-0.4, 0.3]])),
    },
    {
        "A": AnchorCalibration(
            np.array([0.1, 0.01]), _covariance(2), np.array([0.4, 7.0]), 93, np.array([1.0, 2.0, 2.5])
        )
    },
    {"1": TagCalibration(0.03, 0.01, 40)},
    ("walk 1", "walk 2"),
    0.0583,
    {"S 1": np.array([[1.5, 2.5, 0.01, -0.2], [3.25, 2.0, 0.05, 0.1]])},
)


@pytest.fixture
def path(tmp_path):
    return write_calibration(CALIBRATION, tmp_path / "calibration.toml")


def test_a_calibration_is_read_back_to_the_bit(path, tmp_path):
    found = read_calibration(path)
    assert write_calibration(found, tmp_path / "again.toml").read_text("utf-8") == path.read_text("utf-8")
    assert (found.recordings, found.tags, found.range_spread) == (("walk 1", "walk 2"), CALIBRATION.tags, 0.0583)
    np.testing.assert_array_equal(found.stations["S 1"].coefficients, CALIBRATION.stations["S 1"].coefficients)
    np.testing.assert_array_equal(found.stations["S 1"].mounted.rotation, [0.5, 0.5, 0.5, 0.5])
    assert found.stations["S 2"].mounted is None
    np.testing.assert_array_equal(found.bearing_map["S 1"], CALIBRATION.bearing_map["S 1"])


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("format = 1", "format = 2", "format = 2, expected the calibration.toml of `trackwright calibrate`, format = 1"),
        ("format = 1\n", "", "no format, expected"),
        ("rows = 812\n", "rows = -812\n", "stations.S 1.rows = -812, expected greater than or equal to 0"),
        ("range_spread = 0.0583", "range_spread = 0", "range_spread = 0, expected greater than 0"),
        ("    0.01,\n]\ncovariance", "    nan,\n]\ncovariance", "anchors.A.coefficients = [0.1, nan], expected finite numbers"),
        ("position = [\n    1.0", "position = [\n    nan", "anchors.A.position = [nan, 2.0, 2.5], expected finite numbers"),
        ("position = [\n    1.0,", "position = [", "anchors.A.position = [2.0, 2.5], expected numbers of shape 3"),
        ("sigma = 0.01", "sigma = -0.01", "tags.1.sigma = -0.01, expected greater than or equal to 0"),
        ("        3.25,", "        nan,", "[nan, 2.0, 0.05, 0.1]], expected finite numbers"),
        ("[stations", "[range_quality]\nslope = 1.0\n\n[stations", "range_quality is no key of it"),
    ],
)  # fmt: skip
def test_other_content_is_refused_in_one_line(path, before, after, words):
    text = path.read_text("utf-8")
    assert before in text, text
    path.write_text(text.replace(before, after, 1), "utf-8")
    with pytest.raises(UnusableInput, match=re.escape(words)) as refusal:
        read_calibration(path)
    assert str(refusal.value).startswith(str(path))
    assert str(refusal.value).endswith("write it with `trackwright calibrate`")
