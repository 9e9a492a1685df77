"""Dilution of precision against independent computations, and the shapes of known point sets."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.recordings.checks.geometry import Dilution, dilution, information, shape
from trackwright.trackers.recordings.kinds import KINDS

ONE_DEGREE = np.radians(1.0)


def _range_dilution(anchors: np.ndarray, positions: np.ndarray) -> Dilution:
    rig = Rig("rig", anchors={str(k): place for k, place in enumerate(anchors)})
    return dilution(information(KINDS["ranges"], rig, [(name,) for name in rig.anchors], positions))


def test_range_dilution_is_the_standard_deviation_of_least_squares_positions():
    # oracle: 20,000 noisy sets of ranges, each solved by Gauss and Newton from the true place
    anchors = np.array([[0, 0, 0.3], [6, 0, 2.6], [6, 5, 0.4], [0, 5, 2.9], [3, 2, 3.0]])
    place = np.array([2.0, 3.0, 1.0])
    rng = np.random.default_rng(1)
    sigma = 1e-3
    ranges = np.linalg.norm(place - anchors, axis=1) + rng.normal(0, sigma, (20000, 5))
    found = np.tile(place, (20000, 1))
    for _ in range(3):
        toward = found[:, None] - anchors
        distance = np.linalg.norm(toward, axis=-1)
        jacobian = toward / distance[..., None]
        missed = ranges - distance
        found += [np.linalg.lstsq(j, m, rcond=None)[0] for j, m in zip(jacobian, missed, strict=True)]
    spread = found.std(axis=0) / sigma
    seen = _range_dilution(anchors, place[None])
    # a standard deviation from 20,000 draws is good to 0.5 %, four of them are 2 %
    np.testing.assert_allclose(seen.horizontal[0], np.hypot(spread[0], spread[1]), rtol=0.02)
    np.testing.assert_allclose(seen.vertical[0], spread[2], rtol=0.02)


def test_bearing_dilution_is_that_of_the_gradients_of_the_angles():
    stations = [
        Station(np.array([0.0, 3.0, 2.3]), np.array([0.5, 0.5, 0.5, 0.5])),
        Station(np.array([6.0, 0.0, 2.0]), np.array([0.1, -0.2, 0.7, 0.6]) / np.sqrt(0.9)),
    ]
    place = np.array([2.0, 2.0, 1.0])
    rows = []
    for station in stations:
        x, y, z = station.position_in_array(place)
        flat = np.hypot(x, z)
        azimuth = np.array([z, 0.0, -x]) / flat**2
        elevation = np.array([-x * y / flat, flat, -z * y / flat]) / (flat**2 + y**2)
        rows += [station.world_from_array() @ azimuth, station.world_from_array() @ elevation]
    jacobian = np.stack(rows)
    cov = ONE_DEGREE**2 * np.linalg.inv(jacobian.T @ jacobian)
    rig = Rig("rig", stations={"a": stations[0], "b": stations[1]})
    found = dilution(information(KINDS["bearings"], rig, [("a",), ("b",)], place[None]))
    # slopes over 0.2 mm are good to about 1e-9
    np.testing.assert_allclose(found.horizontal[0], np.sqrt(cov[0, 0] + cov[1, 1]), rtol=1e-7)
    np.testing.assert_allclose(found.vertical[0], np.sqrt(cov[2, 2]), rtol=1e-7)
    flat = jacobian[:, :2]
    known = np.sqrt(np.trace(ONE_DEGREE**2 * np.linalg.inv(flat.T @ flat)))
    np.testing.assert_allclose(found.horizontal_at_height[0], known, rtol=1e-7)


def test_only_coordinates_without_information_are_undetermined():
    square = np.array([[0.0, 0, 1], [4, 0, 1], [4, 4, 1], [0, 4, 1]])
    seen = _range_dilution(square, np.array([[2.0, 2.0, 1.0]]))
    assert np.isinf(seen.vertical[0])
    # four unit vectors along the diagonals: JᵀJ = 2 I, so √(½ + ½)
    np.testing.assert_allclose(seen.horizontal[0], 1.0, rtol=1e-9)
    pair = _range_dilution(square[:1], np.array([[2.0, 2.0, 1.0]]))
    assert np.isinf(pair.horizontal[0])
    assert np.isinf(pair.horizontal_at_height[0])


def test_shapes_are_recognised_in_any_orientation():
    rng = np.random.default_rng(2)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    corners = np.array([[x, y, z] for x in (0, 4) for y in (0, 5) for z in (0, 3)], float)
    assert shape(corners @ turn)[0] == "solid"
    assert shape((corners * [1, 1, 0.05]) @ turn)[0] == "plane"
    assert shape((corners * [1, 0.01, 0.01]) @ turn)[0] == "line"
    assert shape(corners * 0 + 1)[0] == "point"


@pytest.mark.parametrize("pairs", ["of one anchor", "all"])
def test_dilution_of_differences_is_that_of_arrivals_at_an_unknown_time(pairs):
    anchors = np.random.default_rng(4).uniform(0.0, [6.0, 5.0, 3.0], (6, 3))
    rig = Rig("room", anchors={f"A{k}": x for k, x in enumerate(anchors)})
    ids = list(combinations(rig.anchors, 2))[: 5 if pairs == "of one anchor" else None]
    place = np.array([2.0, 2.5, 1.2])
    away = place - anchors
    # Arrivals of half the variance of a difference; the last column is the time of transmission.
    jacobian = np.column_stack([away / np.linalg.norm(away, axis=1, keepdims=True), np.ones(6)])
    covariance = 0.5 * np.linalg.inv(jacobian.T @ jacobian)
    seen = dilution(information(KINDS["tdoa"], rig, ids, place[None]))
    np.testing.assert_allclose(seen.horizontal, np.sqrt(covariance[0, 0] + covariance[1, 1]), rtol=1e-6)
    np.testing.assert_allclose(seen.vertical, np.sqrt(covariance[2, 2]), rtol=1e-6)
