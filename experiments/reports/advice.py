"""What the evidence says in words: one sentence on top, and what to beware of."""

from __future__ import annotations

import math
from dataclasses import dataclass

from experiments.reports.tuning_data import Score, TuningEvidence
from tuning.diagnostics import contradicted

WORSE = 0.02
"""Part by which a figure may rise before it counts as worse."""

WORSE_BY = 0.01
"""The same in nats, whose zero is nowhere in particular, and in distances between distributions, near zero if good."""

FAR = 0.1
"""Distance of NIS or NEES from its distribution (`tuning.consistency`) above which covariances mislead."""

ADVICE = "Do not read such numbers as measured: keep them fixed, tie those that act alike, or record more motion."
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SHAPES = ("nis-shape", "nees-shape")


@dataclass(frozen=True)
class IdentifiabilityIssue:
    """`word`: what to do; `verdict`: one sentence; `warnings`: what to beware of; `good`: whether there is nothing."""

    word: str
    verdict: str
    good: bool
    warnings: tuple[str, ...]


def judged(evidence: TuningEvidence) -> IdentifiabilityIssue:
    """What the evidence says."""
    against = [*_unmoved(evidence), *_worse(evidence), *_undetermined(evidence)]
    doubts = _inconsistent(evidence)
    best = evidence.score(evidence.objective)
    parts = [_change(best, best.training) if best else f"{evidence.objective_about} was tuned"]
    rmse = evidence.score("rmse")
    if rmse is not None and math.isfinite(rmse.held_out[0]):
        parts.append(f"on held-out recordings {_change(rmse, rmse.held_out)}")
    elif rmse is not None and best is not rmse and math.isfinite(rmse.training[0]):
        parts.append(_change(rmse, rmse.training))
    told = [n.determined for n in evidence.numbers]
    if told and None not in told:
        parts.append(_determined(told.count(True), len(told)))
    elif False in told:
        parts.append(f"the recordings leave {told.count(False)} of {len(told)} numbers open")
    sentence = "; ".join(parts)
    if not sentence.startswith(evidence.objective):
        sentence = sentence[0].upper() + sentence[1:]
    word = "Look before you use it." if against else "Use its estimates, not its covariances." if doubts else "Use it."
    return IdentifiabilityIssue(word, f"{sentence}.", not (against or doubts), (*against, *doubts))


def is_worse(score: Score, pair: tuple[float, float]) -> bool:
    """Whether the second number is worse than the first by more than `WORSE`: larger, or further from the target."""
    before, after = pair
    if not (math.isfinite(before) and math.isfinite(after)):
        return math.isfinite(before)
    if score.target is None:
        return after > before + (WORSE * before if score.unit not in ("nats", "1") else WORSE_BY)
    return abs(after - score.target) > abs(before - score.target) + WORSE * abs(score.target)


def is_better(score: Score, pair: tuple[float, float]) -> bool:
    """Whether the second number is better than the first by more than `WORSE`."""
    return all(math.isfinite(x) for x in pair) and is_worse(score, (pair[1], pair[0]))


def percent(pair: tuple[float, float]) -> str:
    """The change from the first to the second in per cent, with its sign; empty where it says nothing."""
    before, after = pair
    if not (math.isfinite(before) and math.isfinite(after) and before > 0):
        return ""
    change = 100 * (after / before - 1)
    digits = 0 if abs(change) >= 10 else 1
    return f"{change:+.{digits}f} %".replace("-", "−")


def number(value: float) -> str:
    """Four digits for a person to read, with a real minus sign; a dash where there is none."""
    if not math.isfinite(value):
        return "–"
    text = f"{value:.4g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}·10{str(int(exponent)).translate(RAISED)}"
    return text.replace("-", "−")


def _change(score: Score, pair: tuple[float, float]) -> str:
    unit = "" if score.unit == "1" else f" {score.unit}"
    relative = percent(pair) if score.unit not in ("nats", "1") else ""
    change = f" ({relative})" if relative else ""
    title = score.title[0].lower() + score.title[1:] if not score.title[:2].isupper() else score.title
    return f"{title} went from {number(pair[0])} to {number(pair[1])}{unit}{change}"


def _unmoved(evidence: TuningEvidence) -> list[str]:
    """Whether nothing was gained."""
    if not evidence.numbers or any(abs(n.after - n.before) > 1e-6 * abs(n.before) for n in evidence.numbers):
        return []
    where = "on the held-out recordings " if evidence.held_out else ""
    return [f"Nothing was gained: no point that the fit met is better {where}than the numbers that it began with."]


def _inconsistent(evidence: TuningEvidence) -> list[str]:
    """Which distributions are far from what they should be, even if not further than before."""
    found = []
    for key in SHAPES:
        score = evidence.score(key)
        if score is None:
            continue
        held_out = math.isfinite(score.held_out[1])
        value = (score.held_out if held_out else score.training)[1]
        if value > FAR:
            where = "held-out recordings" if held_out else "the recordings tuned on"
            found.append(
                f"The {key.removesuffix('-shape').upper()} is far from its distribution on {where} ({number(value)}; "
                f"below {FAR} is fair): with these numbers it does not know how wrong it is there."
            )
    return found


def _worse(evidence: TuningEvidence) -> list[str]:
    """What got worse although it was not to."""
    found = []
    goal = evidence.score(evidence.objective)
    if goal is not None and goal.training[1] > goal.training[0]:
        found.append(f"The objective itself got worse: {_change(goal, goal.training)}.")
    rmse = evidence.score("rmse")
    if rmse is not None and is_worse(rmse, rmse.held_out):
        more = f"more than {100 * WORSE:.0f} % worse"
        found.append(f"Held-out {_change(rmse, rmse.held_out)}: {more}. {_why(evidence)}")
    for key in SHAPES:
        score = evidence.score(key)
        if score is None:
            continue
        where = [
            name
            for name, pair in (("the recordings tuned on", score.training), ("held-out recordings", score.held_out))
            if is_worse(score, pair)
        ]
        if where:
            quantity = key.removesuffix("-shape").upper()
            found.append(
                f"The {quantity} distribution is further than before from what it should be on {' and '.join(where)}: "
                "the covariances that this filter reports deserve less belief than the old ones."
            )
    return found


def _why(evidence: TuningEvidence) -> str:
    """Which assumption fails, by the innovations after the fit."""
    found = [] if evidence.innovations is None else contradicted(evidence.innovations[1])
    if not found:
        return "Its innovations contradict no assumption on the noise: perhaps too few recordings were tuned on."
    return f"What the innovations contradict: {'; '.join(found)}."


def _undetermined(evidence: TuningEvidence) -> list[str]:
    """What the recordings leave open: in the words that came with the fit, or else by name."""
    if evidence.identifiability_issues:
        *others, last = evidence.identifiability_issues
        return [*(f"{text}." for text in others), f"{last}. {ADVICE}"]
    names = [n.name for n in evidence.numbers if n.determined is False]
    return [f"The recordings do not determine {', '.join(names)}: other values fit as well. {ADVICE}"] if names else []


def _determined(known: int, all_of_them: int) -> str:
    if all_of_them == 1:
        return "the recordings determine the number" if known else "the recordings do not determine the number"
    if known == all_of_them:
        return f"the recordings determine {'both' if known == 2 else f'all {known}'} numbers"
    return f"the recordings determine {known or 'none'} of {all_of_them} numbers"
