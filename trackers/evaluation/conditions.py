"""Conditions on metrics, such as `p95_m > 0.5 or lost_s > 0`, in the words of SQL."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, near
from trackwright.trackers.evaluation.evaluate import Evaluation


def condition_of(expression: str, names: Sequence[str]) -> pl.Expr:
    """The condition on metrics of these names; raises UnusableInput for a text that is none."""
    where, used, problem = f"--fail-if '{expression}'", list[str](), "is no condition on metrics"
    try:
        condition = pl.sql_expr(expression)
        used = condition.meta.root_names()
        fits = pl.DataFrame({name: [0.0] for name in used}).select(condition).dtypes == [pl.Boolean] and used
    except pl.exceptions.PolarsError as error:
        fits, problem = False, f"cannot be read ({str(error).splitlines()[0]})"
    if unknown := [name for name in used if name not in names]:
        raise UnusableInput(f"{where}: no metric '{unknown[0]}'{near(unknown[0], names)}; names: {', '.join(names)}")
    if not fits:
        fix = f"expected NAME OPERATOR NUMBER joined by and, or, e.g. p95_m>0.5; names: {', '.join(names)}"
        raise UnusableInput(f"{where}: {problem}; {fix}")
    return condition


def violation(evaluation: Evaluation, expression: str) -> str | None:
    """The condition and its metrics, None where it is false; raises UnusableInput for a metric without a value, too."""
    condition, overall = condition_of(expression, list(evaluation.overall)), evaluation.overall
    values = {name: overall[name] for name in condition.meta.root_names()}
    if lacking := [name for name, value in values.items() if value is None]:
        present = ", ".join(key for key, value in overall.items() if value is not None)
        words = f"'{lacking[0]}' has no value for these tracks; metrics with a value: {present}"
        raise UnusableInput(f"--fail-if '{expression}': {words}")
    if not pl.DataFrame([values]).select(condition).item():
        return None
    return f"{expression} ({', '.join(f'{name} is {value:.6g}' for name, value in values.items())})"
