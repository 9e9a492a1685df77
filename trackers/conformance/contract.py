"""A contract is a list of checks with names; each passes, fails with one sentence and the usual fix, or is skipped.

`report` runs all of them for a reader; called one by one they raise, as pytest expects.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple
from unittest import SkipTest

from trackwright.trackers.core.errors import one_line, require
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.kinds import Kind


class BrokenContract(ValueError):  # noqa: N818 - public name
    """A part of a user violates an assumption of the library: found, expected, usual fix in one sentence."""


class NotApplicable(SkipTest):
    """The reason why a check has nothing to say of a part."""


class Result(NamedTuple):
    """What a check found: for a failure the sentence with the usual fix, `seconds` of processor time."""

    name: str
    outcome: Literal["pass", "fail", "skip"]
    sentence: str
    seconds: float


@dataclass(frozen=True, eq=False)
class Check:
    """One check of a contract; it runs once. Called, it raises what it found: `BrokenContract`, or SkipTest.

    `test`: returns what a passed check measured, in words, or None. `after`: the check that has to pass before this one
    has a meaning.
    """

    name: str
    test: Callable[[], str | None]
    after: Check | None = None

    @cached_property
    def _found(self) -> tuple[str, Exception | None, float]:
        started, words, error = time.process_time(), "", None
        try:
            if self.after is not None and self.after.result.outcome != "pass":
                raise NotApplicable(f"needs '{self.after.name}', which does not pass")
            words = self.test() or ""
        except Exception as raised:
            error = raised
        return words, error, time.process_time() - started

    @property
    def result(self) -> Result:
        """What the check found."""
        words, error, seconds = self._found
        if error is None:
            return Result(self.name, "pass", words, seconds)
        if isinstance(error, SkipTest):
            return Result(self.name, "skip", str(error), seconds)
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        return Result(self.name, "fail", one_line(f"{kind}{error}"), seconds)

    def __call__(self) -> None:
        error = self._found[1]
        if error is not None:
            raise error

    def __str__(self) -> str:
        return self.name


class Report(tuple[Result, ...]):
    """The results of all checks of a contract, shown as a table."""

    @property
    def failures(self) -> tuple[Result, ...]:
        """The checks that failed; none where the contract is kept."""
        return tuple(result for result in self if result.outcome == "fail")

    def __repr__(self) -> str:
        width = max(len(result.name) for result in self)
        lines = [f"{r.outcome}  {r.name:<{width}}  {r.seconds:5.1f} s  {r.sentence}".rstrip() for r in self]
        counts = [f"{sum(r.outcome == outcome for r in self)} {word}" for outcome, word in _WORDS.items()]
        return "\n".join([*lines, ", ".join(counts)])


_WORDS = {"pass": "passed", "fail": "failed", "skip": "skipped"}


CHECKED: dict[str, tuple[Any, str]] = {
    "check_motion": (AbstractMotion, "a motion, an AbstractMotion"),
    "check_sensor": (AbstractSensor, "a sensor, an AbstractSensor"),
    "check_tracker": (AbstractTracker, "a tracker, an AbstractTracker, as in `batches` of a NamedTracker"),
    "check_kind": (Kind, "a kind of measurement, a Kind"),
    "check_importer": (Callable, "an importer, a function of a path"),
}
"""The check functions, and what each is for."""


def require_part(function: str, given: Any) -> None:
    """Raises UnusableInput unless the object is one that this check function is for, with the function that is."""
    kind, expected = CHECKED[function]
    of_class, others = isinstance(given, type), (name for name, (one, _) in CHECKED.items() if isinstance(given, one))
    fix = "an object of the class" if of_class else next(others, None)
    words = f"{expected}; usual fix: {fix}" if fix else expected
    require(isinstance(given, kind) and not of_class, function, given.__name__ if of_class else given, words)


def report(checks: Iterable[Check]) -> Report:
    """The results of all checks."""
    return Report(check.result for check in checks)
