"""The predictions of each kind of measurement against those of the trackers' sensors, and a user's own kind."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from trackwright.trackers.aoa.fusion import BearingSensor, bearing_inputs
from trackwright.trackers.aoa.phases import SphericalPhases
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.parts.fixes import FixSensor
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.recordings.kinds import KINDS, Column, Kind, add_kind

RNG = np.random.default_rng(32)
TURNED = np.array([0.5, -0.3, 0.7, 0.4]) / np.sqrt(0.99)
ANTENNAS = np.array([[0.0, 0.0], [0.02, 0.001], [-0.01, 0.03], [0.03, -0.02]])
RIG = Rig(
    "rig",
    anchors={"A": np.array([0.0, 1.0, 2.0]), "B": np.array([4.0, -1.0, 2.5])},
    stations={
        "S": Station(np.array([1.0, 0.5, 2.0]), TURNED, ANTENNAS, 0.0125),
        "T": Station(np.array([-2.0, 3.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0]), ANTENNAS[:3], 0.06),
    },
)
POSITIONS = RNG.uniform(-5.0, 5.0, (40, 3))
NUMBER = RNG.integers(0, 2, (40, 1))


def _predicted(name: str, columns: int) -> np.ndarray:
    kind = KINDS[name]
    ids = list(kind.places(RIG))
    number = NUMBER if kind.sensors else np.zeros((40, 0), int)
    assert kind.predicted is not None
    return kind.predicted(POSITIONS, kind.sensors_of(RIG, ids, number, columns))


def _measured(sensor, position, inputs) -> list[float]:
    view = SimpleNamespace(position=Vector(*position), velocity=Vector(0.0, 0.0, 0.0))
    return [float(x) for x in sensor.measure(view, inputs)]


def test_ranges_bearings_and_fixes_are_predicted_as_their_sensors_do():
    anchors, stations = list(RIG.anchors.values()), list(RIG.stations.values())
    ranges, bearings = RangeSensor(1, 2, 0.1, 1.0, 4.0), BearingSensor(0.1, 0.1, 4.0)
    expected: dict[str, list[list[float]]] = {"ranges": [], "bearings": [], "fixes": []}
    for p, (k,) in zip(POSITIONS, NUMBER, strict=True):
        row = bearing_inputs(stations[k])
        inputs = {"origin": row[:3], "axes": row[3:], "station": float(k)}
        expected["ranges"].append(_measured(ranges, p, {"anchors": anchors[k], "anchor": np.array([float(k)])}))
        expected["bearings"].append(_measured(bearings, p, inputs))
        expected["fixes"].append(_measured(FixSensor(0.1, 0.1), p, {}))
    for name, values in expected.items():
        np.testing.assert_allclose(_predicted(name, len(values[0])), values, rtol=1e-12)


def test_phases_are_predicted_as_their_sensor_does_with_none_for_an_antenna_that_a_station_lacks():
    found, stations = _predicted("phases", 4), list(RIG.stations.values())
    for row, p, (k,) in zip(found, POSITIONS, NUMBER, strict=True):
        expected = _measured(SphericalPhases(stations[k]), p, {})
        np.testing.assert_allclose(row[: len(expected)], expected, rtol=1e-9, atol=1e-9)
        assert np.isnan(row[len(expected) :]).all()


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda: Kind("Bistatic", ()), "expected lower case"),
        (lambda: Kind("bistatic", (Column("path"),)), "expected a unit at its end"),
        (lambda: Kind("bistatic", (Column("path_m"),), ("beacon",)), "expected anchor"),
        (lambda: add_kind(Kind("ranges", (Column("range_m"),))), "is a table of the format"),
        (lambda: add_kind(Kind("truth", (Column("range_m"),))), "is a table of the format"),
    ],
)
def test_a_kind_that_the_format_cannot_hold_is_refused(made, message):
    with pytest.raises(UnusableInput, match=message):
        made()
