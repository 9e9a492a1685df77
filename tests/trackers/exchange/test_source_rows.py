"""Tables in text as people have them: each kind of file against the numbers that were written into it."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.in_process import assert_refused_last, trackwright
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.estimates import read_estimates
from trackwright.trackers.exchange.expressions import columns_of
from trackwright.trackers.exchange.mapping import TableMapping, mapped_table
from trackwright.trackers.exchange.pose_errors import compare_trajectories
from trackwright.trackers.exchange.source_rows import Reading, read_json, read_rows
from trackwright.trackers.exchange.trajectories import PoseTrajectory, read_trajectory
from trackwright.trackers.recordings.folder import read_recording

WIDE = ("t_s=t", "range_m[A1]=d1", "range_m[A2]=d2")
ROWS = [(0.0, "T", "A1", 1.5), (0.0, "T", "A2", 2.5), (0.1, "T", "A1", 1.6), (0.1, "T", "A2", 1234.5)]


def _ranges(path, reading, columns=WIDE):
    rows, notices = read_json(path, reading, None, False) if path.suffix == ".jsonl" else read_rows(path, reading)
    table, more = mapped_table(rows, TableMapping("ranges", columns_of(columns), tag="T"))
    return table.rows(), [*notices, *more]


def _numbered(first=1):
    return ("t_s=column1", f"range_m[A1]=column{first + 1}", f"range_m[A2]=column{first + 2}")


@pytest.mark.parametrize(
    ("text", "how", "columns", "said"),
    [
        ("0,1.5,2.5\n0.1,1.6,1234.5\n", {"header": "none"}, _numbered(), ""),
        ("0,9,1.5,2.5\n0.1,9,1.6,1234.5,7\n", {"header": "none"}, _numbered(2), "1 row with fewer than 5 cells"),
        ("log of 5 May\n\nt,d1,d2\n0,1.5,2.5\n0.1,1.6,1234.5\n", {"header": "3"}, WIDE, ""),
        ("a,b\nc\nt,d1,d2\n0,1.5,2.5\n0.1,1.6,1234.5\n", {"skip": 2}, WIDE, ""),
        ("# UWB, 6\n# v2\n\nt,d1,d2\n0,1.5,2.5\n# lost\n0.1,1.6,1234.5\n", {}, WIDE, "3 lines of comments left out: 1, 2, 6"),
        ("# t,d1,d2\n0,1.5,2.5\n0.1,1.6,1234.5\n", {}, WIDE, "line 1 is the header"),
        ("%t,d1,d2\n0,1.5,2.5\n0.1,1.6,1234.5\n", {}, ("t_s=%t", *WIDE[1:]), "line 1 is the header"),
        ("t,d1,d2\ns,[m],(m)\n0,1.5,2.5\n0.1,1.6,1234.5\n", {}, WIDE, "line 2 has units, left out: t s, d1 [m], d2 (m)"),
        ("\td1\td2\n0\t1.5\t2.5\n0.1\t1.6\t1234.5\n", {}, ("t_s=column1", *WIDE[1:]), r"separated by '\t'"),
        ("sep=;\nt;d1;d2\n0;1,5;2,5\n0,1;1,6;1234,5\n", {"decimal": ","}, WIDE, "separated by ';'"),
        ("  t   d1  d2\n 0  1.5   2.5 \n0.1   1.6  1234.5\n", {}, WIDE, "separated by ' '"),
        ("t;d1;d2\n0;1.5;2.5\n0.1;1.6;1,234.5\n", {"thousands": ","}, WIDE, ""),
        ('t,d1,d2\n0,"1.5",2.5\n0.1,1.6,"1\'234.5"\n', {"thousands": "'"}, WIDE, ""),
        ("t;d1;d2\n0;1,5;2,5\n0,1;1,6;1.234,5\n", {"thousands": ".", "decimal": ","}, WIDE, ""),
        ("t,d1,d2,d3\n0,1.5,2.5,N/A\n0.1,1.6,1234.5,-999\n", {"missing": ("N/A", "-999")}, (*WIDE, "range_m[A3]=d3"),
         "2 cells with N/A, -999 read as missing"),
        ("t,d1,d2\n0,1.5,2.5,\n0.1,1.6,1234.5,\n", {}, WIDE, ""),
    ],
)  # fmt: skip
def test_a_table_in_text_is_read_as_it_was_written_and_a_line_says_what_was_left_out(
    tmp_path, text, how, columns, said
):
    path = tmp_path / "log.csv"
    path.write_text(text)
    rows, notices = _ranges(path, Reading(**how), columns)
    assert sorted(rows) == ROWS
    assert said in " ".join(notices)


@pytest.mark.parametrize(("encoding", "named"), [("cp1252", "cp1252"), ("utf-16", ""), ("utf-16-le", "utf-16-le")])
def test_texts_of_windows_are_read_by_their_mark_or_their_name(tmp_path, encoding, named):
    path = tmp_path / "log.csv"
    path.write_bytes("t;Länge;d2\r\n0;1.5;2.5\r\n0.1;1.6;1234.5\r\n".encode(encoding))
    rows, _ = _ranges(path, Reading(encoding=named), ("t_s=t", "range_m[A1]=Länge", "range_m[A2]=d2"))
    assert sorted(rows) == ROWS
    if named:
        with pytest.raises(UnusableInput, match="--encoding"):
            read_rows(path, Reading())


@pytest.mark.parametrize(
    ("expression", "header", "cells", "expected"),
    [
        ("secs+nsecs*1e-9", "secs,nsecs", ["1777904000,0", "1777904000,500000000"], [1777904000.0, 1777904000.5]),
        ("date+time in dd.mm.yyyy", "date,time", ["04.05.2026,14:13:20", "04.05.2026,14:13:20.5"], [1777904000.0, 1777904000.5]),
        ("when in dd-mmm-yyyy", "when,x", ["04-May-2026 14:13:20,0", "04-may-2026 14:13:20.5,0"], [1777904000.0, 1777904000.5]),
        ("when in hh:mm:ss", "when,x", ["23:59:59.5,0", "00:00:00.25,0"], [86399.5, 86400.25]),
        ("when in matlab", "when,x", ["740106.5,0", "740106.75,0"], [20577.5 * 86400, 20577.75 * 86400]),
        ("day+part in excel", "day,part", ["46146,0.5", "46146,0.75"], [20577.5 * 86400, 20577.75 * 86400]),
        ("a+b", "a+b,a", ["1,5", "2,5"], [1.0, 2.0]),
    ],
)  # fmt: skip
def test_a_time_is_read_from_two_columns_a_clock_or_days(tmp_path, expression, header, cells, expected):
    path = tmp_path / "log.csv"
    path.write_text(f"{header},d1\n" + "".join(f"{line},1.5\n" for line in cells))
    rows, _ = _ranges(path, Reading(), (f"t_s={expression}", "range_m[A1]=d1"))
    np.testing.assert_allclose([row[0] for row in rows], expected, atol=1e-6, rtol=0)


def test_json_lines_of_kits_are_rows_for_each_element_or_key(tmp_path):
    path = tmp_path / "tag.jsonl"
    path.write_text(
        '0 {"links": [{"A": "A1", "R": "1.5"}, {"A": "A2", "R": "2.5"}]}\n{"state": "lost"}\n'
        '0.1 -> {"links": [{"A": "A1", "R": 1.6}, {"A": "A2", "R": 1234.5}], "battery": [3, 4, 5]}\n'
    )
    assert sorted(_ranges(path, Reading(), ("t_s=time", "anchor=links[].A", "range_m=links[].R"))[0]) == ROWS
    path.write_text('{"t":0,"UWB":{"A1":1.5,"A2":2.5}}\n{"t":0.1,"UWB":{"A1":1.6,"A2":1234.5}}\n')
    assert sorted(_ranges(path, Reading(), ("t_s=t", "range_m[{a}]=UWB.{a}"))[0]) == ROWS
    path.write_text('{"t":0}\n{"t":\n')
    with pytest.raises(UnusableInput, match="line 2: .*--skip-bad-lines"):
        read_json(path, Reading(), None, False)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,1.5,2.5\n1,2,3\n", "line 1 is '0,1.5,2.5', without names of columns; .*--header none"),
        ("log\nt,d1,d2\n0,1,2\n", "line 2 has 3 cells, expected 1 as in line 1, the header.*--header LINE"),
        ("t,d1,d1\n0,1,2\n", "'d1' is duplicated in line 1.*--header none --skip 1"),
        ("t,d1,d2\n\n0,1,N/A\n", r"row 1 \(line 3\), column d2: 'N/A'.*--missing=N/A"),
        ("t;d1;d2\n0;1;1,234.5\n", "line 2.*--thousands ','"),
        ("t,d1,d2\n12:00:01,1,2\n", "line 2.*'t_s=t in hh:mm:ss'"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_line_and_the_option_that_reads_it(tmp_path, text, words):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(UnusableInput, match=words):
        _ranges(path, Reading())


def test_a_refused_value_is_named_by_line_and_column_of_the_users_file_in_any_part(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "anchors.csv").write_text("id;X_mm;Y_mm;Z_mm\nA1;0;0;2500\nA2;10000;0;400\n")
    (tmp_path / "log.csv").write_text("# x\nt,d1,d2,s\n0,1.5,2.5,1\n0.1,,9,0\n")
    columns = ("--columns", *WIDE, "range_std_m=s", "--tag", "T", "--rig", "anchors.csv", "--out", "hall")
    refused = trackwright("import", "log.csv", "--table", "ranges", *columns)
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


@pytest.mark.parametrize("align", ["se2", "se3", "sim3", "scale"])
@pytest.mark.parametrize("shaking", [0.0, 1e-3])
def test_a_tag_at_rest_is_aligned_by_none_or_origin_alone(align, shaking):
    rng, times = np.random.default_rng(3), np.arange(200) * 0.1
    truth = PoseTrajectory(times, [3.0, 2.0, 1.0] + shaking * rng.normal(size=(200, 3)), None, "truth")
    own = PoseTrajectory(times, truth.positions + 0.05 * rng.normal(size=(200, 3)), None, "own")
    with pytest.raises(UnusableInput, match="do not move with it.*use --align none, or origin"):
        compare_trajectories(own, truth, align)
    assert compare_trajectories(own, truth, "origin").pairs == 200


@pytest.mark.parametrize(("digits", "words"), [(-3, "40 poses, one time"), (0, "40 poses, 5 times")])
def test_stamps_that_have_lost_their_digits_are_refused_in_poses_and_in_tables_for_each_tag(tmp_path, digits, words):
    path, stamps = tmp_path / "own.tum", [round(1604644000 + 0.1 * k, digits) for k in range(40)]
    path.write_text("".join(f"{t} {k} 0 1 0 0 0 1\n" for k, t in enumerate(stamps)))
    with pytest.raises(UnusableInput, match=words):
        read_trajectory(path)
    table = pl.DataFrame({"t_s": stamps, "tag": "T1", "x_m": 1.0, "y_m": 2.0})
    table.write_csv(tmp_path / "own.csv")
    with pytest.raises(UnusableInput, match=words):
        read_estimates(tmp_path / "own.csv")
    table.with_columns(tag=pl.Series([f"T{k}" for k in range(40)])).write_csv(tmp_path / "own.csv")
    assert len(read_estimates(tmp_path / "own.csv")[0]) == 40
