"""What was printed elsewhere beside what a study found, and conclusions that it bears out or not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Value(NamedTuple):
    """A figure and its 95 % interval."""

    value: float
    low: float
    high: float

    def times(self, factor: float) -> Value:
        """The figure in another unit."""
        return Value(self.value * factor, self.low * factor, self.high * factor)


@dataclass(frozen=True)
class ExpectedResult:
    """A printed number beside ours, both in `unit`.

    `fitted`: whether the printed number was used to choose the world's or the trackers' free numbers; otherwise it is
    predicted. `within`: the relative difference that counts as reached, None where nothing was asked. `note`: where it
    isn't reached, the nearest and why.
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
        """Ours over the printed one."""
        return self.ours.value / self.printed

    @property
    def reached(self) -> bool | None:
        """Whether ours is as near as asked."""
        return None if self.within is None else abs(self.ratio - 1) <= self.within


@dataclass(frozen=True)
class Conclusion:
    """A statement, whether the study bears it out, and the numbers that say so."""

    statement: str
    holds: bool
    evidence: str
