"""Errors and consistency of each recording with a tracker before and after tuning, as `evaluate` has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from trackwright.experiments.pages.reports.worse_recordings import worse
from trackwright.experiments.text.tables import rendered, ruled_table, terminal_width
from trackwright.experiments.text.wording import Unit, fixed, length_unit
from trackwright.trackers.evaluation.association import Association, associate_truth
from trackwright.trackers.evaluation.evaluate import Evaluation, evaluate_association
from trackwright.trackers.evaluation.statements import covariance_statements
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker

WIDTH = 120
DEGREES = Unit("°", 57.29577951308232)


class Compared(NamedTuple):
    """A table of recordings before and after tuning, and sentences on the covariances after it.

    `about`: in words, the recordings; `head`: its columns; `rows`: the text of its cells. `worse`: clauses on the
    recordings that got worse.
    """

    about: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    statements: tuple[str, ...]
    worse: tuple[str, ...] = ()

    def text(self) -> str:
        """The table and the sentences for a terminal."""
        title = f"{self.about[0].upper()}{self.about[1:]}, before → after"
        return rendered(terminal_width(WIDTH), ruled_table(title, self.head, 1, self.rows), *self.statements)


def tracked(tracker: NamedTracker, folders: Sequence[RecordingFolder]) -> Association:
    """The estimates of the recordings, tracked as `track` does it, with their truth."""
    truths = {f.name: f.tables["truth"] for f in folders if "truth" in f.tables}
    return associate_truth(tracker.run(folders).table, truths)


def compare(sides: Sequence[Association], folders: Sequence[RecordingFolder], dimensions: int, about: str) -> Compared:
    """Errors of the recordings `folders` in the estimates before and after tuning, those of `tracked`.

    `dimensions`: 3 for errors and ellipsoids in space, 2 for those over the floor. `about`: in words, the recordings.
    A recording without truth has no figures but those of its innovations.
    """
    before, after = (_evaluation(side, folders) for side in sides)
    suffix = "_3d" if dimensions == 3 and before.overall.get("coverage_95_3d") is not None else ""
    error = "rmse_direction_rad" if before.bearing else f"rmse{suffix}_m"
    pairs = list(zip(before.recordings, after.recordings, strict=True))
    unit = DEGREES if before.bearing else length_unit(before.overall[error] or 1.0)
    shape = "ellipsoid" if suffix else "ellipse"
    named = {
        f"{'3-D ' if suffix else ''}RMSE, {unit.name}": (error, unit.factor, 3 if unit.name == "m" else 1),
        f"% in 95 % {shape}": (f"coverage_95{suffix}", 100.0, 0),
        "NEES/dof": (f"nees{suffix}_ratio", 1.0, 2),
        "NIS r 1 s": ("nis_correlation_1s", 1.0, 2),
    }
    rows = [(old["recording"], *_cells(old, new, named.values())) for old, new in pairs]
    if len(pairs) > 1:
        means = [_means(side, named.values()) for side in zip(*pairs, strict=True)]
        rows.append((f"mean of {len(pairs)}", *_cells(means[0], means[1], named.values())))
    sentences = covariance_statements(after.overall, after.recordings)
    # A better height is no excuse for a worse place on the floor.
    judged = {"": error.replace("_3d", ""), suffix: error}
    clauses = tuple(
        clause for old, new in pairs for own, metric in judged.items() for clause in worse(old, new, metric, own)
    )
    return Compared(about, ("recording", *named), tuple(rows), tuple(sentences), clauses)


def _evaluation(side: Association, folders: Sequence[RecordingFolder]) -> Evaluation:
    own = Association.joined([side.of_recording(name) for name in sorted(f.name for f in folders)])
    return evaluate_association(own, {f.name: f.rig.stations for f in folders})


def _cells(old: Any, new: Any, columns: Any) -> Iterator[str]:
    for name, factor, digits in columns:
        pair = (None if side[name] is None else factor * side[name] for side in (old, new))
        yield " → ".join(fixed(value, digits) for value in pair)


def _means(metrics: Sequence[Any], columns: Any) -> dict[str, float | None]:
    """The mean over recordings, each with the same weight; None where one has no value."""
    means: dict[str, float | None] = {}
    for name, _, _ in columns:
        values = [m[name] for m in metrics]
        means[name] = None if None in values else sum(values) / len(values)
    return means
