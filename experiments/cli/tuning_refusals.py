"""Why `tune` does not write the values of a fit: levels that collapsed, no optimum, recordings that get worse."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from experiments.pages.reports.recordings_compared import Compared
from tuning import FitResult


class Refusal(NamedTuple):
    """What is wrong with the values of a fit, in a clause, and the usual fix."""

    text: str
    fix: str


def refusals(result: FitResult, compared: Compared, held_out: bool) -> list[Refusal]:
    """The reasons not to use the values; none for a fit that was interrupted, of which the user knows."""
    if result.uncertainty is None:
        return []
    found = [Refusal(text, "--freeze it or --bound it, or --average repeats") for text in result.collapsed]
    if not (held_out or result.at_optimum):
        found.append(Refusal("the fit ended before its optimum", "more --steps or --starts"))
    return found + [Refusal(text, "--tune fewer numbers, or more recordings") for text in compared.worse]


def in_words(found: Sequence[Refusal]) -> str:
    """All reasons and what to do, in one line."""
    fixes = dict.fromkeys(one.fix for one in found)
    return f"{'; '.join(one.text for one in found)}. Usual fix: {', or '.join(fixes)}; --force writes it all the same"
