"""Repeats, quantisation steps and correlation times are those with which the readings were made."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.recordings.checks.all_checks import check
from trackwright.trackers.recordings.checks.readings import (
    Readings,
    about_local_line,
    autocorrelation,
    quantisation_step,
    readings,
    repeated_share,
)
from trackwright.trackers.recordings.folder import RecordingFolder

STEP_S = 0.1
ANCHORS = {"A1": np.array([0.0, 0.0, 3.0]), "A2": np.array([8.0, 1.0, 2.0])}
QUARTER_TURN = Station(np.array([1.0, -2.0, 1.0]), np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]))


def _gauss_markov(rows, streams, tau, seed=0):
    """Errors of unit variance, exp(−t/τ) correlated, as readings of so many streams of equal times."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-STEP_S / tau) if tau else 0.0
    x = rng.normal(size=(rows, streams))
    for k in range(1, rows):
        x[k] = kept * x[k - 1] + np.sqrt(1 - kept**2) * x[k]
    return _of(x.T.ravel(), streams)


def _of(values, streams=1, column="range_m"):
    number = np.repeat(np.arange(streams), len(values) // streams)
    times = np.tile(STEP_S * np.arange(len(values) // streams), streams)
    return Readings((column,), number, times, values[:, None], np.full((len(values), 1), np.nan))


@pytest.mark.parametrize("tau", [0.5, 1.5, 4.0])
def test_the_correlation_time_of_a_gauss_markov_error_is_found(tau):
    read = _gauss_markov(3000, 4, tau)
    found = autocorrelation(read, 0.3 * read.values[:, 0])
    assert found.resolved
    assert found.ended
    assert found.time == pytest.approx(tau, rel=0.2)
    assert found.interval == pytest.approx(STEP_S)
    assert found.sigma == pytest.approx(0.3, rel=0.1)


def test_outliers_do_not_hide_a_correlation():
    read = _gauss_markov(3000, 4, 1.5)
    values = read.values[:, 0].copy()
    values[np.random.default_rng(1).random(len(values)) < 0.02] += 50.0
    assert autocorrelation(read, values).time > 0.75


def test_white_errors_are_uncorrelated_and_streams_are_not_mixed():
    read = _gauss_markov(3000, 4, 0.0)
    assert not autocorrelation(read, read.values[:, 0]).resolved
    # The offset between two streams is no correlation.
    assert not autocorrelation(read, read.values[:, 0] + 5.0 * read.stream).resolved
    assert autocorrelation(_of(np.ones(200)), np.ones(200)) is None


@pytest.mark.parametrize(("step", "column"), [(0.01, "range_m"), (np.deg2rad(2.0), "azimuth_rad"), (0.0078, "x_m")])
def test_a_quantisation_step_is_found(step, column):
    rng = np.random.default_rng(2)
    values = 3.0 + 0.5 * np.sin(0.01 * np.arange(2000)) + 2.0 * step * rng.normal(size=2000)
    values = step * np.round(values / step)
    if column.endswith("_rad"):
        values = np.mod(values + np.pi, 2 * np.pi) - np.pi
    # One in a hundred is a mean of two.
    values[::100] += 0.5 * step
    assert quantisation_step(_of(values, 1, column), 0) == pytest.approx(step, rel=1e-3)


def test_a_continuous_value_has_no_step_and_nor_has_a_constant_one():
    rng = np.random.default_rng(3)
    assert quantisation_step(_of(rng.normal(size=5000)), 0) is None
    assert quantisation_step(_of(rng.uniform(size=300)), 0) is None
    assert quantisation_step(_of(np.ones(100)), 0) is None


def test_repeats_are_counted_along_streams():
    values = np.repeat(np.arange(50.0), 2)  # each reading twice
    assert repeated_share(_of(values)) == pytest.approx(50 / 99)
    assert repeated_share(_of(np.tile([1.0, 2.0], 50))) == 0.0
    # The last reading of a stream and the first of the next one are no repeat.
    assert repeated_share(_of(np.array([1.0, 2.0, 2.0, 1.0]), 2)) == 0.0


def test_a_local_line_takes_out_motion():
    times = STEP_S * np.arange(400)
    read = _of(np.concatenate([5.0 + 1.3 * times, 40.0 - 0.7 * times]), 2)
    about = about_local_line(read)[:, 0].reshape(2, 400)
    assert np.abs(about[:, 20:-20]).max() < 1e-9
    turning = _of(np.mod(1.5 * times, 2 * np.pi) - np.pi, 1, "azimuth_rad")
    assert np.abs(about_local_line(turning)[20:-20]).max() < 1e-9


def _folder(seed=4):
    """A tag on a circle, its ranges, bearings and fixes with known errors, and its truth."""
    rng = np.random.default_rng(seed)
    t = STEP_S * np.arange(600)
    place = np.stack([4 + 2 * np.cos(0.3 * t), 2 + np.sin(0.3 * t), np.full_like(t, 1.2)], axis=1)
    errors = {name: rng.normal(size=(len(t), n)) * 0.1 for name, n in (("ranges", 2), ("bearings", 2), ("fixes", 3))}
    distance = np.stack([np.sqrt(((place - a) ** 2).sum(axis=1)) for a in ANCHORS.values()], axis=1) + errors["ranges"]
    # In the station's axes x is the world's y, y the world's −x.
    x, y, z = place[:, 1] + 2.0, -(place[:, 0] - 1.0), place[:, 2] - 1.0
    angles = np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=1) + errors["bearings"]
    columns = {"t_s": t, "tag": ["T1"] * len(t)}
    tables = {
        "ranges": pl.concat(
            [
                pl.DataFrame({**columns, "anchor": [k] * len(t), "range_m": d})
                for k, d in zip(ANCHORS, distance.T, strict=True)
            ]
        ).sort("t_s", maintain_order=True),
        "bearings": pl.DataFrame(
            {**columns, "station": ["S1"] * len(t), "azimuth_rad": angles[:, 0], "elevation_rad": angles[:, 1]}
        ),
        "fixes": pl.DataFrame(
            {**columns, **dict(zip(("x_m", "y_m", "z_m"), (place + errors["fixes"]).T, strict=True))}
        ),
        "truth": pl.DataFrame({**columns, **dict(zip(("x_m", "y_m", "z_m"), place.T, strict=True))}),
    }
    rig = Rig(name="circle", anchors=ANCHORS, stations={"S1": QUARTER_TURN})
    return RecordingFolder("circle", None, rig, tables), errors


@pytest.mark.parametrize("name", ["ranges", "bearings", "fixes"])
def test_errors_are_differences_from_truth(name):
    folder, errors = _folder()
    expected = errors[name].T.reshape(-1, 1) if name == "ranges" else errors[name]
    np.testing.assert_allclose(readings(folder, name).errors, expected, atol=1e-9)


def test_check_reports_them_with_and_without_truth():
    folder, _ = _folder()
    ranges = folder.tables["ranges"].with_columns(range_m=(pl.col("range_m") / 0.25).round() * 0.25)
    folder = RecordingFolder("circle", None, folder.rig, {**folder.tables, "ranges": ranges})
    lines = [f"{found.where}: {found.message}" for found in check(folder)]
    assert any(line.startswith("ranges: quantised: range_m in steps of 0.25 m") for line in lines)
    assert any("repeated readings" in line and line.startswith("ranges") for line in lines)
    assert any(line.startswith("fixes: errors of x_m against truth") and "uncorrelated" in line for line in lines)
    blind = {name: table for name, table in folder.tables.items() if name != "truth"}
    lines = [found.message for found in check(RecordingFolder("circle", None, folder.rig, blind))]
    assert not any("against truth:" in line for line in lines)
