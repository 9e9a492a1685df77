"""The error for unusable input."""

from __future__ import annotations

from collections.abc import Iterable


class UnusableInput(ValueError):  # noqa: N818 - a fault of the input, not of the program
    """Unusable input, with a message of one line: what, where, found, expected, usual fix."""

    def __init__(self, message: str) -> None:
        printable = "".join(c if c.isprintable() or c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in message)
        super().__init__(" ".join(printable.split()))


def listed(names: Iterable[object], most: int = 5) -> str:
    """Names separated by commas, at most so many of them."""
    shown = [str(name) for name in names]
    return ", ".join(shown[:most]) + (f" and {len(shown) - most} more" if len(shown) > most else "")
