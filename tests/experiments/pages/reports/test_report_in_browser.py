"""The page of a study in Chromium: it fits its window and draws every chart."""

import pytest

from tests.browser import chromium
from tests.experiments.monte_carlo.small_study import SMALL
from trackwright.experiments.monte_carlo import PREDICTED, Conclusion, ExpectedResult
from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.experiments.pages.reports.study import study_page
from trackwright.experiments.text.expectations import Value

pytestmark = pytest.mark.slow

MEASURE = """() => {
  const root = document.documentElement, count = (what) => document.querySelectorAll(what).length;
  const charts = [...document.querySelectorAll(".chart .main-svg")].map((one) => one.clientWidth);
  return [root.scrollWidth, count("figure"), count(".js-plotly-plot"), Math.min(...charts), count("section")];
}"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    results = run_study(SMALL, folder)
    claims = [
        ExpectedResult(
            "Table 1, antennas 3-7-8, elevation", 10.731, Value(10.2, 9.9, 10.6), "°", PREDICTED, note="A remark."
        ),
        Conclusion("The filter is better throughout", holds=True, evidence="0.5 against 0.7 m", origin=PREDICTED),
    ]
    path = folder / "measured.html"
    path.write_text(study_page(results, claims, ["study", "small.toml"]), "utf-8")
    return path


@pytest.mark.parametrize("width", [1280, 500])
def test_the_report_fits_its_window_and_shows_every_drawing(report, width):
    with chromium() as browser:
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.goto(report.as_uri())
        page.wait_for_selector(".chart .main-svg", state="attached")
        wide, images, loaded, narrowest, sections = page.evaluate(MEASURE)
    assert wide <= width
    assert images == loaded >= 4
    assert narrowest > 0.3 * width
    assert sections == 7
