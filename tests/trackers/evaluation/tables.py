"""The evaluation of a table of estimates against tables of truth."""

from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.rows import refuse_without_overlap, scored_rows


def evaluate_table(tracks, truths, stations=None):
    """The metrics of estimates against the truth of each recording by name; refused where no estimate has one."""
    rows = scored_rows(tracks, truths, stations)
    refuse_without_overlap(rows, truths)
    return Evaluation.of(rows)
