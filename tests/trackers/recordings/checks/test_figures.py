"""The figures of checks are those with which the readings were made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import (
    AXES,
    differences,
    hall,
    height,
    only,
    tool,
    with_anchors,
    with_columns,
)
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.exchange.importing import moved_truth
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.checks.compared import compared, moments, robust_fit
from trackwright.trackers.recordings.checks.imu import between, check_imu, imu_rows, true_attitude
from trackwright.trackers.recordings.checks.readings import Readings, autocorrelation, quantisation_step, repeated_share
from trackwright.trackers.recordings.checks.residuals import residuals
from trackwright.trackers.recordings.checks.rules import check_rows
from trackwright.trackers.recordings.folder import RecordingFolder

STEP_S, T = 0.1, pl.col("t_s")


def _of(values, streams=1, column="range_m"):
    """Readings of so many streams of equal times."""
    number = np.repeat(np.arange(streams), len(values) // streams)
    times = np.tile(STEP_S * np.arange(len(values) // streams), streams)
    return Readings((column,), number, times, values[:, None], np.full((len(values), 1), np.nan))


def _gauss_markov(tau, rows=3000, streams=4):
    """Errors of unit variance, exp(−t/τ) correlated."""
    rng, kept = np.random.default_rng(0), np.exp(-STEP_S / tau) if tau else 0.0
    x = rng.normal(size=(rows, streams))
    for k in range(1, rows):
        x[k] = kept * x[k - 1] + np.sqrt(1 - kept**2) * x[k]
    return _of(x.T.ravel(), streams)


@pytest.mark.parametrize("tau", [0.0, 0.5, 1.5, 4.0])
def test_the_correlation_time_of_errors_is_found_along_streams(tau):
    read = _gauss_markov(tau)
    # The offset between two streams is no correlation.
    sigma, interval, time = autocorrelation(read, 0.3 * read.values[:, 0] + 5.0 * read.stream)
    assert (sigma, interval) == (pytest.approx(0.3, rel=0.1), pytest.approx(STEP_S))
    assert time == pytest.approx(tau, rel=0.2)
    wild = np.where(np.random.default_rng(1).random(len(read.times)) < 0.02, 50.0, 0.0)
    assert autocorrelation(read, read.values[:, 0] + wild)[2] >= tau / 2
    assert autocorrelation(_of(np.ones(200)), np.ones(200)) is None


@pytest.mark.parametrize(("step", "column"), [(0.01, "range_m"), (np.deg2rad(2.0), "azimuth_rad"), (0.0078, "x_m")])
def test_a_quantisation_step_is_found(step, column):
    rng = np.random.default_rng(2)
    values = step * np.round((3 + 0.5 * np.sin(0.01 * np.arange(2000)) + 2 * step * rng.normal(size=2000)) / step)
    values = np.mod(values + np.pi, 2 * np.pi) - np.pi if column.endswith("_rad") else values
    values[::100] += 0.5 * step  # one in a hundred is a mean of two
    assert quantisation_step(_of(values, 1, column), 0) == pytest.approx(step, rel=1e-3)
    for continuous in (rng.normal(size=5000), rng.uniform(size=300), np.ones(100)):
        assert quantisation_step(_of(continuous), 0) is None


def test_repeats_are_counted_along_streams():
    assert repeated_share(_of(np.repeat(np.arange(50.0), 2))) == pytest.approx(50 / 99)
    assert repeated_share(_of(np.array([1.0, 2.0, 2.0, 1.0]), 2)) == 0.0


def test_bias_slope_delay_and_outliers_of_one_anchor_are_found_and_the_others_are_clean():
    rng, t, rows = np.random.default_rng(2), 0.1 * np.arange(600), []
    places = {"A": (0.0, 0.0, 3.0), "B": (8.0, 1.0, 2.0), "C": (7.0, 7.0, 3.0), "D": (-1.0, 6.0, 2.0)}
    at = lambda t: np.stack([3 + 2.5 * np.cos(0.5 * t), 3 + 2 * np.sin(0.8 * t), np.ones_like(t)], axis=1)  # noqa: E731
    for anchor, place in places.items():
        distance = np.linalg.norm(at(t - 0.3 * (anchor == "A")) - place, axis=1)
        value = distance + rng.normal(0, 0.02, len(t))
        value += (anchor == "A") * (0.2 + 0.03 * (distance - distance.mean()) + 4.0 * (rng.random(len(t)) < 0.04))
        rows.append(pl.DataFrame({"t_s": t, "tag": "T", "anchor": anchor, "range_m": value}))
    fine = 0.02 * np.arange(-100, 3200)
    truth = pl.DataFrame({"t_s": fine, "tag": "T"} | dict(zip(AXES, at(fine).T, strict=True)))
    rig = replace(hall().rig, anchors={key: np.array(place) for key, place in places.items()}, stations={}, tags={})
    walk = replace(hall(), rig=rig, tables={"ranges": pl.concat(rows).sort("t_s"), "truth": truth})
    found = residuals(compared(walk, "ranges"))
    figures = dict(zip(found._fields, (one[:, 0] for one in found), strict=True))
    for name, value, within in (
        ("bias", 0.2, 0.06),
        ("slope", 0.03, 0.01),
        ("delay", 0.3, 0.03),
        ("outliers", 0.04, 0.02),
    ):
        assert figures[name][0] == pytest.approx(value, abs=within), name
    np.testing.assert_allclose(figures["bias"][1:], 0.0, atol=0.005)
    np.testing.assert_allclose(figures["spread"][1:], 0.02, rtol=0.2)
    assert np.isnan(figures["delay"][1:]).all()
    (line,) = [one.message for one in check(walk) if one.message.startswith("anchor A against truth")]
    assert "bias +0.2" in line
    assert "late by 0.3" in line
    assert quick_check(walk) == []


@pytest.mark.parametrize("schedule", ["messages", "turns"])
def test_biases_of_differences_are_those_of_anchors_whichever_is_the_first(schedule):
    late, folder = {"A1": 0.3, "A3": -0.4, "A4": 0.1, "A7": 0.2, "A8": -0.1}, differences(schedule)
    one, other = (pl.col(c).cast(pl.String).replace_strict(late, default=0.0) for c in ("anchor", "anchor_2"))
    view = compared(with_columns("tdoa", pl.col("range_difference_m") + one - other)(folder), "tdoa")
    found = dict(zip(view.ids, residuals(view).bias[:, 0], strict=True))
    assert np.isnan(residuals(view.of_rows(view.group < 2)).delay[2:]).all()  # too few of their own
    # The median of the biases is zero, as none of theirs is seen.
    assert found == pytest.approx({anchor: late.get(anchor, 0.0) for anchor in folder.rig.anchors}, abs=0.03)


def test_a_robust_fit_ignores_a_fifth_of_wild_errors():
    rng, true = np.random.default_rng(0), np.array([1.0, -2.0])
    x = rng.uniform(-3, 3, 400)
    y = true[0] * x + true[1] + rng.normal(0, 0.05, 400) + 30.0 * (rng.random(400) < 0.2)
    found, size = robust_fit(lambda p: (p[0] * x + p[1] - y)[:, None], np.zeros(2))
    assert found == pytest.approx(true, abs=0.03)
    assert size < 0.06


@pytest.mark.parametrize("turn", [(0.8, 0.6), (1.0, 0.0)])
def test_a_truth_in_another_frame_and_late_is_named_with_the_numbers_that_bring_it_over(turn):
    x, y, (c, s) = pl.col("x_m"), pl.col("y_m"), turn
    moved = with_columns("truth", x_m=c * x - s * y + 50.0, y_m=s * x + c * y, t_s=T + 0.35)
    folder = moved(only("ranges", "truth")(hall()))
    (error,) = quick_check(folder)
    transform = error.message.rpartition(" ")[2]
    assert float(transform.split(",")[4]) == pytest.approx(-0.35, abs=0.02)
    truth, _ = moved_truth(folder.tables["truth"], folder, transform)
    assert quick_check(replace(folder, tables={**folder.tables, "truth": truth})) == []


def test_a_truth_somewhat_late_is_a_warning_with_the_option_that_shifts_it_and_late_fixes_are_none():
    for table, late in (("ranges", 0.35), ("ranges", -0.25), ("bearings", 0.35)):
        (warning,) = quick_check(with_columns("truth", t_s=T + late)(only(table, "truth")(hall())))
        assert (warning.level, warning.where) == ("warning", table)
        assert float(warning.message.rpartition(",")[2]) == pytest.approx(-late, abs=0.03)
    truth = hall().tables["truth"]
    for late, levels in ((0.4, []), (-0.4, ["warning"])):  # fixes come late by the delay of their filter
        fixes = truth.with_columns(t_s=T + late)
        assert [one.level for one in quick_check(replace(hall(), tables={"fixes": fixes, "truth": truth}))] == levels


def test_a_wrong_place_of_an_anchor_is_corrected_to_the_side_on_which_rig_toml_has_it():
    (error,) = quick_check(with_anchors(lambda _: {"A4": np.array([12.0, 3.0, 2.7])})(hall()))
    place = [float(x) for x in error.message.partition("at (")[2].partition(")")[0].split(",")]
    np.testing.assert_allclose(place, hall().rig.anchors["A4"], atol=0.4)


@pytest.mark.parametrize("table", ["ranges", "bearings"])
def test_exact_readings_of_a_moment_close_to_zero(table):
    view = moments(height(None)(only(table)(hall())), table)
    truth = hall().tables["truth"].select(AXES).to_numpy()[:: len(hall().tables["truth"]) // len(view.heights)]
    exact = view._replace(values=view.kind.values_at(truth[view.moment], view.sensors))
    assert exact.closing() < 2e-3
    assert moments(with_anchors(lambda anchors: dict.fromkeys(anchors, np.ones(3)))(hall()), "ranges") is None


def test_gaps_of_differences_are_those_of_the_tag_whichever_anchors_it_hears():
    pair, folder = pl.struct("anchor", "anchor_2").rank("dense"), differences()
    in_turn = folder.tables["tdoa"].filter(pair % 3 == (T // 2) % 3)
    late = in_turn.with_columns(pl.when(T > 10).then(T + 7).otherwise("t_s"))
    gaps = [
        [one.message for one in check_rows(folder.rig, {"tdoa": x}) if "gaps" in one.message] for x in (in_turn, late)
    ]
    assert gaps[0] == []
    assert gaps[1][0].startswith("gaps longer than 1 s: 1, the longest 7.1 s before t_s 17.1 (tag ")


@pytest.mark.parametrize(("metres", "least"), [(None, 5), (1.0, 4)])
def test_too_few_anchors_for_differences_are_named(metres, least):
    heard = [f"A{k + 1}" for k in range(least - 1)]
    few = differences().tables["tdoa"].filter(pl.col("anchor").is_in(heard) & pl.col("anchor_2").is_in(heard))
    rig = replace(differences().rig, tags={tag: Tag(height=metres) for tag in few["tag"].unique()})
    messages = [result.message for result in check(replace(differences(), rig=rig, tables={"tdoa": few}))]
    assert f"anchors observed: {least - 1}, expected {least} or more for a position" in messages


def test_rates_of_the_true_attitude_are_those_of_a_steady_turn_and_no_window_lies_across_a_gap():
    t, rate = 0.05 * np.arange(40), np.array([0.3, -0.5, 0.8])
    half, axis = np.linalg.norm(rate) * t / 2, rate / np.linalg.norm(rate)
    q = {"qw": np.cos(half)} | {name: x * np.sin(half) for name, x in zip(("qx", "qy", "qz"), axis, strict=True)}
    _, found = true_attitude(pl.DataFrame({"t_s": t, "tag": "T"} | q)).rates()
    np.testing.assert_allclose(found, np.tile(rate, (len(found), 1)), atol=1e-9)
    t = np.concatenate([0.1 * np.arange(20), 5 + 0.1 * np.arange(20)])
    columns = [f"{name}_{axis}_{unit}" for name, unit in (("accel", "mps2"), ("gyro", "radps")) for axis in "xyz"]
    rows = imu_rows(pl.DataFrame({"t_s": t, "tag": "T"} | dict.fromkeys(columns, 2.0)), "T")
    turned = between(rows.times, rows.turned, np.array([0.5, 1.5, 5.5]), np.array([1.0, 5.5, 6.0]))
    np.testing.assert_allclose(turned, [[1.0] * 3, [np.nan] * 3, [1.0] * 3])


def test_a_row_of_another_clock_costs_no_memory():
    for name in ("imu", "truth"):
        table = tool().tables[name]
        far = pl.concat([table, table.tail(1).with_columns(T + 1e14)])
        assert [*check_imu(replace(tool(), tables=tool().tables | {name: far}))] == []


@pytest.mark.parametrize("pair", [("A1", "A2"), ("A3", "A4"), ("A1", "A4"), ("A2", "A3")])
def test_exchanged_ids_in_a_symmetric_hall_are_named_with_the_other_pair(pair):
    corners = {f"A{k + 1}": np.array([x, y, 2.5]) for k, (x, y) in enumerate(((0, 0), (10, 0), (10, 8), (0, 8)))}
    times, rng = np.arange(0, 40, 0.1), np.random.default_rng(1)
    path = np.stack([5 + 3 * np.cos(times / 4), 4 + 2.5 * np.sin(times / 4), np.full(len(times), 1.2)], axis=1)
    swap = {pair[0]: pair[1], pair[1]: pair[0]}
    rows = [
        (t, "T1", swap.get(name, name), np.linalg.norm(p - corner) + rng.normal(0, 0.06))
        for t, p in zip(times.tolist(), path, strict=True)
        for name, corner in corners.items()
    ]
    ranges = pl.DataFrame(rows, schema=["t_s", "tag", "anchor", "range_m"], orient="row")
    rig = Rig("hall", anchors=corners, tags={"T1": Tag(1.2)})
    (found,) = (one for one in check(RecordingFolder("hall", None, rig, {"ranges": ranges})) if one.level == "error")
    other = next(two for two in (("A3", "A4"), ("A1", "A2"), ("A2", "A3"), ("A1", "A4")) if not {*two} & {*pair})
    assert all(f"anchors {a} and {b} swapped" in found.message for a, b in (pair, other))
