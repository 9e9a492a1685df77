"""A fit in tables and on its page, against the fit, the estimates and their evaluation."""

import re

import numpy as np
import pytest

import trackwright as tw
from tests.experiments.cli.small_archive import random_walk
from trackwright.experiments.pages.tuning import (
    Compared,
    Verdict,
    compare,
    sweep_chart,
    traces_of,
    tracked,
    tuned_parameters,
    tuning_page,
)
from trackwright.experiments.text.tables import number
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.evaluation.comparison import Difference
from trackwright.tuning.data import fit_data
from trackwright.tuning.fit_warnings import Issue
from trackwright.tuning.parameters import Parameter
from trackwright.tuning.sweeping import Sweep

PATTERNS = ("motion.sigma_a", "sensors.fixes.sigma_horizontal")
NASTY = "tune <script>alert(1)</script> 'a&b'"
ABOUT = "held-out recordings"
WALKS = {"short": 100, "long": 400}


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    """Two walks, and a tracker with levels that are too small, and with right ones."""
    there = tmp_path_factory.mktemp("walks")
    folders = [tw.read(random_walk(there / name, k, 0.25, rows)) for k, (name, rows) in enumerate(WALKS.items(), 1)]
    named = tw.build("fix-kf", folders, free_height=True)
    return folders, [named.with_values({"sensors.fixes.sigma_*": sigma}) for sigma in (0.05, 0.25)]


def _both(trackers, folders):
    return [tracked(tracker, folders) for tracker in trackers]


@pytest.mark.parametrize(("dimensions", "suffix"), [(2, ""), (3, "_3d")])
def test_the_figures_are_those_of_evaluate_and_recordings_have_the_same_say(walks, dimensions, suffix):
    folders, trackers = walks
    found = compare(_both(trackers, folders), folders, dimensions, ABOUT)
    sides = [{r["recording"]: r for r in tw.evaluate(t.run(folders), folders).recordings} for t in trackers]
    rows = {(row[0], row[1]): dict(zip(found.sections[0].head, row, strict=True)) for row in found.sections[0].rows}
    for name, change in found.verdict.recordings.items():
        for side, run in zip(sides, ("before", "after"), strict=True):
            assert rows[name, run]["RMSE"] == f"{100 * side[name]['rmse_m']:.1f}"
            assert rows[name, run]["NEES /dof"] == f"{side[name]['nees_ratio']:.2f}"
        kept = found.content()["recordings"][name]
        assert kept["log_density"]["after"] == pytest.approx(change.second, rel=1e-5)
        for metric in (f"rmse{suffix}_m", f"coverage_95{suffix}", f"regret{suffix}", "nis_ratio"):
            assert kept[metric] == pytest.approx([side[name][metric] for side in sides], rel=1e-5)
    assert found.statements[0].startswith("Reported ")
    assert found.verdict.word == "better"
    back = compare(_both(trackers[::-1], folders), folders, dimensions, ABOUT).verdict
    assert (back.word, sorted(text.split()[0] for text in back.got_worse)) == ("worse", ["long", "short"])
    assert back.change.value == pytest.approx(-found.verdict.change.value)


def _compared(*change, worse=()):
    """A table with this change of the log density, and the names of recordings that got worse."""
    difference = Difference(*change, 0.0, 30)
    return Compared(ABOUT, [], [], Verdict(difference, dict.fromkeys(worse, difference)))


@pytest.mark.slow
def test_the_parameters_steps_and_page_of_a_fit_are_those_of_the_fit(tmp_path):
    folders = [tw.read(random_walk(tmp_path / name, k, 0.25, 64)) for k, name in enumerate("abc")]
    named = tw.build("fix-kf", folders)
    data = fit_data(named.only_batch(folders), "nll", folders[2:], 3)
    options = tw.FitOptions(steps=6, starts=2, prior="flat")
    result = tw.fit(named, folders[:2], objective="nll", tune=PATTERNS, options=options)
    intervals, issues = result.intervals, [Issue((PATTERNS[0],), "an issue")]
    shown = tuned_parameters(result, intervals, issues)
    for one, name in zip(shown, PATTERNS, strict=True):
        before, after = (float(values[name]) for values in (result.starts[0][0].values, result.values))
        assert one[:4] == (name, one.unit, before, after)
        assert one.determined is (name != PATTERNS[0])
    assert shown[1].low < shown[1].after < shown[1].high
    assert [p.determined for p in tuned_parameters(result, {})] == [None, None]
    traces = traces_of(result)
    assert len(traces) == len(result.starts)
    np.testing.assert_array_equal(traces[0].objective, [s.value for s in result.trace])
    more = {"tracker": "fix-kf", "cautions": ["a note"], "commands": [NASTY]}
    page = tuning_page(result, data, "nll", _compared(1.0, 0.5, -0.9, -0.1), intervals, issues, **more)
    text = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    words = number(shown[0].after), number(shown[1].high), "Worse.", "An issue.", "A note.", "a, b"
    assert all(word in text for word in words)
    assert "<script>alert" not in page


@pytest.mark.parametrize("two", [False, True])
def test_a_sweep_has_a_curve_for_each_value_of_the_second_number_and_its_least_value_marked(two):
    grids = [np.geomspace(0.1, 1.0, 5), np.linspace(1.0, 2.0, 3)]
    values = (np.log(grids[0])[:, None] + 1) ** 2 + (grids[1] - 1.5) ** 2
    parameters = [Parameter((name,), Scale(1.0, "m"), name) for name in ("a", "b")]
    values = values if two else values[:, 0]
    swept = Sweep(parameters[: 1 + two], grids[: 1 + two], np.stack([values - 0.1, values + 0.1]), 1)
    *curves, least = [part for part in sweep_chart(swept, "rmse (m)").parts if not part.filled]
    for curve, column in zip(curves, values.reshape(5, -1).T, strict=True):
        np.testing.assert_allclose(curve.y, column)
    assert least.y[0] == pytest.approx(values.min())
    assert sweep_chart(swept, "rmse (m)").x == "a (m)"
