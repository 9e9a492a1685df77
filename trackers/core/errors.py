"""The error for unusable input."""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Iterable
from numbers import Integral
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np

T = TypeVar("T")

LONGEST = 3000
"""Characters of a message; the middle of a longer one, which quotes an input of any length, is left out."""


class UnusableInput(ValueError):  # noqa: N818 - a fault of the input, not of the program
    """Unusable input, with a message of one line: what, where, found, expected, usual fix."""

    def __init__(self, message: str) -> None:
        text = " ".join(printable(message).split())
        super().__init__(text if len(text) <= LONGEST else text[: LONGEST // 2] + " … " + text[-LONGEST // 2 :])


def printable(text: object) -> str:
    """The text with a mark in place of each control character, which may move a terminal's cursor."""
    return "".join(c if c.isprintable() or c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in str(text))


def one_line(text: object) -> str:
    """The text `printable` in one line, with single spaces."""
    return " ".join(printable(text).split())


def has_control(text: str) -> bool:
    """Whether the text has a control character, as an end of line or an escape, or bytes that are no UTF-8."""
    return any(unicodedata.category(c) in ("Cc", "Cs") for c in text)


def listed(names: Iterable[object], most: int = 5) -> str:
    """Names separated by commas, at most so many of them."""
    shown = [str(name) for name in names]
    return ", ".join(shown[:most]) + (f" and {len(shown) - most} more" if len(shown) > most else "")


def near(word: str, names: Iterable[str]) -> str:
    """` (did you mean …?)` with the nearest of the names, or nothing where none is near."""
    known = list(names)
    found = [name for name in known if name.endswith(f".{word}")] or difflib.get_close_matches(word, known, 1, 0.6)
    return f" (did you mean {found[0]}?)" if found else ""


def require(fits: bool, function: str, found: Any, expected: str) -> None:
    """Refuse an argument of a function unless it `fits`, with its value or its type, and the `expected` one."""
    if not fits:
        plain = found is None or isinstance(found, (bool, int, float, str))
        raise UnusableInput(f"{function}: found {repr(found) if plain else type(found).__name__}; expected {expected}")


def is_count(found: Any) -> bool:
    """Whether an argument is a whole number from 0."""
    return isinstance(found, Integral) and not isinstance(found, bool) and int(found) >= 0


def numbers_of(kind: str, value: Any) -> np.ndarray:
    """The value of a tunable of this kind as an array of floats; raises UnusableInput for anything but numbers."""
    # numpy takes a tenth of a second to import, which a help or a refused argument need not wait for.
    import numpy as np

    found = np.asarray(value)
    require(found.dtype.kind in "biuf", f"a {kind}", value, "a number or an array of numbers")
    return found.astype(float)


def one_or_more(found: Any, kinds: tuple[type[T], ...], expected: str) -> list[T]:
    """One object of these kinds, or an iterable of some, as a list; raises UnusableInput for anything else."""
    items = list(found) if isinstance(found, Iterable) and not isinstance(found, kinds) else [found]
    wrong = next((x for x in items if not isinstance(x, kinds)), None)
    if not items or wrong is not None:
        # A table iterates over its columns and a text over its letters.
        kind = type(wrong if isinstance(found, (list, tuple)) else found).__name__ if items else "nothing"
        raise UnusableInput(f"found {kind}; expected {expected}")
    return items
