"""Times that a user holds as seconds: numbers, NumPy's and pandas' time stamps and durations in any unit."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float


def seconds(times: Any) -> Float[np.ndarray, "*shape"]:
    """Numbers as they are, time stamps as seconds since 1970 (UTC where they have a time zone), durations as seconds.

    Raises ValueError for a missing time stamp, and for one of months or years.
    """
    values = np.asarray(times)
    if values.dtype == object and values.size and hasattr(values.flat[0], "timestamp"):
        # Time stamps with a time zone.
        values = np.array([np.nan if one is None or one != one else one.timestamp() for one in values.flat])
    elif values.dtype.kind in "mM":
        unit, _ = np.datetime_data(values.dtype)
        if unit in ("generic", "Y", "M"):
            raise ValueError(f"times of type {values.dtype}; expected seconds, or time stamps of days or finer units")
        # Whole and broken seconds apart: nanoseconds since 1970 have more digits than a float.
        missing = np.isnat(values)
        fine = values.astype(f"{'datetime64' if values.dtype.kind == 'M' else 'timedelta64'}[ns]").astype(np.int64)
        values = np.where(missing, np.nan, fine // 10**9 + (fine % 10**9) / 1e9)
    else:
        return np.asarray(values, np.float64)
    if np.isnan(values).any():
        raise ValueError(f"times[{int(np.argmax(np.isnan(values)))}] is missing (NaT); leave the row out")
    return values
