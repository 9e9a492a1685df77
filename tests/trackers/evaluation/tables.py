"""The evaluation of a table of estimates against tables of truth."""

from trackwright.trackers.evaluation.association import associate_truth, refuse_without_overlap
from trackwright.trackers.evaluation.evaluate import evaluate_association


def evaluate_table(tracks, truths, stations=None, every=None):
    """The metrics of estimates against the truth of each recording by name; refused where no estimate has one."""
    association = associate_truth(tracks, truths)
    refuse_without_overlap(association, truths)
    return evaluate_association(association, stations, every)
