"""Conditions on error metrics, such as `p95_m > 0.5 or lost_fraction > 0.01`, that fail a pipeline."""

from __future__ import annotations

import operator
import re
from collections.abc import Sequence
from typing import NamedTuple

from trackers.core.errors import UnusableInput, near
from trackers.evaluation.evaluate import Evaluation, Metrics

COMPARISONS = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
CONDITION = re.compile(
    r"\s*([A-Za-z]\w*)\s*(<=|>=|==|!=|<|>)\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*", re.ASCII
)


class Condition(NamedTuple):
    """A metric, one of `COMPARISONS` and a number, all as text."""

    name: str
    sign: str
    number: str


def conditions(expression: str, names: Sequence[str]) -> list[list[Condition]]:
    """The conditions of an expression, NAME OPERATOR NUMBER joined by `and` and `or`: alternatives of all that hold.

    Raises UnusableInput for any other expression, and for a name that is none of the `names` of metrics.
    """
    return [
        [_condition(part, expression, names) for part in re.split(r"\band\b", alternative)]
        for alternative in re.split(r"\bor\b", expression)
    ]


def violation(evaluation: Evaluation, expression: str) -> str | None:
    """The conditions that hold, such as `p95_m is 0.62 > 0.5`; None if the expression is false of the overall metrics.

    Raises UnusableInput as `conditions`, and for a metric without a value, which must not pass.
    """
    true = []
    for alternative in conditions(expression, list(evaluation.overall)):
        parts = [_check(evaluation.overall, part, expression) for part in alternative]
        if all(holds for holds, _ in parts):
            true.append(" and ".join(text for _, text in parts))
    return "; ".join(true) or None


def _condition(text: str, expression: str, names: Sequence[str]) -> Condition:
    match = CONDITION.fullmatch(text)
    if match is None:
        raise UnusableInput(
            f"--fail-if '{expression}': cannot read '{text.strip()}'; expected NAME OPERATOR NUMBER joined by "
            f"and, or, e.g. p95_m>0.5; names: {', '.join(names)}"
        )
    found = Condition(*match.groups())
    if found.name not in names:
        raise UnusableInput(
            f"--fail-if '{expression}': no metric '{found.name}'{near(found.name, names)}; names: {', '.join(names)}"
        )
    return found


def _check(overall: Metrics, condition: Condition, expression: str) -> tuple[bool, str]:
    name, sign, number = condition
    if overall[name] is None:
        present = ", ".join(key for key, value in overall.items() if value is not None)
        raise UnusableInput(
            f"--fail-if '{expression}': '{name}' has no value for these tracks; metrics with a value: {present}"
        )
    return COMPARISONS[sign](overall[name], float(number)), f"{name} is {overall[name]:.6g} {sign} {number}"
