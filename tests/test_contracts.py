"""The motions and sensors of the library keep the contracts that a user's own are checked against."""

import pytest

from tests.catalogue import MOTIONS, SENSORS
from trackwright.trackers.core.run.checks import check_motion, check_sensor

SLOW = {
    *(name for name in MOTIONS if name.endswith(", no accelerometer")),
    "fixes", "fixes above the anchors' plane", "ranges", "range differences", "bearings",
}  # fmt: skip
"""Of classes that another case has with more of its code: an IMU that is whole or missing, noise that is reported."""


def _names(cases):
    return [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in cases]


@pytest.mark.parametrize("name", _names(MOTIONS))
def test_every_motion_keeps_its_contract(name):
    case = MOTIONS[name]
    check_motion(case.motion, case.state, case.inputs, case.dt)


@pytest.mark.parametrize("name", _names(SENSORS))
def test_every_sensor_keeps_its_contract(name):
    case = SENSORS[name]
    check_sensor(case.sensor, case.view, case.inputs, case.reported)
