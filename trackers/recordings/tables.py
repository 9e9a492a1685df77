"""The tables of recording folders: a CSV or Parquet file as raw columns with their lines, checked and converted."""

from __future__ import annotations

import csv
import difflib
import gzip
import io
import re
import zlib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UNIX_S, UnusableInput, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.files import file_bytes
from trackwright.trackers.recordings.kinds import UNITS, Kind, Layout, table_kinds

SUFFIXES = (".csv", ".csv.gz", ".parquet")

JITTER_S, JITTER = 1.0, 5.0  # late rows are sorted up to so many s, or median steps
LEAST_AGAIN = 5  # rows that repeat earlier times, or end `FAR` of these before the next, from which a clock went back
FAR, HOUR_S = 5.0, 3600.0  # at the end of summer time a clock goes back by an hour
WRAPS = {
    2.0**24 * 1e-6: "2²⁴ µs (16.777 s)", 2.0**40 / 63.8976e9: "2⁴⁰ ticks of a DW1000 (17.207 s)",
    2.0**16 * 1e-3: "2¹⁶ ms (65.536 s)", 2.0**32 * 1e-6: "2³² µs (4294.967 s)", 2.0**24 * 1e-3: "2²⁴ ms (16777.216 s)",
    86400.0: "a day", 604800.0: "a week", 2.0**32 * 1e-3: "2³² ms (4294967.296 s)",
}  # fmt: skip
"""Periods of counters and clocks, s, in words."""

_LARGEST = 1e15  # its square is within the range of a 32-bit float
_LATEST = 1e20  # beyond nanoseconds since 1970

_FOUND = {
    r"\d{4}-.*": "it looks like a date: `trackwright import` with 't_s={column} in iso'",
    r"\d{1,4}([-/.])(\d{1,2}|[A-Za-z]{3})\1\d{1,4}([T ].*)?": (
        "it looks like a date: `trackwright import` with 't_s={column} in dd/mm/yyyy', or its own form, as dd-mmm-yyyy"
    ),
    r"\d{1,2}:\d\d(:.*)?": "it looks like a time of day: `trackwright import` with 't_s={column} in hh:mm:ss'",
    r"[-+]?\d+,\d+([eE][-+]?\d+)?": "a decimal comma? `trackwright import --decimal ,`; or thousands? `--thousands ,`",
    r"[-+]?\d{1,3}([,.' ])\d{3}(\1\d{3}|[.,]\d)\d*.*|[-+]?\d{1,3}[' ]\d{3}": (
        "thousands are grouped in it: `trackwright import --thousands {mark!r}`"
    ),
    r"[-+]?\d*\.\d+([eE][-+]?\d+)?": "it has a decimal point: `trackwright import --decimal .`, the default",
    r"[^ \d]*": "leave a missing cell empty, or name its mark: `trackwright import --missing={text}`",
}
"""What to do about a text where a number is expected, by its form."""


@dataclass(frozen=True)
class TableFile:
    """Raw columns, text of CSV, typed of Parquet; `lines`: of CSV rows; `decimal`, `thousands`: marks in numbers."""

    path: Path
    frame: pl.DataFrame
    lines: Sequence[int] | pl.Series | None = None
    decimal: str = "."
    thousands: str = ""

    def location(self, row: int, column: str) -> str:
        """File, row and column in words, for messages; `row` is counted from 0."""
        line = "" if self.lines is None else f" (line {self.lines[row]})"
        return f"{self.path}: row {row + 1}{line}, column {column}"

    def refuse(self, wrong: pl.Series, column: str, expected: str) -> None:
        """Raises UnusableInput with the first of the wrong rows and its cell, if there is one."""
        if wrong.fill_null(False).any():
            row = first_row(wrong.fill_null(False))
            cell = self.frame[column][row]
            found = f"{cell[:40]!r}" if isinstance(cell, str) else "empty" if cell is None else f"{cell:g}"
            raise UnusableInput(f"{self.location(row, column)}: {found}, expected {expected}")

    def numbers(self, column: str) -> pl.Series:
        """The column as Float64, null where empty or NaN; raises UnusableInput at a text, or for another type."""
        cells = self.frame[column]
        if cells.dtype != pl.String:
            if not (cells.dtype.is_numeric() or cells.dtype == pl.Null):
                raise UnusableInput(f"{self.path}: column {column} has type {cells.dtype}, expected plain numbers")
            return cells.cast(pl.Float64).fill_nan(None)
        text = points = cells.str.strip_chars()
        if self.thousands:
            mark, point = re.escape(self.thousands), re.escape(self.decimal)
            grouped = text.str.contains(rf"^[-+]?\d{{1,3}}(?:{mark}\d{{3}})+(?:{point}\d*)?$").fill_null(False)
            points = text.str.replace_all(self.thousands, "", literal=True).zip_with(grouped, text)
        if self.decimal == ",":
            # A point, as it groups thousands, is then no part of a number.
            points = points.str.replace(".", "x", literal=True).str.replace(",", ".", literal=True)
        numbers = points.cast(pl.Float64, strict=False)
        if (wrong := numbers.is_null() & (text != "").fill_null(False)).any():
            self.refuse(wrong, column, f"a number; {remedy(text[first_row(wrong)], column)}")
        return numbers.fill_nan(None)


def first_row(rows: pl.Series) -> int:
    """The number of the first row that is true, of which there is one."""
    return int(rows.arg_max() or 0)


def remedy(text: str, column: str) -> str:
    """What to do about a text where a number is expected."""
    if text == column:
        return "its name stands again in it: remove that row, or `trackwright import` leaves the header out"
    words = next((words for form, words in _FOUND.items() if re.fullmatch(form, text)), "leave a missing cell empty")
    return words.format(column=column, text=text[:20], mark=text.lstrip("+-0123456789")[:1])


def read_table_file(path: Path) -> TableFile:
    """The raw columns of a `.csv`, `.csv.gz` or `.parquet` file; raises UnusableInput for a broken or empty file."""
    file = TableFile(path, read_parquet(path)) if path.name.lower().endswith(".parquet") else _csv(path)
    if file.frame.height == 0:
        raise UnusableInput(f"{path}: the table has no rows, expected at least one; remove the file if there are none")
    return file


def content_of_file(path: Path) -> bytes:
    """The bytes of a file, unpacked where its name ends with .gz; raises UnusableInput."""
    try:
        data = file_bytes(path)
        return gzip.decompress(data) if path.name.lower().endswith(".gz") else data
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or f"its gzip data are damaged or end too early: {error}"
        raise UnusableInput(f"{path}: cannot be read ({reason}); check the file and its permissions") from error


def read_parquet(path: Path) -> pl.DataFrame:
    """The columns of a Parquet file; raises UnusableInput for a broken file."""
    data = content_of_file(path)
    try:
        return pl.read_parquet(io.BytesIO(data))
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError) as error:
        raise UnusableInput(f"{path}: is a broken Parquet file ({str(error)[:100]}); write it again") from error


def _csv(path: Path) -> TableFile:
    """The cells of a CSV file as text; blank lines are left out."""
    data = content_of_file(path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        fix = "export it again as CSV in UTF-8"
        raise UnusableInput(f"{path}: is not UTF-8 text at byte {error.start}, expected CSV text; {fix}") from error
    if "\0" in text:
        raise UnusableInput(f"{path}: holds binary data, expected CSV text in UTF-8; export it again as CSV")
    lines = pl.DataFrame({"text": text.replace("\r\n", "\n").replace("\r", "\n").split("\n")}).with_row_index("line", 1)
    lines = lines.filter(pl.col("text").str.strip_chars() != "")
    if not lines.height:
        raise UnusableInput(f"{path}: the file is empty, expected a header line and rows; remove it if there are none")
    head = lines["text"][0]
    names = [name.strip() for name in next(csv.reader([head]))]
    if len(names) == 1 and (head.startswith("#") or any(mark in head for mark in ";\t")):
        raise UnusableInput(f"{path}: line 1 is {head[:60]!r}, expected names separated by commas; export it again")
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise UnusableInput(f"{path}: column {twice[0]!r} is duplicated in line 1, expected once; remove one")
    rows = lines[1:]
    unquoted = rows["text"].str.replace_all('"[^"]*"', "")
    cells = unquoted.str.count_matches(",", literal=True) + 1
    wrong = (cells != len(names)) | unquoted.str.contains('"', literal=True)
    if wrong.any():
        row = first_row(wrong)
        found = "a quote that is not closed" if '"' in unquoted[row] else f"{cells[row]} cells"
        found = f"row {row + 1} (line {rows['line'][row]}) has {found}, expected {len(names)} cells as in the header"
        raise UnusableInput(f"{path}: {found}; look for a truncated file or decimal commas")
    schema = dict.fromkeys(names, pl.String)
    body = "\n".join(rows["text"]).encode()
    frame = pl.read_csv(body, has_header=False, schema=schema) if rows.height else pl.DataFrame(schema=schema)
    return TableFile(path, frame, rows["line"])


def read_table(path: Path, name: str, rig: Rig, placed: bool = True) -> tuple[pl.DataFrame, list[str], list[str]]:
    """A table sorted by time, notices, ignored columns; or UnusableInput. `placed`: sensors must be in the rig."""
    file, kind = read_table_file(path), table_kinds()[name]
    expected, ignored = _columns(file, kind)
    times = _numbers(file, "t_s", _LATEST)
    file.refuse(times.is_null(), "t_s", "seconds; remove the row")
    present = [column for column in (*expected.values, *expected.optional) if column in file.frame.columns]
    columns = [times, *(_ids(file, column) for column in expected.ids)]
    columns += [_numbers(file, column, _LARGEST) for column in present]
    for column in expected.quality:
        with suppress(UnusableInput):  # it says something else
            columns.append(_numbers(file, column, _LARGEST))
            ignored.remove(column)
    frame, notices = pl.DataFrame(columns), list[str]()
    check_stds(file, frame, [column for column in expected.optional if column not in QUATERNION])
    if "qw" in frame.columns:
        square = frame.select(pl.sum_horizontal(pl.col(QUATERNION).pow(2), ignore_nulls=False)).to_series()
        file.refuse((square - 1).abs() > 0.1, "qw", "qw … qz of length 1; leave those of an unknown attitude empty")
    if placed:
        _check_sensors(file, frame, kind, rig)
    for column, unit in ((column.name, UNITS[column.unit]) for column in kind.columns if column.positive):
        if zeros := int((frame[column] == 0).sum()):
            notices.append(f"{name}: {name} of 0 {unit}: {zeros}; not used: leave the cell of a missing reading empty")
            frame = frame.with_columns(pl.when(pl.col(column) != 0).then(column).alias(column))
    frame, wraps = unwrapped(frame, expected.ids)
    notices += [f"{name}: {wrap}" for wrap in wraps]
    steps = frame["t_s"].diff()
    if unordered := int((steps < 0).sum()):
        _refuse_restart(file, frame.drop(set(expected.quality) & {*frame.columns}), expected.ids)
        count = f"{unordered} of {frame.height}, by {-float(steps.min()):.6g} s at most"  # type: ignore[arg-type]
        notices.append(f"{name}: rows earlier than the previous row: {count}; sorted")
        frame = frame.sort("t_s", maintain_order=True)
    return frame, notices, ignored


def _columns(file: TableFile, kind: Kind) -> tuple[Layout, list[str]]:
    """The columns of the format, and the names of others; refuses missing and misspelt ones."""
    present = file.frame.columns
    expected = kind.layout(present)
    required = ("t_s", *expected.ids, *(expected.values or kind.least))
    unknown = [column for column in present if column not in (*required, *expected.optional)]
    for column in required:
        if column not in present:
            near = difflib.get_close_matches(column, unknown, 1, 0.5)
            there = ", ".join(repr(c[:30]) for c in present[:14])
            instead = f"rename {near[0][:30]!r} if it is that column (check the unit)" if near else f"found {there}"
            raise UnusableInput(f"{file.path}: no column {column}, expected {', '.join(required)}; {instead}")
    if kind.attitude and 0 < len({*QUATERNION} & {*present}) < len(QUATERNION):
        raise UnusableInput(f"{file.path}: expected all of the columns qw, qx, qy, qz or none; add the others")
    absent = [column for column in expected.optional if column not in present]
    for column in unknown:
        near = difflib.get_close_matches(column.lower(), absent, 1, 0.75)
        if near or re.search(r"std|sigma|phase" if kind.numbered else r"std|sigma", column, re.IGNORECASE):
            meant = near or [c for c in expected.optional if c not in QUATERNION]
            words = " or ".join(meant[:3]) or "no such column"
            raise UnusableInput(f"{file.path}: unknown column {column[:40]!r}, expected {words}; rename or remove it")
    return expected, unknown


def _ids(file: TableFile, column: str) -> pl.Series:
    cells = file.frame[column]
    if not (cells.dtype.is_integer() or cells.dtype in (pl.String, pl.Categorical, pl.Enum, pl.Null)):
        raise UnusableInput(f"{file.path}: column {column} has type {cells.dtype}, expected text; ids are text")
    ids = cells.cast(pl.String).str.strip_chars()
    file.refuse(ids.str.contains(r"\p{Cc}"), column, "an id without the control character that it has; remove it")
    file.refuse(ids.fill_null("") == "", column, "an id; remove the row or name it")
    return ids


def _numbers(file: TableFile, column: str, largest: float) -> pl.Series:
    numbers = file.numbers(column)
    file.refuse(numbers.abs() > largest, column, "a finite number in SI units; leave the cell empty if it is missing")
    return numbers


def check_stds(file: TableFile, frame: pl.DataFrame, columns: Iterable[str]) -> None:
    """Raises UnusableInput with the row of a standard deviation that is not above zero, in one of these columns."""
    expected = "a standard deviation above zero; leave the cell empty if it is unknown"
    for column in columns:
        if column in frame.columns:
            file.refuse(frame[column] <= 0, column, expected)


def _check_sensors(file: TableFile, frame: pl.DataFrame, kind: Kind, rig: Rig) -> None:
    """Refuses anchors and stations that the rig lacks, differences of one anchor, and phases that fit no array."""
    known = kind.places(rig)
    expected = f"one of rig.toml: {listed(known, 12)}; ids are text and must be spelt the same"
    if not known:
        survey = ", or find them by `trackwright survey`" if kind.name == "ranges" else ""
        expected = f"a position in rig.toml, which has none; add [{kind.noun}s]{survey}"
    for column in kind.sensors:
        file.refuse(~frame[column].is_in(pl.Series([*known], dtype=pl.String).implode()), column, expected)
    if kind.difference:
        first, second = kind.sensors
        file.refuse(frame[first] == frame[second], second, f"another than {first}")
    if not kind.numbered:
        return
    stations = {name: rig.stations[name].antennas for name in frame[kind.noun].unique(maintain_order=True)}
    bare = pl.Series([name for name, antennas in stations.items() if antennas is None], dtype=pl.String)
    array = "a station with antennas_m and wavelength_m in rig.toml; add both, or give its angles in the table bearings"
    file.refuse(frame[kind.noun].is_in(bare.implode()), kind.noun, array)
    counts = {name: len(antennas) for name, antennas in stations.items() if antennas is not None}
    phases, most = kind.layout(frame.columns).values, max(counts.values())
    names = [kind.columns[0].name.format(n=n + 1) for n in range(most)]
    if {*phases} != {*names}:
        expected = f"expected {names[0]} … {names[-1]}, one for each antenna of the largest station in rig.toml"
        raise UnusableInput(f"{file.path}: {len(phases)} phase columns, {expected}; leave cells without a phase empty")
    for number, column in enumerate(names):
        fewer = pl.Series([name for name, count in counts.items() if count <= number], dtype=pl.String)
        beyond = frame[kind.noun].is_in(fewer.implode()) & frame[column].is_not_null()
        file.refuse(beyond, column, "an empty cell, since the station has fewer antennas in rig.toml")


def _refuse_restart(file: TableFile, frame: pl.DataFrame, ids: tuple[str, ...]) -> None:
    """Raises UnusableInput where the clock of a sensor and tag restarts."""
    rows = frame.with_row_index("row").unique(subset=frame.columns, keep="first", maintain_order=True)
    for part in rows.partition_by(ids, maintain_order=True):
        t = part["t_s"].to_numpy()
        if (at := restarted_at(t, frame["t_s"].to_numpy())) is not None:
            found = f"{t[at]:.3f} after {t[:at].max():.3f} of the same {' and '.join(ids[::-1])}: the clock went back"
            fix = "expected times that increase; make two recordings of it, or sort rows that are out of order alone"
            raise UnusableInput(f"{file.location(part['row'][at], 't_s')}: {found}; {fix}")


def unwrapped(table: pl.DataFrame, ids: Sequence[str]) -> tuple[pl.DataFrame, list[str]]:
    """The table with the times of a counter that wrapped, each part after the one before, and a notice that says so."""
    first = pl.struct(ids).is_first_distinct() if ids else pl.int_range(pl.len()) == 0
    t, begins = table["t_s"].to_numpy(), table.select(first).to_series().to_numpy()
    # Rows of one sensor may stand after those of another: a step back into the first of them is none of the clock.
    steps = np.where(begins[1:], 0.0, np.diff(t))
    usual = float(np.quantile(np.abs(steps[steps != 0]), 0.95)) if steps.any() else 0.0
    for period, words in WRAPS.items():
        # Messages may be missing at the wrap; readings as rare as the period say nothing of one.
        back = np.abs(steps + period) < np.clip(5.0 * usual, 1e-3 * period, 0.05 * period)
        if back.any() and np.ptp(t) < 1.001 * period:
            turns = back.astype(int) - (np.abs(steps - period) < 1e-3 * period)
            times = np.concatenate([t[:1], t[1:] + period * np.cumsum(turns)])
            at = ", ".join(str(k + 2) for k in np.flatnonzero(back)[:4])
            notice = f"the clock goes back by {words} at row {at}: a counter that wraps; unwrapped"
            return table.with_columns(t_s=times), [notice]
    return table, []


def restarted_at(t: np.ndarray, others: np.ndarray | None = None) -> int | None:
    """The first of times (n,), s, that goes back, unlike late rows, and repeats earlier times or is far from them.

    Far also from the times of `others`, since one sensor may be out of reach.
    """
    latest = np.maximum.accumulate(t)
    late = max(JITTER_S, JITTER * float(np.median(np.abs(np.diff(t, prepend=t[0])))))
    behind = t < latest - late
    for start, end in np.flatnonzero(np.diff(behind, prepend=False, append=False)).reshape(-1, 2):
        first, last = t[start:end].min(), t[start:end].max()
        if end - start >= LEAST_AGAIN and first < last:
            repeats, every = t[~behind & (t > first)].min() < last, t if others is None else others
            # Parts of a file that are out of order follow each other, or have dates.
            restarts = first < UNIX_S or abs(t[start - 1] - t[start] - HOUR_S) < late
            if repeats or (restarts and every[every > last].min() - last > FAR * late):
                return int(start)
    return None
