"""Rates, windows and clocks by which mistakes in an IMU are named."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import tool
from trackwright.trackers.recordings.checks.imu import between, check_imu, imu_rows, true_attitude

ACCEL, GYRO = ([f"{name}_{axis}_{unit}" for axis in "xyz"] for name, unit in (("accel", "mps2"), ("gyro", "radps")))
QUATERNION = ["qw", "qx", "qy", "qz"]
C = pl.col


def test_a_delay_that_hardly_changes_slow_turns_is_told():
    t, rates = 0.02 * np.arange(3000), np.zeros((3000, 3))
    rates[:, 2] = 0.5 + 0.25 * np.sin(0.4 * t) + 0.03 * np.sin(5.0 * t)
    half = (0.5 * t - 0.625 * np.cos(0.4 * t) - 0.006 * np.cos(5.0 * t)) / 2
    truth = pl.DataFrame({"t_s": t, "tag": "T", "qw": np.cos(half), "qx": 0.0, "qy": 0.0, "qz": np.sin(half)})
    vectors = zip([*ACCEL, *GYRO], [*np.zeros((2, 3000)), np.full(3000, 9.81), *rates.T], strict=True)
    imu = pl.DataFrame({"t_s": t + 0.5, "tag": "T"} | dict(vectors))
    (found,) = check_imu({"imu": imu, "truth": truth})
    assert "comes 0.50 s late" in found.message


def test_rates_of_the_true_attitude_are_those_of_a_steady_turn():
    t, rate = 0.05 * np.arange(40), np.array([0.3, -0.5, 0.8])
    half = np.linalg.norm(rate) * t / 2
    axis = rate / np.linalg.norm(rate)
    truth = pl.DataFrame({"t_s": t, "tag": "T", "qw": np.cos(half)} | {
        name: x * np.sin(half) for name, x in zip(QUATERNION[1:], axis, strict=True)
    })  # fmt: skip
    _, found = true_attitude(truth).rates()
    np.testing.assert_allclose(found, np.tile(rate, (len(found), 1)), atol=1e-9)


def test_no_window_lies_across_a_gap():
    t = np.concatenate([0.1 * np.arange(20), 5 + 0.1 * np.arange(20)])
    rows = imu_rows(pl.DataFrame({"t_s": t, "tag": "T"} | dict.fromkeys((*ACCEL, *GYRO), 2.0)), "T")
    found = between(rows.times, rows.turned, np.array([0.5, 1.5, 5.5]), np.array([1.0, 5.5, 6.0]))
    np.testing.assert_allclose(found, [[1.0] * 3, [np.nan] * 3, [1.0] * 3])


@pytest.mark.parametrize("late", [0.0, 0.6, -1.5])
def test_the_clock_of_an_imu_is_compared_with_true_heights_where_there_is_no_attitude(late):
    t = 0.02 * np.arange(1500)
    height = 1.0 + 0.1 * np.sin(2.1 * t) + 0.06 * np.sin(3.7 * t + 1.0)
    lift = -0.1 * 2.1**2 * np.sin(2.1 * t) - 0.06 * 3.7**2 * np.sin(3.7 * t + 1.0)
    noise = np.random.default_rng(5).normal(0, 0.2, (len(t), 3)) + [0.0, 0.0, 9.81]
    noise[:, 2] += lift
    imu = pl.DataFrame(
        {"t_s": t + late, "tag": "T"} | dict(zip(ACCEL, noise.T, strict=True)) | dict.fromkeys(GYRO, 0.0)
    )
    found = check_imu({"imu": imu, "truth": pl.DataFrame({"t_s": t, "tag": "T", "z_m": height})})
    words = f"comes {abs(late):.2f} s {'late' if late > 0 else 'early'} against the truth's heights"
    assert [words in one.message for one in found] == [True] * (late != 0)


def test_a_row_of_another_clock_costs_no_memory():
    table = tool().tables["imu"]
    far = pl.concat([table, table.tail(1).with_columns(pl.col("t_s") + 1e14)])
    assert check_imu(dict(tool().tables) | {"imu": far}) == []
    truth = tool().tables["truth"]
    far = pl.concat([truth, truth.tail(1).with_columns(pl.col("t_s") + 1e14)]).drop(QUATERNION)
    assert check_imu({"imu": table, "truth": far}) == []
