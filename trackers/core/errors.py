"""The error for unusable input; numbers and times that users hold; these, counts and names as messages write them."""

from __future__ import annotations

import difflib
import math
import unicodedata
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from numbers import Integral
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np

T = TypeVar("T")

LONGEST = 3000  # longest message, characters; the middle of a longer one, which quotes an input, is left out
# Times from `UNIX_S` on count from 1970, in s below `UNIX_MS`: no recording lasts the three years before.
UNIX_S, UNIX_MS = 1e8, 1e11
COARSE_S = 1e-2  # spacing of times in single precision from which they are no longer told apart


class UnusableInput(ValueError):  # noqa: N818 - a fault of the input, not of the program
    """Unusable input, with a message of one line: what, where, found, expected, usual fix."""

    def __init__(self, message: str) -> None:
        text = " ".join(printable(message).split())
        super().__init__(text if len(text) <= LONGEST else text[: LONGEST // 2] + " … " + text[-LONGEST // 2 :])


def printable(text: object) -> str:
    """The text with control characters, which may move a terminal's cursor, replaced by a mark."""
    return "".join(c if c.isprintable() or c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in str(text))


def one_line(text: object) -> str:
    """The text `printable` in one line, with single spaces."""
    return " ".join(printable(text).split())


def has_control(text: str) -> bool:
    """Whether the text has a control character, as an end of line or an escape, or bytes that are no UTF-8."""
    return any(unicodedata.category(c) in ("Cc", "Cs") for c in text)


def listed(names: Iterable[object], most: int = 5) -> str:
    """Names separated by commas, at most `most` of them."""
    shown = [str(name) for name in names]
    return ", ".join(shown[:most]) + (f" and {len(shown) - most} more" if len(shown) > most else "")


def near(word: str, names: Iterable[str]) -> str:
    """` (did you mean …?)` with the nearest of the names, or those that go on alike, or nothing where none is near."""
    known = list(names)
    longer = [name for name in known if name.startswith(f"{word}_")]
    matches = [name for name in known if name.endswith(f".{word}")][:1]
    matches = matches or [name for name in longer if len(name) == min(map(len, longer))]
    matches = matches or difflib.get_close_matches(word, known, 1, 0.6)
    matches = matches or difflib.get_close_matches(word.lower(), known, 1, 0.6)
    return f" (did you mean {' or '.join(matches)}?)" if matches else ""


def require(fits: bool, function: str, value: Any, expected: str) -> None:
    """Raises UnusableInput unless an argument `fits`, with its value or type and the `expected` one."""
    if not fits:
        plain = value is None or isinstance(value, (bool, int, float, str))
        raise UnusableInput(f"{function}: found {repr(value) if plain else type(value).__name__}; expected {expected}")


def is_count(value: Any) -> bool:
    """Whether the value is a whole number from 0."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 0


def floats(what: str, values: Any) -> np.ndarray:
    """The values as floats, NaN where an array masks them; raises UnusableInput for anything but numbers."""
    # Importing numpy takes a tenth of a second, which help and refused arguments need not wait for.
    import numpy as np

    try:
        return np.ma.filled(np.ma.asarray(values, float), np.nan)
    except (TypeError, ValueError) as error:
        raise UnusableInput(f"{what}: {error}; expected an array of numbers, NaN for what is missing") from None


def one_or_more(given: Any, kinds: tuple[type[T], ...], expected: str) -> list[T]:
    """One object of these kinds, or an iterable of some, as a list; raises UnusableInput for anything else."""
    items = list(given) if isinstance(given, Iterable) and not isinstance(given, kinds) else [given]
    wrong = next((x for x in items if not isinstance(x, kinds)), None)
    if not items or wrong is not None:
        # A table iterates over its columns and a text over its letters.
        kind = type(wrong if isinstance(given, (list, tuple)) else given).__name__ if items else "nothing"
        raise UnusableInput(f"found {kind}; expected {expected}")
    return items


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


def seconds(times: Any) -> np.ndarray:
    """Numbers as they are, time stamps as seconds since 1970 (UTC where they have a time zone), durations as seconds.

    Raises UnusableInput for a missing time stamp, and for one of months or years.
    """
    import numpy as np

    values = np.asarray(times)
    if values.dtype == object and values.size and hasattr(values.flat[0], "timestamp"):
        # Time stamps with a time zone.
        values = np.array([np.nan if stamp is None or stamp != stamp else stamp.timestamp() for stamp in values.flat])
    elif values.dtype.kind in "mM":
        unit, _ = np.datetime_data(values.dtype)
        if unit in ("generic", "Y", "M"):
            raise UnusableInput(f"times of type {values.dtype}; expected seconds, or time stamps of days or finer")
        # Whole seconds and fractions separately: nanoseconds since 1970 have more digits than a float.
        missing = np.isnat(values)
        fine = values.astype(f"{'datetime64' if values.dtype.kind == 'M' else 'timedelta64'}[ns]").astype(np.int64)
        values = np.where(missing, np.nan, fine // 10**9 + (fine % 10**9) / 1e9)
    else:
        if values.dtype == np.float32 and (step := float(np.spacing(np.abs(values).max(initial=0.0)))) > COARSE_S:
            raise UnusableInput(f"times in single precision have steps of {step:.2g} s; expected double precision")
        return floats("times", times)
    if np.isnan(values).any():
        raise UnusableInput(f"times[{int(np.argmax(np.isnan(values)))}] is missing (NaT); leave the row out")
    return values


def zero_of(first: float) -> float:
    """The zero, s, of the displayed times of a recording that begins at `first`: `first` if that counts from 1970."""
    return float(first) if UNIX_S <= first < math.inf else 0.0


def moment(time: float) -> str:
    """A time, s, for messages: the date and time of day, UTC, where it counts from 1970, else seconds."""
    if not UNIX_S <= time < UNIX_MS:
        return f"{round(float(time), 6):.12g} s"  # times since 1970 have steps of 0.24 µs
    text = datetime.fromtimestamp(round(float(time), 3), UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
    return text.rstrip("0").rstrip(".") + " UTC"


def span(first: float, last: float) -> str:
    """The time from `first` to `last`, s, for messages, each as a `moment`."""
    return f"{moment(first).removesuffix(' s')} to {moment(last)}"


def time_label(zero: float) -> str:
    """The label of an axis of times, s, after `zero`; with the date where times count from 1970."""
    return f"time (s) since {moment(zero)}" if zero else "time (s)"
