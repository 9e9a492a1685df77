"""The reader of the tables of a recording folder, which checks and converts their columns."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.kinds import QUATERNION, Kind, Layout, table_kinds, unit_of
from trackwright.trackers.recordings.table_file import TableFile, first_row, read_table_file, remedy

JITTER_S, JITTER = 1.0, 5.0
"""Rows count as late, and are sorted, up to this many s, or median steps of their sensor and tag."""

LEAST_AGAIN = 5
"""Rows that repeat earlier times from which a clock went back."""

WRAPS = {2.0**32 * 1e-6: "2³² µs (4294.967 s)", 2.0**32 * 1e-3: "2³² ms (4294967.296 s)"}
"""Periods of counters of 32 bits, s, in words."""

_CONTROL = r"\p{Cc}"
_LARGEST = 1e15  # its square is within the range of a 32-bit float
_LATEST = 1e20  # beyond nanoseconds since 1970


def read_table(path: Path, name: str, rig: Rig, placed: bool = True) -> tuple[pl.DataFrame, list[str], list[str]]:
    """The table in `path`, sorted by time, null where a value is missing, notices of changes, and ignored columns.

    Ids are String, all other columns Float64. Columns of signal quality are kept where all cells are numbers. `placed`:
    whether all anchors and stations must be in the rig. Raises UnusableInput with file, row and column.
    """
    file, kind = read_table_file(path), table_kinds()[name]
    expected, ignored = _columns(file, kind)
    ids = [_ids(file, column) for column in expected.ids]
    times = _numbers(file, "t_s", _LATEST)
    if times.has_nulls():
        raise UnusableInput(
            f"{file.location(first_row(times.is_null()), 't_s')}: no time, expected seconds; remove the row"
        )
    numbers = [_numbers(file, c, _LARGEST) for c in (*expected.values, *expected.optional) if c in file.frame.columns]
    quality = [column for column in map(partial(_quality, file), expected.quality) if column is not None]
    ignored = [name for name in ignored if name not in {column.name for column in quality}]
    frame = pl.DataFrame([times, *ids, *numbers, *quality])
    check_stds(file, frame, [column for column in expected.optional if column not in QUATERNION])
    _check_quaternions(file, frame)
    if placed:
        _check_sensors(file, frame, kind, rig)
    notices = []
    for column in (column.name for column in kind.columns if column.positive):
        zero = int((frame[column] == 0).sum())
        if zero:
            text = f"{name}: {name} of 0 {unit_of(column)}: {zero}; not used: leave the cell of a missing reading empty"
            notices.append(text)
            frame = frame.with_columns(pl.when(pl.col(column) != 0).then(column).alias(column))
    unwrapped, wraps = unwrapped_times(frame["t_s"].to_numpy())
    notices += [f"{name}: {wrap}" for wrap in wraps]
    frame = frame.with_columns(t_s=unwrapped) if wraps else frame
    unordered = int((frame["t_s"].diff() < 0).sum())
    if unordered:
        _refuse_restart(file, frame.drop(column.name for column in quality), expected.ids)
        most = -float(frame["t_s"].diff().min())  # type: ignore[arg-type]
        count = f"{unordered} of {frame.height}, by {most:.6g} s at most"
        notices.append(f"{name}: rows earlier than the previous row: {count}; sorted")
        frame = frame.sort("t_s", maintain_order=True)
    return frame, notices, ignored


def _columns(file: TableFile, kind: Kind) -> tuple[Layout, list[str]]:
    present = file.frame.columns
    expected = kind.layout(present)
    required = ("t_s", *expected.ids, *(expected.values or kind.least))
    known = {*required, *expected.optional}
    unknown = [c for c in present if c not in known]
    for column in required:
        if column not in present:
            near = difflib.get_close_matches(column, unknown, 1, 0.5)
            there = ", ".join(repr(c[:30]) for c in present[:14])
            instead = f"rename {near[0][:30]!r} if it is that column (check the unit)" if near else f"found {there}"
            raise UnusableInput(f"{file.path}: no column {column}, expected {', '.join(required)}; {instead}")
    numbered = sorted(number for number in map(kind.number_of, expected.values) if number is not None)
    if numbered != list(range(1, len(numbered) + 1)):
        first = kind.columns[0].name.format
        raise UnusableInput(
            f"{file.path}: columns are numbered {numbered}, expected {first(n=1)} … {first(n='N')} without gaps; "
            "leave the column of an unused antenna empty"
        )
    quaternion = [c for c in QUATERNION if c in present]
    if kind.attitude and 0 < len(quaternion) < 4:
        raise UnusableInput(f"{file.path}: columns {', '.join(quaternion)}, expected all of qw, qx, qy, qz or none")
    absent = [c for c in expected.optional if c not in present]
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
    ids = cells.cast(pl.String)
    # The few different ids first.
    different = ids.unique()
    if different.str.strip_chars().str.contains(_CONTROL).any():
        row = first_row(ids.str.strip_chars().str.contains(_CONTROL).fill_null(False))
        raise UnusableInput(
            f"{file.location(row, column)}: {ids[row]!r} has a control character; remove it from the id"
        )
    if not (different.has_nulls() or (different == "").any() or (different.str.strip_chars() != different).any()):
        return ids
    ids = ids.str.strip_chars()
    missing = ids.is_null() | (ids == "")
    if missing.any():
        raise UnusableInput(
            f"{file.location(first_row(missing), column)}: empty, expected an id; remove the row or name it"
        )
    return ids


def _numbers(file: TableFile, column: str, largest: float) -> pl.Series:
    """The column as Float64, null where empty or NaN."""
    cells = file.frame[column]
    if cells.dtype == pl.String:
        text = cells.str.strip_chars()
        numbers = text.cast(pl.Float64, strict=False)
        wrong = numbers.is_null() & text.is_not_null() & (text != "")
        if wrong.any():
            row = first_row(wrong)
            raise UnusableInput(
                f"{file.location(row, column)}: {text[row][:40]!r}, expected a number; {remedy(text[row], column)}"
            )
    elif cells.dtype.is_numeric() or cells.dtype == pl.Null:
        numbers = cells.cast(pl.Float64)
    else:
        raise UnusableInput(f"{file.path}: column {column} has type {cells.dtype}, expected plain numbers in SI units")
    numbers = numbers.fill_nan(None)
    beyond = (numbers.abs() > largest).fill_null(False)
    if beyond.any():
        row = first_row(beyond)
        raise UnusableInput(
            f"{file.location(row, column)}: {numbers[row]:g}, expected a finite number in SI units; "
            "leave the cell empty if it is missing"
        )
    return numbers


def _quality(file: TableFile, column: str) -> pl.Series | None:
    """A column of signal quality as Float64; None where a cell is no number, so that it says something else."""
    try:
        return _numbers(file, column, _LARGEST)
    except UnusableInput:
        return None


def check_stds(file: TableFile, frame: pl.DataFrame, columns: Iterable[str]) -> None:
    """Raises UnusableInput with the row of a standard deviation that is not above zero, in one of these columns."""
    for column in columns:
        if column in frame.columns:
            wrong = (frame[column] <= 0).fill_null(False)
            if wrong.any():
                row = first_row(wrong)
                raise UnusableInput(
                    f"{file.location(row, column)}: {frame[column][row]:g}, expected a standard deviation above zero; "
                    "leave the cell empty if it is unknown"
                )


def _check_quaternions(file: TableFile, frame: pl.DataFrame) -> None:
    if "qw" in frame.columns:
        zero = frame.select(pl.sum_horizontal(pl.col(QUATERNION).abs(), ignore_nulls=False) == 0).to_series()
        if zero.any():
            raise UnusableInput(
                f"{file.location(first_row(zero), 'qw')}: a zero quaternion, expected a unit quaternion; "
                "leave its four cells empty if the attitude is unknown"
            )


def _check_sensors(file: TableFile, frame: pl.DataFrame, kind: Kind, rig: Rig) -> None:
    known = kind.places(rig)
    for column in kind.sensors:
        for sensor in frame[column].unique(maintain_order=True):
            if sensor not in known:
                row = first_row(frame[column] == sensor)
                if not known:
                    raise UnusableInput(
                        f"{file.location(row, column)}: {column} {sensor!r}: rig.toml gives no {kind.noun} a position; "
                        f"add [{kind.noun}s]" + (", or find them by `trackwright survey`" * (kind.name == "ranges"))
                    )
                there = ", ".join(list(known)[:12]) + (" …" if len(known) > 12 else "")
                raise UnusableInput(
                    f"{file.location(row, column)}: {column} {sensor!r} is not in rig.toml, expected one of: {there}; "
                    "ids are text and must be spelt the same"
                )
    if kind.difference:
        first, second = kind.sensors
        same = frame[first] == frame[second]
        if same.any():
            row = first_row(same)
            raise UnusableInput(
                f"{file.location(row, second)}: {second} {frame[second][row]!r} is the {first}, too; expected another"
            )
    if kind.numbered:
        stations = frame[kind.noun].unique(maintain_order=True)
        _check_antennas(file, frame, kind, {name: rig.stations[name].antennas for name in stations})


def _check_antennas(file: TableFile, frame: pl.DataFrame, kind: Kind, arrays: dict) -> None:
    """Refuses a number of phase columns other than the antennas of the largest array; smaller ones use the first."""
    phases = kind.layout(frame.columns).values
    for station, antennas in arrays.items():
        if antennas is None:
            raise UnusableInput(
                f"{file.path}: station {station!r} has phases but no antennas_m and wavelength_m in rig.toml; "
                "add both, or give its angles in the table bearings"
            )
    largest = max(len(antennas) for antennas in arrays.values())
    for station, antennas in arrays.items():
        beyond = [frame[name].is_not_null() for name in phases[len(antennas) :]]
        if len(phases) != largest or any((filled & (frame["station"] == station)).any() for filled in beyond):
            raise UnusableInput(
                f"{file.path}: {len(phases)} phase columns, but station {station!r} has {len(antennas)} antennas in "
                "rig.toml, expected as many; leave the cell of an antenna without a phase empty"
            )


def _refuse_restart(file: TableFile, frame: pl.DataFrame, ids: tuple[str, ...]) -> None:
    """Raises UnusableInput where the clock of a sensor and tag restarts."""
    rows = frame.with_row_index("row").unique(subset=frame.columns, keep="first", maintain_order=True)
    for part in rows.partition_by(ids, maintain_order=True):
        t = part["t_s"].to_numpy()
        at = restarted_at(t)
        if at is not None:
            raise UnusableInput(
                f"{file.location(part['row'][at], 't_s')}: {t[at]:.3f} after {t[:at].max():.3f} of the same "
                f"{' and '.join(reversed(ids))}: the clock went back; expected times that increase; make the rows "
                "before and after it two recordings"
            )


def unwrapped_times(t: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Times (n,), s, of a counter that wrapped, each part after the one before, and a notice that says so."""
    steps = np.diff(t)
    for period, words in WRAPS.items():
        # Messages may be missing at the wrap.
        back = np.abs(steps + period) < max(1e-3 * period, 5.0 * float(np.median(np.abs(steps)) if len(steps) else 0.0))
        if back.any():
            turns = back.astype(int) - (np.abs(steps - period) < 1e-3 * period)
            times = np.concatenate([t[:1], t[1:] + period * np.cumsum(turns)])
            at = ", ".join(str(k + 2) for k in np.flatnonzero(back)[:4])
            return times, [f"the clock goes back by {words} at row {at}: a counter that wraps; unwrapped"]
    return t, []


def restarted_at(t: np.ndarray) -> int | None:
    """The first row of times (n,), s, at which they go back and then repeat times that they had before; None without.

    Late rows do not, which fill a gap, nor duplicates, nor rows in any order, whose steps are as large.
    """
    latest = np.maximum.accumulate(t)
    behind = t < latest - max(JITTER_S, JITTER * float(np.median(np.abs(np.diff(t, prepend=t[0])))))
    for start, end in np.flatnonzero(np.diff(behind, prepend=False, append=False)).reshape(-1, 2):
        again = t[start:end]
        if len(again) >= LEAST_AGAIN and (~behind & (t > again.min()) & (t < again.max())).any():
            return int(start)
    return None
