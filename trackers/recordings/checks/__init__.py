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
    """One result, of a table, file or column: an `error` makes tracks fail or wrong, a `warning` is an anomaly."""

    level: Level
    where: str
    message: str


def format_results(results: Sequence[CheckResult]) -> str:
    """The results as aligned lines of plain text, the most severe first, and a last line with their counts."""
    width = max((len(one.where) for one in results), default=0)
    ordered = sorted(results, key=lambda one: LEVELS.index(one.level))
    lines = [printable(f"{one.level:<7}  {one.where:<{width}}  {one.message}") for one in ordered]
    errors, warnings, infos = (sum(one.level == level for one in results) for level in LEVELS)
    return "\n".join([*lines, f"errors: {errors}, warnings: {warnings}, notes: {infos}"])
