"""One update: compressed and sequential against the joint update of the textbook."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import LinearSensor
from tests.oracles import normal_log_density
from trackwright.trackers.core.filters.ekf import ExtendedKalman, compressed, sequential_updates
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian, matrix
from trackwright.trackers.core.model.motion import ConstantVelocity, Kinematic
from trackwright.trackers.core.model.sensor import Reading

# One by one, each of their operations would be compiled for itself.
compressed, sequential_updates = jax.jit(compressed), jax.jit(sequential_updates, static_argnums=3)

STATES = 4


def _rows(H, columns):
    return [{j: jnp.asarray(row[j]) for j in columns} for row in H]


def _joint(cov, residual, H):
    """The textbook's joint update with unit noise: small step, covariance, NIS and log density without its 2π."""
    S = H @ cov @ H.T + np.eye(len(H))
    K = cov @ H.T @ np.linalg.inv(S)
    density = normal_log_density(residual, S) + 0.5 * len(residual) * np.log(2 * np.pi)
    return K @ residual, cov - K @ S @ K.T, residual @ np.linalg.solve(S, residual), density


def _problem(seed, channels, columns):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(STATES, STATES))
    H = np.zeros((channels, STATES))
    H[:, columns] = rng.normal(size=(channels, len(columns))) * 3
    return factor @ factor.T, rng.normal(size=channels) * 4, H


def _assert_is_joint(cov, residual, H, result):
    step, upper, nis, log_density = result
    expected = _joint(cov, residual, H)
    np.testing.assert_allclose(step, expected[0], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(upper, expected[1][np.triu_indices(STATES)], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose([nis, log_density], expected[2:], rtol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_channels_one_after_another_are_the_joint_update(seed):
    cov, residual, H = _problem(seed, 3, [0, 1, 2, 3])
    upper = tuple(jnp.asarray(cov[np.triu_indices(STATES)]))
    _assert_is_joint(cov, residual, H, sequential_updates(upper, list(residual), _rows(H, range(STATES)), STATES))


@pytest.mark.parametrize("columns", [[1, 3], [2], [0, 1, 2, 3]])
@pytest.mark.parametrize("deficient", [False, True])
def test_compressed_channels_are_the_joint_update_of_all(columns, deficient):
    cov, residual, H = _problem(len(columns), 8, columns)
    if deficient:
        # Masked channels, and all others seeing one direction only, like antennas on a line.
        H, residual = np.outer(np.arange(8) % 3, H[0]), residual * (np.arange(8) % 3 > 0)
    equivalent, rows, rest = compressed(list(map(jnp.asarray, residual)), _rows(H, columns))
    assert len(equivalent) == len(columns)
    upper = tuple(jnp.asarray(cov[np.triu_indices(STATES)]))
    step, upper, nis, log_density = sequential_updates(upper, equivalent, rows, STATES)
    _assert_is_joint(cov, residual, H, (step, upper, nis + rest, log_density - 0.5 * rest))


def test_what_no_state_explains_keeps_its_digits_in_single_precision():
    # A residual almost along H: |r|² is 1e8 times what is left of it, so that a difference of squares has no digit.
    rng = np.random.default_rng(0)
    H = rng.normal(size=(8, 2)).astype(np.float32)
    beside = rng.normal(size=8)
    beside -= H @ np.linalg.lstsq(H.astype(float), beside, rcond=None)[0]
    residual = (H @ np.array([3e3, -2e3]) + beside).astype(np.float32)
    exact = residual - H.astype(float) @ np.linalg.lstsq(H.astype(float), residual.astype(float), rcond=None)[0]
    rest = compressed(list(jnp.asarray(residual)), [dict(enumerate(jnp.asarray(row))) for row in H])[2]
    assert rest.dtype == jnp.float32
    # Each component of the remainder is rounded like the residual, to 2e-4.
    assert float(rest) == pytest.approx(exact @ exact, rel=2e-3)


def test_a_direction_that_is_hardly_observed_keeps_the_sum_of_squares_in_single_precision():
    # As the distance by a small array: of the Cholesky factor of HᵀH three digits of seven would be left.
    rng = np.random.default_rng(0)
    H = rng.normal(size=(8, 3))
    H[:, 2] = H[:, 0] + 5e-3 * H[:, 2]
    residual = jnp.asarray(rng.normal(size=8), jnp.float32)
    rows = [dict(enumerate(jnp.asarray(row, jnp.float32))) for row in H]
    equivalent, factor, rest = compressed(list(residual), rows)
    assert all(x > 0 for x in factor[2].values())
    assert sum(x**2 for x in equivalent) + rest == pytest.approx(float(residual @ residual), rel=3e-6)


def test_students_t_with_many_degrees_of_freedom_is_the_normal_update():
    cov, residual, H = _problem(7, 3, [0, 1, 2, 3])
    upper = tuple(jnp.asarray(cov[np.triu_indices(STATES)]))
    normal = sequential_updates(upper, list(residual), _rows(H, range(STATES)), STATES)
    student = sequential_updates(upper, list(residual), _rows(H, range(STATES)), STATES, jnp.asarray(1e9))
    for a, b in zip(jax.tree_util.tree_leaves(student), jax.tree_util.tree_leaves(normal), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


def test_students_t_moves_less_the_farther_off_a_reading_is():
    one = (jnp.asarray(1.0),)
    moves = [
        float(sequential_updates(one, [jnp.asarray(r)], [{0: jnp.asarray(1.0)}], 1, jnp.asarray(4.0))[0][0]) / r
        for r in (0.1, 1.0, 10.0, 100.0)
    ]
    assert moves == sorted(moves, reverse=True)
    assert moves[0] > 0.5
    assert moves[-1] < 0.01


@pytest.mark.parametrize("form", [tuple, jnp.asarray])
@pytest.mark.parametrize("far", [0.0, 1e5])
def test_a_position_is_known_to_the_spacing_of_numbers(form, far):
    """Readings with 1 µm of noise at 100 km, where numbers in single precision are 8 mm apart."""
    rng = np.random.default_rng(4)
    truth, motion = far + rng.uniform(0, 1, 2), ConstantVelocity(1e-9, 2)
    with jax.enable_x64(False):
        cov = np.diag([1.0, 1.0, 1e-12, 1e-12]).astype(np.float32)
        cov = jnp.asarray(cov) if form is not tuple else tuple(jnp.asarray(cov[np.triu_indices(4)]))
        mean = Kinematic(Vector(*(jnp.float32(far),) * 2), Vector(jnp.float32(0), jnp.float32(0)))
        belief, sensor = Gaussian(mean, cov), LinearSensor(np.eye(2, 4, dtype=np.float32), [jnp.float32(1e-6)] * 2, 2)

        @jax.jit
        def updated(belief, values):
            reading = Reading(list(values), [jnp.asarray(True)] * 2)
            return ExtendedKalman().update(belief, motion, sensor, reading, {})[0]

        for _ in range(20):
            belief = updated(belief, jnp.asarray(truth + 1e-6 * rng.normal(size=2), jnp.float32))
        variance = belief.cov[0] if form is tuple else belief.cov[0, 0]
    error = abs(float(belief.mean.position[0]) - truth[0])
    assert error <= float(variance) ** 0.5 * (1.0 if far else 5.0)
    assert float(variance) ** 0.5 < 0.02 if far else float(variance) ** 0.5 < 1e-6


@pytest.mark.parametrize("form", [tuple, jnp.asarray])
def test_variances_stay_positive_where_precise_readings_leave_large_ones_that_cancel(form):
    """Three of four directions are measured a hundred times each; every component keeps a variance of about 1."""
    rows = np.random.default_rng(2).normal(size=(3, 4)).astype(np.float32)
    with jax.enable_x64(False):
        cov = jnp.eye(4) if form is not tuple else tuple(jnp.eye(4)[np.triu_indices(4)])
        zero = jnp.float32(0)
        belief = Gaussian(Kinematic(Vector(zero, zero), Vector(zero, zero)), cov)

        @jax.jit
        def updated(belief, row):
            reading = Reading([zero], [jnp.asarray(True)])
            return ExtendedKalman().update(
                belief, ConstantVelocity(0.1, 2), LinearSensor(row[None], [jnp.float32(1e-6)], 1), reading, {}
            )[0]

        for k in range(300):
            belief = updated(belief, jnp.asarray(rows[k % 3]))
        P = np.asarray(matrix(belief.cov), float)
    assert np.linalg.eigvalsh(P)[0] > 0
    unseen = np.linalg.svd(rows)[2][-1]
    assert unseen @ P @ unseen == pytest.approx(1.0, rel=1e-3)
