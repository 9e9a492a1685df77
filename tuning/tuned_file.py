"""`tuned.toml`: tuned numbers with unit and standard error, written by `tune` and read by `track --noise`."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trackers.core.errors import UnusableInput
from trackers.recordings.atomic import atomic_write
from tuning import FitResult
from tuning.intervals import Interval


def write_tuned(path: Path, tracker: str, objective: str, result: FitResult, intervals: Mapping[str, Interval]) -> Path:
    """Write the fit's numbers by name: value, unit, standard error and 95 % interval, by label; nan where not known."""
    lines = [
        "# Written by `trackwright tune`; read by `trackwright track --noise`.",
        f'tracker = "{tracker}"',
        f'objective = "{objective}"',
        f"before = {result.start_value:.8g}",
        f"after = {result.value:.8g}",
        "",
    ]
    # Tied tunables stand here one by one: a pattern for them may match others of the tracker too.
    for parameter, name in ((p, name) for p in result.parameters for name in p.names):
        nothing = np.full(np.shape(result.values[parameter.label]), np.nan)
        ends = np.stack(intervals.get(parameter.label, (nothing, nothing)))
        low, high = np.where(np.isfinite(ends).all(axis=0), ends, np.nan)
        lines += [
            f"[tunables.{json.dumps(name, ensure_ascii=False)}]",
            f"value = {_number(result.values[parameter.label])}",
            f'unit = "{parameter.example.unit}"',
            f"standard_error = {_number(result.standard_errors[parameter.label])}",
            f"lowest_95 = {_number(low)}",
            f"highest_95 = {_number(high)}",
            "",
        ]
    return atomic_write(path, lambda temporary: temporary.write_text("\n".join(lines), encoding="utf-8"))


def _number(value: Any) -> str:
    array = np.asarray(value, float)
    if array.ndim:
        return "[" + ", ".join(_number(x) for x in array) + "]"
    return repr(float(array))


def read_tuned(path: Path) -> dict[str, Any]:
    """The values by name; raises UnusableInput where the file isn't what `tune` writes."""
    try:
        content = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); expected the tuned.toml of `tune`") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UnusableInput(
            f"{path}: is not valid TOML ({str(error).splitlines()[0]}); write it with `tune`"
        ) from error
    table = content.get("tunables")
    if not isinstance(table, Mapping) or not table:
        raise UnusableInput(f"{path}: found no [tunables], expected the tuned.toml of `trackwright tune`")
    values = {}
    for name, entry in table.items():
        value = entry.get("value") if isinstance(entry, Mapping) else None
        try:
            values[name] = np.asarray(value)
            usable = values[name].dtype.kind in "if" and np.all(np.isfinite(values[name]))
        except ValueError:
            usable = False
        if not usable:
            raise UnusableInput(f"{path}: tunables.{name}.value is {value!r}, expected a finite number or a list")
    return values
