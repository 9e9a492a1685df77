"""Values with intervals, printed numbers beside them, and conclusions that a study supports or contradicts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Value(NamedTuple):
    """A metric and its 95 % interval."""

    value: float
    low: float
    high: float

    def times(self, factor: float) -> Value:
        """The metric in another unit."""
        return Value(self.value * factor, self.low * factor, self.high * factor)


@dataclass(frozen=True)
class ExpectedResult:
    """A number that a paper prints, and the study's own, both in `unit`.

    `quantity`: which number of the paper it is. `fitted`: whether the printed number was used to choose free parameters
    of the world or of the trackers; otherwise ours is a prediction. `within`: largest relative difference that counts
    as reached, None where none is set. `note`: explanation where it is not reached.
    """

    quantity: str
    printed: float
    ours: Value
    unit: str
    fitted: bool
    within: float | None = 0.10
    note: str = ""

    @property
    def ratio(self) -> float:
        """Our number over the printed one."""
        return self.ours.value / self.printed

    @property
    def reached(self) -> bool | None:
        """Whether the relative difference is at most `within`; None where that is None."""
        return None if self.within is None else abs(self.ratio - 1) <= self.within


@dataclass(frozen=True)
class Conclusion:
    """A statement, whether it holds in the study, and the numbers that support or contradict it."""

    statement: str
    holds: bool
    evidence: str
