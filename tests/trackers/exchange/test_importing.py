"""`import` from end to end: CSV, logs and trajectories become recordings that `check` accepts, or nothing is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.in_process import assert_refused_last, trackwright
from trackwright.trackers.evaluation.rows import AXES
from trackwright.trackers.exchange.importing import found_placement
from trackwright.trackers.exchange.trajectories import write_trajectory
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.folder import read_recording, write_recording

RIG = 'format = 1\nname = "hall 3"\n[anchors]\nA1 = [0.0, 0.0, 2.0]\nA2 = [6.0, 0.0, 2.5]\n0x0F = [0.0, 5.0, 2.2]\n'
WIDE = ("t_s=t", "range_m[A1]=d1", "range_m[A2]=d2")
CSV = ("--table", "ranges", "--columns", "t_s=stamp*0.001", "range_m=distance in mm", "anchor=id", "--tag", "T1")


@pytest.fixture
def there(tmp_path, monkeypatch):
    """A folder with a CSV log in mm and ms with ids as the device prints them, and a rig; it is the current one."""
    rng = np.random.default_rng(1)
    rows = [f"{k * 100},{anchor},{rng.integers(2000, 5000)}" for k in range(20) for anchor in ("A1", "A2", "0x0F")]
    (tmp_path / "log.csv").write_text("stamp,id,distance\n" + "\n".join(rows) + "\n")
    (tmp_path / "rig.toml").write_text(RIG)
    (tmp_path / "units.csv").write_text("anchor,x,y,z\n,mm,mm,mm\nA1,0,0,2500\n")
    (tmp_path / "twice.csv").write_text("anchor,x,x_mm,y,z\nA1,0,0,0,2\n")
    (tmp_path / "wide.csv").write_text("t,d1,d2" + "".join(f"\n{t},1,2" for t in (*range(20), *np.arange(0.5, 20))))
    lines = "".join(f"{0.1 * k} {1 + 0.01 * k} 2 0.5 0 0 0 1\n" for k in range(-5, 30))
    (tmp_path / "mocap.tum").write_text(lines)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_csv_log_and_a_trajectory_become_one_recording(there):
    assert trackwright("import", "log.csv", *CSV, "--rig", "rig.toml", "--out", "hall").code == 0
    said = trackwright("import", "mocap.tum", "--table", "truth", "--tag", "T1", "--out", "hall")
    assert said.code == 0, said.err
    recording = read_recording(there / "hall")
    assert recording.name == "hall"
    assert {name: len(table) for name, table in recording.tables.items()} == {"ranges": 60, "truth": 35}
    assert recording.tables["ranges"]["anchor"].unique(maintain_order=True).to_list() == ["A1", "A2", "0x0F"]
    assert recording.tables["ranges"]["t_s"][3] == pytest.approx(0.1)
    assert recording.tables["ranges"]["range_m"].is_between(2.0, 5.0).all()
    assert "qw" not in recording.tables["truth"].columns
    assert_refused_last(trackwright("import", "log.csv", *CSV, "--out", "hall"), "has the table ranges already")


@pytest.mark.parametrize(
    ("source", "arguments", "words"),
    [
        ("log.csv", CSV, ("ranges: no positions of anchors", "by --rig")),
        ("log.csv", ("--table", "ranges"), ("needs t_s", "found 'stamp', 'id', 'distance'", "--columns")),
        ("log.csv", ("--table", "fixes", "--columns", "t_s=stamp"), ("fixes needs tag", "'distance'; give --tag ID")),
        ("log.csv", (), ("--table or --mapping",)),
        ("log.csv", ("--mapping", "dwm1001", "--table", "ranges"), ("--table or --mapping",)),
        ("log.csv", ("--mapping", "dwm1001", "--skip", "2"), ("--skip: a file of --mapping has tables",)),
        ("missing.csv", CSV, ("missing.csv", "cannot be read")),
        ("mocap.tum", ("--table", "truth"), ("truth needs tag", "give --tag ID")),
        ("log.csv", (*CSV, "--rig", "units.csv"), ("line 2 has units, left out: x mm, y mm, z mm; expected them in",)),
        ("log.csv", (*CSV, "--rig", "twice.csv"), ("'x', 'x_mm', 'y', 'z'; expected anchor, x, y, z",)),
        ("wide.csv", (*CSV[:2], "--columns", *WIDE, *CSV[-2:], "--rig", "rig.toml"), ("row 21", "the clock went back")),
        ("rig.toml", ("--table", "truth", "--tag", "T"), ("rig.toml: line 3 has 1 cell",)),
    ],
)
def test_what_is_not_understood_is_refused_and_nothing_is_written(there, source, arguments, words):
    assert_refused_last(trackwright("import", source, *arguments, "--out", "new"), *words)
    assert not (there / "new").exists()
    assert not list(there.glob(".*"))


def test_a_refused_value_is_named_by_line_and_column_of_the_users_file_in_any_part(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "anchors.csv").write_text("id;X_mm;Y_mm;Z_mm\n1.0;0;0;2500\n2.0;10000;0;400\n")
    (tmp_path / "log.csv").write_text("# x\nt,d1,d2,s\n0,1.5,2.5,1\n0.1,,9,0\n")
    columns = ("--columns", WIDE[0], "range_m[1]=d1", "range_m[2]=d2", "range_std_m=s", "--tag", "T", "--out", "hall")
    # The line of its header and the separator are the log's alone.
    how = ("--header", "2", "--separator", ",", "--rig", "anchors.csv")
    refused = trackwright("import", "log.csv", "--table", "ranges", *columns, *how)
    assert_refused_last(refused, "log.csv: row 2 (line 4), column s: 0, expected a standard deviation above zero")
    assert not (tmp_path / "hall").exists()


@pytest.mark.parametrize("given", ["anchors.csv", "site.toml"])
def test_a_truth_may_come_first_and_a_table_is_replaced_where_that_is_asked_for(tmp_path, monkeypatch, given):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "anchors.csv").write_text("id;X_mm;Y_mm;Z_mm\nA1;0;0;2500\nA2;10000;0;400\n")
    (tmp_path / "site.toml").write_text("format = 1\n[anchors]\nA1 = [0.0, 0.0, 2.5]\nA2 = [10.0, 0.0, 0.4]\n")
    (tmp_path / "truth.tum").write_text("".join(f"0.{k} {k} 0 1 0 0 0 1\n" for k in range(9)))
    (tmp_path / "log.csv").write_text("t,d1,d2\n0,1.5,2.5\n0.1,1.6,1.5\n")
    assert trackwright("import", "truth.tum", "--table", "truth", "--tag", "T", "--out", "hall").code == 0
    with (tmp_path / "hall" / "rig.toml").open("a") as rig:
        rig.write("\n[tags.T]\nheight_m = 1.2\n")
    ranges = ("import", "log.csv", "--table", "ranges", "--tag", "T", "--out", "hall", "--columns", *WIDE)
    said = trackwright(*ranges, "--rig", given)
    assert said.code == 0, said.err
    filled = read_recording(tmp_path / "hall").rig
    assert (filled.anchors["A2"].tolist(), filled.tags["T"].height) == ([10.0, 0.0, 0.4], 1.2)
    (tmp_path / "log.csv").write_text("t,d1,d2\n0,7,2.5\n")
    assert_refused_last(trackwright(*ranges), "has the table ranges already", "--replace")
    assert trackwright(*ranges, "--replace").code == 0
    assert pl.read_parquet("hall/ranges.parquet")["range_m"].to_list() == [7.0, 2.5]
    assert set(read_recording(tmp_path / "hall").tables) == {"ranges", "truth"}


@pytest.fixture
def foreign(tmp_path, monkeypatch):
    """A recording `hall` of ranges, and `mocap.tum`, its truth turned by 37°, shifted by 100 m and 0.35 s early."""
    folder = tw.simulate.ranges(n=1, rows=300, seed=4).folder()
    truth = folder.tables["truth"]
    places = (truth.select("x_m", "y_m", "z_m").to_numpy() - [100.0, -50.0, 2.0]) @ _turn(-37.0)
    own = truth.with_columns(pl.col("t_s") - 0.35, *(pl.Series(a, x) for a, x in zip(AXES, places.T, strict=True)))
    write_trajectory(own.drop(QUATERNION, strict=False), tmp_path / "mocap.tum")
    write_recording(replace(folder, tables={"ranges": folder.tables["ranges"]}), tmp_path / "hall")
    monkeypatch.chdir(tmp_path)
    return truth


def _turn(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _distances(truth):
    moved = read_recording("hall").tables["truth"]
    at = [np.interp(truth["t_s"], moved["t_s"], moved[axis]) for axis in ("x_m", "y_m")]
    return np.hypot(at[0] - truth["x_m"], at[1] - truth["y_m"])[5:-5]


TRUTH = ("import", "mocap.tum", "--table", "truth", "--tag", "0", "--out", "hall")


def test_a_truth_in_another_frame_and_on_another_clock_is_brought_over_by_the_readings(foreign):
    said = trackwright(*TRUTH, "--align-truth")
    assert said.code == 0, said.err
    assert "ranges then differ by 0.0" in said.err
    *_, z, yaw, later = (float(x) for x in said.err.partition("--transform ")[2].partition(":")[0].split(","))
    assert (yaw, later, z) == (pytest.approx(-37.0, abs=2.0), pytest.approx(0.35, abs=0.1), pytest.approx(2, abs=0.2))
    # The ranges have biases of a decimetre.
    assert _distances(foreign).max() < 0.15
    Path("hall/truth.parquet").unlink()
    assert trackwright(*TRUTH, "--transform=100,-50,2,-37,0.35").code == 0
    assert _distances(foreign).max() < 1e-3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--transform", "1,2,3"), ("--transform 1,2,3: expected X,Y,Z,YAW or X,Y,Z,YAW,S",)),
        (("--table", "fixes", "--transform", "1,2,3,4"), ("move a truth; expected --table truth",)),
        (("--tag", "9", "--align-truth"), ("no measurement at the times of the truth",)),
    ],
)
def test_a_truth_that_cannot_be_brought_over_is_refused(foreign, arguments, words):
    assert_refused_last(trackwright(*TRUTH, *arguments), *words)
    assert not Path("hall/truth.parquet").exists()


@pytest.mark.slow
def test_a_height_that_biases_of_ranges_do_not_determine_stays_as_it_is():
    folder = tw.simulate.ranges(n=1, rows=400, seed=4, hidden=0.0, bias=0.0).folder()
    longer = folder.tables["ranges"].with_columns(pl.col("range_m") + 0.04)
    found, words = found_placement(replace(folder, tables={**folder.tables, "ranges": longer}))
    assert found[2] == 0.0
    assert "z as it was" in words
