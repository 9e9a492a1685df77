"""The column of signal quality that the noise of calibrated ranges follows; the fit is in `tuning/range_quality.py`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trackwright.trackers.recordings.input_file import TomlReader

LARGEST = 3.0
"""Standard deviations from its mean beyond which a quality says no more about noise."""


class RangeQuality(NamedTuple):
    """The column of ranges that their noise follows: log σ changes by `slope` · z.

    z is the quality about its mean `centre` in units of its standard deviation `spread`, both of the recordings of the
    fit. `standard_error`: of the slope. `gain`: by how much ranges left out of the fit are more probable, mean in nats.
    """

    column: str
    centre: float
    spread: float
    slope: float
    standard_error: float
    gain: float

    @classmethod
    def read(cls, reader: TomlReader, where: str, content: dict[str, Any]) -> RangeQuality:
        """That in a table of a file, which has exactly its fields; the reader refuses others."""
        column, *numbers = (content[name] for name in cls._fields)
        if not isinstance(column, str) or not column:
            reader.wrong(f"{where}.column", column, "the name of a column of ranges")
        values = [reader.number(f"{where}.{name}", x) for name, x in zip(cls._fields[1:], numbers, strict=True)]
        if values[1] <= 0.0:
            reader.wrong(f"{where}.spread", content["spread"], "a number above zero")
        return cls(column, *values)

    def standardised(self, values: np.ndarray) -> np.ndarray:
        """z, at most `LARGEST` in size; zero where a quality is missing."""
        return np.nan_to_num(np.clip((values - self.centre) / self.spread, -LARGEST, LARGEST))
