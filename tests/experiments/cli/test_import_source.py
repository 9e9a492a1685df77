"""`import` from end to end: CSV, logs and trajectories become recordings that `check` accepts, or nothing is written."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.in_process import assert_refused, trackwright
from trackers.recordings.folder import read_recording

RIG = 'format = 1\nname = "hall 3"\n[anchors]\nA1 = [0.0, 0.0, 2.0]\nA2 = [6.0, 0.0, 2.5]\n0x0F = [0.0, 5.0, 2.2]\n'
CSV = ("--table", "ranges", "--columns", "t_s=stamp*0.001", "range_m=distance in mm", "anchor=id", "--tag", "T1")


@pytest.fixture
def there(tmp_path, monkeypatch):
    """A folder with a CSV log in mm and ms with ids as the device prints them, and a rig; it is the current one."""
    rng = np.random.default_rng(1)
    rows = [f"{k * 100},{anchor},{rng.integers(2000, 5000)}" for k in range(20) for anchor in ("A1", "A2", "0x0F")]
    (tmp_path / "log.csv").write_text("stamp,id,distance\n" + "\n".join(rows) + "\n")
    (tmp_path / "rig.toml").write_text(RIG)
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
    _refused_last(trackwright("import", "log.csv", *CSV, "--out", "hall"), "has the table ranges already")


def _refused_last(said, *words):
    """As `assert_refused`, after the notices that name the format."""
    assert_refused(said._replace(err=said.err.splitlines()[-1] + "\n"), *words)


def test_other_separators_and_mappings_from_a_file(there):
    text = (there / "log.csv").read_text().replace(",", ";")
    (there / "log.csv").write_text(text)
    (there / "map.toml").write_text(
        '[[tables]]\ntable = "ranges"\nseparator = ";"\n'
        'columns = { t_s = "stamp in ms", range_m = "distance in mm", anchor = "id" }\n'
    )
    said = trackwright("import", "log.csv", "--mapping", "map.toml", "--tag", "T1", "--rig", "rig.toml", "--out", "a")
    assert said.code == 0, said.err
    assert len(pl.read_parquet("a/ranges.parquet")) == 60


def test_a_log_of_a_kit_brings_its_anchors(there):
    line = "1151[5.00,8.00,2.25]=6.48 0CA8[0.00,8.00,2.25]=6.51 111C[5.00,0.00,2.25]=3.18 est[2.57,1.98,1.68,100]"
    (there / "tag.log").write_text("".join(f"12:00:0{k}.5 {line}\n" for k in range(5)))
    said = trackwright("import", "tag.log", "--tag", "C5", "--out", "kit")
    assert said.code == 0, said.err
    assert "read as dwm1001" in said.err
    recording = read_recording(there / "kit")
    assert recording.rig.anchors["0CA8"].tolist() == [0.0, 8.0, 2.25]
    assert {name: len(table) for name, table in recording.tables.items()} == {"ranges": 15, "fixes": 5}


def test_a_log_in_milliseconds_takes_a_unit_and_no_other_column(there):
    line = "POS,2.57,2.00,1.67,97"
    (there / "tag.log").write_text(f"1500 {line}\n2500 {line}\n")
    said = trackwright("import", "tag.log", "--tag", "C5", "--columns", "t_s=time in ms", "--out", "kit")
    assert said.code == 0, said.err
    assert pl.read_parquet("kit/fixes.parquet")["t_s"].to_list() == [1.5, 2.5]
    for arguments, words in ((("--table", "ranges"), "leave --table"), (("--columns", "x_m=time"), "has one column")):
        _refused_last(trackwright("import", "tag.log", "--tag", "C5", *arguments, "--out", "new"), words)


@pytest.mark.parametrize(
    ("source", "arguments", "words"),
    [
        ("log.csv", CSV, ("ranges: anchor 'A1', 'A2', '0x0F' without a position", "--rig")),
        ("log.csv", ("--table", "ranges"), ("needs t_s", "found 'stamp', 'id', 'distance'", "--columns")),
        ("log.csv", (), ("no table given", "--table")),
        ("log.csv", ("--columns", "range_m=distance"), ("--columns without --table",)),
        ("log.csv", ("--mapping", "map.toml", "--table", "ranges"), ("one or the other",)),
        ("missing.csv", CSV, ("missing.csv", "cannot be read")),
        ("mocap.tum", ("--table", "truth"), ("do not name the tag",)),
        ("mocap.tum", ("--table", "ranges", "--tag", "T"), ("truth or fixes",)),
        ("rig.toml", ("--table", "truth", "--tag", "T"), ("no trajectory format",)),
    ],
)
def test_what_is_not_understood_is_refused_and_nothing_is_written(there, source, arguments, words):
    _refused_last(trackwright("import", source, *arguments, "--out", "new"), *words)
    assert not (there / "new").exists()
    assert not list(there.glob(".*"))


def test_a_bad_value_is_named_by_the_line_of_its_source(there):
    lines = (there / "log.csv").read_text().splitlines()
    lines[7] = lines[7].replace(",", ",x", 2)
    (there / "log.csv").write_text("\n".join(lines) + "\n")
    said = trackwright("import", "log.csv", *CSV, "--rig", "rig.toml", "--out", "new")
    _refused_last(said, "log.csv: row 7 (line 8), column distance", "expected a number")
