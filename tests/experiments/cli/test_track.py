"""`track` and `evaluate` from end to end: parts, values, smoothing, several trackers, files and exit codes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.broken import BROKEN
from tests.faulty import good_tables, with_table, write_good
from tests.in_process import PLAIN, assert_refused, trackwright
from trackwright.sim import worlds
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.folder import Selection, read_recording, write_recording

BEARINGS = ("station", "azimuth_rad", "elevation_rad", "std_azimuth_rad", "std_elevation_rad")


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Two tags among four anchors, 6 s of ranges."""
    path = tmp_path_factory.mktemp("track") / "room"
    write_recording(worlds.ranges(n=2, seed=5, rows=60).folder(), path)
    return path


@pytest.fixture(scope="module")
def vehicles(tmp_path_factory):
    """Six vehicles with position fixes, and the run of their Kalman filter; what was said, and both folders."""
    there = tmp_path_factory.mktemp("vehicles")
    write_recording(worlds.agv(n=6, seed=3, rows=40).folder(), there / "vehicles")
    run = ("track", there / "vehicles", "--tracker", "fix-kf", "--figures", "png", "--out", there / "run")
    return trackwright(*run), there / "vehicles", there / "run"


def _tracks(folder):
    return pl.read_parquet(folder / "tracks.parquet")


def _overall(folder, *options):
    said = trackwright("evaluate", folder, "--json", *options)
    assert said.code == 0, said
    return json.loads(said.out)["overall"]


def _pictures(folder):
    assert all(file.read_bytes().startswith(b"\x89PNG\r\n\x1a\n") for file in folder.glob("*.png"))
    return {file.stem for file in folder.glob("*.png")}


def test_a_run_folder_has_tables_metrics_figures_a_page_and_a_manifest(vehicles):
    said, read, folder = vehicles
    assert said.code == 0, said
    assert {"floor-plan", "error-cdf", "nees-over-time", "nis-over-time", "coverage"} <= _pictures(folder)
    assert said.out.splitlines()[0] == "6 tracks: 6 ok"
    assert said.out.splitlines()[-1].startswith(f"wrote {folder / 'tracks.parquet'} (240 estimates), ")
    assert f"{len(_pictures(folder))} figures" in said.out.splitlines()[-1]
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (manifest["tracker"], manifest["seed"], manifest["command"][1]) == ("fix-kf", 0, "track")
    assert {"trackwright", "jax", "python"} <= manifest["versions"].keys()
    assert (folder / "recordings.txt").read_text() == f"{read.resolve()}\n"
    assert not [p.name for p in folder.iterdir() if p.name.startswith(".")]
    again = trackwright("evaluate", folder)
    assert (again.code, again.err) == (0, "")
    assert again.out in said.out
    kept = json.loads((folder / "evaluation.json").read_text())
    assert kept["overall"] == _overall(folder)
    assert len(kept["tracks"]) == 6


def test_without_truth_tracks_are_written_but_not_evaluated(vehicles, tmp_path):
    _, read, folder = vehicles
    shutil.copytree(read, tmp_path / "blind")
    (tmp_path / "blind" / "truth.parquet").unlink()
    options = ("--tracker", "fix-kf", "--figures", "png")
    said = trackwright("track", tmp_path / "blind", *options, "--out", tmp_path / "run")
    assert said.code == 0
    assert "errors in" not in said.out
    assert "Without truth: " in said.out
    assert _pictures(tmp_path / "run") == {"floor-plan", "nis-over-time"}
    assert _tracks(tmp_path / "run").equals(_tracks(folder))
    assert_refused(trackwright("evaluate", tmp_path / "run"), "blind", "no truth table")
    assert _overall(tmp_path / "run", "--truth", read) == _overall(folder)


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), pytest.param(("--free-height",), marks=pytest.mark.slow)])
def test_bearings_of_a_walk_are_tracked_at_the_known_height_or_estimate_it(tmp_path, options):
    folder = worlds.fusion(n=1, seed=8, rows=28, stations=4, sigma_angle=0.03, bias_angle=0.0, lost=0.0).folder()
    height = folder.tables["truth"]["z_m"][0]
    tables = {name: folder.tables[name] for name in ("bearings", "truth")}
    write_recording(replace(folder, rig=replace(folder.rig, tags={"0": Tag(height)}), tables=tables), tmp_path / "room")
    said = trackwright("track", tmp_path / "room", *options, *PLAIN, "--out", tmp_path / "out")
    assert "tracker: bearings (" in said.err
    tracks, metrics = _tracks(tmp_path / "out"), _overall(tmp_path / "out")
    assert tracks.height == 28  # four stations at once: one estimate for each time
    assert ((tracks["z_m"] == height) & (tracks["std_z_m"] == 0)).all() == (not options)
    assert ("3-D RMSE" in " ".join(said.out.split())) <= bool(options), "a given height is not the tracker's"
    # The defaults expect stations with biases of 0.2 rad, which these have not.
    assert metrics["rmse_m"] < 0.3


@pytest.mark.slow
def test_a_part_of_a_recording_is_tracked_and_of_estimates_evaluated(room, tmp_path):
    part = ("--tag", "1", "--from", 1, "--to", 4)
    done = trackwright("track", room, *PLAIN, "--tracker", "uwb", *part, "--out", tmp_path / "part")
    assert done.code == 0, done
    tracks = _tracks(tmp_path / "part")
    assert set(tracks["tag"]) == {"1"}
    assert 1 <= tracks["t_s"].min() < 1.2
    assert 3.8 < tracks["t_s"].max() <= 4
    assert trackwright("track", room, *PLAIN, "--tracker", "uwb", "--out", tmp_path / "whole").code == 0
    later = _tracks(tmp_path / "whole").filter((pl.col("tag") == "0") & (pl.col("t_s") >= 2))
    assert _overall(tmp_path / "whole", "--tag", "0", "--from", "2")["n_rows"] == later.height


def test_seconds_after_the_start_are_refused_where_times_count_from_1970(room):
    folder = read_recording(room)
    tables = {name: table.with_columns(pl.col("t_s") + 1777898800.0) for name, table in folder.tables.items()}
    with pytest.raises(UnusableInput, match="3 s is long before them; 3 s after the start is 1777898803"):
        Selection(start=3.0).of(replace(folder, tables=tables))


def test_a_value_set_is_that_of_a_noise_file_and_goes_before_it(room, tmp_path):
    (tmp_path / "noise.toml").write_text('tracker = "multilateration"\n[tunables."sigma_r"]\nvalue = 0.3\n')
    by_file = ("--noise", tmp_path / "noise.toml")
    for name, options in {
        "file": by_file, "set": ("--tracker", "multilateration", "--set", "sigma_*=0.3"),
        "both": (*by_file, "--set", "sigma_r=0.01"),
    }.items():  # fmt: skip
        said = trackwright("track", room, *PLAIN, *options, "--out", tmp_path / name)
        assert said.code == 0, said
    assert json.loads((tmp_path / "file" / "manifest.json").read_text())["tracker"] == "multilateration"
    assert _tracks(tmp_path / "file").equals(_tracks(tmp_path / "set"))
    assert not _tracks(tmp_path / "both").equals(_tracks(tmp_path / "set"))


@pytest.mark.slow
def test_smoothed_tracks_have_the_rows_columns_and_likelihoods_of_filtered_ones(beginnings, tmp_path):
    found = {}
    for name, options in {"filtered": (), "smoothed": ("--smooth",), "lagged": ("--lag", 0.5)}.items():
        line = ("track", beginnings / "good", "--tracker", "fix-kf", *options, *PLAIN, "--out", tmp_path / name)
        assert trackwright(*line).code == 0
        found[name] = _tracks(tmp_path / name)
    filtered = found["filtered"]
    for name in ("smoothed", "lagged"):
        for column in ("t_s", "tag", "nis", "log_likelihood", "status"):
            assert found[name][column].equals(filtered[column])
        assert filtered["std_x_m"].mean() > found[name]["std_x_m"].mean()


def test_runs_are_compared_in_one_table_with_paired_differences(tmp_path):
    write_good(tmp_path / "good")
    for name in ("moving-average", "median"):
        options = ("--tracker", name, *PLAIN, "--out", tmp_path / name)
        assert trackwright("track", tmp_path / "good", *options).code == 0
        found = json.loads((tmp_path / name / "evaluation.json").read_text())
        both = (
            _tracks(tmp_path / name).drop_nulls("x_m").join(good_tables()["truth"], on=["tag", "t_s"], suffix="_true")
        )
        errors = both.select(both["x_m"] - both["x_m_true"], both["y_m"] - both["y_m_true"]).to_numpy()
        assert found["overall"]["rmse_m"] == pytest.approx(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    said = trackwright("evaluate", tmp_path / "median", tmp_path / "moving-average", "--out", tmp_path / "all")
    assert said.code == 0, said
    assert "Differences from median" in said.out
    assert "adjusted for" in said.out
    assert [line.split()[0] for line in said.out.splitlines() if " RMSE, " in line] == ["moving-average"]
    # The distribution of errors, their boxes, and a floor plan by each tracker.
    assert (tmp_path / "all" / "comparison.html").read_text().count('<div class="chart">') == 2


@pytest.mark.slow
def test_recordings_that_cannot_be_read_or_lack_what_the_tracker_reads_cost_their_own_line(tmp_path):
    for name, kept in (("ranged", "ranges"), ("moved", "imu")):
        write_good(tmp_path / name)
        rig = tmp_path / name / "rig.toml"
        rig.write_text(rig.read_text().replace('name = "good"', f'name = "{name}"').split("[path]")[0])
        for table in (tmp_path / name).glob("*.csv"):
            if table.stem not in (kept, "truth"):
                table.unlink()
    word = BROKEN["infinite value"](tmp_path / "bad")
    paths = [tmp_path / name for name in ("ranged", "moved", "bad")]
    said = trackwright("track", *paths, "--out", tmp_path / "out", *PLAIN)
    assert said.code == 3, said
    lines = [line for line in said.err.splitlines() if line.startswith("not tracked: ")]
    assert word in lines[0]
    assert f"{tmp_path / 'moved'}: tracker 'uwb' needs" in lines[1]
    content = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert [one["recording"] for one in content["recordings"]] == ["ranged"]


def test_a_recording_without_a_value_is_tracked(tmp_path):
    write_good(tmp_path / "empty")
    good_tables()["phases"].with_columns(pl.col("^phase_.*$") * None).write_csv(tmp_path / "empty" / "phases.csv")
    said = trackwright("track", tmp_path / "empty", "--tracker", "das", "--out", tmp_path / "none")
    assert said.code == 0, said
    assert "4 tracks: 4 too little data" in said.out
    assert "notice: not evaluated: " in said.err
    assert _tracks(tmp_path / "none")["azimuth_rad"].null_count() == 200


@pytest.mark.parametrize("tracker", ["uwb", "multilateration"])
def test_negative_ranges_and_kilometres_are_reported_and_move_no_track(tmp_path, tracker):
    row = pl.int_range(pl.len())
    spoiled = pl.when(row % 20 == 7).then(-3.0).when(row % 20 == 13).then(4321.0).otherwise(pl.col("range_m"))
    with_table("ranges", lambda t: t.with_columns(range_m=spoiled))(tmp_path / "recording")
    said = trackwright("track", tmp_path / "recording", "--tracker", tracker, *PLAIN, "--out", tmp_path / "out")
    assert "ranges: negative values of range_m: 20" in said.err
    assert "ranges: outliers of range_m" in said.err
    both = _tracks(tmp_path / "out").filter(tag="T1").join(good_tables()["truth"], on=["tag", "t_s"], suffix="_true")
    errors = np.hypot(both["x_m"] - both["x_m_true"], both["y_m"] - both["y_m_true"]).drop_nulls().to_numpy()
    # Four anchors, 3 cm of noise, a tag at 1 m/s; a row with one outlier of four ranges is the worst.
    assert len(errors) > 40
    assert np.sqrt(np.mean(errors[10:] ** 2)) < 0.3
    assert errors.max() < 2.0
