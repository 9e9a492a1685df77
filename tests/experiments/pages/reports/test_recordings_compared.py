"""The table of recordings before and after tuning, against the evaluation of the tracks."""

import numpy as np
import pytest

import trackwright as tw
from tests.experiments.pages.reports.tuning_report_data import report_data, walk
from trackwright.experiments.pages.reports.before_after import compare, tracked
from trackwright.experiments.pages.reports.tuning import tuning_page

SIGMAS = "sensors.fixes.sigma_*"


@pytest.fixture(scope="module")
def walks():
    folders = [walk("short", 1, 100), walk("long", 2, 400)]
    named = tw.build("fix-kf", folders, free_height=True)
    return folders, (named.with_values({SIGMAS: 0.05}), named.with_values({SIGMAS: 0.25}))


def _both(trackers, folders):
    return [tracked(tracker, folders) for tracker in trackers]


@pytest.mark.parametrize(("dimensions", "suffix"), [(2, ""), (3, "_3d")])
def test_the_figures_are_those_of_evaluate_and_recordings_have_the_same_say(walks, dimensions, suffix):
    folders, trackers = walks
    found = compare(_both(trackers, folders), folders, dimensions, "held-out recordings")
    sides = [{r["recording"]: r for r in tw.evaluate(t.run(folders), folders).recordings} for t in trackers]
    assert [row[0] for row in found.rows] == ["long", "short", "mean of 2"]
    for name, *cells in found.rows[:2]:
        before, after = (side[name] for side in sides)
        error, share, nees, correlation = (cell.split(" → ") for cell in cells)
        assert error == [f"{100 * m[f'rmse{suffix}_m']:.1f}" for m in (before, after)]
        assert share == [f"{100 * m[f'coverage_95{suffix}']:.0f}" for m in (before, after)]
        assert nees == [f"{m[f'nees{suffix}_ratio']:.2f}" for m in (before, after)]
        assert correlation == [f"{m['nis_correlation_1s'] + 0.0:.2f}" for m in (before, after)]
    mean = np.mean([sides[1][name][f"rmse{suffix}_m"] for name in ("short", "long")])
    assert found.rows[2][1].split(" → ")[1] == f"{100 * mean:.1f}"
    assert found.statements[0].startswith("Reported ")
    assert found.worse == ()
    back = compare(_both(trackers[::-1], folders), folders, dimensions, "held-out recordings").worse
    expected = [False, True][: dimensions - 1]
    for name in ("short", "long"):
        assert ["ellipsoid" in text for text in back if text.startswith(name) and "95 %" in text] == expected
    text = found.text()
    assert text.startswith("Held-out recordings, before → after")
    assert all(cell in text for row in found.rows for cell in row)


def test_a_recording_without_truth_has_no_errors(walks):
    folders, trackers = walks
    own = [folders[0], walk("blind", 3, 100, truth=False)]
    found = compare(_both(trackers, own), own, 2, "recordings tuned on")
    blind = next(row for row in found.rows if row[0] == "blind")
    assert blind[1:4] == ("– → –",) * 3
    assert "–" not in blind[4]


def test_the_page_of_a_tuning_run_shows_the_table(walks):
    folders, trackers = walks
    found = compare(_both(trackers, folders), folders, 2, "held-out recordings")
    page = tuning_page(report_data(compared=found))
    assert "Held-out recordings</h2>" in page
    assert found.rows[0][1] in page


def test_recordings_tracked_beside_those_shown_change_nothing(walks):
    folders, trackers = walks
    sides = _both(trackers, folders)
    assert compare(sides, folders[:1], 2, "a") == compare(_both(trackers, folders[:1]), folders[:1], 2, "a")
