"""Layouts by gradient: the bound against dense NumPy with finite differences, its slope, constraints and searches."""

from functools import partial
from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.experiments.lab.questions._designs import LAYOUTS, TAG_POINTS, TOOL_POINTS, designs, hall, stand
from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.layout import DEFAULT_WAVELENGTH, boresight_bounds
from trackwright.trackers.aoa.phases import PlanePhases
from trackwright.tuning.design.bound import SensorAtEpoch, bounds, information, mean_bound
from trackwright.tuning.design.layouts import PlanarArray, WallAnchors, range_differences, ranges, spacing_violation
from trackwright.tuning.design.search import descend, exchange, exhaust

ROOM = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]])
BANDS = np.array([[0.2, 1.0], [2.0, 3.0], [0.2, 1.0], [2.0, 3.0]])
POINTS = np.array([[2.0, 1.0, 1.2], [3.5, 2.5, 0.9], [5.0, 3.0, 1.5]])
THETA = np.array([[0.1, 0.3], [0.35, 0.9], [0.6, 0.5], [0.9, 0.2]])
SIGMA = 0.05


def _differences(measure, point, step=1e-5):
    """The Jacobian of a measurement by central differences."""
    columns = [(measure(point + e) - measure(point - e)) / (2 * step) for e in step * np.eye(len(point))]
    return np.stack(columns, axis=1)


@pytest.fixture(scope="module")
def room():
    """Four anchors in a small room, and the value and slope of its objective."""
    layout = WallAnchors(ROOM, BANDS, 1.0, partial(ranges, SIGMA))
    return layout, jax.jit(jax.value_and_grad(layout.objective(POINTS)))


def _room_bound(places, points=POINTS):
    """The mean bound of ranges by textbook: H of finite differences, dense inverse."""
    variances = []
    for point in points:
        H = _differences(lambda p: np.linalg.norm(p - places, axis=1), point)
        variances.append(np.trace(np.linalg.inv(H.T @ H / SIGMA**2)))
    return np.sqrt(np.mean(variances))


def test_the_bound_of_ranges_is_that_of_dense_matrices(room):
    layout, evaluate = room
    # Finite differences are good to 1e-9 of the slopes; a tail of a million degrees of freedom leaves 2e-6.
    assert float(jnp.exp(evaluate(THETA)[0])) == pytest.approx(
        _room_bound(np.asarray(layout.positions(THETA))), rel=1e-5
    )


def test_the_slope_of_the_bound_is_that_of_finite_differences(room):
    _, evaluate = room
    slope, step = np.asarray(evaluate(THETA)[1]), 1e-5
    for k in np.ndindex(THETA.shape):
        up, down = THETA.copy(), THETA.copy()
        up[k] += step
        down[k] -= step
        assert slope[k] == pytest.approx(float(evaluate(up)[0] - evaluate(down)[0]) / (2 * step), rel=1e-4, abs=1e-6)


def test_a_known_height_leaves_the_information_of_the_plane():
    layout = WallAnchors(ROOM, BANDS, 1.0, partial(ranges, SIGMA), height=1.2)
    found = np.asarray(jax.jit(lambda t: information(layout.sensors(t), jnp.asarray([2.0, 1.0])))(THETA))
    places = np.asarray(layout.positions(THETA))
    H = _differences(lambda p: np.linalg.norm(np.append(p, 1.2) - places, axis=1), np.array([2.0, 1.0]))
    assert found == pytest.approx(H.T @ H / SIGMA**2, rel=1e-5)


def test_the_information_of_range_differences_is_that_of_a_dense_covariance():
    fixed = np.array([[3.0, 2.0, 2.9]])
    layout = WallAnchors(ROOM, BANDS, 1.0, partial(range_differences, SIGMA), fixed=fixed)
    found = np.asarray(jax.jit(lambda t: information(layout.sensors(t), jnp.asarray(POINTS[0])))(THETA))
    places = np.vstack([np.asarray(layout.positions(THETA)), fixed])
    # All pairs of five times of arrival with half the variance each.
    incidence = np.array([row - other for row, other in combinations(np.eye(5), 2)])
    H = incidence @ _differences(lambda p: np.linalg.norm(p - places, axis=1), POINTS[0])
    assert found == pytest.approx(H.T @ np.linalg.pinv(incidence @ incidence.T * SIGMA**2 / 2) @ H, rel=1e-5)


def test_the_bound_of_phases_is_that_of_centred_dense_matrices():
    layout = stand()
    theta = np.random.default_rng(0).random(layout.shape)
    places, wave = np.asarray(layout.positions(theta)), 2 * np.pi / DEFAULT_WAVELENGTH
    point, n = TOOL_POINTS[5], len(theta)
    centre, J = np.eye(n) - np.ones((n, n)) / n, np.zeros((3, 3))
    for station in work_station(places).stations.values():
        antennas = station.antenna_positions()
        # Steps of 10 µm in distances that are a metre: good to 1e-6 of a phase's slope.
        H = _differences(lambda p, a=antennas: -wave * np.linalg.norm(p - a, axis=1), point)
        J += H.T @ centre @ H / layout.sigma_p**2
    found = np.asarray(jax.jit(lambda t: information(layout.sensors(t), jnp.asarray(point)))(theta))
    assert found == pytest.approx(J, rel=1e-4, abs=1e-4 * np.abs(J).max())


def test_at_boresight_a_plane_waves_information_is_the_closed_form():
    class Angles(eqx.Module):
        """Azimuth and elevation as the plane sensor reads them, from a position that holds both."""

        sensor: PlanePhases

        def measure(self, view, inputs):
            beam = type("Beam", (), {"azimuth": view.position[0], "elevation": view.position[1]})
            return self.sensor.measure(beam, inputs)

        def residual(self, reading, predicted):
            return self.sensor.residual(reading, predicted)

    station = work_station().stations["1"]
    look = SensorAtEpoch(Angles(PlanePhases(station, 0.3)), {}, 8)
    J = np.asarray(jax.jit(lambda p: information([look], p))(np.zeros(2)))
    assert np.sqrt(np.diag(np.linalg.inv(J))) == pytest.approx(
        boresight_bounds(station.antennas, station.wavelength, 0.3), rel=1e-6
    )


def test_the_mean_bound_is_the_root_mean_square_over_the_points(room):
    def of(theta, points):
        sensors = room[0].sensors(theta)
        return bounds(sensors, points), mean_bound(sensors, points)

    each, mean = jax.jit(of)(THETA, POINTS)
    assert mean == pytest.approx(np.sqrt(np.mean(each**2)))


def test_anchors_stay_on_the_walls_and_in_their_bands(room):
    layout, _ = room
    theta = layout.project(jnp.asarray(np.random.default_rng(1).normal(0.5, 2.0, (4, 2))))
    x, y, z = np.asarray(layout.positions(theta)).T
    assert np.all(np.minimum(np.minimum(abs(x), abs(x - 6.0)), np.minimum(abs(y), abs(y - 4.0))) < 1e-9)
    assert np.all((BANDS[:, 0] - 1e-12 <= z) & (z <= BANDS[:, 1] + 1e-12))
    assert layout.theta(np.asarray(layout.positions(theta))) == pytest.approx(np.asarray(theta), abs=1e-9)
    with pytest.raises(ValueError, match="off the walls"):
        layout.theta(np.full((4, 3), 1.0))


def test_things_that_stand_too_near_cost_the_square_of_what_is_missing():
    places = jnp.asarray([[0.0, 0.0], [0.5, 0.0], [5.0, 0.0]])
    assert float(spacing_violation(places, 1.0)) == pytest.approx(0.25)
    assert float(spacing_violation(places, 0.5)) == 0.0
    assert np.all(np.isfinite(jax.jit(jax.grad(lambda p: spacing_violation(p, 1.0)))(np.zeros((2, 2)))))


def _valley(theta, weight=1.0):
    """Least, 1, on the ring of radius 0.4 about the middle; away from (0.9, 0.5) it rises with the weight."""
    radius = jnp.sqrt(jnp.sum((theta[0] - 0.5) ** 2) + 1e-12)
    return 1.0 + (radius - 0.4) ** 2 + weight * 1e-2 * jnp.sum((theta[0] - jnp.asarray([0.9, 0.5])) ** 2)


def test_a_descent_finds_the_least_of_many_starts():
    starts = np.random.default_rng(0).random((8, 1, 2))
    found = descend(_valley, lambda t: jnp.clip(t, 0.0, 1.0), starts, steps=200)
    assert found.theta[0] == pytest.approx([0.9, 0.5], abs=0.01)
    assert found.evaluations == 8 * 201


def test_an_exhausted_grid_gives_the_best_pair_and_an_exchange_one_that_no_single_move_betters():
    choices = np.random.default_rng(2).random((12, 2))

    def apart(theta, weight=1.0):
        return -jnp.sum((theta[0] - theta[1]) ** 2)

    square = np.sum((choices[:, None] - choices) ** 2, axis=-1)
    every = exhaust(apart, choices, combinations(range(12), 2))
    assert (every.value, every.evaluations) == (pytest.approx(-square.max()), 66)
    moved = exchange(apart, choices, [np.array([0, 1]), np.array([5, 7])])
    one, other = (int(np.argmin(np.sum((choices - t) ** 2, axis=1))) for t in moved.theta)
    assert moved.value == pytest.approx(-max(square[one].max(), square[other].max()))
    assert moved.evaluations % 12 == 0


@pytest.mark.parametrize(("name", "layout", "points"), [("anchors", hall, TAG_POINTS), ("array", stand, TOOL_POINTS)])
def test_designs_that_are_kept_hold_their_constraints_and_have_the_bounds_they_say(name, layout, points):
    layout, kept = layout(), designs(name)
    evaluate = jax.jit(lambda t: (mean_bound(layout.sensors(t), jnp.asarray(points)), layout.violation(t)))
    for design in kept.values():
        theta = jnp.asarray(layout.theta(design.positions))
        assert np.all((theta > -1e-3) & (theta < 1 + 1e-3))  # places are kept to four digits
        bound, violation = evaluate(theta)
        assert float(bound) == pytest.approx(design.bound, rel=2e-3)
        # 0.5 % of a spacing, or of a side lobe.
        assert float(violation) < 2.5e-5
    usual, grid, gradient = (kept[layout] for layout in LAYOUTS)
    assert gradient.bound <= grid.bound < usual.bound
    assert gradient.thousands < grid.thousands


def test_an_array_that_is_too_thin_is_told_by_its_side_lobes():
    layout = PlanarArray(work_station().stations, np.array([0.04, 0.02]), DEFAULT_WAVELENGTH / 2, 0.66, 0.25, 4)
    square = jnp.asarray([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    assert float(jnp.max(layout.side_lobes(square))) > 0.9
    assert float(layout.violation(square)) > 0.05
