import re
import shutil
import subprocess

import pytest

from tests.experiments.monte_carlo.small_study import SMALL
from trackwright.experiments.monte_carlo import PREDICTED, Conclusion, ExpectedResult
from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.experiments.pages.reports.study import study_page
from trackwright.experiments.text.expectations import Value

pytestmark = pytest.mark.slow
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

MEASURE = """<script>addEventListener("load", () => {
  const images = [...document.images], root = document.documentElement;
  root.dataset.found = [root.scrollWidth, innerWidth, images.length, images.filter(i => i.naturalWidth > 0).length,
    Math.min(...[...document.querySelectorAll(".chart .main-svg")].map(i => i.clientWidth)),
    [...document.querySelectorAll("section")].length].join(" ");
});</script></body>"""


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
    path.write_text(study_page(results, claims, [], ["study", "small.toml"]).replace("</body>", MEASURE), "utf-8")
    return path


@pytest.mark.parametrize("width", [1280, 500])
def test_the_report_fits_its_window_and_shows_every_drawing(report, width):
    if BROWSER is None:
        pytest.skip("no Chromium here")
    # Chromium's windows are no narrower than 500; the page's narrow layout begins at 720.
    done = subprocess.run(
        [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900",
         "--virtual-time-budget=5000", "--dump-dom", report.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    found = re.search(r'data-found="([^"]+)"', done.stdout)
    assert found is not None, done.stderr
    wide, window, images, loaded, narrowest, sections = map(float, found[1].split())
    assert wide <= window
    assert images == loaded >= 4
    assert narrowest > 0.3 * window
    assert sections == 6
