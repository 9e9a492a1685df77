"""Attitudes of stations in rig.toml: by quaternion or by yaw, pitch and roll."""

from __future__ import annotations

import numpy as np
import pytest

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.rig_file import read_rig


def _station(tmp_path, lines):
    path = tmp_path / "rig.toml"
    path.write_text(f"format = 1\n[stations.S]\nposition_m = [0.0, 0.0, 2.0]\n{lines}\n")
    rig, notices = read_rig(path)
    assert notices == ()
    return rig


@pytest.mark.parametrize(
    ("lines", "looks", "up"),
    [
        ("yaw_deg = 0", (1, 0, 0), (0, 0, 1)),
        ("yaw_deg = 90", (0, 1, 0), (0, 0, 1)),
        ("yaw_deg = 0\npitch_deg = 90", (0, 0, -1), (1, 0, 0)),
        ("yaw_deg = 0\nroll_deg = 90", (1, 0, 0), (0, -1, 0)),
        ("yaw_deg = 90\npitch_deg = 90", (0, 0, -1), (0, 1, 0)),
        ("yaw_deg = 90\nroll_deg = 90", (0, 1, 0), (1, 0, 0)),
        ("yaw_deg = -90", (0, -1, 0), (0, 0, 1)),
        ("rotation_wxyz = [0.7071068, 0.7071068, 0.0, 0.0]", (0, -1, 0), (0, 0, 1)),
    ],
)
def test_a_station_looks_and_stands_as_the_page_says(tmp_path, lines, looks, up):
    axes = _station(tmp_path, lines).stations["S"].world_from_array()
    assert np.allclose(axes[:, 2], looks, atol=1e-6)
    assert np.allclose(axes[:, 1], up, atol=1e-6)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("pitch_deg = 10", "or yaw_deg instead"),
        (
            "rotation_wxyz = [1.0, 0.0, 0.0, 0.0]\nyaw_deg = 3",
            "rotation_wxyz and yaw_deg, pitch_deg or roll_deg, expected one",
        ),
        ("yaw_deg = 'north'", "yaw_deg = 'north', expected a valid number"),
    ],
)
def test_an_unclear_attitude_is_refused(tmp_path, lines, words):
    with pytest.raises(UnusableInput, match=words):
        _station(tmp_path, lines)
