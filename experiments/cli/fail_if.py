"""Conditions on error figures, as `p95_m > 0.5 or lost_fraction > 0.01`, for a pipeline that shall stop."""

from __future__ import annotations

import operator
import re

from trackers.core.errors import UnusableInput
from trackers.evaluation import Evaluation, Figures

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


def fails(evaluation: Evaluation, expression: str) -> str | None:
    """What the overall figures say against the expression, as `p95_m is 0.62 > 0.5`; None where it does not hold.

    The expression is NAME OPERATOR NUMBER, joined by `and` and `or`, of which `and` binds more closely. Raises
    UnusableInput for anything else, for a name there is not, and for a figure without a value, which must not pass.
    """
    held = []
    for alternative in re.split(r"\bor\b", expression):
        parts = [_check(evaluation.overall, part, expression) for part in re.split(r"\band\b", alternative)]
        if all(holds for holds, _ in parts):
            held.append(" and ".join(text for _, text in parts))
    return "; ".join(held) or None


def _check(overall: Figures, condition: str, expression: str) -> tuple[bool, str]:
    match = CONDITION.fullmatch(condition)
    if match is None:
        raise UnusableInput(
            f"--fail-if '{expression}': cannot read '{condition.strip()}'; expected NAME OPERATOR NUMBER joined by "
            f"and, or, as p95_m>0.5; names: {', '.join(overall)}"
        )
    name, sign, number = match.groups()
    if name not in overall:
        raise UnusableInput(f"--fail-if '{expression}': no figure '{name}'; names: {', '.join(overall)}")
    if overall[name] is None:
        present = ", ".join(key for key, value in overall.items() if value is not None)
        raise UnusableInput(
            f"--fail-if '{expression}': '{name}' has no value for these tracks; those that have: {present}"
        )
    return COMPARISONS[sign](overall[name], float(number)), f"{name} is {overall[name]:.6g} {sign} {number}"
