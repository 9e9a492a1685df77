"""The map of bearings' errors: means and standard deviations against the equations of a Gaussian process."""

import numpy as np

from trackwright.trackers.recordings.bearing_map import BearingMap, predicted

RNG = np.random.default_rng(0)
VISITS = np.column_stack([RNG.uniform(0.0, 4.0, (40, 2)), RNG.normal(0.0, [0.1, 0.2], (40, 2))])
PLACES = RNG.uniform(-1.0, 5.0, (25, 2))


def _by_equations(visits, places):
    def kernel(a, b):
        return np.exp(-np.linalg.norm(a[:, None] - b[None], axis=-1) / 0.6)

    means, sigmas = [], []
    for errors, place, visit in ((visits[:, 2], 0.1, 0.06), (visits[:, 3], 0.2, 0.15)):
        K = place**2 * kernel(visits[:, :2], visits[:, :2]) + visit**2 * np.eye(len(visits))
        k = place**2 * kernel(places, visits[:, :2])
        means.append(k @ np.linalg.solve(K, errors))
        sigmas.append(np.sqrt(place**2 + visit**2 - np.diag(k @ np.linalg.solve(K, k.T))))
    return np.stack(means, axis=1), np.stack(sigmas, axis=1)


def test_means_and_standard_deviations_are_those_of_a_gaussian_process():
    for found, expected in zip(predicted(VISITS, PLACES), _by_equations(VISITS, PLACES), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-13)


def test_a_grid_has_the_values_at_its_nodes_about_an_origin_and_of_stations_in_order():
    by_place = BearingMap(0.2, {"A": VISITS, "B": VISITS * [1.0, 1.0, -1.0, 2.0]})
    grid = by_place.grid(["B", "none", "A"], (100.0, -50.0))
    assert grid.values.shape[0] == 3
    for _ in range(20):
        i, j = RNG.integers(grid.values.shape[1]), RNG.integers(grid.values.shape[2])
        place = grid.corner + grid.step * np.array([i, j]) + [100.0, -50.0]
        for station, visits in ((0, by_place.stations["B"]), (2, VISITS)):
            expected = np.concatenate(_by_equations(visits, place[None]), axis=1)[0]
            np.testing.assert_allclose(grid.values[station, i, j], expected, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(grid.values[1, i, j], grid.unknown)
    np.testing.assert_allclose(grid.unknown, [0.0, 0.0, np.hypot(0.1, 0.06), 0.25])
