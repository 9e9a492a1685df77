"""Estimates of any program, and true paths, in files: trajectories, or tables with the columns of `track`."""

from __future__ import annotations

import re
from pathlib import Path

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.trajectory_files import Kind, read_trajectory
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.input_file import beginning
from trackwright.trackers.recordings.table_file import SUFFIXES, TableFile, read_table_file

_DATE = re.compile(r"\d{4}-\d{2}-\d{2}(?:[T ]|$)")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")
_TEXT = ("recording", "tag", "station", "status", "wrapped")


def read_estimates(path: Path, kind: Kind | None = None) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """The estimates in a TUM, KITTI or EuRoC file or a table, and notices.

    A table, CSV or Parquet, has t_s, x_m, y_m and what else of the columns that `track` writes, with `qw, qx, qy, qz`.
    Raises UnusableInput with file and line.
    """
    if kind is None and _is_table(path):
        return _table(read_table_file(path)), ()
    trajectory = read_trajectory(path, kind)
    return trajectory.to_polars().drop("tag"), trajectory.notices


def read_truth(path: Path, tag: str, kind: Kind | None = None) -> RecordingFolder:
    """The true path of one tag in a file, as a recording of that name; raises UnusableInput as `read_estimates`."""
    table, notices = read_estimates(path, kind)
    given = "tag" in table.columns
    table = table if given else table.with_columns(tag=pl.lit(tag))
    columns = [name for name in ("t_s", "tag", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz") if name in table.columns]
    return RecordingFolder(path.stem, path, Rig(path.stem), {"truth": table.select(columns)}, notices)


def assigned(tracks: pl.DataFrame, truths: dict[str, pl.DataFrame], tag: str | None, path: Path) -> pl.DataFrame:
    """The estimates of a file with `recording` and `tag`: those of the truth where the file does not name them.

    `tag`: the one that the file follows, needed where the truth has several. Raises UnusableInput where it is not clear
    which truth is meant.
    """
    if "recording" not in tracks.columns:
        if len(truths) != 1:
            raise UnusableInput(f"{path}: names no recording; found {len(truths)} with truth; give one in --truth")
        tracks = tracks.with_columns(recording=pl.lit(next(iter(truths))))
    if "tag" not in tracks.columns or tag is not None:
        known = sorted({str(t) for truth in truths.values() for t in truth["tag"].unique()})
        if tag is None and len(known) != 1:
            raise UnusableInput(
                f"{path}: names no tag; the truth has {listed(known)}; give the tag it follows in --tag"
            )
        if tag is not None and tag not in known:
            raise UnusableInput(f"--tag {tag}: the truth has no such tag; found {listed(known)}")
        tracks = tracks.with_columns(tag=pl.lit(tag if tag is not None else known[0]))
    return tracks


def _is_table(path: Path) -> bool:
    """Whether the file is a table with a head, and not a list of poses."""
    name = path.name.lower()
    if not name.endswith(SUFFIXES):
        return False
    if name.endswith(".csv"):
        try:
            head = beginning(path, 1000).partition(b"\n")[0]
        except OSError as error:
            raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the path") from error
        return b"t_s" in head
    return True


def _table(file: TableFile) -> pl.DataFrame:
    columns = file.frame.columns
    missing = [name for name in ("t_s", "x_m", "y_m") if name not in columns]
    if missing:
        raise UnusableInput(
            f"{file.path}: no column {', '.join(missing)}; found {listed(columns, 12)}; expected t_s, x_m, y_m and "
            "optionally z_m, std_x_m …, qw … qz; bring it into this form by `trackwright import`"
        )
    texts = [pl.col(name).cast(pl.String) for name in columns if name in _TEXT]
    return file.frame.select(texts + [numbers_of(file, name) for name in columns if name not in _TEXT])


def numbers_of(file: TableFile, column: str) -> pl.Series:
    """The column as Float64, null where empty or NaN; raises UnusableInput with the row of a text."""
    found = file.frame[column]
    if found.dtype != pl.String:
        if not (found.dtype.is_numeric() or found.dtype in (pl.Null, pl.Boolean)):
            raise UnusableInput(f"{file.path}: column {column} has type {found.dtype}; expected numbers")
        return found.cast(pl.Float64).fill_nan(None)
    text = found.str.strip_chars()
    points = text
    if file.decimal == ",":
        # A point, as it groups thousands, is then no part of a number.
        points = text.str.replace(".", "x", literal=True).str.replace(",", ".", literal=True)
    numbers = points.cast(pl.Float64, strict=False)
    wrong = numbers.is_null() & text.is_not_null() & (text != "")
    if wrong.any():
        row = wrong.arg_max()
        assert row is not None
        raise UnusableInput(
            f"{file.location(row, column)}: {text[row][:40]!r}; expected a number; {_remedy(text[row], column)}"
        )
    return numbers.fill_nan(None)


def _remedy(text: str, column: str) -> str:
    """What to do about a text where a number is expected."""
    if _DATE.match(text):
        return f"it looks like a date, which `trackwright import` reads by 't_s={column} in iso'"
    if _DECIMAL_COMMA.fullmatch(text):
        return "it looks like a decimal comma, which `trackwright import --decimal ,` reads"
    return "leave a missing cell empty"
