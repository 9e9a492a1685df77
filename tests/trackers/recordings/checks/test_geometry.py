"""Dilution of precision against independent computations, and the shapes of known point sets."""

from __future__ import annotations

import numpy as np

from trackers.core.rig import Station
from trackers.recordings.checks.geometry import bearing_dilution, range_dilution, shape

ONE_DEGREE = np.radians(1.0)


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
    dilution = range_dilution(anchors, place[None])
    # a standard deviation from 20,000 draws is good to 0.5 %, four of them are 2 %
    np.testing.assert_allclose(dilution.horizontal[0], np.hypot(spread[0], spread[1]), rtol=0.02)
    np.testing.assert_allclose(dilution.vertical[0], spread[2], rtol=0.02)


def test_bearing_dilution_agrees_with_finite_differences_of_the_angles():
    stations = [
        Station(np.array([0.0, 3.0, 2.3]), np.array([0.5, 0.5, 0.5, 0.5])),
        Station(np.array([6.0, 0.0, 2.0]), np.array([0.1, -0.2, 0.7, 0.6]) / np.sqrt(0.9)),
    ]
    place = np.array([2.0, 2.0, 1.0])
    step = 1e-6
    columns = [
        np.concatenate([(s.angles(place + e) - s.angles(place - e)) / (2 * step) for s in stations])
        for e in step * np.eye(3)
    ]
    jacobian = np.stack(columns, axis=1)
    cov = ONE_DEGREE**2 * np.linalg.inv(jacobian.T @ jacobian)
    dilution = bearing_dilution(stations, place[None])
    # central differences with a step of 1e-6 are good to about 1e-9
    np.testing.assert_allclose(dilution.horizontal[0], np.sqrt(cov[0, 0] + cov[1, 1]), rtol=1e-7)
    np.testing.assert_allclose(dilution.vertical[0], np.sqrt(cov[2, 2]), rtol=1e-7)
    flat = jacobian[:, :2]
    known = np.sqrt(np.trace(ONE_DEGREE**2 * np.linalg.inv(flat.T @ flat)))
    np.testing.assert_allclose(dilution.horizontal_at_height[0], known, rtol=1e-7)


def test_only_coordinates_without_information_are_undetermined():
    square = np.array([[0.0, 0, 1], [4, 0, 1], [4, 4, 1], [0, 4, 1]])
    dilution = range_dilution(square, np.array([[2.0, 2.0, 1.0]]))
    assert np.isinf(dilution.vertical[0])
    # four unit vectors along the diagonals: JᵀJ = 2 I, so √(½ + ½)
    np.testing.assert_allclose(dilution.horizontal[0], 1.0, rtol=1e-12)
    pair = range_dilution(square[:1], np.array([[2.0, 2.0, 1.0]]))
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
