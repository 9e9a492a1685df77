"""What a user meets when something he brought cannot be used."""

from __future__ import annotations

from collections.abc import Iterable


class UnusableInput(Exception):  # noqa: N818 - it names what is wrong for the person who reads it, not a fault of the program
    """Input that can't be used, in one line: what, where, found, expected, usual fix."""

    def __init__(self, message: str) -> None:
        printable = "".join(c if c.isprintable() or c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in message)
        super().__init__(" ".join(printable.split()))


def listed(names: Iterable[object], most: int = 5) -> str:
    """Names separated by commas, at most so many of them."""
    shown = [str(name) for name in names]
    return ", ".join(shown[:most]) + (f" and {len(shown) - most} more" if len(shown) > most else "")
