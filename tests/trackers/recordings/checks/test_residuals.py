"""Bias, slope, delay and outliers of readings against truth are those with which the readings were made."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from scipy.stats import spearmanr

from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.checks.all_checks import check
from trackwright.trackers.recordings.checks.compared import compared, robust_fit
from trackwright.trackers.recordings.checks.residuals import residuals
from trackwright.trackers.recordings.folder import RecordingFolder

ANCHORS = {
    "A": np.array([0.0, 0.0, 3.0]),
    "B": np.array([8.0, 1.0, 2.0]),
    "C": np.array([7.0, 7.0, 3.0]),
    "D": np.array([-1.0, 6.0, 2.0]),
}
BIAS, SLOPE, DELAY, OUTLIERS, SIGMA = 0.2, 0.03, 0.3, 0.04, 0.02


def _position(t):
    return np.stack([3 + 2.5 * np.cos(0.5 * t), 3 + 2 * np.sin(0.8 * t), np.full_like(t, 1.0)], axis=-1)


def _walk(wrong: str = "A") -> RecordingFolder:
    """Ranges of a walk to four anchors, those of `wrong` with a bias, a slope, a delay and outliers."""
    rng, times, rows = np.random.default_rng(2), 0.1 * np.arange(600), []
    for anchor, place in ANCHORS.items():
        late = DELAY if anchor == wrong else 0.0
        distance = np.linalg.norm(_position(times - late) - place, axis=1)
        value = distance + rng.normal(0, SIGMA, len(times))
        if anchor == wrong:
            value += BIAS + SLOPE * (distance - distance.mean())
            value[rng.random(len(times)) < OUTLIERS] += 4.0
        rows.append(pl.DataFrame({"t_s": times, "tag": "T", "anchor": anchor, "range_m": value}))
    fine = 0.02 * np.arange(-100, 3200)
    truth = pl.DataFrame({"t_s": fine, "tag": "T"} | dict(zip(("x_m", "y_m", "z_m"), _position(fine).T, strict=True)))
    return RecordingFolder("walk", None, Rig("walk", ANCHORS), {"ranges": pl.concat(rows).sort("t_s"), "truth": truth})


def test_what_one_anchor_does_wrong_is_found_and_the_others_are_clean():
    found = {one.group: one for one in residuals(compared(_walk(), "ranges"))}
    wrong = found.pop("A")
    assert wrong.bias == pytest.approx(BIAS, abs=0.06)
    assert wrong.slope == pytest.approx(SLOPE, rel=0.25)
    assert wrong.delay == pytest.approx(DELAY, rel=0.1)
    assert wrong.outliers == pytest.approx(OUTLIERS, abs=0.02)
    for one in found.values():
        assert one.bias == pytest.approx(0.0, abs=0.005)
        assert one.spread == pytest.approx(SIGMA, rel=0.2)
        assert math.isnan(one.delay)
        assert one.outliers < 0.01


def test_each_column_of_quality_has_a_line_that_says_how_errors_go_with_it():
    walk = _walk()
    ranges, truth = walk.tables["ranges"], walk.tables["truth"]
    rng = np.random.default_rng(5)
    power, flat = rng.normal(-80.0, 5.0, len(ranges)), np.where(np.arange(len(ranges)) < 5, 1.0, np.nan)
    places = np.stack([np.interp(ranges["t_s"], truth["t_s"], truth[f"{axis}_m"]) for axis in "xyz"], axis=1)
    away = np.linalg.norm(places - np.stack([ANCHORS[anchor] for anchor in ranges["anchor"]]), axis=1)
    errors = 0.1 * rng.normal(size=len(ranges)) * np.exp(-0.05 * (power + 80.0)) + 0.004 * (power + 80.0)
    table = ranges.with_columns(range_m=away + errors, rss_dbm=power, few=flat)
    lines = [
        r.message for r in check(replace(walk, tables={"ranges": table, "truth": truth})) if "quarter" in r.message
    ]
    medians = table.select(pl.lit(pl.Series(errors)).median().over("anchor")).to_series().to_numpy()
    e, (low, high) = errors - medians, np.quantile(power, [0.25, 0.75])
    size, signed = (spearmanr(power, x).statistic for x in (np.abs(e), e))
    quarters = [np.quantile(np.abs(e[part]), 0.6827) for part in (power <= low, power >= high)]
    assert size < -0.15 < 0.1 < signed
    assert lines == [
        f"rss_dbm and errors against truth less the median of each anchor: range_m rank correlation {size:+.2f} (size), "
        f"{signed:+.2f} (with sign), 68th percentile of the size {quarters[0]:.2g} m in the lowest quarter, "
        f"{quarters[1]:.2g} m in the highest"
    ]


def test_the_check_prints_a_line_for_each_anchor_and_calls_none_of_it_a_mistake():
    results = check(_walk())
    lines = [result.message for result in results if result.message.startswith("anchor") and "bias" in result.message]
    assert len(lines) == 4
    assert lines[0].startswith("anchor A against truth: bias +0.2")
    assert "late by 0.3" in lines[0]
    assert not [result for result in results if result.level == "error"]


def test_a_robust_fit_ignores_a_fifth_of_wild_errors():
    rng, true = np.random.default_rng(0), np.array([1.0, -2.0])
    x = rng.uniform(-3, 3, 400)
    y = true[0] * x + true[1] + rng.normal(0, 0.05, 400)
    y[rng.random(400) < 0.2] += 30.0
    found, size = robust_fit(lambda p: (p[0] * x + p[1] - y)[:, None], np.zeros(2))
    assert found == pytest.approx(true, abs=0.03)
    assert size < 0.06
