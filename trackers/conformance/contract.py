"""A contract is a list of checks with names; each passes, fails with one sentence, or is skipped; and its report."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any, Literal, NamedTuple, ParamSpec
from unittest import SkipTest

from trackwright.trackers.core.errors import one_line, require
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.kinds import Kind

P = ParamSpec("P")


class BrokenContract(ValueError):  # noqa: N818 - public name
    """A part of a user violates an assumption of the library: found, expected, usual fix in one sentence."""


class NotApplicable(SkipTest):
    """The reason why a check has nothing to say of a part."""


class Result(NamedTuple):
    """What a check found: a measurement in words, the fault or the reason to skip; `seconds` of processor time."""

    name: str
    outcome: Literal["pass", "fail", "skip"]
    sentence: str
    seconds: float


@dataclass(frozen=True, eq=False)
class Check:
    """One check of a contract; it runs once. Called, it raises what it found: `BrokenContract`, or SkipTest.

    `test`: returns what a passed check measured, in words, or None. `after`: the check that has to pass before.
    """

    name: str
    test: Callable[[], str | None]
    after: Check | None = None

    @cached_property
    def _found(self) -> tuple[str, Exception | None, float]:
        started, words, error = time.process_time(), None, None
        try:
            if self.after is not None and self.after.result.outcome != "pass":
                raise NotApplicable(f"needs '{self.after.name}', which does not pass")
            if not __debug__:
                raise NotApplicable("python -O leaves asserts out; run it without")
            words = self.test()
        except Exception as raised:
            error = BrokenContract(one_line(raised)) if isinstance(raised, AssertionError) else raised
        return words or "", error, time.process_time() - started

    @property
    def result(self) -> Result:
        """What the check found."""
        words, error, seconds = self._found
        outcome: Any = "pass" if error is None else "skip" if isinstance(error, SkipTest) else "fail"
        kind = "" if error is None or isinstance(error, (ValueError, SkipTest)) else f"{type(error).__name__}: "
        return Result(self.name, outcome, words if error is None else one_line(f"{kind}{error}"), seconds)

    def __call__(self) -> None:
        if self._found[1] is not None:
            raise self._found[1]

    def __str__(self) -> str:
        return self.name


def check(after: Check | None = None) -> Callable[[Callable[[], str | None]], Check]:
    """Makes a check of a function, with the check's name."""
    return lambda test: Check(test.__name__.strip("_").replace("_", " "), test, after)


class Report(tuple[Result, ...]):
    """The results of all checks of a contract, shown as a table."""

    @property
    def failures(self) -> tuple[Result, ...]:
        """The checks that failed; none where the contract is kept."""
        return tuple(result for result in self if result.outcome == "fail")

    def __repr__(self) -> str:
        width = max(len(result.name) for result in self)
        lines = [f"{r.outcome}  {r.name:<{width}}  {r.seconds:5.1f} s  {r.sentence}".rstrip() for r in self]
        counts = {"pass": "passed", "fail": "failed", "skip": "skipped"}
        return "\n".join([*lines, ", ".join(f"{sum(r.outcome == o for r in self)} {w}" for o, w in counts.items())])


def reported(checks: Callable[P, list[Check]]) -> Callable[P, Report]:
    """A function of the same arguments that runs all checks."""

    return wraps(checks)(lambda *given, **named: Report(one.result for one in checks(*given, **named)))


CHECKED: dict[str, Any] = {
    "check_motion": AbstractMotion,
    "check_sensor": AbstractSensor,
    "check_tracker": AbstractTracker,
    "check_kind": Kind,
    "check_importer": Callable,
}
"""The check functions, and what each is for."""


def require_part(function: str, given: Any) -> None:
    """Raises UnusableInput unless the object is one that this check function is for, with the function that is."""
    wanted, of_class = CHECKED[function], isinstance(given, type)
    fix = "an object of the class" if of_class else "".join(n for n, one in CHECKED.items() if isinstance(given, one))
    words = f"an object of {wanted.__name__}" + f"; usual fix: {fix}" * bool(fix)
    require(isinstance(given, wanted) and not of_class, function, given.__name__ if of_class else given, words)
