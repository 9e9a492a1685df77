"""The motions and sensors of the library keep the contracts that a user's own are checked against."""

import pytest

from tests.catalogue import MOTIONS, SENSORS
from trackwright.trackers.conformance.parts import motion_checks, sensor_checks

SLOW = {
    *(name for name in MOTIONS if name.endswith((", no accelerometer", ", no IMU", ", transport"))),
    "fixes", "fixes above the anchors' plane", "ranges", "range differences", "bearings",
}  # fmt: skip
"""Of classes that another case has with more of its code: an IMU that is whole or missing, noise that is reported."""

DIFFERENCES = {
    "ground",
    "halting, at rest",
    "damped velocity",
    "driven body",
    "fixes on the floor",
    "plane waves",
    "bearings with variances",
}
"""Whose derivatives are held against difference quotients in the default suite: a program more for each."""


def _params(cases, checks):
    return [
        pytest.param(check, id=f"{name}-{check}", marks=pytest.mark.slow if _slow(name, f"{check}") else ())
        for name, case in cases.items()
        for check in checks(case)
    ]


def _slow(name, check):
    return name in SLOW or (check == "derivatives" and name not in DIFFERENCES)


@pytest.mark.parametrize("check", _params(MOTIONS, lambda c: motion_checks(c.motion, c.state, c.inputs, c.dt)))
def test_every_motion_keeps_its_contract(check):
    check()


@pytest.mark.parametrize("check", _params(SENSORS, lambda c: sensor_checks(c.sensor, c.view, c.inputs, c.reported)))
def test_every_sensor_keeps_its_contract(check):
    check()
