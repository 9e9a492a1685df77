"""Recordings that are refused, and recordings with an anomaly that are read with a notice.

`BROKEN[name](folder)` and `ANOMALOUS[name](folder)` write a recording to the new folder `folder` and return a word
expected in the message.
"""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from tests.faulty import (
    RIG,
    Builder,
    then,
    with_cell,
    with_directory,
    with_file,
    with_line,
    with_parquet,
    with_renamed,
    with_rig,
    with_table,
)


def _no_tables(folder: Path) -> str:
    for file in folder.glob("*.csv"):
        file.unlink()
    return "no tables"


def _duplicate_table(folder: Path) -> str:
    shutil.copy(folder / "ranges.csv", folder / "copy")
    (folder / "ranges.csv.gz").write_bytes(gzip.compress((folder / "copy").read_bytes()))
    (folder / "copy").unlink()
    return "both ranges.csv and ranges.csv.gz"


def _is_a_file(folder: Path) -> str:
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.write_text(RIG)
    return str(folder)


_JUNK = bytes(range(256)) * 8
_QUATERNION = "rotation_wxyz = [0.5, 0.5, 0.5, 0.5]"
_ANTENNAS = "antennas_m = [[0.02, 0.0], [0.0, 0.01], [-0.02, 0.0], [0.0, -0.01]]\n"
_S1_PHASES = "wavelength_m = 0.0125\n" + _ANTENNAS

BROKEN: dict[str, Builder] = {
    # the folder
    "folder does not exist": lambda folder: str(folder),
    "path is a file": _is_a_file,
    "no tables": then(_no_tables),
    "duplicate table": then(_duplicate_table),
    "table is a directory": with_directory("ranges.csv"),
    "misspelt table name": with_file("ranges.csv", lambda data: data, to="range.csv"),
    "table in an unknown kind": with_file("bearings.csv", lambda data: data, to="bearings.txt"),
    "no common tag": with_table("truth", lambda table: table.with_columns(tag=pl.lit("T9")), word="no common tag"),
    # rig.toml
    "rig missing": then(lambda folder: [(folder / "rig.toml").unlink(), "rig.toml"][1]),
    "rig is a directory": with_directory("rig.toml"),
    "rig empty": with_file("rig.toml", b""),
    "rig broken TOML": with_rig("[anchors]", "[anchors"),
    "rig table duplicated": with_rig("[tags.T2]", "[tags.T1]"),
    "rig without format": with_rig("format = 1\n", ""),
    "rig of another format": with_rig("format = 1", "format = 2"),
    "rig name a number": with_rig('name = "good"', "name = 7"),
    "rig key misspelt": with_rig("[anchors]", "[anchor]", "anchors"),
    "anchor of two numbers": with_rig("[6.0, 0.0, 2.6]", "[6.0, 0.0]", "anchors.A2"),
    "anchor not a number": with_rig("[6.0, 0.0, 2.6]", "[6.0, nan, 2.6]", "anchors.A2"),
    "anchor beyond all numbers": with_rig("[6.0, 0.0, 2.6]", f"[6.0, {10**400}, 2.6]", "anchors.A2"),
    "anchors not a table": with_rig("[anchors]", "anchors = 3\n[comment]", "anchors"),
    "station without position": with_rig("position_m = [0.0, 2.5, 2.3]\n", "", "position_m"),
    "zero quaternion": with_rig(_QUATERNION, "rotation_wxyz = [0, 0, 0, 0]", "stations.S1.rotation_wxyz"),
    "quaternion not of unit length": with_rig(_QUATERNION, "rotation_wxyz = [1, 1, 0, 0]", "stations.S1.rotation_wxyz"),
    "negative wavelength": with_rig("wavelength_m = 0.0125", "wavelength_m = -0.0125", "wavelength_m"),
    "antennas without wavelength": with_rig("wavelength_m = 0.0125\n", "", "wavelength_m"),
    "tag height beyond reason": with_rig("height_m = 1.0", "height_m = 1e9", "tags.T1.height_m"),
    "walls of three numbers": with_rig("[path]", "[floor]\nwalls_m = [[0, 0, 1]]\n[path]", "floor.walls_m"),
    "path of one corner": with_rig("[[1.0, 1.0], [5.0, 1.0], [5.0, 4.0]]", "[[1.0, 1.0]]", "knots_m"),
    "path with a repeated knot": with_rig("[5.0, 4.0]]", "[5.0, 1.0]]", "knot 2 of the path repeats"),
    # a table's file
    "empty file": with_file("ranges.csv", b""),
    "header only": with_file("ranges.csv", lambda data: data.split(b"\n")[0] + b"\n"),
    "binary junk": with_file("ranges.csv", _JUNK),
    "UTF-16": with_file("ranges.csv", lambda data: data.decode().encode("utf-16")),
    "truncated gzip": with_file("ranges.csv", lambda data: gzip.compress(data)[:-400], to="ranges.csv.gz"),
    "gzip named text": with_file("ranges.csv", gzip.compress),
    "truncated Parquet": with_parquet("ranges", lambda data: data[:-200]),
    "Parquet with damaged footer": with_parquet("ranges", lambda data: data[:-60] + b"\xff" * 52 + data[-8:]),
    "Parquet with damaged pages": with_parquet("ranges", lambda data: data[:4] + _JUNK[:900] + data[904:]),
    "line cut off": with_file("ranges.csv", lambda data: data[: data.rindex(b",")][: -len(b",1.23")]),
    "semicolons": with_file("ranges.csv", lambda data: data.replace(b",", b";")),
    "comment first": with_line("ranges", lambda line: f"# by T1\n{line}", 0, "line 1 is '# by T1', expected names"),
    "decimal commas": with_file("fixes.csv", lambda data: data.replace(b".", b",")),
    "a cell too many": with_line("ranges", lambda line: line + ",1", 5, "ranges.csv: row 5 (line 6)"),
    "one row too long and one too short": with_file(
        "ranges.csv", lambda data: data.replace(b"\n", b",9\n", 5).replace(b",9\n", b"\n", 4)[:-6] + b"\n"
    ),
    "quote left open": with_line("ranges", lambda line: '"' + line, 5, "row 5 (line 6) has a quote that is not closed"),
    # its columns
    "column missing": with_table("ranges", lambda table: table.drop("anchor")),
    "column misnamed": with_renamed("ranges", "range_m", "range"),
    "column in degrees": with_renamed("bearings", "azimuth_rad", "azimuth_deg"),
    "column duplicated": with_renamed("ranges", "range_std_m", "range_m"),
    "no header": with_file("ranges.csv", lambda data: data.partition(b"\n")[2]),
    "misnamed standard deviation": with_renamed("ranges", "range_std_m", "std_range_m"),
    "quaternion with three columns": with_table("truth", lambda table: table.drop("qz")),
    "phase column too many": with_table("phases", lambda table: table.with_columns(phase_5_rad=pl.col("phase_4_rad"))),
    "phases of a station without antennas": with_rig(_S1_PHASES, "", "phases.csv"),
    # its cells
    "text in a number": with_cell("ranges", "range_m", "far"),
    "number with a unit": with_cell("ranges", "range_m", "2.5 m"),
    "infinite value": with_cell("ranges", "range_m", "inf"),
    "number beyond all numbers": with_cell("truth", "x_m", "1e999"),
    "time missing": with_cell("ranges", "t_s", ""),
    "time not a number": with_cell("truth", "t_s", "nan"),
    "time a clock text": with_cell("ranges", "t_s", "12:00:01"),
    "time a date": with_table("ranges", lambda x: x.with_columns(t_s=pl.lit("2026-05-01")), word="'t_s=t_s in iso'"),
    "header again": with_table(
        "ranges", lambda x: x.with_columns(t_s=pl.lit("t_s")), word="its name stands again in it"
    ),
    "clock that starts again": with_table(
        "ranges",
        lambda table: pl.concat([table, table.with_columns(pl.col("t_s") + 0.02)]),
        word="row 401 (line 402), column t_s: 0.020 after 4.900 of the same anchor and tag: the clock went back",
    ),
    "tag missing": with_cell("ranges", "tag", ""),
    "unknown anchor": with_cell("ranges", "anchor", "A9"),
    "unknown station": with_cell("bearings", "station", "s1"),
    "negative standard deviation": with_cell("ranges", "range_std_m", "-0.03"),
    "zero standard deviation": with_cell("fixes", "x_std_m", "0"),
    "zero quaternion in truth": with_cell("truth", "qw", "0"),
    "angles as a quaternion in truth": with_cell("truth", "qw", "90"),
    "Parquet with text for numbers": with_table(
        "ranges", lambda table: table.with_columns(range_m=pl.lit("far")), "parquet", "row 1, column range_m"
    ),
    "Parquet with dates for times": with_table(
        "ranges", lambda table: table.with_columns(pl.from_epoch("t_s", "s")), "parquet", "ranges.parquet: column t_s"
    ),
    "Parquet without rows": with_table("ranges", lambda table: table.clear(), "parquet"),
}


def _when(tag: str, column: str, start: float, stop: float, value: pl.Expr) -> pl.Expr:
    """`column` replaced by `value` for one tag between two times, s."""
    here = (pl.col("tag") == tag) & pl.col("t_s").is_between(start, stop)
    return pl.when(here).then(value).otherwise(pl.col(column)).alias(column)


def _anomalous(name: str, change: Callable[[pl.DataFrame], pl.DataFrame], word: str) -> Builder:
    return with_table(name, change, word=word)


ANOMALOUS: dict[str, Builder] = {
    "rows out of order": _anomalous("ranges", lambda table: table.reverse(), "earlier than the previous row"),
    "some rows late": _anomalous(
        "imu", lambda table: pl.concat([table[10:], table[:10]]), "earlier than the previous row"
    ),
    "duplicate rows": _anomalous("ranges", lambda table: pl.concat([table[:20], table]), "duplicate rows: 20"),
    "duplicate times": _anomalous(
        "fixes",
        lambda table: pl.concat([table, table[:6].with_columns(pl.col("x_m") + 0.01)]),
        "time of another row of the same sensor and tag: 6",
    ),
    "unknown tag": _anomalous(
        "ranges",
        lambda table: pl.concat([table, table.filter(pl.col("tag") == "T1").with_columns(tag=pl.lit("T7"))]),
        "not in rig.toml: 1 ('T7')",
    ),
    "gap": _anomalous(
        "bearings", lambda table: table.filter(~pl.col("t_s").is_between(1.0, 3.0)), "gaps longer than 1 s: 4"
    ),
    "outlying range": _anomalous(
        "ranges",
        lambda table: table.with_columns(_when("T1", "range_m", 1.99, 2.01, pl.lit(250.0))),
        "outliers of range_m: 4",
    ),
    "two adjacent outlying fixes": _anomalous(
        "fixes", lambda table: table.with_columns(_when("T2", "y_m", 1.99, 2.11, pl.lit(-40.0))), "outliers of y_m: 2"
    ),
    "zeros for missing ranges": _anomalous(
        "ranges",
        lambda table: table.with_columns(_when("T1", "range_m", 0.99, 1.11, pl.lit(0.0))),
        "ranges of 0 m: 8; not used",
    ),
    "clock with jitter": _anomalous(
        "ranges",
        lambda table: table.with_columns(pl.col("t_s") + 0.7 * (pl.int_range(pl.len()) // 8 % 2)),
        "earlier than the previous row",
    ),
    "negative range": _anomalous(
        "ranges",
        lambda table: table.with_columns(_when("T1", "range_m", 0.99, 1.01, pl.lit(-1.0))),
        "negative values of range_m: 4",
    ),
    "angles in degrees": _anomalous(
        "bearings", lambda table: table.with_columns(pl.col("azimuth_rad", "elevation_rad").degrees()), "degrees"
    ),
    "phases from 0 to 2 pi": _anomalous(
        "phases", lambda table: table.with_columns(pl.col("^phase_.*$") % (2 * np.pi)), "not wrapped"
    ),
    "unknown column": _anomalous("ranges", lambda table: table.with_columns(remark=pl.lit("good")), "'remark'"),
    "unknown file": then(lambda folder: [(folder / "notes.csv").write_text("a,b\n1,2\n"), "not one of the tables"][1]),
    "unknown key in the rig": with_rig('about = "Made for tests."', 'operator = "me"', "'operator'"),
}
