"""Values with intervals, printed numbers beside them, and conclusions that a study supports or contradicts."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple


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

    FITTED: the world or a tracker was adjusted to it, or a choice was made after seeing it. DERIVED: it follows from
    other numbers, by a formula, by symmetry or because it is printed twice; it is shown and not counted again.
    PREDICTED: neither.
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
