"""Samples of an IMU held over rows, rest, and axes that are levelled by the sensor's own attitude."""

import numpy as np
import pytest

from trackwright.trackers.uwb_imu.rows_between import REST_ACCEL_STD, REST_GYRO_STD, imu_inputs, to_level_axes


def test_a_sample_is_held_for_a_while_and_a_gap_is_a_gap():
    imu = np.arange(0, 1, 0.1)
    times = np.array([-0.1, 0.0, 0.15, 0.95, 1.05, 1.3])
    samples = np.tile(np.arange(10.0)[:, None], (1, 3))
    gyro = np.where(np.arange(10)[:, None] == 9, np.nan, samples)
    inputs = imu_inputs(times, imu, samples, gyro)
    np.testing.assert_array_equal(inputs["imu"], [[0, 0], [1, 1], [1, 1], [1, 1], [1, 0], [0, 0]])
    np.testing.assert_array_equal(inputs["accel"][:, 0], [0, 0, 1, 9, 9, 0])


def test_rest_is_detected_and_gives_the_gyro_bias():
    rng = np.random.default_rng(0)
    imu = np.arange(0, 4, 0.01)
    accel = np.array([0.0, 0.0, 9.81]) + 0.02 * rng.normal(size=(400, 3))
    gyro = 0.03 + 0.002 * rng.normal(size=(400, 3))
    accel[200:] += np.sin(10 * imu[200:, None])
    rest = imu_inputs(np.array([0.0, 1.9, 3.5]), imu, accel, gyro)["rest"]
    np.testing.assert_array_equal(rest[:, 6], [1, 1, 0])
    np.testing.assert_allclose(rest[1, 3:6], 0.03, atol=0.001)


@pytest.mark.parametrize(("shaken", "turned", "at_rest"), [(0.9, 0.9, 1), (1.1, 0.0, 0), (0.0, 1.1, 0)])
def test_a_body_is_at_rest_up_to_the_largest_standard_deviations(shaken, turned, at_rest):
    imu = np.arange(0, 2, 0.01)
    # An alternating ±a has a standard deviation of a; one axis that moves is enough.
    sign = np.where(np.arange(200) % 2, 1.0, -1.0)[:, None]
    accel = np.array([0.0, 0.0, 9.81]) + shaken * REST_ACCEL_STD * sign * [0.0, 0.0, 1.0]
    gyro = 0.03 + turned * REST_GYRO_STD * sign * [0.0, 1.0, 0.0]
    rest = imu_inputs(np.array([1.5]), imu, accel, gyro)["rest"]
    np.testing.assert_array_equal(rest[:, 6], at_rest)


def test_a_sensor_that_takes_gravity_out_is_levelled_by_its_own_attitude():
    q = np.array([[0.5, 0.5, 0.5, 0.5], [2.0, 0.0, 0.0, 0.0], [np.nan] * 4])  # x to y, y to z, z to x
    accel, gyro = to_level_axes(np.tile([1.0, 2.0, 3.0], (3, 1)), q, 9.81)
    np.testing.assert_allclose(accel[:2], [[3, 1, 2 + 9.81], [1, 2, 3 + 9.81]])
    np.testing.assert_array_equal(gyro[:2], 0)
    assert np.isnan(accel[2]).all()
