"""The tables of a recording folder: which columns they have, and the checks and types that make one usable."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from trackers.core.errors import UnusableInput
from trackers.core.rig import Rig
from trackers.recordings.cells import Cells, read_cells

MEASUREMENTS = ("ranges", "fixes", "bearings", "phases", "imu")
TABLES = (*MEASUREMENTS, "truth")
QUATERNION = ("qw", "qx", "qy", "qz")

_SENSOR = {"ranges": "anchor", "bearings": "station", "phases": "station"}
_AXES = ("x", "y", "z")
_PLACE = tuple(f"{axis}_m" for axis in _AXES)
_VALUES = {
    "ranges": ("range_m",),
    "fixes": _PLACE,
    "bearings": ("azimuth_rad", "elevation_rad"),
    "imu": (*(f"accel_{axis}_mps2" for axis in _AXES), *(f"gyro_{axis}_radps" for axis in _AXES)),
    "truth": _PLACE,
}
_PHASE = re.compile(r"phase_([1-9]\d*)_rad")
_LARGEST = 1e15  # its square still fits a 32-bit float
_LATEST = 1e20  # more than the nanoseconds since 1970


@dataclass(frozen=True)
class Layout:
    """A table's columns: ids, values, and the optional ones it may carry."""

    ids: tuple[str, ...]
    values: tuple[str, ...]
    optional: tuple[str, ...]


def layout(name: str, columns: list[str]) -> Layout:
    """The columns that table `name` has to have and may have; those of `phases` follow from its `columns`."""
    values = _VALUES[name] if name != "phases" else tuple(c for c in columns if _PHASE.fullmatch(c))
    ids = ("tag", _SENSOR[name]) if name in _SENSOR else ("tag",)
    spreads = tuple(std_column(c) for c in values) + (("phase_std_rad",) if name == "phases" else ())
    return Layout(ids, values, spreads + (QUATERNION if name in ("imu", "truth") else ()))


def std_column(value: str) -> str:
    """The name of the column with the standard deviation of `value`: `range_m` gives `range_std_m`."""
    quantity, _, unit = value.rpartition("_")
    return f"{quantity}_std_{unit}"


def read_table(path: Path, name: str, rig: Rig) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """The table in `path`, sorted by time, with null where a value is missing, and what was odd about the file.

    Ids are String, everything else Float64. Raises UnusableInput with file, row and column.
    """
    cells = read_cells(path)
    expected, ignored = _columns(cells, name)
    ids = [_ids(cells, column) for column in expected.ids]
    times = _numbers(cells, "t_s", _LATEST)
    if times.has_nulls():
        raise UnusableInput(f"{cells.place(_first(times.is_null()), 't_s')}: no time, expected seconds; remove the row")
    numbers = [_numbers(cells, c, _LARGEST) for c in (*expected.values, *expected.optional) if c in cells.frame.columns]
    frame = pl.DataFrame([times, *ids, *numbers])
    _check_spreads(cells, frame, expected)
    _check_quaternions(cells, frame)
    _check_sensors(cells, frame, name, rig)
    notices = [f"{name}: column {c!r} of {path.name} is not part of the format and was ignored" for c in ignored]
    late = int((frame["t_s"].diff() < 0).sum())
    if late:
        notices.append(f"{name}: rows earlier than the row above them: {late} of {frame.height}; sorted")
        frame = frame.sort("t_s", maintain_order=True)
    return frame, tuple(notices)


def _columns(cells: Cells, name: str) -> tuple[Layout, list[str]]:
    found = cells.frame.columns
    expected = layout(name, found)
    required = ("t_s", *expected.ids, *(expected.values or ("phase_1_rad",)))
    known = {*required, *expected.optional}
    strange = [c for c in found if c not in known]
    for column in required:
        if column not in found:
            near = difflib.get_close_matches(column, strange, 1, 0.5)
            there = ", ".join(repr(c[:30]) for c in found[:14])
            instead = f"rename {near[0][:30]!r} if that is it (and mind the unit)" if near else f"found {there}"
            raise UnusableInput(f"{cells.path}: no column {column}, expected {', '.join(required)}; {instead}")
    numbered = sorted(int(match[1]) for match in map(_PHASE.fullmatch, expected.values) if match)
    if name == "phases" and numbered != list(range(1, len(numbered) + 1)):
        raise UnusableInput(
            f"{cells.path}: phase columns are numbered {numbered}, expected phase_1_rad … phase_N_rad without a hole; "
            "an antenna that was never seen keeps its column, empty"
        )
    quaternion = [c for c in QUATERNION if c in found]
    if name in ("imu", "truth") and 0 < len(quaternion) < 4:
        raise UnusableInput(f"{cells.path}: columns {', '.join(quaternion)}, expected all of qw, qx, qy, qz or none")
    absent = [c for c in expected.optional if c not in found]
    for column in strange:
        near = difflib.get_close_matches(column.lower(), absent, 1, 0.75)
        if near or re.search(r"std|sigma|phase", column, re.IGNORECASE):
            meant = near or [c for c in expected.optional if c not in QUATERNION]
            words = " or ".join(meant[:3]) or "no such column"
            raise UnusableInput(f"{cells.path}: unknown column {column[:40]!r}, expected {words}; rename or remove it")
    return expected, strange


def _ids(cells: Cells, column: str) -> pl.Series:
    found = cells.frame[column]
    if not (found.dtype.is_integer() or found.dtype in (pl.String, pl.Categorical, pl.Enum, pl.Null)):
        raise UnusableInput(f"{cells.path}: column {column} has type {found.dtype}, expected text; ids are text")
    ids = found.cast(pl.String).str.strip_chars()
    missing = ids.is_null() | (ids == "")
    if missing.any():
        raise UnusableInput(f"{cells.place(_first(missing), column)}: empty, expected an id; remove the row or name it")
    return ids


def _numbers(cells: Cells, column: str, largest: float) -> pl.Series:
    """The column as Float64, null where empty or NaN."""
    found = cells.frame[column]
    if found.dtype == pl.String:
        text = found.str.strip_chars()
        numbers = text.cast(pl.Float64, strict=False)
        wrong = numbers.is_null() & text.is_not_null() & (text != "")
        if wrong.any():
            row = _first(wrong)
            raise UnusableInput(
                f"{cells.place(row, column)}: {text[row][:40]!r}, expected a number; leave a missing cell empty"
            )
    elif found.dtype.is_numeric() or found.dtype == pl.Null:
        numbers = found.cast(pl.Float64)
    else:
        raise UnusableInput(f"{cells.path}: column {column} has type {found.dtype}, expected plain numbers in SI units")
    numbers = numbers.fill_nan(None)
    beyond = (numbers.abs() > largest).fill_null(False)
    if beyond.any():
        row = _first(beyond)
        raise UnusableInput(
            f"{cells.place(row, column)}: {numbers[row]:g}, expected a finite number in SI units; "
            "leave the cell empty if it is missing"
        )
    return numbers


def _check_spreads(cells: Cells, frame: pl.DataFrame, expected: Layout) -> None:
    for column in expected.optional:
        if column in frame.columns and column not in QUATERNION:
            wrong = (frame[column] <= 0).fill_null(False)
            if wrong.any():
                row = _first(wrong)
                raise UnusableInput(
                    f"{cells.place(row, column)}: {frame[column][row]:g}, expected a standard deviation above zero; "
                    "leave the cell empty if it is unknown"
                )


def _check_quaternions(cells: Cells, frame: pl.DataFrame) -> None:
    if "qw" in frame.columns:
        zero = frame.select(pl.sum_horizontal(pl.col(QUATERNION).abs(), ignore_nulls=False) == 0).to_series()
        if zero.any():
            raise UnusableInput(
                f"{cells.place(_first(zero), 'qw')}: a quaternion of zeros, expected a unit quaternion; "
                "leave its four cells empty if the attitude is unknown"
            )


def _check_sensors(cells: Cells, frame: pl.DataFrame, name: str, rig: Rig) -> None:
    if name not in _SENSOR:
        return
    column = _SENSOR[name]
    known = rig.anchors if column == "anchor" else rig.stations
    heard = frame[column].unique(maintain_order=True).to_list()
    for sensor in heard:
        if sensor not in known:
            row = _first(frame[column] == sensor)
            listed = ", ".join(list(known)[:12]) + (" …" if len(known) > 12 else "") if known else "none"
            raise UnusableInput(
                f"{cells.place(row, column)}: {column} {sensor!r} is not in rig.toml, expected one of: {listed}; "
                "ids are text and must agree to the letter"
            )
    if name == "phases":
        _check_antennas(cells, frame, {sensor: rig.stations[sensor].antennas for sensor in heard})


def _check_antennas(cells: Cells, frame: pl.DataFrame, arrays: dict) -> None:
    """As many phase columns as antennas; where stations differ, the smaller arrays leave their last columns empty."""
    phases = [c for c in frame.columns if _PHASE.fullmatch(c)]
    for station, antennas in arrays.items():
        if antennas is None:
            raise UnusableInput(
                f"{cells.path}: station {station!r} has phases but no antennas_m and wavelength_m in rig.toml; "
                "add both, or give its angles in the table bearings"
            )
    largest = max(len(antennas) for antennas in arrays.values())
    for station, antennas in arrays.items():
        beyond = frame.filter(pl.col("station") == station).select(phases[len(antennas) :])
        if len(phases) != largest or any(column.count() for column in beyond):
            raise UnusableInput(
                f"{cells.path}: {len(phases)} phase columns, but station {station!r} has {len(antennas)} antennas in "
                "rig.toml, expected as many; an antenna that was not seen keeps its column, empty"
            )


def _first(rows: pl.Series) -> int:
    found = rows.arg_max()
    assert found is not None
    return int(found)
