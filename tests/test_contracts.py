"""The motions and sensors of the library keep the contracts that a user's own are checked against."""

import pytest

from tests.catalogue import MOTIONS, SENSORS
from trackwright.trackers.core.run.checks import check_motion, check_sensor


@pytest.mark.parametrize("name", MOTIONS)
def test_every_motion_keeps_its_contract(name):
    case = MOTIONS[name]
    check_motion(case.motion, case.state, case.inputs, case.dt)


@pytest.mark.parametrize("name", SENSORS)
def test_every_sensor_keeps_its_contract(name):
    case = SENSORS[name]
    check_sensor(case.sensor, case.view, case.inputs, case.reported)
