"""Data-quality checks of a recording, which `all_checks` runs: the result of one, and a list of them as plain text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from trackwright.trackers.core.errors import printable

Level = Literal["error", "warning", "info"]
LEVELS: tuple[Level, ...] = ("error", "warning", "info")


@dataclass(frozen=True)
class CheckResult:
    """One result: `error`, tracking fails or gives wrong results; `warning`, an anomaly; `info`, a property.

    `where`: the table, file or column concerned.
    """

    level: Level
    where: str
    message: str


def format_results(results: Sequence[CheckResult]) -> str:
    """The results as aligned lines of plain text, the most severe first, and a last line with their counts."""
    ordered = sorted(results, key=lambda result: LEVELS.index(result.level))
    width = max((len(result.where) for result in results), default=0)
    lines = [printable(f"{result.level:<7}  {result.where:<{width}}  {result.message}") for result in ordered]
    errors, warnings, infos = (sum(result.level == level for result in results) for level in LEVELS)
    return "\n".join([*lines, f"errors: {errors}, warnings: {warnings}, notes: {infos}"])
