"""Mistakes in the IMU of a simulated tool are named, with its true attitude and without."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import polars as pl
import pytest

from trackwright.sim import worlds
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.checks.imu import between, check_imu, imu_rows, true_attitude
from trackwright.trackers.recordings.folder import RecordingFolder

ACCEL, GYRO = ([f"{name}_{axis}_{unit}" for axis in "xyz"] for name, unit in (("accel", "mps2"), ("gyro", "radps")))
QUATERNION = ["qw", "qx", "qy", "qz"]
C = pl.col


@cache
def _tool() -> RecordingFolder:
    return worlds.tool(n=1, seed=0, rows=600).folder()


def _changed(table: str, *columns: pl.Expr, truth: bool = True) -> RecordingFolder:
    folder = _tool()
    tables = dict(folder.tables) | {table: folder.tables[table].with_columns(*columns)}
    return replace(folder, tables={name: rows for name, rows in tables.items() if truth or name != "truth"})


def _signs(names: list[str], signs: tuple[int, int, int]) -> list[pl.Expr]:
    return [C(name) * sign for name, sign in zip(names, signs, strict=True)]


def _swapped(names: list[str]) -> list[pl.Expr]:
    return [C(names[1]).alias(names[0]), C(names[0]).alias(names[1])]


FLIPPED, SWAPPED = _signs(GYRO, (-1, -1, -1)), [*_swapped(ACCEL), *_swapped(GYRO)]
DOWN = [*_signs(ACCEL, (1, -1, -1)), *_signs(GYRO, (1, -1, -1))]

WITH_TRUTH = {
    "signs of the gyro": ("error", "only with the signs of x, y, z of the turn rates flipped", FLIPPED),
    "x and y swapped": ("error", "only with x and y of the turn rates swapped;", SWAPPED),
    "x and y of the gyro swapped": ("error", "only with x and y of the turn rates swapped;", _swapped(GYRO)),
    "upside down": ("warning", "only with the signs of y, z of the turn rates flipped", DOWN),
    "turn rates in rpm": (
        "error",
        "turn rates are 9.6 times those of the truth's attitude: looks like rpm",
        [C(GYRO) * 9.5493],
    ),
    "half the full scale": (
        "error",
        "turn rates are 0.5 times those of the truth's attitude",
        [C(GYRO) * 0.5, C("t_s") + 0.5],
    ),
    "clock 40 ms late": ("warning", "comes 0.04 s late against the truth's attitude", [C("t_s") + 0.04]),
    "clock 0.5 s late": ("warning", "comes 0.50 s late against the truth's attitude", [C("t_s") + 0.5]),
    "clock 2 s early": ("error", "comes 2.00 s early against the truth's attitude", [C("t_s") - 2.0]),
}

ALONE = {
    "signs of the gyro": ("error", "with the signs of x, y, z of the turn rates flipped, or two axes of both", FLIPPED),
    "x and y swapped": ("error", "with the signs of x, y, z of the turn rates flipped, or two axes of both", SWAPPED),
    "x and y of the gyro swapped": ("error", "with x and y of the turn rates swapped (", _swapped(GYRO)),
    "upside down": ("warning", "the IMU is upside down", DOWN),
}


@pytest.mark.parametrize("truth", [True, False])
def test_no_mistake_is_named_in_the_imu_of_the_tool(truth):
    assert [one.message for one in quick_check(_changed("imu", truth=truth))] == []


@pytest.mark.parametrize("name", WITH_TRUTH)
def test_a_mistake_is_named_with_the_true_attitude(name):
    level, words, columns = WITH_TRUTH[name]
    found = [(one.level, one.message) for one in check(_changed("imu", *columns)) if one.where == "imu"]
    assert any(level == of and words in message for of, message in found), found


def test_a_delay_that_hardly_changes_slow_turns_is_told():
    t, rates = 0.02 * np.arange(3000), np.zeros((3000, 3))
    rates[:, 2] = 0.5 + 0.25 * np.sin(0.4 * t) + 0.03 * np.sin(5.0 * t)
    half = (0.5 * t - 0.625 * np.cos(0.4 * t) - 0.006 * np.cos(5.0 * t)) / 2
    truth = pl.DataFrame({"t_s": t, "tag": "T", "qw": np.cos(half), "qx": 0.0, "qy": 0.0, "qz": np.sin(half)})
    vectors = zip([*ACCEL, *GYRO], [*np.zeros((2, 3000)), np.full(3000, 9.81), *rates.T], strict=True)
    imu = pl.DataFrame({"t_s": t + 0.5, "tag": "T"} | dict(vectors))
    (found,) = check_imu({"imu": imu, "truth": truth})
    assert "comes 0.50 s late" in found.message


@pytest.mark.parametrize("name", ALONE)
def test_a_mistake_is_named_by_gravity_alone(name):
    level, words, columns = ALONE[name]
    found = [(one.level, one.message) for one in quick_check(_changed("imu", *columns, truth=False))]
    assert any(level == of and words in message for of, message in found), found


@pytest.mark.parametrize(
    ("words", "order"), [("x, y, z, w", (1, 2, 3, 0)), ("z, w, x, y", (3, 0, 1, 2)), ("inverted", None)]
)
def test_quaternions_of_the_truth_in_another_order_are_named(words, order):
    columns = (
        [-C(name) for name in QUATERNION[1:]]
        if order is None
        else [C(QUATERNION[k]).alias(name) for k, name in zip(order, QUATERNION, strict=True)]
    )
    (error,) = quick_check(_changed("truth", *columns))
    assert error.where == "truth"
    assert words in error.message


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
    table = _tool().tables["imu"]
    far = pl.concat([table, table.tail(1).with_columns(pl.col("t_s") + 1e14)])
    assert check_imu(dict(_tool().tables) | {"imu": far}) == []
    truth = _tool().tables["truth"]
    far = pl.concat([truth, truth.tail(1).with_columns(pl.col("t_s") + 1e14)]).drop(QUATERNION)
    assert check_imu({"imu": table, "truth": far}) == []
