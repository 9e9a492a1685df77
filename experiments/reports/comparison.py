"""Two runs side by side: the figures of two studies, or of two evaluations, and which of them really differ."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from experiments.monte_carlo.declaration import short
from experiments.monte_carlo.expectations import Value
from trackers.core.errors import UnusableInput

RESULTS, EVALUATION = "results.json", "evaluation.json"
COUNTS = ("n", "n_rows", "n_no_estimate", "n_no_truth", "n_hole")


class Pair(NamedTuple):
    """A figure of two runs: whose it is, its name, and both values; without an interval where a run has none."""

    whose: str
    figure: str
    before: Value
    after: Value

    @property
    def ratio(self) -> float:
        """The second over the first."""
        return self.after.value / self.before.value if self.before.value else math.nan

    @property
    def differs(self) -> bool | None:
        """Whether the difference is more than chance, by the intervals' widths; None where they are unknown.

        As if the runs were independent: where they share their random numbers, less would be enough.
        """
        widths = [v.high - v.low for v in (self.before, self.after)]
        if not all(math.isfinite(w) for w in widths):
            return None
        return abs(self.after.value - self.before.value) > math.hypot(*widths) / 2


def pairs(first: Path, second: Path) -> tuple[list[Pair], list[str]]:
    """The figures that both runs have, and what only one of them has; raises UnusableInput for what is no run."""
    kinds = [_kind(folder) for folder in (first, second)]
    if kinds[0] != kinds[1]:
        raise UnusableInput(
            f"{first} holds {kinds[0]}, {second} {kinds[1]}; expected two runs of one kind: two studies, or two "
            "folders of `track` that were evaluated"
        )
    read = _of_study if kinds[0] == RESULTS else _of_evaluation
    a, b = (dict(read(_json(folder / kinds[0]))) for folder in (first, second))
    common = [Pair(whose, figure, a[whose, figure], b[whose, figure]) for whose, figure in a if (whose, figure) in b]
    if not common:
        raise UnusableInput(f"{first} and {second} have no figure of the same world and tracker in common")
    mine, its = ({whose for whose, _ in x} for x in (a, b))
    alone = [f"only in {first}: {w}" for w in sorted(mine - its)] + [
        f"only in {second}: {w}" for w in sorted(its - mine)
    ]
    return common, alone


def _kind(folder: Path) -> str:
    for name in (RESULTS, EVALUATION):
        if (folder / name).is_file():
            return name
    raise UnusableInput(
        f"{folder}: no {RESULTS} and no {EVALUATION}; expected what `trackwright study` or `trackwright evaluate` wrote"
    )


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise UnusableInput(f"{path}: cannot be read as JSON; run the study or `evaluate` again") from error


def _of_study(content: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str], Value]]:
    for cell in content["cells"]:
        point = ", ".join(f"{short(k)} {v}" for k, v in cell["point"].items())
        whose = ", ".join(x for x in (cell["world"], point, cell["tracker"]) if x)
        for figure, value in cell["figures"].items():
            yield (whose, figure), Value(*(math.nan if value[k] is None else value[k] for k in Value._fields))


def _of_evaluation(content: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str], Value]]:
    for named in [{"recording": "all recordings", **content["overall"]}, *content["recordings"]]:
        for figure, value in named.items():
            if isinstance(value, (int, float)) and figure not in COUNTS:
                yield (named["recording"], figure), Value(float(value), math.nan, math.nan)
