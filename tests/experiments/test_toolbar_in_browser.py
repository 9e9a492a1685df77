"""The toolbar of every chart on every kind of page in Chromium: nothing there may upload a chart."""

import re

import pytest

from tests.browser import chromium, watched
from tests.experiments.monte_carlo.small_study import SMALL
from tests.experiments.pages.charts.small_runs import small_run
from tests.experiments.pages.reports.small_tracks import small_tracks
from tests.experiments.pages.reports.test_track_page import NO_EVENTS
from tests.tuning.calibration_worlds import world
from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.experiments.pages.calibration import report_on, write_calibration_report
from trackwright.experiments.pages.reports.comparison import comparison_charts, write_comparison
from trackwright.experiments.pages.reports.track import run_data, write_track_page
from trackwright.experiments.pages.study import study_page
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.tuning.calibrating import calibrate

BUTTONS = {"Zoom", "Pan", "Reset axes", "Download plot as a PNG", "Download plot as a png"}
UPLOADS = re.compile("share|upload|cloud|studio|publish", re.IGNORECASE)

FOUND = """() => {
  const bars = [...document.querySelectorAll(".modebar-btn")], charts = [...document.querySelectorAll(".js-plotly-plot")];
  return {
    titles: [...new Set(bars.map((one) => one.dataset.title || one.getAttribute("aria-label")))],
    visible: bars.filter((one) => one.offsetParent !== null || one.getClientRects().length > 0).length,
    bars: charts.filter((one) => one.querySelector(".modebar-btn")).length,
    charts: charts.length,
    shared: charts.filter((one) => one._context.showSendToCloud || one._context.plotlyServerURL).length,
    words: [...document.querySelectorAll("button, a, [role=button], [data-title]")]
      .map((one) => [one.textContent, one.title, one.dataset.title].join(" ")),
    links: [...document.querySelectorAll("a[href]")].map((one) => one.href).filter((one) => /plotly|cloud/i.test(one)),
  };
}"""


def _track(folder):
    tracks = small_tracks()
    run = run_data(tracks, NO_EVENTS, Evaluation.of(tracks.rows), "uwb")
    write_track_page(folder / "track.html", [run], "trackwright track hall")
    return folder / "track.html"


def _study(folder):
    path = folder / "study.html"
    path.write_text(study_page(run_study(SMALL, folder / "study"), [], ["study", "small.toml"]), "utf-8")
    return path


def _comparison(folder):
    runs = [small_run("uwb", {"a": 0.2}), small_run("median", {"a": 0.5})]
    return write_comparison(folder / "comparison.html", ["uwb", "median"], [], comparison_charts(runs), ["report"])


def _calibration(folder):
    folders = world(5, 1, seconds=30.0)[1]
    calibration = calibrate(folders)
    out, report = folder / "calibration.toml", report_on(calibration, folders)
    return write_calibration_report(out, calibration, report, ["calibrate"])


@pytest.mark.parametrize(
    "page_of",
    [_track, *(pytest.param(one, marks=pytest.mark.slow) for one in (_comparison, _study, _calibration))],
    ids=["track", "comparison", "study", "calibration"],
)
def test_no_chart_of_any_page_can_be_uploaded_and_a_phone_has_no_toolbar(page_of, tmp_path):
    path = page_of(tmp_path)
    with chromium() as browser:
        for width in (1300, 400):
            page = browser.new_context(viewport={"width": width, "height": 900}).new_page()
            errors = watched(page)
            page.goto(path.as_uri())
            page.wait_for_selector(".js-plotly-plot .modebar-btn", state="attached")
            found = page.evaluate(FOUND)
            assert set(found["titles"]) <= BUTTONS
            assert {"Zoom", "Pan", "Reset axes"} <= set(found["titles"])
            assert found["bars"] == found["charts"] > 0
            assert found["shared"] == 0
            assert found["links"] == []
            assert not [one for one in found["words"] if UPLOADS.search(one)]
            assert (found["visible"] > 0) == (width > 600)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert not errors
