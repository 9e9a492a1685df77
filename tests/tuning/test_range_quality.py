"""The noise of ranges that follows signal quality: its fit, and what recordings left out confirm of it."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from scipy.optimize import minimize
from scipy.stats import t as student_t

from tests.tuning.calibration_worlds import ANCHORS, world
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.model.tunable import tunables
from trackwright.trackers.recordings.range_quality import RangeQuality
from trackwright.tuning.calibrating import calibrate
from trackwright.tuning.clustered_regression import DOF
from trackwright.tuning.range_quality import Errors, confirmed, fitted_scales, log_density

SLOPE, CENTRE, SPREAD = -0.4, -80.0, 5.0
POWER = RangeQuality("rss_dbm", CENTRE, SPREAD, 0.0, 0.0, 0.0)


def _errors(rng, slope=SLOPE, rows=600):
    """Errors of three anchors in pieces of 10 rows, which share a quality: its scores are dependent."""
    anchor, piece = rng.integers(0, 3, rows), np.arange(rows) // 10
    power, other = CENTRE + SPREAD * rng.normal(size=rows)[piece], rng.normal(size=rows)[piece]
    # Errors of a piece differ in size by more than their quality says.
    own = np.exp(0.3 * rng.normal(size=rows)[piece])
    sigma = np.array([0.05, 0.1, 0.2])[anchor] * np.exp(slope * (power - CENTRE) / SPREAD) * own
    error = sigma * rng.standard_t(DOF, size=rows)
    return Errors(error, anchor, np.ones(rows), piece, {"rss_dbm": power, "channel": other})


def test_scales_and_slope_are_the_most_probable_ones():
    errors = _errors(np.random.default_rng(0))
    weighted = errors._replace(weight=np.random.default_rng(1).uniform(0.5, 1.5, len(errors.error)))
    z = np.clip((errors.quality["rss_dbm"] - CENTRE) / SPREAD, -3.0, 3.0)

    def improbability(x):
        sigma = np.exp(x[errors.anchor] + x[3] * z)
        return -(weighted.weight * (student_t.logpdf(errors.error / sigma, DOF) - np.log(sigma))).sum()

    found, best = fitted_scales(weighted, POWER), minimize(improbability, np.array([-2.0, -2.0, -2.0, 0.0]))
    np.testing.assert_allclose([*found.logarithms, found.slope], best.x, atol=2e-4)
    assert log_density(weighted, found, POWER) @ weighted.weight == pytest.approx(-best.fun, rel=1e-8)


def test_standard_errors_are_those_of_errors_that_last():
    fits = [fitted_scales(_errors(np.random.default_rng(seed)), POWER) for seed in range(80)]
    standardised = [(fit.slope - SLOPE) / fit.standard_error for fit in fits]
    # Their spread over 80 data sets has a standard error of 0.08; with rows as independent ones it would be 1.8.
    assert 0.8 < np.std(standardised) < 1.25
    assert abs(np.mean(standardised)) < 0.4


def test_a_column_that_says_nothing_is_seldom_confirmed_and_the_one_that_does_always():
    def found(seed, slope):
        rng = np.random.default_rng(seed)
        halves = [_errors(rng, slope, 300) for _ in range(2)]
        columns = {name: np.concatenate([half.quality[name] for half in halves]) for name in halves[0].quality}
        whole = Errors(*(np.concatenate(x) for x in zip(*(h[:4] for h in halves), strict=True)), columns)
        return confirmed(whole._replace(piece=np.arange(600) // 10), [halves, halves[::-1]])

    assert {found(seed, SLOPE).column for seed in range(30)} == {"rss_dbm"}
    assert sum(found(seed, 0.0) is not None for seed in range(100)) < 15


def _recordings(count):
    """Walks whose ranges have errors of a scale that follows a received power, which is missing now and then."""
    rng = np.random.default_rng(5)
    for recording in world(4, recordings=count)[1]:
        truth, ranges = recording.tables["truth"], recording.tables["ranges"]
        places = np.stack([np.interp(ranges["t_s"], truth["t_s"], truth[f"{axis}_m"]) for axis in "xyz"], axis=1)
        away = np.linalg.norm(places - np.stack([ANCHORS[anchor] for anchor in ranges["anchor"]]), axis=1)
        power = CENTRE + SPREAD * rng.normal(size=len(ranges))
        errors = 0.1 * np.exp(SLOPE * (power - CENTRE) / SPREAD) * rng.standard_t(DOF, size=len(ranges))
        seen = np.where(np.abs(power - CENTRE) < 0.2, np.nan, power)
        table = ranges.with_columns(range_m=away + 0.2 + errors, rss_dbm=seen, channel=rng.random(len(ranges)))
        yield replace(
            recording, tables={**recording.tables, "ranges": table.with_columns(pl.col("rss_dbm").fill_nan(None))}
        )


@pytest.mark.parametrize("count", [1, 3])
def test_a_calibration_recovers_the_slope_of_its_world_from_one_recording_or_several(count):
    found = calibrate(list(_recordings(count))).range_quality
    assert found.column == "rss_dbm"
    assert found.gain > 0.05
    assert (found.centre, found.spread) == (pytest.approx(CENTRE, abs=0.5), pytest.approx(SPREAD, rel=0.05))
    assert abs(found.slope - SLOPE * found.spread / SPREAD) < 3.0 * found.standard_error < 0.15


def test_a_calibrated_tracker_has_the_slope_and_reads_the_quality_of_each_range():
    one, other = _recordings(2)
    calibration = calibrate(one)
    (batch,) = build("uwb", other.calibrated(calibration)).batches(other.calibrated(calibration))
    slope = tunables(batch.tracker)["sensors.ranges.quality_slope"].value
    assert slope == pytest.approx(calibration.range_quality.slope, rel=1e-6)
    quality = batch.trajectories[0].recording.readings["ranges"].reported[:, 1]
    power = other.tables["ranges"]["rss_dbm"].to_numpy()
    there = np.abs(power - calibration.range_quality.centre) < 3.0 * calibration.range_quality.spread
    expected = (power - calibration.range_quality.centre) / calibration.range_quality.spread
    np.testing.assert_allclose(quality[there], expected[there], rtol=1e-6)
    assert (quality[np.isnan(power)] == 0.0).all()
    assert np.abs(quality).max() == 3.0
    bare = replace(other, tables={**other.tables, "ranges": other.tables["ranges"].drop("rss_dbm")})
    assert "no column 'rss_dbm', which their noise follows" in bare.calibrated(calibration).notices[-1]
