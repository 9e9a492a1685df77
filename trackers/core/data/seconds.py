"""Times that a user holds as seconds: numbers, NumPy's and pandas' time stamps and durations; and times as text."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.errors import UnusableInput

UNIX_S, UNIX_MS = 1e8, 1e11
"""Times from `UNIX_S` on count from 1970, in s below `UNIX_MS`: no recording lasts the three years before."""

HOLE_S, HOLE_M = 1.0, 0.02
"""Limits of interpolated truth, s and m: between rows that exceed both there is none."""


def seconds(times: Any) -> Float[np.ndarray, "*shape"]:
    """Numbers as they are, time stamps as seconds since 1970 (UTC where they have a time zone), durations as seconds.

    Raises UnusableInput for a missing time stamp, and for one of months or years.
    """
    values = np.asarray(times)
    if values.dtype == object and values.size and hasattr(values.flat[0], "timestamp"):
        # Time stamps with a time zone.
        values = np.array([np.nan if stamp is None or stamp != stamp else stamp.timestamp() for stamp in values.flat])
    elif values.dtype.kind in "mM":
        unit, _ = np.datetime_data(values.dtype)
        if unit in ("generic", "Y", "M"):
            raise UnusableInput(f"times of type {values.dtype}; expected seconds, or time stamps of days or finer")
        # Whole seconds and fractions separately: nanoseconds since 1970 have more digits than a float.
        missing = np.isnat(values)
        fine = values.astype(f"{'datetime64' if values.dtype.kind == 'M' else 'timedelta64'}[ns]").astype(np.int64)
        values = np.where(missing, np.nan, fine // 10**9 + (fine % 10**9) / 1e9)
    else:
        return np.asarray(values, np.float64)
    if np.isnan(values).any():
        raise UnusableInput(f"times[{int(np.argmax(np.isnan(values)))}] is missing (NaT); leave the row out")
    return values


def zero_of(first: float) -> float:
    """The zero, s, of the displayed times of a recording that begins at `first`: `first` if that counts from 1970."""
    return float(first) if UNIX_S <= first < np.inf else 0.0


def moment(time: float) -> str:
    """A time, s, for messages: the date and time of day, UTC, where it counts from 1970, else seconds."""
    if not UNIX_S <= time < UNIX_MS:
        return f"{round(float(time), 6):.12g} s"  # times since 1970 have steps of 0.24 µs
    text = datetime.fromtimestamp(round(float(time), 3), UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
    return text.rstrip("0").rstrip(".") + " UTC"


def span(first: float, last: float) -> str:
    """The time from `first` to `last`, s, for messages, each as a `moment`."""
    return f"{moment(first).removesuffix(' s')} to {moment(last)}"


def time_label(zero: float) -> str:
    """The label of an axis of times, s, after `zero`; with the date where times count from 1970."""
    return f"time (s) since {moment(zero)}" if zero else "time (s)"


def first_not_before(times: np.ndarray, low: np.ndarray, high: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The first index in `low` … `high` (N,) of a time that is not before `wanted` (N,); `high` where all are before.

    `times` (n,): sorted between each pair of `low` and `high`.
    """
    for _ in range(int((high - low).max(initial=0)).bit_length()):
        middle = (low + high) // 2
        earlier = times[middle] < wanted
        low, high = np.where(earlier & (low < high), middle + 1, low), np.where(earlier, high, middle)
    return high
