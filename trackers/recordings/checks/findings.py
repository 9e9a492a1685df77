"""One thing that a check found, and a list of them as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Level = Literal["error", "warning", "info"]
LEVELS: tuple[Level, ...] = ("error", "warning", "info")


@dataclass(frozen=True)
class Finding:
    """`error`: results will be wrong or there are none; `warning`: odd but usable; `info`: good to know."""

    level: Level
    where: str
    message: str


def format_findings(findings: Sequence[Finding]) -> str:
    """The findings as aligned lines of plain text, the gravest first, and a last line that counts them."""
    ordered = sorted(findings, key=lambda finding: LEVELS.index(finding.level))
    width = max((len(finding.where) for finding in findings), default=0)
    lines = [f"{finding.level:<7}  {finding.where:<{width}}  {finding.message}" for finding in ordered]
    errors, warnings, infos = (sum(finding.level == level for finding in findings) for level in LEVELS)
    return "\n".join([*lines, f"errors: {errors}, warnings: {warnings}, notes: {infos}"])
