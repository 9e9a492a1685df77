"""A fit in tables and on its page, against the fit, the estimates and their evaluation."""

import re

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.experiments.pages.tuning import (
    Compared,
    TunedParameter,
    Verdict,
    advice,
    compare,
    sweep_chart,
    traces_of,
    tracked,
    tuned_parameters,
    tuning_page,
)
from trackwright.experiments.text.wording import number
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.evaluation.comparison import Difference
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.data import fit_data
from trackwright.tuning.fit_warnings import Issue
from trackwright.tuning.parameters import Parameter
from trackwright.tuning.sweeping import Sweep

PATTERNS = ("motion.sigma_a", "sensors.fixes.sigma_horizontal")
NASTY = "tune <script>alert(1)</script> 'a&b'"
ABOUT = "held-out recordings"


def _walk(name, seed, rows=60, truth=True):
    """Fixes of a tag that walks at random."""
    rng = np.random.default_rng(seed)
    place = np.cumsum(0.1 * rng.normal(size=(rows, 3)), axis=0) + [2.0, 3.0, 1.0]
    tables = {}
    for kind, values in (("fixes", place + 0.25 * rng.normal(size=place.shape)), *[("truth", place)] * truth):
        columns = {f"{a}_m": values[:, k] for k, a in enumerate("xyz")}
        tables[kind] = pl.DataFrame({"t_s": np.arange(rows) * 0.2, "tag": "t0"} | columns)
    return RecordingFolder(name, None, Rig(name, anchors={"A": np.array([0.0, 0.0, 2.0])}), tables)


@pytest.fixture(scope="module")
def walks():
    """Two walks, and a tracker with levels that are too small, and with right ones."""
    folders = [_walk("short", 1, 100), _walk("long", 2, 400)]
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


CHANGES = {"Better.": (-2.0, 1.0, 2.5, 3.5), "Worse.": (1.0, 0.5, -0.9, -0.1), "Not told apart.": (1.0, 0.9, -0.4, 0.2)}


@pytest.mark.parametrize(("word", "change"), CHANGES.items())
def test_a_verdict_names_its_interval_what_got_worse_and_what_is_not_determined(word, change):
    known, unknown = TunedParameter("a.b", "1", 1.0, 2.0, 1.5, 2.5, True), TunedParameter("c.d", "1", 1.0, 2.0)
    found, sentence, warnings = advice([known], _compared(*change, worse=("line-c",)), [], [])
    assert (found, len(warnings)) == (word, int(word == "Worse."))
    assert all(text.startswith(f"line-c got worse, 1.00 → {change[1]:.2f} nats") for text in warnings)
    assert f"95 % interval {change[2]:+.2f} to {change[3]:+.2f}" in sentence
    (text,) = advice([known, unknown._replace(determined=False)], _compared(-2.0, 1.0, 2.5, 3.5), [], [])[2]
    assert text.startswith("Not determined by the recordings: c.d. Do not use such values")
    _, _, warnings = advice([known], _compared(-2.0, 1.0, 2.5, 3.5), ["an issue"], ["a caution"])
    assert warnings == ["A caution.", "An issue."]
    assert Verdict(None, {}, "too short").word == "not judged"


def test_the_parameters_steps_and_page_of_a_fit_are_those_of_the_fit(walks):
    folders = [_walk(name, k, 64) for k, name in enumerate("abc")]
    named = tw.build("fix-kf", folders)
    data = fit_data(named.only_batch(folders), "nll", folders[2:], 1000, 3)
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
    more = {"tracker": "fix-kf", "cautions": [], "notes": ["A note."], "commands": [NASTY]}
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
