"""The data of a tuning report, against the fit and the tracks they describe."""

from dataclasses import replace

import numpy as np
import pytest

from tests.experiments.pages.reports.tuning_report_data import walk
from trackwright.experiments.pages.reports.tuning import collect, tuned_parameters
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.recordings.tracks import batches
from trackwright.tuning.data import FitData
from trackwright.tuning.fit_warnings import Issue
from trackwright.tuning.fitting import FitOptions, fit
from trackwright.tuning.objectives import parse_objective

PATTERNS = ("motion.sigma_a", "sensors.fixes.sigma_horizontal")
NLL = "nll"


@pytest.fixture(scope="module")
def run():
    (group,) = spec_of("fix-kf").batches([walk(name, k, rows=64) for k, name in enumerate("abcd")], "fix-kf", False)
    training, held_out = group.trajectories[:2], group.trajectories[2:]
    rows = [batch for _, batch in batches(training)]
    result = fit(
        group.tracker, rows, parse_objective(NLL, "position", 3), PATTERNS, FitOptions(steps=6, starts=2, prior="flat")
    )
    issues = [Issue((PATTERNS[0],), "an issue")]
    data = FitData(group.tracker, parse_objective(NLL), NLL, group.planar, 3, training, held_out, "recordings")
    collected = collect(result, data, NLL, result.intervals, issues)
    return result, replace(collected, tracker="fix-kf")


def test_parameters_are_those_of_the_fit_and_one_with_an_issue_is_not_determined(run):
    result, data = run
    for number, name in zip(data.parameters, PATTERNS, strict=True):
        assert number.name == name
        assert number.before == float(result.starts[0][0].values[name])
        assert number.after == float(result.values[name])
        assert number.determined is (name != PATTERNS[0])
    assert data.parameters[1].low < data.parameters[1].after < data.parameters[1].high
    assert data.issues == ("an issue",)


def test_recordings_tuned_on_and_held_out_are_kept_apart(run):
    _, data = run
    assert data.training == ("a", "b")
    assert data.held_out == ("c", "d")


def test_every_start_ends_in_the_trace_and_the_winner_is_first(run):
    result, data = run
    assert len(data.traces) == len(result.starts)
    np.testing.assert_array_equal(data.traces[0].objective, [s.value for s in result.trace])


def test_without_any_interval_it_is_unknown_what_is_determined(run):
    result, _ = run
    assert [n.determined for n in tuned_parameters(result, {}, [])] == [None, None]
    assert [n.determined for n in tuned_parameters(result, {}, [Issue((PATTERNS[0],), "an issue")])] == [
        False,
        None,
    ]
