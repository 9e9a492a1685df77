"""A contract is a list of checks with names; each passes, fails with one sentence, or is skipped; and its report."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any, Literal, NamedTuple, ParamSpec
from unittest import SkipTest

from trackwright.trackers.core.errors import one_line

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
    """One check of a contract, which runs once, after another has passed; called, it raises what it found."""

    test: Callable[[], str | None]
    after: Check | None = None

    def __str__(self) -> str:
        return self.test.__name__.strip("_").replace("_", " ")

    @cached_property
    def found(self) -> tuple[Result, Exception | None]:
        """What it measured, and the fault or the reason to skip."""
        started, sentence, error = time.process_time(), "", None
        try:
            if not __debug__ or (self.after and self.after.result.outcome != "pass"):
                raise NotApplicable(f"needs '{self.after}', and python without -O, which leaves asserts out")
            sentence = self.test() or ""
        except Exception as raised:
            error = BrokenContract(one_line(raised)) if isinstance(raised, AssertionError) else raised
            kind = "" if isinstance(error, (ValueError, SkipTest)) else f"{type(error).__name__}: "
            sentence = one_line(f"{kind}{error}")
        outcome: Any = "pass" if error is None else "skip" if isinstance(error, SkipTest) else "fail"
        return Result(f"{self}", outcome, sentence, time.process_time() - started), error

    @property
    def result(self) -> Result:
        """What the check found."""
        return self.found[0]

    def __call__(self) -> None:
        if self.found[1] is not None:
            raise self.found[1]


def check(after: Check | None = None) -> Callable[[Callable[[], str | None]], Check]:
    """Makes a check of a function, with the check's name."""
    return lambda test: Check(test, after)


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
