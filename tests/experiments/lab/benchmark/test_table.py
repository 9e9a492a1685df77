"""What counts as better, equal and worse."""

from __future__ import annotations

import numpy as np
import pytest

from trackwright.experiments.lab.benchmark.declaration import DEFAULT, MOTION, OURS, SMOOTHED
from trackwright.experiments.lab.benchmark.scoring import Cell
from trackwright.experiments.lab.benchmark.table import _against, _summary
from trackwright.trackers.evaluation.comparison import TrackErrors

FAILED = Cell(failed="LinAlgError: singular")


def _cell(size, seconds=100.0):
    """Independent normal errors of this size, ten a second."""
    times = np.arange(0.0, seconds, 0.1)
    errors = size * np.abs(np.random.default_rng(1).standard_normal(len(times)))
    nan = np.full(len(times), np.nan)
    return Cell(rmse=size, errors={("hall", "1"): TrackErrors(times, errors, nan, nan)})


@pytest.mark.parametrize(
    ("ours", "other", "counts"),
    [
        (_cell(1.0), _cell(1.5), (1, 0, 0, 0)),
        (_cell(1.5), _cell(1.0), (0, 0, 0, 1)),
        (_cell(1.0), _cell(1.0), (0, 1, 0, 0)),
        # Three readings are no five pieces, so that their difference has no interval.
        (_cell(1.0, 0.3), _cell(1.5, 0.3), (0, 1, 1, 0)),
        (FAILED, _cell(1.0), (0, 0, 0, 1)),
        (_cell(1.0), FAILED, (1, 0, 0, 0)),
        (FAILED, FAILED, (0, 1, 0, 0)),
    ],
)
def test_worse_is_a_failure_or_a_larger_error_beyond_an_interval(ours, other, counts):
    ((_, tally),) = _against({"hall": {OURS: ours, "mine": other}})
    assert (tally.better, tally.equal, tally.unknown, len(tally.worse)) == counts


def test_estimators_that_use_later_readings_are_compared_with_the_smoothed_one_alone():
    assert not list(_against({"hall": {OURS: _cell(1.0), "gtsam": _cell(0.5)}}))
    ((name, tally),) = _against({"hall": {SMOOTHED: _cell(0.5), "gtsam": _cell(1.0)}})
    assert (name, tally.better) == ("gtsam", 1)


def test_ours_at_several_levels_of_motion_stands_in_for_the_default_one():
    cells = {"hall": {OURS: _cell(1.5), MOTION[0]: _cell(0.5), "mine": _cell(1.0)}}
    tallies = [dict(_against(cells, ours)) for ours in (DEFAULT, MOTION)]
    assert [(tally["mine"].better, len(tally["mine"].worse)) for tally in tallies] == [(0, 1), (1, 0)]
    assert tallies[0].keys() == {"mine"}


def test_a_failure_is_counted_as_such_and_not_among_readings():
    some = _cell(1.0)._replace(missing=0.2)
    row = _summary("mine", {"hall": {"mine": some}, "shed": {"mine": FAILED}})
    assert (row["failures"], row["readings without an estimate, %"]) == (1, "20.0")
    assert _summary("mine", {"shed": {"mine": FAILED}})["readings without an estimate, %"] == ""
