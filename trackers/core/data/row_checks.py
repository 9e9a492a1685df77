"""The check of a recording's rows: sorted times, arrays of one row per time, finite numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from trackwright.trackers.core.errors import UnusableInput


class ReadingArrays(Protocol):
    """The arrays of a sensor's readings: values, their mask, and reported noise."""

    @property
    def values(self) -> np.ndarray: ...
    @property
    def seen(self) -> np.ndarray: ...
    @property
    def reported(self) -> np.ndarray | None: ...


def check_rows(
    name: str,
    times: np.ndarray,
    readings: Mapping[str, ReadingArrays],
    inputs: Mapping[str, np.ndarray],
    truth: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> None:
    """Raises UnusableInput, naming the recording, where times are unsorted, shapes differ or a number isn't finite."""
    check_times(name, times)
    for sensor, own in readings.items():
        _check_readings(f"{name}: readings['{sensor}']", own, len(times))
    for quantity, values in inputs.items():
        _check_array(f"{name}: inputs['{quantity}']", values, len(times))
    for quantity, (values, known) in truth.items():
        _check_array(f"{name}: truth['{quantity}']", values, len(times))
        _check_array(f"{name}: truth['{quantity}'], where it is known,", known, len(times))


def check_times(name: str, times: np.ndarray) -> None:
    """Raises UnusableInput, by the recording's name, where the times (T,) of its rows are not finite or unsorted."""
    if times.ndim != 1 or len(times) == 0:
        raise UnusableInput(f"{name}: times have shape {times.shape}, expected (T,) with at least one row")
    if not np.all(np.isfinite(times)):
        raise UnusableInput(f"{name}: times[{int(np.argmin(np.isfinite(times)))}] is not finite")
    if np.any(np.diff(times) < 0):
        row = int(np.argmax(np.diff(times) < 0)) + 1
        raise UnusableInput(f"{name}: times[{row}] = {times[row]} s comes before the row above; sort the rows first")


def _check_array(what: str, array: np.ndarray, rows: int) -> None:
    array = np.asarray(array)
    found = len(array) if array.ndim else 0
    if found != rows:
        raise UnusableInput(f"{what} has {found} rows, expected {rows}, one for each time")
    bad = ~np.isfinite(array)
    if bad.any():
        row = np.argwhere(bad)[0][0]
        raise UnusableInput(f"{what} row {row} is not finite; mark what is missing by a mask")


def _check_readings(what: str, readings: ReadingArrays, rows: int) -> None:
    values, seen = np.asarray(readings.values), np.asarray(readings.seen)
    if values.ndim != 2 or len(values) != rows or seen.shape != values.shape:
        raise UnusableInput(f"{what} has values {values.shape} and seen {seen.shape}, expected ({rows}, channels) both")
    reported = np.zeros((rows, 0)) if readings.reported is None else readings.reported
    if len(reported) != rows:
        raise UnusableInput(f"{what}.reported has {len(reported)} rows, expected {rows}")
    for array in (values, reported):
        bad = ~np.isfinite(array)
        if bad.any():
            row, channel = np.argwhere(bad)[0]
            raise UnusableInput(
                f"{what} row {row}, channel {channel} is not finite; for a missing value store 0 and set seen to False"
            )


def read_only(array: ArrayLike) -> np.ndarray:
    """A view of the array that refuses assignment."""
    view = np.asarray(array).view()
    view.flags.writeable = False
    return view
