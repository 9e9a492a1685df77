"""Mapped columns against arithmetic done by hand, and every mistake in them with its words."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.expressions import columns_of, parsed
from trackwright.trackers.exchange.imported import import_frames
from trackwright.trackers.exchange.mapping import TableMapping, mapped_table
from trackwright.trackers.exchange.mapping_file import read_mapping
from trackwright.trackers.recordings.kinds import layout
from trackwright.trackers.recordings.table_file import TableFile, read_table_file

RIG = Rig("room", {"A1": np.array([0.0, 0, 2]), "A2": np.array([4.0, 0, 2]), "7": np.array([0.0, 4, 2])})


@pytest.mark.parametrize(
    ("target", "text", "value", "expected"),
    [
        ("range_m", "d*0.001", 1500.0, 1.5),
        ("range_m", "d in mm", 1500.0, 1.5),
        ("range_m", "sqrt(d)", 9.0, 3.0),
        ("azimuth_rad", "d*-1 in deg", 90.0, -np.pi / 2),
        ("accel_x_mps2", "d in g", 1.0, 9.80665),
        ("gyro_x_radps", "d in deg/s", 180.0, np.pi),
        ("t_s", "d in us", 2.5e6, 2.5),
        ("t_s", "d - 1718000000", 1718000001.5, 1.5),
        ("range_m", "d in ns", 10.0, 2.99792458),
    ],
)
def test_an_expression_is_the_arithmetic_it_says(target, text, value, expected):
    table = next(
        name for name in ("ranges", "bearings", "imu", "odometry") if target in ("t_s", *layout(name, ()).values)
    )
    ids, values = layout(table, ())[:2]
    entries = {"t_s": "t"} | dict.fromkeys(ids, "'A1'") | dict.fromkeys(values, "d") | {target: text}
    frame = pl.DataFrame({"t": [1.0], "d": [value]})
    mapping = TableMapping(table, columns_of([f"{k}={v}" for k, v in entries.items()]))
    found, _ = mapped_table(TableFile(Path("x.csv"), frame), mapping)
    assert found[target][0] == pytest.approx(expected)


def test_a_column_for_each_anchor_becomes_a_row_for_each(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text("time,d1,d2,power,note\n0.1,1000,2000,-70,x\n0.2,,2100,-71,y\n")
    columns = columns_of(["t_s=time", "range_m[A1]=d1 in mm", "range_m[A2]=d2 in mm", "rss_dbm=power"])
    table, notices = mapped_table(read_table_file(path), TableMapping("ranges", columns, tag="T"))
    assert table.rows() == [(0.1, "T", "A1", 1.0, -70.0), (0.1, "T", "A2", 2.0, -70.0), (0.2, "T", "A2", 2.1, -71.0)]
    assert notices == ["1 row without a value left out", "columns not used: note"]


def test_a_column_for_each_pair_of_anchors_becomes_a_row_for_each(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text("t_s,d21,d71\n0.1,1.0,2.0\n0.2,,2.5\n")
    columns = columns_of(["range_difference_m[A2,A1]=d21", "range_difference_m[7, A1]=d71"])
    table, _ = mapped_table(read_table_file(path), TableMapping("tdoa", columns, tag="T"))
    assert table.rows() == [(0.1, "T", "A2", "A1", 1.0), (0.1, "T", "7", "A1", 2.0), (0.2, "T", "7", "A1", 2.5)]


@pytest.mark.parametrize(
    ("tags", "entries", "tag", "words"),
    [
        (["T1", "T2"], [], "T1", "the column tag has T1, T2; --tag T1 would overwrite it; leave it out"),
        (["T1", "T2"], ["tag='T1'"], None, "the column tag has T1, T2; --tag T1 would overwrite it"),
        ([7, 8], ["tag=tag"], "7", 'where = { tag = ["7"] } in a file of --mapping'),
    ],
)
def test_a_tag_for_all_rows_that_others_would_lose_is_refused(tags, entries, tag, words):
    frame = pl.DataFrame({"t_s": [0.0, 1.0], "tag": tags, "anchor": "A1", "range_m": 1.0})
    with pytest.raises(UnusableInput, match=re.escape(words)):
        mapped_table(TableFile(Path("x"), frame), TableMapping("ranges", columns_of(entries), tag=tag))


def test_a_tag_for_all_rows_fills_what_is_empty_and_names_what_a_filter_has_left():
    frame = pl.DataFrame({"t_s": [0.0, 1.0, 2.0], "tag": ["T1", "", "T2"], "anchor": "A1", "range_m": 1.0})
    file = TableFile(Path("x"), frame)
    table, _ = mapped_table(file, TableMapping("ranges", tag="T1", where={"tag": ["T1", ""]}))
    assert table["tag"].to_list() == ["T1", "T1"]
    table, _ = mapped_table(file, TableMapping("ranges", columns_of(["tag='X9'"]), where={"tag": ["T1"]}))
    assert table["tag"].to_list() == ["X9"]


def test_frames_with_time_stamps_begin_at_their_origin():
    stamps = pd.date_range("2026-05-01T12:00:00.25", periods=3, freq="s")
    ranges = pd.DataFrame({"t_s": stamps, "anchor": "A1", "range_m": 1.0})
    truth = pd.DataFrame({"t_s": stamps - pd.Timedelta("1s"), "x_m": 1.0, "y_m": 0.0, "z_m": 0.0})
    for origin in ("start", "2026-05-01T12:00:00.25", stamps[0].timestamp()):
        tables = import_frames({"ranges": ranges, "truth": truth}, RIG, tag="T", origin=origin).tables
        assert tables["ranges"]["t_s"].to_list() == pytest.approx([0.0, 1.0, 2.0], abs=1e-6)
        assert tables["truth"]["t_s"].to_list() == pytest.approx([-1.0, 0.0, 1.0], abs=1e-6)


@pytest.mark.parametrize(
    ("dates", "words"),
    [
        (
            ["2026-05-04T14:13:20.26+02:00", "2026-05-04T14:13:20.36"],
            "'2026-05-04T14:13:20.36'; row 1 '2026-05-04T14:13:20.26+02:00'; expected a time zone in",
        ),
        (
            ["2026-05-04T14:13:20.26", "2026-05-04T14:13:20.36Z"],
            "row 2, column when: '2026-05-04T14:13:20.36Z'; row 1 '2026-05-04T14:13:20.26'; expected a",
        ),
        (["2026-05-04T14:13:20", "noon"], "row 2, column when: 'noon'; expected a date such as"),
    ],
)
def test_dates_with_and_without_a_time_zone_are_told_apart(dates, words):
    frame = pl.DataFrame({"when": dates, "tag": "a", "x_m": 1.0, "y_m": 0.0, "z_m": 0.0})
    with pytest.raises(UnusableInput, match=re.escape(words)):
        mapped_table(TableFile(Path("x"), frame), TableMapping("fixes", columns_of(["t_s=when in iso"])))


def _of_dates(dates, order):
    frame = pl.DataFrame({"when": dates, "tag": "T1", "x_m": 1.0, "y_m": 2.0, "z_m": 0.0})
    return mapped_table(TableFile(Path("x"), frame), TableMapping("fixes", columns_of([f"t_s=when in {order}"])))


@pytest.mark.parametrize(
    ("order", "text"),
    [
        ("mm/dd/yyyy", "05/04/2026 14:13:20.000"),
        ("MM/DD/YYYY", "5/4/2026 14:13:20"),
        ("dd/mm/yyyy", "04/05/2026 14:13:20,0"),
        ("dd-mm-yyyy", "04-05-2026T16:13:20+02:00"),
        ("yyyy/mm/dd", "2026/05/04 14:13:20Z"),
        ("iso", "2026-05-04T14:13:20.000000000Z"),
        ("dd.mm.yyyy", "04.05.2026 14:13:20.000"),
    ],
)
def test_dates_are_read_in_the_order_that_is_named(order, text):
    table, _ = _of_dates([text, text], order)
    assert table["t_s"].to_list() == [datetime(2026, 5, 4, 14, 13, 20, tzinfo=UTC).timestamp()] * 2


@pytest.mark.parametrize(
    ("order", "dates", "words"),
    [
        ("iso", ["05/04/2026 14:13:20"], "row 1, .*no order is guessed: name it, as 't_s=when in mm/dd/yyyy'"),
        ("iso", ["05-04-2026 14:13:20"], "name it, as 't_s=when in mm-dd-yyyy'"),
        ("iso", ["2026-05-04 14:13:20", "05/13/2026 14:13:20"], "row 2, column when: '05/13/2026 14:13:20'"),
        ("iso", ["2026/05/04 14:13:20"], "expected a date such as 2026-05-31"),
        ("iso", [20260504], "expected a date such as 2026-05-31"),
        ("dd/mm/yyyy", ["04/05/2026 14:13:20", "05/13/2026 14:13:20"], "row 2, .*expected a date such as 31/05/2026"),
        ("mm/dd/yyyy", ["05/04/26 14:13:20"], "expected a date such as 05/31/2026 14:00:00.25"),
        ("mm/dd/yyyy", ["05/04/2026 02:13:20 PM"], "expected a date such as 05/31/2026 14:00:00.25"),
        ("iso", ["04.05.2026 14:13:20", "05.13.2026 14:13:20"], "row 2, .*expected a date such as 31.05.2026"),
    ],
)
def test_dates_in_another_order_than_the_one_named_are_refused(order, dates, words):
    with pytest.raises(UnusableInput, match=words):
        _of_dates(dates, order)


def test_dotted_dates_are_day_month_year_and_a_line_says_so():
    table, notices = _of_dates(["04.05.2026 14:13:20.500", "04.05.2026 14:13:21,500"], "iso")
    assert table["t_s"][0] == datetime(2026, 5, 4, 14, 13, 20, 500_000, tzinfo=UTC).timestamp()
    assert notices == ["column when: dates are read as dd.mm.yyyy"]


@pytest.mark.parametrize(
    ("table", "columns", "words"),
    [
        ("ranges", ["range_m=distance in deg"], ("deg", "m, dm, cm")),
        ("ranges", ["range_m=d", "range_m=d"], ("twice",)),
        ("ranges", ["range_m=d/0"], ("division by zero",)),
        ("ranges", ["range_m=distance_m", "anchor=id"], ("no column 'distance_m'", "expected 'distance_mm'?")),
        ("ranges", ["rnage_m=distance_mm"], ("has no column rnage_m", "range_m")),
        ("ranges", ["range_m=distance_mm", "anchor=gap"], ("row 2 (line 3), column gap", "empty")),
        ("truth", ["x_m=word[A1]", "y_m=word", "z_m=word"], ("no column",)),
        (
            "fixes",
            ["x_m=gap", "y_m=gap"],
            ("needs z_m, which no column gives", "expected a column, an empty one where no height is measured"),
        ),
        ("fixes", ["x_m[A1]=word"], ("has no anchors or stations",)),
    ],
)
def test_a_mistake_in_a_mapping_is_refused(tmp_path, table, columns, words):
    path = tmp_path / "log.csv"
    path.write_text("t_s,tag,id,distance_mm,word,gap\n0,T,A1,1000,1,a\n1,T,A1,1000,oops,\n")
    with pytest.raises(UnusableInput) as refused:
        mapped_table(read_table_file(path), TableMapping(table, columns_of(columns)))
    for word in words:
        assert word in str(refused.value)


def test_a_mapping_is_read_from_toml(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text('[[tables]]\ntable = "ranges"\ntopic = "/uwb"\ncolumns = { range_m = "d in mm" }\n')
    (mapping,) = read_mapping(path).tables
    assert mapping == TableMapping("ranges", {"range_m": parsed("range_m", "d in mm")}, "/uwb")
    for text, word in (("x = 1", "expected entries"), ('[[tables]]\ntabel = "x"', "unknown key 'tabel'"),
                       ('[[tables]]\ntable = "range"', "expected one of ranges"), ("[[tables]]\n", "no table"),
                       ('[[tables]]\ntable="ranges"\ncolumns={range_m=3}', "range_m = 3; expected texts"),
                       ('[[tables]]\ntable="ranges"\ncolumns=["d"]', r"columns = \['d'\]; expected texts"),
                       ('[[tables]]\ntable="ranges"\nanchors={x_m="x"}', "anchors with x_m, columns with none; exp"),
                       ('[tables]\ntable = "ranges"', r"write \[\[tables\]\]")):  # fmt: skip
        path.write_text(text)
        with pytest.raises(UnusableInput, match=word):
            read_mapping(path)


def _ranges():
    return {"distance": [1000, 2000, 1500], "anchor": ["A1", "A2", "A1"], "when": [0.0, 0.1, 0.2]}


@pytest.mark.parametrize("make", [pd.DataFrame, pl.DataFrame, pl.LazyFrame])
def test_frames_become_a_recording(make):
    columns = {"ranges": ["range_m=distance in mm", "t_s=when"]}
    recording = import_frames({"ranges": make(_ranges())}, RIG, columns, tag="T1", name="monday")
    assert recording.name == "monday"
    assert recording.path is None
    assert recording.tables["ranges"].rows() == [(0.0, "T1", "A1", 1.0), (0.1, "T1", "A2", 2.0), (0.2, "T1", "A1", 1.5)]


@pytest.mark.parametrize("unit", ["ns", "us", "ms", "s"])
def test_an_index_of_pandas_times_is_read_as_seconds_in_any_unit(unit):
    stamps = pd.to_datetime(["2026-05-01T12:00:00", "2026-05-01T12:00:01", "2026-05-01T12:00:02"]).as_unit(unit)
    frame = pd.DataFrame({"range_m": [1.0, 2.0, 1.5], "anchor": ["A1", "A2", None]}, index=stamps.rename("stamp"))[:2]
    recording = import_frames({"ranges": frame}, RIG, {"ranges": ["t_s=stamp"]}, tag="T1")
    start = datetime(2026, 5, 1, 12, tzinfo=UTC).timestamp()
    assert recording.tables["ranges"]["t_s"].to_list() == [start, start + 1]


@pytest.mark.parametrize(
    ("columns", "tag", "words"),
    [
        ([], "T1", r"add columns=\{'ranges': \['range_m="),
        (["range_m=distance_mm in mm"], None, "give tag='ID'$"),
    ],
)
def test_frames_are_refused_in_words_of_python(columns, tag, words):
    frame = pl.DataFrame({"t_s": [0.0], "anchor": ["A1"], "distance_mm": [900.0]})
    with pytest.raises(UnusableInput, match=words) as refused:
        import_frames({"ranges": frame}, RIG, {"ranges": columns}, tag=tag)
    assert "--" not in str(refused.value)
    with pytest.raises(UnusableInput, match="columns: found list; expected expressions by table"):
        import_frames({"ranges": frame}, RIG, columns, tag=tag)
    with pytest.raises(
        UnusableInput, match=r"import_frames: found DataFrame; expected frames by table, as \{'ranges': frame\}"
    ):
        import_frames(frame, RIG)
