"""Values with intervals, printed numbers beside them, and conclusions that a study supports or contradicts; as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from trackwright.experiments.text.tables import NO_UNIT, Unit, rounded
from trackwright.trackers.core.errors import counted


class Value(NamedTuple):
    """A metric and its 95 % interval."""

    value: float
    low: float
    high: float

    def times(self, factor: float) -> Value:
        """The metric in another unit."""
        return Value(self.value * factor, self.low * factor, self.high * factor)


class Origin(StrEnum):
    """How free a number or a conclusion was to differ from the paper's.

    FITTED: the world, a tracker or a choice was adjusted to it. DERIVED: it follows from other numbers; it is shown and
    not counted again. PREDICTED: neither.
    """

    FITTED = "fitted"
    DERIVED = "derived"
    PREDICTED = "predicted"


FITTED, DERIVED, PREDICTED = Origin


@dataclass(frozen=True)
class ExpectedResult:
    """A number that a paper prints, and the study's own, both in `unit`.

    `quantity`: which number of the paper it is. `within`: largest relative difference that counts as reached, None
    where none is set. `note`: explanation where it is not reached, or why it is not predicted. `share`: a percentage of
    a whole, compared by the smaller of it and the rest: 98.3 % and 93.7 % differ as 1.7 % and 6.3 % do.
    """

    quantity: str
    printed: float
    ours: Value
    unit: str
    origin: Origin
    within: float | None = 0.10
    note: str = ""
    share: bool = False

    @property
    def compares_rest(self) -> bool:
        """Whether what a share leaves over is compared."""
        return self.share and self.printed > 50.0

    @property
    def ratio(self) -> float:
        """Our number over the printed one; of the rests of a share above one half."""
        ours, printed = self.ours.value, self.printed
        return (100.0 - ours) / (100.0 - printed) if self.compares_rest else ours / printed

    @property
    def reached(self) -> bool | None:
        """Whether the relative difference is at most `within`; None where that is None, and for a derived number."""
        return None if self.within is None or self.origin is DERIVED else abs(self.ratio - 1) <= self.within


@dataclass(frozen=True)
class Conclusion:
    """A statement, whether it holds in the study, and the numbers that support or contradict it.

    `origin`: FITTED where a choice was made for it to hold; DERIVED where it rests on a number that is not predicted.
    """

    statement: str
    holds: bool
    evidence: str
    origin: Origin


Claim = ExpectedResult | Conclusion


def with_interval(value: Value, unit: Unit = NO_UNIT) -> str:
    """A metric with its interval; alone where the interval is unknown or empty after rounding."""
    scaled = value.times(unit.factor)
    spread = scaled.high - scaled.low
    low, high = rounded(scaled.low, spread), rounded(scaled.high, spread)
    if not math.isfinite(spread) or low == high:
        return rounded(scaled.value, math.nan)
    return f"{rounded(scaled.value, spread)} ({low} … {high})"


def fixed_interval(value: Value, form: str, unit: str = "") -> str:
    """A value and its interval by a number format as `+.1f`, the unit after the value."""
    return f"{value.value:{form}}{unit} ({value.low:{form}} … {value.high:{form}})"


def listed(values: Mapping[str, float | Value], form: str) -> str:
    """Names with their values, which are formatted by a text as `{:.1f} cm`."""
    return ", ".join(f"{k} {form.format(v.value if isinstance(v, Value) else v)}" for k, v in values.items())


def headline(numbers: Iterable[tuple[str, bool | None]], conclusions: Iterable[tuple[str, bool]]) -> str:
    """How many numbers, by origin, are reached, None where they are not judged, and how many conclusions hold."""
    of_numbers, of_conclusions, sentences = list(numbers), list(conclusions), []
    for origin in reversed(Origin):
        derived = origin is Origin.DERIVED
        ours = [bool(true) for of, true in of_numbers if of == origin and (derived or true is not None)]
        held = [true for of, true in of_conclusions if of == origin]
        parts = [counted(len(ours), "number")] * bool(ours) + [counted(len(held), "conclusion")] * bool(held)
        if derived:
            sentences += [f"Derived, not counted: {', '.join(parts)}."] * bool(parts)
            continue
        if ours:
            parts[0] = f"{sum(ours)} of {parts[0]} within tolerance"
        if held:
            parts[-1] = f"{sum(held)} of {parts[-1]} {'holds' if sum(held) == 1 else 'hold'}"
        if parts or origin is Origin.PREDICTED:
            sentences.append(f"{origin.capitalize()}: {'; '.join(parts) or 'nothing'}.")
    return " ".join(sentences)


def ratio_text(ratio: float, compares_rest: bool) -> str:
    """The ratio of our number to the printed one; marked where it is that of what two shares leave over."""
    return f"{ratio:.2f} (rest)" if compares_rest else f"{ratio:.2f}"
