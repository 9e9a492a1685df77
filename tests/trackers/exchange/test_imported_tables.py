"""Files as people have them: each against the rows that were written into it, and each mistake with its words."""

from __future__ import annotations

import gzip
import re
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pandas as pd
import polars as pl
import pytest

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.importing import format_of, import_frames, read_source
from trackwright.trackers.exchange.mapping import ORIGIN, PRESETS, TableMapping, read_mapping
from trackwright.trackers.exchange.text_tables import columns_of

RIG = Rig("room", {"A1": np.array([0.0, 0, 2]), "A2": np.array([4.0, 0, 2]), "7": np.array([0.0, 4, 2])})
WIDE = ("t_s=t", "range_m[A1]=d1", "range_m[A2]=d2")
ROWS = [(0.0, "T", "A1", 1.5), (0.0, "T", "A2", 2.5), (0.1, "T", "A1", 1.6), (0.1, "T", "A2", 1234.5)]
BODY = "0,1.5,2.5\n0.1,1.6,1234.5\n"
NOON = datetime(2026, 5, 4, 14, 13, 20, tzinfo=UTC).timestamp()


def _read(path, columns=WIDE, table="ranges", tag="T", **how):
    """The rows of a file by table, and what was noticed."""
    mapping = TableMapping(table=table, columns=columns_of(columns), tag=tag, **how)
    source = read_source(path, format_of(path), [mapping])
    return {n: t.drop(ORIGIN, strict=False).rows() for n, t in source.tables.items()}, " ".join(source.notices)


def _column(*numbers):
    return ("t_s=column1", *(f"range_m[A{k}]=column{n}" for k, n in enumerate(numbers, 1)))


@pytest.mark.parametrize(
    ("text", "how", "columns", "said"),
    [
        (BODY, {"header": "none"}, _column(2, 3), ""),
        ("0,9,1.5,2.5\n0.1,9,1.6,1234.5,7\n", {"header": "none"}, _column(3, 4), "1 row with fewer than 5 cells"),
        (f"log of 5 May\n\nt,d1,d2\n{BODY}", {"header": "3"}, WIDE, ""),
        ("# UWB, 6\n# v2\n\nt,d1,d2\n0,1.5,2.5\n# lost\n0.1,1.6,1234.5\n", {}, WIDE, "3 lines of comments left out: 1, 2, 6"),
        (f"# t,d1,d2\n{BODY}", {"header": 1}, ("t_s=# t", *WIDE[1:]), ""),
        (f"t,d1,d2\ns,[m],(m)\n{BODY}", {}, WIDE, "line 2 has units, left out: t s, d1 m, d2 m"),
        ("\td1\td2\n0\t1.5\t2.5\n0.1\t1.6\t1234.5\n", {}, ("t_s=column1", *WIDE[1:]), r"separated by '\t'"),
        ("sep=;\nt;d1;d2\n0;1,5;2,5\n0,1;1,6;1234,5\n", {"decimal": ","}, WIDE, "separated by ';'"),
        ("  t   d1  d2\n 0  1.5   2.5 \n0.1   1.6  1234.5\n", {}, WIDE, "separated by ' '"),
        ("t;d1;d2\n0;1.5;2.5\n0.1;1.6;1,234.5\n", {"thousands": ","}, WIDE, ""),
        ('t,d1,d2,say\n0,"1.5",2.5,"a, b\nc"\n0.1,1.6,"1\'234.5",\n', {"thousands": "'"}, WIDE, "columns not used: say"),
        ('t,d1,d2,"a\nb"\n0,1.5,2.5,\n0.1,1.6,1234.5,\n', {}, WIDE, "columns not used: a"),
        ("t;d1;d2\n0;1,5;2,5\n0,1;1,6;1.234,5\n", {"thousands": ".", "decimal": ","}, WIDE, ""),
        ("t,d1,d2,d3\n0,1.5,2.5,N/A\n0.1,1.6,1234.5,-999\n", {"missing": ["N/A", "-999"]}, (*WIDE, "range_m[A3]=d3"),
         "2 cells with N/A, -999 read as missing"),
        ("t;a;d\n0;A1;1,5\n0;A2;2,5\n0,1;A1;1,6\n0,1;A2;1234,5\n0,2;A1;-1,0\n0,2;A2;-1\n", {"missing": ["-1"], "decimal": ","},
         ("t_s=t", "anchor=a", "range_m=d"), "2 cells with -1 read as missing"),
        ("t,d1,d2\n0,1.5,2.5\nt,d1, d2\n0.1,1.6,1234.5\nt,d1,d2\n", {}, WIDE, "2 lines with the header again left out: 3, 5"),
        ("t,d1,d2\r0,1.5,2.5\r\n0.1,1.6,1234.5".encode("utf-16"), {}, WIDE, ""),
        ("t,d1,d2\n0,1.5,2.5\n0.1,1.6,1234.5".encode("utf-16-le"), {"encoding": "utf-16-le"}, WIDE, ""),
        ("t;Länge;d2\n0;1.5;2.5\n0.1;1.6;1234.5\n".encode("cp1252"), {"encoding": "cp1252"}, ("t_s=t", "range_m[A1]=Länge", WIDE[2]), ""),
        ("t,d1,d2,ok\n0,1.5,2.5,1.0\n0,9,9,\n0.1,1.6,1234.5,1.00\n0,9,9,2\n", {"where": {"ok": [1]}}, WIDE, "2 rows left out"),
        ("t\td1\td2\n0\t1500\t2500\n0.1\t1600\t1234500\n", {}, ("t_s=t", "range_m[A1]=d1 in mm", "range_m[A2]=d2*0.001"), ""),
    ],
)  # fmt: skip
def test_a_table_in_text_is_read_as_it_was_written_and_a_line_says_what_was_left_out(
    tmp_path, text, how, columns, said
):
    (tmp_path / "log.txt").write_bytes(text if isinstance(text, bytes) else text.encode())
    tables, notices = _read(tmp_path / "log.txt", columns, **how)
    assert sorted(tables["ranges"]) == ROWS
    assert said in notices


@pytest.mark.parametrize(
    ("text", "columns", "said"),
    [
        ('0 {"links": [{"A": "A1", "R": "1.5"}, {"A": "A2", "R": "2.5"}]}\n{"state": "lost"}\n'
         '0.1 -> {"links": [{"A": "A1", "R": 1.6}, {"A": "A2", "R": 1234.5}], "battery": [3, 4, 5]}\n',
         ("t_s=time", "anchor=links[].A", "range_m=links[].R"), ""),
        ('[\n{"t":0,"UWB":{"A1":1.5,"A2":2.5}},\n{"t":0.1,"UWB":{"A1":1.6,"A2":1234.5}}\n', ("t_s=t", "range_m[A1]=UWB.A1", "range_m[A2]=UWB.A2"), ": 1"),
        ('{"log": [{\n"A1":1.5,"A2":2.5,"t":0},\n{"A1":1.6,"A2":1234.5,"t":0.1}]}', ("t_s=log[].t", "range_m[A1]=log[].A1", "range_m[A2]=log[].A2"), ""),
        ('[{"A1":1.5,"A2":2.5},{"A1":1.6,"A2":1234.5}]', ("t_s=line*0.1", "range_m[A1]=A1", "range_m[A2]=A2"), ""),
        ('{"A1":1.5,"A2":2.5}\n{"A\nboot 3\n{"A1":1.6,"A2":1234.5}', ("t_s=line*0.1", "range_m[A1]=A1", "range_m[A2]=A2"),
         "2 lines without values left out: 2, 3"),
    ],
)  # fmt: skip
def test_json_lines_of_kits_are_rows_for_each_element_or_key(tmp_path, text, columns, said):
    (tmp_path / "tag.jsonl.gz").write_bytes(gzip.compress(text.encode()))
    tables, notices = _read(tmp_path / "tag.jsonl.gz", columns)
    assert sorted(tables["ranges"]) == ROWS
    assert said in notices


@pytest.mark.parametrize(
    ("expression", "header", "cells", "expected"),
    [
        ("secs+nsecs*1e-9", "secs,nsecs", ["1777904000,0", "1777904000,500000000"], [NOON, NOON + 0.5]),
        ("date+time in dd.mm.yyyy", "date,time", ["04.05.2026,14:13:20", "04.05.2026,14:13:20.5"], [NOON, NOON + 0.5]),
        ("date+time - 7200 in iso", "date,time", ["2026-05-04,16:13:20", "2026-05-04,16:13:20.5"], [NOON, NOON + 0.5]),
        ("when + 86400.5 in hh:mm:ss", "when,x", ["00:00:01,0", "00:00:02,0"], [86401.5, 86402.5]),
        ("when in dd-mmm-yyyy", "when,x", ["04-May-2026 14:13:20,0", "04-may-2026 14:13:20.5,0"], [NOON, NOON + 0.5]),
        ("when in hh:mm:ss", "when,x", ["23:59:59.5,0", "00:00:00.25,0", "23:59:59.75,0"], [86399.5, 86400.25, 86399.75]),
        ("when in matlab", "when,x", ["740106.5,0", "740106.75,0"], [20577.5 * 86400, 20577.75 * 86400]),
        ("day+part in excel", "day,part", ["46146,0.5", "46146,0.75"], [20577.5 * 86400, 20577.75 * 86400]),
        ("a+b", "a+b,a", ["1,5", "2,5"], [1.0, 2.0]),
        ("`a-1` in ms", "a-1,a", ["1000,5", "2000,5"], [1.0, 2.0]),
        ("`t_ms`", "t_ms,a", ["1,5", "2,5"], [1.0, 2.0]),
        ("when in mm/dd/yyyy", "when,x", ["05/04/2026 14:13:20.000,0"] * 2, [NOON] * 2),
        ("when in dd-mm-yyyy", "when,x", ["04-05-2026T16:13:20+02:00,0"] * 2, [NOON] * 2),
        ("when in iso", "when,x", ["2026-05-04T14:13:20.000000000Z,0"] * 2, [NOON] * 2),
    ],
)  # fmt: skip
def test_a_time_is_read_from_two_columns_a_clock_a_date_or_days(tmp_path, expression, header, cells, expected):
    path = tmp_path / "log.csv"
    path.write_text(f"{header},d1\n" + "".join(f"{line},1.5\n" for line in cells))
    tables, _ = _read(path, (f"t_s={expression}", "range_m[A1]=d1"))
    np.testing.assert_allclose([row[0] for row in tables["ranges"]], expected, atol=1e-6, rtol=0)


def test_marks_of_missing_values_that_a_parquet_file_does_not_have_are_named(tmp_path):
    pl.DataFrame({"t": [0.0, 1.0], "d1": [1.5, -1.0]}).write_parquet(tmp_path / "log.parquet")
    assert "--missing is not used" in _read(tmp_path / "log.parquet", WIDE[:2], missing=["-1"])[1]


def test_a_column_for_each_anchor_or_pair_becomes_a_row_for_each(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text("time,d1,d2,power,note\n0.1,1000,2000,-70,x\n0.2,,2100,-71,y\n")
    columns = ["t_s=time", "range_m[A1]=d1 in mm", "range_m[A2]=d2 in mm", "rss_dbm=power"]
    tables, notices = _read(path, columns)
    assert tables["ranges"] == [(0.1, "T", "A1", 1.0, -70), (0.1, "T", "A2", 2.0, -70), (0.2, "T", "A2", 2.1, -71)]
    assert notices == "ranges: 1 row without a value left out ranges: columns not used: note"
    path.write_text("t_s,d21,d71,s\n0.1,1.0,2.0,0.3\n0.2,,2.5,\n")
    columns = ["range_difference_m[A2,A1]=d21", "range_difference_m[7, A1]=d71", "range_difference_std_m[7, A1]=s"]
    rows = [(t, *row) for t, _, *row in _read(path, columns, "tdoa")[0]["tdoa"]]
    assert rows == [(0.1, "A2", "A1", 1.0, None), (0.1, "7", "A1", 2.0, 0.3), (0.2, "7", "A1", 2.5, None)]


# Output of the DWM1001's shell, commands les, lec and lep, as public code quotes it.
LES = (
    "1151[5.00,8.00,2.25]=6.48 0CA8[0.00,8.00,2.25]=6.51 111C[5.00,0.00,2.25]=3.18 1150[0.00,0.00,2.25]=3.16 "
    "le_us=2576 est[2.57,1.98,1.68,100]"
)
LEC = (
    "DIST,4,AN0,1151,5.00,8.00,2.25,6.44,AN1,0CA8,0.00,8.00,2.25,6.50,AN2,111C,5.00,0.00,2.25,3.24,"
    "AN3,1150,0.00,0.00,2.25,3.19,POS,2.55,2.01,1.71,98"
)
LEP = "POS,2.57,2.00,1.67,97"


@pytest.mark.parametrize(
    ("text", "time", "expected", "said"),
    [
        (f"dwm> les\n0.1 {LES}\n0.2 {LEC}\n", "time", {
            "ranges": [(t, "T", a, d) for t, row in ((0.1, (6.48, 6.51, 3.18, 3.16)), (0.2, (6.44, 6.5, 3.24, 3.19)))
                       for a, d in zip(("1151", "0CA8", "111C", "1150"), row, strict=True)],
            "fixes": [(0.1, "T", 2.57, 1.98, 1.68), (0.2, "T", 2.55, 2.01, 1.71)]}, "1 line without values left out: 1"),
        (f"23:59:59.5 -> {LEP}\n00:00:01,5 {LEP}\n", "time in hh:mm:ss",
         {"fixes": [(86399.5, "T", 2.57, 2.0, 1.67), (86401.5, "T", 2.57, 2.0, 1.67)]}, ""),
        (f"[2026-05-04T14:13:20] {LEP}\n", "time in iso", {"fixes": [(NOON, "T", 2.57, 2.0, 1.67)]}, ""),
        (f"{LEP}\n{LEP}\n", "line*0.1", {"fixes": [(0.0, "T", 2.57, 2.0, 1.67), (0.1, "T", 2.57, 2.0, 1.67)]}, ""),
    ],
)  # fmt: skip
def test_the_lines_of_a_kit_are_read_by_the_patterns_of_its_preset(tmp_path, text, time, expected, said):
    (tmp_path / "log.txt").write_text(text)
    mappings = [replace(m, tag="T", columns={**m.columns, "t_s": time}) for m in read_mapping(PRESETS["dwm1001"])]
    source = read_source(tmp_path / "log.txt", "csv", mappings)
    assert {name: table.drop(ORIGIN).rows() for name, table in source.tables.items()} == expected
    assert said in " ".join(source.notices)


CSV = "t_s,tag,id,distance,word,gap\n0,T,A1,1000,1,a\n1,T,A1,1000,oops,\n"
DATES = "t,d1\n{},1\n{},1\n"
US = "05/04/2026 14:13:20"
NO_ZONE, ZONE = "2026-05-04T14:13:20", "2026-05-04T14:13:21Z"
SECONDS = "s,ns,x,y,z\n" + "".join(f"{1777904000 + k // 9},{k},{k},0,1\n" for k in range(40))
POSE, TRUTH = "0 0 0 0 0 0 0 1\n", {"table": "truth", "columns": ()}


def _when(unit):
    return {"columns": [f"t_s=t in {unit}", WIDE[1]]}


@pytest.mark.parametrize(
    ("name", "text", "options", "words"),
    [
        ("log.csv", "0,1.5,2.5\n1,2,3\n", {}, "line 1 is '0,1.5,2.5', without names of columns; .*--header none"),
        ("log.csv", "t,d1,d2\n0,1,2\n1,2\n", {}, "line 3 has 2 cells, expected 3"),
        ("log.csv", "t,d1,d1\n0,1,2\n", {}, "'d1' is duplicated in line 1.*--header none --skip 1"),
        ("log.csv", "t,d1,d2\n\n0,1,N/A\n", {}, r"row 1 \(line 3\), column d2: 'N/A'.*--missing=N/A"),
        ("log.csv", "t,d\0\n", {}, "holds binary data.*--encoding utf-16-le"),
        ("log.csv", CSV, {"columns": ["range_m=d", "range_m=d"]}, "range_m is given twice"),
        ("log.csv", CSV, {"columns": ["range_m=distance in deg"]}, "unit 'deg' does not fit range_m; expected one of m, dm, cm"),
        ("log.csv", CSV, {"columns": ["range_m=distance", "anchor=id+tag"]}, "anchor=id.tag of type String; expected text"),
        ("log.csv", CSV, {"columns": ["anchor=id"]}, "ranges needs range_m.*add --columns 'range_m=distance in UNIT'"),
        ("log.csv", CSV.replace("1,T,", "1,T2,"), {"columns": ["anchor=id", "range_m=distance"]},
         r'the column tag has T2, which --tag T would overwrite; leave it out.*where = { tag = \["T"\] }'),
        ("log.csv", CSV.replace("1,T,", "1,T2,"), {"columns": ["tag='X9'", "range_m=distance"], "tag": None}, "has T, T2, which"),
        ("log.csv", DATES.format(US, US), _when("iso"), "no order is guessed: name it, as 't_s=t in mm/dd/yyyy' or 't_s=t in dd/mm/yyyy'"),
        ("log.csv", DATES.format(*["04.05.26 14:13:20"] * 2), _when("dd.mm.yyyy"), "write years in full, from 1900 on, hours of 24"),
        ("log.csv", DATES.format("0001-01-01T00:00:00Z", ZONE), _when("iso"), "write years in full, from 1900 on"),
        ("log.csv", DATES.format("2:13:20 PM", "14:13:21"), _when("hh:mm:ss"), "write hours of 24, minutes and seconds"),
        ("log.csv", DATES.format("00:59", "01:00"), _when("hh:mm:ss"), "'00:59'; expected hh:mm:ss, all three in every row"),
        ("log.csv", DATES.format("12:59:59", "12:61:00"), _when("hh:mm:ss"), "'12:61:00'; expected hh:mm:ss"),
        ("log.csv", "t,d in mm\n0,2710\n", {"columns": [WIDE[0], "range_m=d in mm"]}, "expected `d in mm` in mm, or `d in mm` if"),
        *(("log.csv", f"{name},t\n0,40\n", {"table": table, "columns": [f"{target}={name}"]}, f"expected `{re.escape(name)}` in {unit}, or")
          for table, target, name, unit in (("ranges", "range_m[A1]", "Distanz [mm]", "mm"), ("ranges", "range_m[A1]", "d_cm", "cm"),
                                            ("ranges", "t_s", "t_ms", "ms"), ("bearings", "azimuth_rad", "az (°)", "deg"))),
        ("log.csv", CSV, {"decimal": ",", "thousands": ","}, "--thousands and --decimal: both are ','; expected two marks"),
        ("log.csv", DATES.format(0, 1), {"columns": [WIDE[0], "range_m[A1]=d1+50mm"]}, "range_m=d1.50mm: cannot be read"),
        ("log.csv", CSV, {"columns": ["anchor=5", "range_m=distance"]}, "anchor=5 .*expected text .*or 'TEXT' for every row"),
        ("log.csv", CSV, {"columns": ["anchor=id", "range_m=distance"], "where": {"word": [2]}}, "where word = 2 fits no row; found 1, oops"),
        ("log.csv", DATES.format(US, "13/05/2026 14:13:20"), _when("mm/dd/yyyy"), "name it, as 't_s=t in dd/mm/yyyy'$"),
        ("log.csv", DATES.format(ZONE, ZONE), {"columns": ["t_s=t*2 in iso", WIDE[1]]}, r"t\*2 in iso: expected columns joined by"),
        ("log.csv", "lat,time,d\n1,0,2\n", {"columns": ["range_m[A1]=d"]}, "needs t_s, .*'t_s=time in UNIT'"),
        ("log.csv", "t;d1\n0,1;4.51\n", {"columns": ["t_s=t", WIDE[1]], "decimal": ","}, r"'4\.51', .*it has a decimal point"),
        ("log.csv", DATES.format(NO_ZONE, ZONE), _when("iso"), r"line 3\), .*a time zone in all rows or none"),
        ("log.csv", SECONDS, {"table": "truth", "columns": ["t_s=s", "x_m=x", "y_m=y", "z_m=z"]},
         r"column s: 40 poses of tag T, 5 times: the stamps have lost their digits.*t_s=secs\+nsecs\*1e-9"),
        ("a.tum", "".join(f"1604644894.0 {k} 0 0 0 0 0 1\n" for k in range(9)), TRUTH, "9 poses of tag T, one time: the stamps have lost"),
        ("a.tum", f"{POSE}1 0 0 0 0 0 0\n", TRUTH, r"line 2\), column column7, the last; expected 8 numbers"),
        ("a.tum", f"# x\n{POSE}1 0 zero 0 0 0 0 1\n", TRUTH, r"line 3\), column y_m: 'zero'"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_with_its_place_and_the_usual_fix(tmp_path, name, text, options, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(UnusableInput, match=words) as refused:
        _read(tmp_path / name, **options)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1", "x is no key of it"),
        ("tables = []", "no tables; expected entries"),
        ('[[tables]]\ntable = "ranges"\ntabel = "x"', "tables 1.tabel is no key of it"),
        ('[[tables]]\ntable = "range"', "tables 1: table 'range'; expected one of ranges"),
        ("[[tables]]\n", "tables 1.table is missing"),
        ('[[tables]]\ntable="ranges"\ncolumns={range_m=3}', "columns.range_m = 3, expected a valid string"),
        ('[[tables]]\ntable="ranges"\nlines="("', "lines = .*regular expression"),
        ('[[tables]]\ntable="ranges"\ndecimal="x"', "decimal = 'x', expected '.' or ','"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_file_of_mappings_is_refused_with_its_key(tmp_path, text, words):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(UnusableInput, match=f"map.toml: .*{words}|map.toml: {words}"):
        read_mapping(tmp_path / "map.toml")


@pytest.mark.parametrize("make", [pd.DataFrame, pl.DataFrame, pl.LazyFrame])
def test_frames_become_a_recording(make):
    frame = make({"distance": [1000, 2000, 1500], "anchor": ["A1", "A2", "A1"], "when": [0.0, 0.1, 0.2]})
    columns = {"ranges": ["range_m=distance in mm", "t_s=when"]}
    recording = import_frames({"ranges": frame}, RIG, columns, tag="T1", name="monday")
    assert (recording.name, recording.path) == ("monday", None)
    assert recording.tables["ranges"].rows() == [(0.0, "T1", "A1", 1.0), (0.1, "T1", "A2", 2.0), (0.2, "T1", "A1", 1.5)]


def test_frames_with_times_in_a_unit_or_a_name_twice_are_refused():
    times = pd.DataFrame({"when": pd.to_datetime([0, 1], unit="s"), "anchor": "A1", "range_m": 1.0})
    for frame, words in ((times, "holds times, read as s"), (times[["when", "when"]], "found 'when, when'; .* once")):
        with pytest.raises(UnusableInput, match=words):
            import_frames({"ranges": frame}, RIG, {"ranges": ["t_s=when in ms"]}, tag="T1")
