"""Advice on a tuning result in words: a one-sentence summary, and warnings."""

from __future__ import annotations

import math
from dataclasses import dataclass

from trackwright.experiments.pages.reports.tuning_data import MetricChange, TuningReportData
from trackwright.experiments.text.wording import number, percent_change, uncapitalised
from trackwright.tuning.diagnostics import violated_assumptions

WORSE = 0.02
"""Relative increase above which a metric counts as worse."""

WORSE_BY = 0.01
"""The same, absolute: in nats, which have no natural zero, and for distances between distributions."""

FAR = 0.1
"""Distance of NIS or NEES from its distribution (`tuning.pit_uniformity`) above which covariances are misleading."""

ADVICE = "Do not use such values as measurements: freeze or tie these parameters, or record more motion."
SHAPES = ("nis-shape", "nees-shape")


@dataclass(frozen=True)
class Advice:
    """`word`: what to do; `summary`: one sentence; `good`: whether there are no warnings."""

    word: str
    summary: str
    good: bool
    warnings: tuple[str, ...]


def advice_on(data: TuningReportData) -> Advice:
    """Summary, warnings and advice on a tuning result."""
    against = [*(_sentence(text) for text in data.cautions), *_worse(data), *_undetermined(data)]
    doubts = _inconsistent(data)
    best = data.metric(data.objective)
    parts = [_change(best, best.training) if best else f"{data.objective_about} was tuned"]
    rmse = data.metric("rmse")
    if rmse is not None and math.isfinite(rmse.held_out[0]):
        parts.append(f"on held-out recordings {_change(rmse, rmse.held_out)}")
    elif rmse is not None and best is not rmse and math.isfinite(rmse.training[0]):
        parts.append(_change(rmse, rmse.training))
    determined = [p.determined for p in data.parameters]
    if determined and None not in determined:
        parts.append(_determined(determined.count(True), len(determined)))
    elif False in determined:
        parts.append(f"the recordings do not determine {determined.count(False)} of {len(determined)} parameters")
    sentence = "; ".join(parts)
    if not sentence.startswith(data.objective):
        sentence = sentence[0].upper() + sentence[1:]
    word = "Check before use." if against else "Use the estimates, not the covariances." if doubts else "Ready to use."
    return Advice(word, f"{sentence}.", not (against or doubts), (*against, *doubts))


def is_worse(metric: MetricChange, pair: tuple[float, float]) -> bool:
    """Whether the metric increased by more than `WORSE`, or `WORSE_BY`."""
    before, after = pair
    if not (math.isfinite(before) and math.isfinite(after)):
        return math.isfinite(before)
    return after > before + (WORSE * before if metric.unit not in ("nats", "1") else WORSE_BY)


def is_better(metric: MetricChange, pair: tuple[float, float]) -> bool:
    """Whether the metric decreased by as much."""
    return all(math.isfinite(x) for x in pair) and is_worse(metric, (pair[1], pair[0]))


def _change(metric: MetricChange, pair: tuple[float, float]) -> str:
    unit = "" if metric.unit == "1" else f" {metric.unit}"
    relative = percent_change(*pair) if metric.unit not in ("nats", "1") else ""
    change = f" ({relative})" if relative else ""
    return f"{uncapitalised(metric.title)} changed from {number(pair[0])} to {number(pair[1])}{unit}{change}"


def _inconsistent(data: TuningReportData) -> list[str]:
    """Warnings where NIS or NEES is far from its distribution, also where it was before."""
    warnings = []
    for key in SHAPES:
        metric = data.metric(key)
        if metric is None:
            continue
        held_out = math.isfinite(metric.held_out[1])
        value = (metric.held_out if held_out else metric.training)[1]
        if value > FAR:
            where = "held-out recordings" if held_out else "the recordings tuned on"
            warnings.append(
                f"{key.removesuffix('-shape').upper()} is far from its distribution on {where} (distance "
                f"{number(value)}; below {FAR} is acceptable): the reported covariances are wrong there."
            )
    return warnings


def _worse(data: TuningReportData) -> list[str]:
    """Warnings where a metric got worse."""
    warnings = []
    goal = data.metric(data.objective)
    if goal is not None and goal.training[1] > goal.training[0]:
        warnings.append(f"The objective itself got worse: {_change(goal, goal.training)}.")
    rmse = data.metric("rmse")
    if rmse is not None and is_worse(rmse, rmse.held_out):
        more = f"more than {100 * WORSE:.0f} % worse"
        warnings.append(f"Held-out {_change(rmse, rmse.held_out)}: {more}. {_why(data)}")
    for key in SHAPES:
        metric = data.metric(key)
        if metric is None:
            continue
        where = [
            name
            for name, pair in (("the recordings tuned on", metric.training), ("held-out recordings", metric.held_out))
            if is_worse(metric, pair)
        ]
        if where:
            quantity = key.removesuffix("-shape").upper()
            warnings.append(
                f"{quantity} is further from its distribution than before on {' and '.join(where)}: the reported "
                "covariances are less reliable than the old ones."
            )
    return warnings


def _why(data: TuningReportData) -> str:
    """The assumptions that the innovations after the fit contradict."""
    violated = [] if data.innovations is None else violated_assumptions(data.innovations[1])
    if not violated:
        return "The innovations contradict no noise assumption: perhaps too few recordings were tuned on."
    return f"The innovations contradict the assumption {'; and '.join(violated)}."


def _undetermined(data: TuningReportData) -> list[str]:
    """Warnings on undetermined parameters: the sentences of the fit, else their names."""
    if data.issues:
        *others, last = data.issues
        return [*(f"{text}." for text in others), f"{last}. {ADVICE}"]
    names = [p.name for p in data.parameters if p.determined is False]
    return (
        [f"The recordings do not determine {', '.join(names)}: other values fit equally well. {ADVICE}"]
        if names
        else []
    )


def _sentence(clause: str) -> str:
    """A clause as a sentence; one that begins with the name of a parameter keeps its case."""
    first = clause.split(" ", 1)[0]
    return (clause if "." in first else clause[0].upper() + clause[1:]) + "."


def _determined(known: int, all_of_them: int) -> str:
    if all_of_them == 1:
        return f"the recordings {'determine' if known else 'do not determine'} the parameter"
    if known == all_of_them:
        return f"the recordings determine {'both' if known == 2 else f'all {known}'} parameters"
    return f"the recordings determine {known or 'none'} of {all_of_them} parameters"
