"""The toolbar of every chart on every kind of page in Chromium: nothing there may upload a chart."""

import pytest

from experiments.interactive.track_page import run_data, write_track_page
from experiments.monte_carlo.runner import run_study
from experiments.reports.study import study_page
from experiments.reports.tuning import write_tuning_report
from tests.browser import chromium, watched
from tests.experiments.interactive.small_tracks import small_tracks
from tests.experiments.interactive.test_track_page import NO_EVENTS
from tests.experiments.monte_carlo.small_study import SMALL
from tests.experiments.reports.tuning_report_data import report_data
from trackers.evaluation import evaluate

BUTTONS = {"Zoom", "Pan", "Reset axes", "Download plot as a PNG", "Download plot as a png"}

FOUND = """() => {
  const bars = [...document.querySelectorAll(".modebar-btn")], charts = [...document.querySelectorAll(".js-plotly-plot")];
  return {
    titles: [...new Set(bars.map((one) => one.dataset.title || one.getAttribute("aria-label")))],
    visible: bars.filter((one) => one.offsetParent !== null || one.getClientRects().length > 0).length,
    bars: charts.filter((one) => one.querySelector(".modebar-btn")).length,
    charts: charts.length,
    shared: charts.filter((one) => one._context.showSendToCloud || one._context.plotlyServerURL).length,
    links: [...document.querySelectorAll("a[href]")].map((one) => one.href).filter((one) => /plotly|cloud/i.test(one)),
  };
}"""


def _track(folder):
    tracks = small_tracks()
    run = run_data(tracks, NO_EVENTS, evaluate(tracks.association, tracks.folders), "uwb")
    write_track_page(folder / "track.html", [run], "trackwright track hall")
    return folder / "track.html"


def _tune(folder):
    return write_tuning_report(folder / "tune.html", report_data())


def _study(folder):
    path = folder / "study.html"
    path.write_text(study_page(run_study(SMALL, folder / "study"), [], [], ["study", "small.toml"]), "utf-8")
    return path


@pytest.mark.parametrize(
    "page_of",
    [_track, pytest.param(_tune, marks=pytest.mark.slow), pytest.param(_study, marks=pytest.mark.slow)],
    ids=["track", "tune", "study"],
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
            assert (found["visible"] > 0) == (width > 600)
            assert not errors
