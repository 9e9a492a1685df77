"""The ratio of lasting residuals against a loop in NumPy, and its statement."""

import dataclasses

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.residuals import residual_ratios
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.trackers.evaluation.statements import LASTING


@pytest.fixture(scope="module")
def clear():
    return tw.simulate.ranges(n=3, rows=600, seed=4, hidden=0.0).folder()


@pytest.fixture(scope="module")
def obstructed(clear):
    return _obstructed(clear)


def _obstructed(folder, longer=3.0):
    """The same ranges, those to one anchor too long by `longer` m for half a minute."""
    anchor = next(iter(folder.rig.anchors))
    behind = (pl.col("anchor") == anchor) & pl.col("t_s").is_between(20.0, 50.0)
    ranges = folder.tables["ranges"].with_columns(
        range_m=pl.col("range_m") + pl.when(behind).then(longer).otherwise(0.0)
    )
    return dataclasses.replace(folder, tables={**folder.tables, "ranges": ranges})


def _by_hand(tracks, folder):
    """The ratio from the tables alone, without the mean bias that the sensor subtracts: the median removes it."""
    residuals, blocks = [], []
    for (tag,), rows in folder.tables["ranges"].drop_nulls().group_by("tag", maintain_order=True):
        own = tracks.to_polars().filter(pl.col("tag") == tag).drop_nulls("x_m")
        first = rows["t_s"].min()
        for t, anchor, value in rows.select("t_s", "anchor", "range_m").iter_rows():
            place = [np.interp(t, own["t_s"], own[f"{axis}_m"]) for axis in "xyz"]
            residuals.append(value - np.linalg.norm(place - folder.rig.anchors[anchor]))
            blocks.append((tag, anchor, (t - first) // 5.0))
    about = np.array(residuals) - np.median(residuals)
    groups = {}
    for block, value in zip(blocks, about, strict=True):
        groups.setdefault(block, []).append(value)
    means = [np.mean(values) for values in groups.values() if len(values) >= 3]
    return np.sqrt(np.mean(np.square(means))) / (1.4826 * np.median(np.abs(about)))


def test_means_over_5_s_of_an_obstructed_anchor_are_larger_than_most_residuals(clear, obstructed):
    tracker = tw.build("uwb", clear)
    found = {}
    for name, folder in (("clear", clear), ("obstructed", obstructed)):
        tracks = tracker.run(folder)
        found[name] = tw.evaluate(tracks, folder)
        ratio = found[name]["residual_ratio_5s"]
        # Times of the table and of the rows differ by rounding, so that a reading may change its block.
        assert ratio == pytest.approx(_by_hand(tracks, folder), rel=0.02)
    assert found["clear"]["residual_ratio_5s"] < 1.1
    assert found["obstructed"]["residual_ratio_5s"] > LASTING
    assert not [s for s in found["clear"].statements if "last:" in s]
    assert [s for s in found["obstructed"].statements if "Residuals of some stations or anchors last:" in s]


OWN_MODEL = {"motion.sigma_bias": 1e-3, "start.sigma_bias": 1e-3, "start.sigma_shared": 1e-3,
             "sensors.ranges.sigma_r": 0.052, "sensors.ranges.positive_skew": 1.0, "sensors.ranges.dof": 1e3,
             "sensors.ranges.bias": np.zeros(8)}  # fmt: skip
"""Levels of `uwb` for ranges with white noise of 5 cm and no bias; a few millimetres are the path's."""


@pytest.mark.parametrize(
    ("noise", "bias", "words"),
    [
        (0.05, 0.0, "The innovations are as the tracker's model expects (NIS/dof "),
        (0.1, 0.0, "The readings scatter 1.8 times as much as the model expects, the model's noise is too small: NIS"),
        (0.05, 0.1, "The model is biased, its noise is not too small: "),
        (0.1, 0.02, "The readings scatter 1.8 times as much as the model expects, the model's noise is too small: NIS"),
    ],
)
def test_without_truth_noise_that_is_too_small_is_told_from_a_bias(noise, bias, words):
    folder = tw.simulate.ranges(n=3, rows=600, seed=4, hidden=0.0, lost=0.0, sigma_r=noise, bias=bias).folder()
    tracks = tw.build("uwb", folder).with_values(OWN_MODEL, "the test").run(folder)
    (sentence,) = Evaluation.of(scored_rows(tracks.to_polars(), {}), residual_ratios(tracks)).statements
    assert sentence.startswith(words)


def test_a_difference_counts_for_both_its_anchors():
    clear = tw.simulate.tdoa(n=1, rows=1600, seed=4, hidden=0.0, schedule="turns").folder()
    # In a ring each anchor comes first and second: signs cancel where pairs are not told apart.
    late, t = sorted(clear.rig.anchors)[2], pl.col("t_s")
    sign = (pl.col("anchor") == late).cast(float) - (pl.col("anchor_2") == late).cast(float)
    table = clear.tables["tdoa"].with_columns(
        range_difference_m=pl.col("range_difference_m") + 1.5 * sign * t.is_between(t.max() / 3, 2 * t.max() / 3)
    )
    wrong = dataclasses.replace(clear, tables={**clear.tables, "tdoa": table})
    ratios = [tw.evaluate(tw.build("tdoa", f).run(f), f)["residual_ratio_5s"] for f in (clear, wrong)]
    assert ratios[0] < 1.1 < LASTING < ratios[1]


@pytest.mark.slow
def test_only_ranges_of_a_tag_itself_count_on_a_body_of_several():
    clear = tw.simulate.body(n=1, rows=600, seed=4, tags=3, bias=0.0, hidden=0.0, sigma_r=0.05).folder()
    folders = clear, _obstructed(clear, 1.0)
    ratios = [tw.evaluate(tw.build("body", f).run(f), f)["residual_ratio_5s"] for f in folders]
    assert ratios[0] < 0.5
    assert ratios[1] > LASTING


@pytest.mark.slow
def test_ranges_are_told_apart_by_their_anchors_beside_bearings():
    folder = _obstructed(tw.simulate.fusion(n=3, rows=600, seed=4, hidden=0.0, bias_angle=0.0).folder())
    tracks = tw.build("fusion", folder).run(folder)
    # Those of the angles do not last.
    assert residual_ratios(tracks)[folder.name][0] == pytest.approx(_by_hand(tracks, folder), rel=0.02)
