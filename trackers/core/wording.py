"""Numbers, counts and repeated names as people write them, for messages and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal

WIDTH = 120
"""Columns of plain text, at most."""


def counted(count: int, noun: str) -> str:
    """A count with its noun, in the plural unless it is one."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def significant(value: float, digits: int) -> str:
    """A number with `digits` significant digits, without powers of ten: 1234.5 with two is `1,200`."""
    return f"{Decimal(f'{value:.{digits}g}'):,f}" if math.isfinite(value) else f"{value}"


def numbered_names(names: Sequence[str]) -> list[str]:
    """The names, those that occur again with their number among all: `a`, `b`, `a` become `a`, `b`, `a 3`."""
    if len(set(names)) == len(names):
        return list(names)
    first = {name: k for k, name in reversed([*enumerate(names)])}
    return [name if first[name] == k else f"{name} {k + 1}" for k, name in enumerate(names)]
