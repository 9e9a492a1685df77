"""A comparison of two studies or of two evaluations: their metrics side by side, as text and as an HTML page."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.monte_carlo.declaration import short
from experiments.monte_carlo.expectations import Value
from experiments.reports.pages import page, write_page
from experiments.reports.tables import rendered, ruled_table, terminal_width
from experiments.reports.wording import MISSING, heading, units_of, with_interval, yes_no
from trackers.core.errors import UnusableInput

RESULTS, EVALUATION = "results.json", "evaluation.json"
COUNTS = ("n", "n_rows", "n_no_estimate", "n_no_truth", "n_hole")
SHOWN = (
    "rmse_m", "median_m", "p95_m", "rmse_3d_m", "p95_3d_m", "rmse_direction_rad", "nees_mean", "nees_ratio",
    "coverage_50", "coverage_90", "coverage_95", "coverage_99", "nis_ratio", "nis_correlation_100ms",
    "nis_correlation_1s", "nis_correlation_5s", "lost_fraction", "diverged",
)  # fmt: skip
HEAD = ("", "metric", "first", "second", "second / first", "differ?")
WIDTH = 150


class Pair(NamedTuple):
    """A metric of two runs: its subject (world and tracker, or recording), its name, and both values.

    Without an interval where a run has none.
    """

    subject: str
    metric: str
    before: Value
    after: Value

    @property
    def ratio(self) -> float:
        """The second over the first."""
        return self.after.value / self.before.value if self.before.value else math.nan

    @property
    def differs(self) -> bool | None:
        """Whether the difference is significant at 5 %, by the intervals' widths; None where they are unknown.

        For independent runs; conservative where they share their random numbers.
        """
        widths = [v.high - v.low for v in (self.before, self.after)]
        if not all(math.isfinite(w) for w in widths):
            return None
        return abs(self.after.value - self.before.value) > math.hypot(*widths) / 2


def pairs(first: Path, second: Path) -> tuple[list[Pair], list[str]]:
    """The metrics that both runs have, and notices on subjects of one run only; raises UnusableInput."""
    kinds = [_kind(folder) for folder in (first, second)]
    if kinds[0] != kinds[1]:
        raise UnusableInput(
            f"{first} holds {kinds[0]}, {second} {kinds[1]}; expected two runs of one kind: two studies, or two "
            "folders of `track` that were evaluated"
        )
    read = _of_study if kinds[0] == RESULTS else _of_evaluation
    a, b = (dict(read(_json(folder / kinds[0]))) for folder in (first, second))
    common = [Pair(*key, a[key], b[key]) for key in a if key in b]
    if not common:
        raise UnusableInput(f"{first} and {second} have no metric of the same world and tracker in common")
    in_a, in_b = ({subject for subject, _ in x} for x in (a, b))
    return common, [
        f"only in {folder}: {subject}"
        for folder, own in ((first, in_a - in_b), (second, in_b - in_a))
        for subject in sorted(own)
    ]


def rows(found: Sequence[Pair]) -> list[list[str]]:
    """The table's cells."""
    values: dict[str, list[float]] = {}
    for pair in found:
        values.setdefault(pair.metric, []).extend([pair.before.value, pair.after.value])
    units, made = units_of(values), []
    for pair in found:
        unit = units[pair.metric]
        both = (with_interval(pair.before, unit), with_interval(pair.after, unit))
        ratio = f"{pair.ratio:.3f}" if math.isfinite(pair.ratio) else MISSING
        made.append([pair.subject, heading(pair.metric, unit), *both, ratio, yes_no(pair.differs)])
    return made


def comparison_text(runs: Sequence[Path], found: Sequence[Pair]) -> str:
    """The metrics side by side, for a terminal."""
    return rendered(terminal_width(WIDTH), ruled_table(f"first: {runs[0]}, second: {runs[1]}", HEAD, 2, rows(found)))


def write_comparison(path: Path, runs: Sequence[Path], found: Sequence[Pair], command: Sequence[str]) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written."""
    text = page(
        "comparison.html",
        title=f"{runs[0]} and {runs[1]}",
        head=HEAD,
        rows=rows(found),
        intervals=any(pair.differs is not None for pair in found),
        words=shlex.join(["trackwright", *command[1:]]),
    )
    return write_page(path, text)


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
        subject = ", ".join(x for x in (cell["world"], point, cell["tracker"]) if x)
        for metric, value in cell["figures"].items():
            yield (subject, metric), Value(*(math.nan if value[k] is None else value[k] for k in Value._fields))


def _of_evaluation(content: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str], Value]]:
    for named in [{"recording": "all recordings", **content["overall"]}, *content["recordings"]]:
        for metric, value in named.items():
            if isinstance(value, (int, float)) and metric not in COUNTS:
                yield (named["recording"], metric), Value(float(value), math.nan, math.nan)
