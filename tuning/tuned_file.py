"""`tuned.toml`: fitted values with unit and standard error, written by `tune` and read by `track --noise`; `--set`."""

from __future__ import annotations

import fnmatch
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import AfterValidator, BaseModel, Field

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.files import atomic_write, read_model

if TYPE_CHECKING:
    from trackwright.trackers.recordings.named_tracker import NamedTracker
    from trackwright.tuning.fitting import FitResult
    from trackwright.tuning.uncertainty import Interval

COMMENT = "# Written by `trackwright tune`; read by `trackwright track --noise`.\n"


def write_tuned(path: Path | str, content: Mapping[str, Any]) -> Path:
    """Writes a tuned.toml of plain numbers: `tracker`, and `tunables`, a `value` and `unit` by name."""
    text = COMMENT + tomli_w.dumps(content)
    return atomic_write(Path(path), lambda temporary: temporary.write_text(text, encoding="utf-8"))


def tuned_content(
    tracker: str, objective: str, result: FitResult, intervals: Mapping[str, Interval],
    calibration: Mapping[str, str] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """The fitted values by name, with unit, standard error and 95 % interval; nan where unknown.

    `intervals`: lowest and highest value by label. `calibration`: the `identity` of the recordings' one.
    """
    table = {}
    # Tied tunables are written one by one: a pattern for them may match others of the tracker too.
    for parameter, name in ((p, name) for p in result.parameters for name in p.names):
        nothing = np.full(parameter.shape, np.nan)
        ends = np.stack(intervals.get(parameter.label, (nothing, nothing)))
        low, high = np.where(np.isfinite(ends).all(axis=0), ends, np.nan)
        table[name] = {
            "value": np.asarray(result.values[parameter.label], float).tolist(),
            "unit": parameter.example.unit,
            "standard_error": np.asarray(result.standard_errors[parameter.label], float).tolist(),
            "lowest_95": low.tolist(),
            "highest_95": high.tolist(),
        }
    return {
        "tracker": tracker,
        "objective": objective,
        **({} if calibration is None else {"calibration": dict(calibration)}),
        "before": float(f"{result.start_value:.8g}"),
        "after": float(f"{result.value:.8g}"),
        "tunables": table,
    }


def _value(given: Any) -> np.ndarray:
    try:
        value = np.asarray(given)
    except ValueError:
        value = np.array("ragged")
    if value.dtype.kind not in "if" or not np.all(np.isfinite(value)):
        raise ValueError(f"= {reprlib.repr(given)}, expected a finite number or a list")
    return value


class _Tunable(BaseModel):
    value: Annotated[Any, AfterValidator(_value)]
    unit: str | None = None


class Tuned(BaseModel):
    """The content of a tuned.toml: the tracker it was fitted for, None where it names none, and its `tunables`.

    `calibration`: name and fingerprint of its recordings' one, None without one.
    """

    tracker: str | None = None
    calibration: dict[Literal["name", "fingerprint"], str] | None = None
    tunables: Annotated[dict[str, _Tunable], Field(min_length=1)]

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The values by name or pattern."""
        return {name: tunable.value for name, tunable in self.tunables.items()}

    def of(self, named: NamedTracker, path: Path | None) -> NamedTracker:
        """The tracker with the values; raises UnusableInput, naming the file, where they or their units do not fit."""
        for pattern, tunable in self.tunables.items():
            for expected in (named.tunables[name].unit for name in fnmatch.filter(named.tunables, pattern)):
                if tunable.unit not in (None, expected):
                    found = f"unit {tunable.unit!r}, expected {expected!r}"
                    raise UnusableInput(f"{path}: '{pattern}': {found}; convert the value")
        return named.with_values(self.values, path)


def read_tuned(path: Path | str) -> Tuned:
    """The tracker and the values by name; raises UnusableInput for a file that `tune` did not write."""
    return read_model(Path(path), Tuned, "the tuned.toml of `trackwright tune`", "write it with `trackwright tune`")


def parse_values(texts: Sequence[str], option: str) -> dict[str, Any]:
    """Values by tunable or pattern of texts such as `sensors.*.sigma_p=0.2`; several numbers of one with commas.

    Raises UnusableInput, naming the option.
    """
    by_name: dict[str, Any] = {}
    for text in texts:
        name, _, numbers = text.partition("=")
        try:
            values = [float(number) for number in numbers.split(",")]
        except ValueError:
            values = []
        if not name or not values or np.isnan(values).any():
            raise UnusableInput(f"{option} {text}: expected NAME=VALUE, as sensors.ranges.sigma_r=0.1")
        if name in by_name:
            raise UnusableInput(f"{option} {name}: is given twice; expected it once; remove one")
        by_name[name] = np.asarray(values if "," in numbers else values[0])
    return by_name


FORM = "PATTERN=START:STOP:COUNT, as 'motion.sigma_a=0.01:1:100', with ':log' at the end for equal ratios"


def parse_grids(texts: Sequence[str], option: str) -> dict[str, np.ndarray]:
    """Grids by tunable or pattern of one or two texts such as `motion.sigma_a=0.01:1:100:log`.

    Raises UnusableInput, naming the option.
    """
    grids: dict[str, np.ndarray] = {}
    for text in texts:
        pattern, _, span = text.rpartition("=")
        log, where = span.endswith(":log"), f"{option} {text}: expected"
        numbers = span.removesuffix(":log").split(":")
        try:
            start, stop, count = (kind(x) for kind, x in zip((float, float, int), numbers, strict=True))
        except ValueError as error:
            raise UnusableInput(f"{where} {FORM}") from error
        if not pattern or not -np.inf < start < stop < np.inf or count < 2:
            raise UnusableInput(f"{where} {FORM}, START below STOP and COUNT at least 2")
        if log and start <= 0:
            raise UnusableInput(f"{where} START above zero for equal ratios")
        grids[pattern] = (np.geomspace if log else np.linspace)(start, stop, int(count))
    if not len(grids) == len(texts) <= 2:
        raise UnusableInput(f"{option} given {len(texts)} times: expected once, or twice for different patterns")
    return grids
