"""Averaged tables have one row per tag, sensor and interval, with the mean of its readings at the mean of their times."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.faulty import write_good
from trackwright.trackers.recordings.folder import averaged, read_recording


def _ranges(seed=0, rows=400):
    rng = np.random.default_rng(seed)
    return pl.DataFrame(
        {
            "t_s": np.sort(rng.uniform(0, 20, rows)),
            "tag": rng.choice(["T1", "T2"], rows),
            "anchor": rng.choice(["A1", "A2", "A3"], rows),
            "range_m": rng.uniform(1, 9, rows),
            "range_std_m": rng.uniform(0.1, 0.3, rows),
        }
    ).with_columns(range_m=pl.when(pl.col("t_s") > 19).then(None).otherwise(pl.col("range_m")))


def test_ranges_are_means_of_each_tag_anchor_and_interval():
    table = _ranges()
    found = averaged(table, "ranges", 0.5)
    assert found.columns == table.columns
    assert found["t_s"].is_sorted()
    groups: dict[tuple, list[dict]] = {}
    for row in table.drop_nulls("range_m").iter_rows(named=True):
        groups.setdefault((row["tag"], row["anchor"], int(row["t_s"] // 0.5)), []).append(row)
    assert len(found) == len(groups)
    for row in found.iter_rows(named=True):
        own = groups[row["tag"], row["anchor"], int(row["t_s"] // 0.5)]
        assert row["t_s"] == pytest.approx(np.mean([r["t_s"] for r in own]))
        assert row["range_m"] == pytest.approx(np.mean([r["range_m"] for r in own]))
        assert row["range_std_m"] == pytest.approx(np.sqrt(np.mean([r["range_std_m"] ** 2 for r in own])))


def test_the_mean_of_angles_is_their_direction_and_leaves_out_missing_ones():
    columns = {"t_s": [0.1, 0.2, 0.3, 1.1], "tag": "T1", "station": "S1"}
    angles = {"azimuth_rad": [3.1, -3.1, None, 0.5], "elevation_rad": [0.1, 0.3, 0.2, None]}
    found = averaged(pl.DataFrame(columns | angles), "bearings", 1.0)
    assert found["azimuth_rad"].to_list() == [pytest.approx(np.pi), 0.5]
    assert found["elevation_rad"].to_list() == [pytest.approx(0.2, abs=1e-3), None]
    assert found["t_s"].to_list() == [pytest.approx(0.2), 1.1]


def test_a_recording_is_averaged_but_for_truth_phases_and_imu(tmp_path):
    write_good(tmp_path / "good")
    folder = read_recording(tmp_path / "good")
    found = folder.averaged(0.35)
    for name, table in folder.tables.items():
        if name in ("ranges", "bearings", "fixes"):
            assert len(found.tables[name]) < 0.5 * len(table)
        else:
            assert found.tables[name].equals(table)
    for wrong in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="expected a time above zero"):
            folder.averaged(wrong)


def test_bearings_are_averaged_by_the_tracker_unless_the_recording_has_its_interval(tmp_path):
    write_good(tmp_path / "good")
    folder = read_recording(tmp_path / "good")
    assert len(folder.rows("bearings", 0.5).times) == len(averaged(folder.tables["bearings"], "bearings", 0.5))
    assert len(folder.averaged(0.0).rows("bearings", 0.5).times) == len(folder.tables["bearings"])
    found = folder.averaged(0.3)
    assert len(found.rows("bearings", 0.5).times) == len(found.tables["bearings"]) < len(folder.tables["bearings"])
