"""Trackers by name on recording folders, and the same rows from arrays."""

from __future__ import annotations

import dataclasses
import sys

import jax
import numpy as np
import polars as pl
import pytest

import trackwright as tw


@pytest.fixture(scope="module")
def folders():
    return [dataclasses.replace(tw.simulate.agv(n=2, seed=k, rows=40).folder(), name=f"agv {k}") for k in range(2)]


@pytest.fixture(scope="module")
def tracker(folders):
    return tw.build("fix-kf", folders)


def test_one_recording_or_several_run_by_name_and_give_a_table_of_all_tags(tracker, folders):
    tracks = tracker.run(folders)
    assert tracks.summaries == {"ok": 4}
    assert tracks.to_polars().select("recording", "tag").n_unique() == 4
    alone = tracker.run(folders[0]).table
    # Bit-identical: batches of two and of four trajectories run in chunks of one shape.
    assert tracks.table.filter(pl.col("recording") == "agv 0").drop("recording").equals(alone.drop("recording"))


def test_values_reach_the_tracker_of_every_recording(tracker, folders):
    louder = tracker.with_values({"sensors.fixes.sigma_*": 0.7})
    for batch in louder.batches(folders):
        assert float(tw.tunables(batch.tracker)["sensors.fixes.sigma_horizontal"].value) == pytest.approx(0.7)
    assert float(tracker.tunables["sensors.fixes.sigma_horizontal"].value) != pytest.approx(0.7)
    with pytest.raises(tw.UnusableInput, match=r"mine: this tracker has no 'sensors\.x'"):
        tracker.with_values({"sensors.x": 1.0}, "mine")


def test_smoothing_lowers_the_error_and_a_lag_is_positive(tracker, folders):
    filtered, smoothed = (tw.evaluate(t.run(folders), folders)["rmse_m"] for t in (tracker, tracker.smoothing()))
    assert smoothed < filtered
    with pytest.raises(tw.UnusableInput, match="lag -1: expected seconds above zero"):
        tracker.smoothing(-1)
    with pytest.raises(tw.UnusableInput, match="cannot be smoothed"):
        tw.build("moving-average", folders).smoothing()


@pytest.mark.slow
def test_a_fit_by_name_returns_the_tracker_by_name_with_other_values(tracker, folders):
    level = "sensors.fixes.sigma_horizontal"
    result = tw.fit(tracker, folders[0], "nll", tune=level, options=tw.FitOptions(steps=3, held_out=folders[1]))
    assert result.value <= result.start_value
    assert float(result.tracker.tunables[level].value) == pytest.approx(float(result.values[level]))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            "trajectories=lambda folder, free_height: folder.tables['fix']",
            "trajectories failed (KeyError in line 4: 'f",
        ),
        ("trajectories=lambda folder: []", "trajectories failed (TypeError: <lambda>() takes 1 positional argument"),
        ("planar=lambda trajectory, free_height: trajectory.hight", "planar failed (AttributeError in line 4: "),
        ("build=lambda trajectory, planar: {}[planar]", "build failed (KeyError in line 4: "),
        ("build=lambda t, planar: tw.uwb_imu.range_tracker(3)", "found readings of fixes; expected 'ranges'"),
        ("build=lambda t, p: dataclasses.replace(F.build(t, p), motion=None)", "run failed (AttributeError"),
    ],
)
def test_a_tracker_of_ones_own_that_fails_is_refused_in_one_line(folders, tmp_path, monkeypatch, changed, words):
    monkeypatch.setattr(sys, "path", list(sys.path))
    lines = ["import dataclasses", "import trackwright as tw", "F = tw.TRACKERS['fix-kf']"]
    (tmp_path / "mine.py").write_text("\n".join([*lines, f"OWN = dataclasses.replace(F, {changed})"]), "utf-8")
    with pytest.raises(tw.UnusableInput) as refused:
        tw.build(f"{tmp_path / 'mine.py'}:OWN", folders).run(folders)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_a_tracker_by_name_lists_its_tunables_and_filters_a_folder_as_a_pure_function():
    folder = tw.simulate.ranges(n=2, rows=40, seed=1).folder()
    named = tw.build("uwb", folder)
    assert tw.tunables(named).keys() == named.tunables.keys() != set()
    (batch,) = named.batches(folder)
    rows = tw.stack([trajectory.recording for trajectory in batch.trajectories])
    jax.tree.map(np.testing.assert_array_equal, tw.stack(folder, tracker=named), rows)
    found, expected = tw.filter_batch(named, folder), tw.filter_batch(batch.tracker, rows)
    for one, other in zip(found.mean.position, expected.mean.position, strict=True):
        np.testing.assert_array_equal(one, other)
