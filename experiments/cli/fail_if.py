"""Conditions on error metrics, such as `p95_m > 0.5 or lost_fraction > 0.01`, that fail a pipeline."""

from __future__ import annotations

import operator
import re

from trackers.core.errors import UnusableInput
from trackers.evaluation import Evaluation, Metrics

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


def violation(evaluation: Evaluation, expression: str) -> str | None:
    """The conditions that hold, such as `p95_m is 0.62 > 0.5`; None if the expression is false of the overall metrics.

    The expression is NAME OPERATOR NUMBER, joined by `and` and `or`; `and` takes precedence. Raises UnusableInput for
    any other expression, an unknown name, and a metric without a value, which must not pass.
    """
    true = []
    for alternative in re.split(r"\bor\b", expression):
        parts = [_check(evaluation.overall, part, expression) for part in re.split(r"\band\b", alternative)]
        if all(holds for holds, _ in parts):
            true.append(" and ".join(text for _, text in parts))
    return "; ".join(true) or None


def _check(overall: Metrics, condition: str, expression: str) -> tuple[bool, str]:
    match = CONDITION.fullmatch(condition)
    if match is None:
        raise UnusableInput(
            f"--fail-if '{expression}': cannot read '{condition.strip()}'; expected NAME OPERATOR NUMBER joined by "
            f"and, or, e.g. p95_m>0.5; names: {', '.join(overall)}"
        )
    name, sign, number = match.groups()
    if name not in overall:
        raise UnusableInput(f"--fail-if '{expression}': no metric '{name}'; names: {', '.join(overall)}")
    if overall[name] is None:
        present = ", ".join(key for key, value in overall.items() if value is not None)
        raise UnusableInput(
            f"--fail-if '{expression}': '{name}' has no value for these tracks; metrics with a value: {present}"
        )
    return COMPARISONS[sign](overall[name], float(number)), f"{name} is {overall[name]:.6g} {sign} {number}"
