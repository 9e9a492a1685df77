"""The pages in Chromium: what moves is where the table has it, what is clicked shows its numbers, nothing is uploaded."""

import numpy as np
import polars as pl
import pytest

from tests.browser import chromium, watched
from tests.experiments.pages.small_tracks import NASTY, TAGS, small_bearings, small_run, small_tracks
from trackwright.experiments.pages.comparison import comparison_charts, write_comparison
from trackwright.experiments.pages.report import write_page
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.experiments.pages.track import run_data, track_page
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.recordings.columns import float_column

PLACE = """([kind, tag]) => {
  const circle = [...document.querySelectorAll("circle.tag")].find((one) => one.dataset.tag === tag);
  const one = circle.parentNode.querySelector(kind).getBoundingClientRect();
  const plan = document.getElementById("plan"), box = plan.getBoundingClientRect(), { xaxis, yaxis } = plan._fullLayout;
  const across = (at, axis) => axis.range[0] + (at - axis._offset) / axis._length * (axis.range[1] - axis.range[0]);
  const x = one.x + one.width / 2 - box.x, y = one.y + one.height / 2 - box.y;
  return [across(x, xaxis), across(2 * yaxis._offset + yaxis._length - y, yaxis), (xaxis.range[1] - xaxis.range[0]) / xaxis._length];
}"""
"""Where the drawn part of a tag is on the plan, m, and the size of a pixel."""


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


def _written(folder, *tracks):
    lost = ((pl.col("tag") == "B") & (abs(pl.col("t_s") - 5.0) < 1e-6)).cast(pl.Int64)
    names = dict(zip(("uwb", NASTY), tracks, strict=False))
    tracks = [ScoredTracks(of.rows.with_columns(losses=lost), of.folders, []) for of in tracks]
    found = zip(names, tracks, strict=True)
    runs = [run_data(of, Evaluation.of(of.rows), f"{k}: a tracker", k, len(names)) for k, of in found]
    write_page(folder / "report.html", track_page(runs, "trackwright track hall"))
    return folder / "report.html"


def _opened(browser, path, width=1300, scheme="light"):
    """The page, and the list into which its errors go."""
    page = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme).new_page()
    errors = watched(page)
    page.goto(path.as_uri())
    page.wait_for_selector(".js-plotly-plot .modebar-btn", state="attached")
    return page, errors


def _go(page, time):
    page.evaluate(
        "t => { const s = document.getElementById('time'); s.value = t; s.dispatchEvent(new Event('input')); }", time
    )


def test_slider_keys_and_clicks_show_what_the_table_holds(browser, tmp_path):
    tracks = small_tracks()
    rows = tracks.rows
    page, errors = _opened(browser, _written(tmp_path, tracks))
    start = float(rows["t_s"].min())
    for tag, number in (("A", 7), ("B", 41), (NASTY, 79)):
        own = np.flatnonzero((rows["tag"] == tag).to_numpy())[number]
        _go(page, float(rows["t_s"][int(own)]) - start + 0.02)
        for kind, names in ((".tag", ("x_m", "y_m")), (".truth", ("true_x_m", "true_y_m"))):
            x, y, pixel = page.evaluate(PLACE, [kind, tag])
            assert np.hypot(*np.subtract((x, y), rows.select(names).row(int(own)))) < pixel
    _go(page, 2.0)
    page.keyboard.press("ArrowRight")
    assert page.inner_text("#clock") == "5.10 s"
    page.keyboard.press("End")
    assert page.inner_text("#clock") == f"{float(rows['t_s'].max()):.2f} s"
    page.keyboard.press(" ")
    page.wait_for_function("parseFloat(document.getElementById('clock').textContent) > 3.2")
    page.keyboard.press(" ")
    own = np.flatnonzero((rows["tag"] == NASTY).to_numpy())[30]
    x, y, time = (float_column(rows, name)[own] for name in ("x_m", "y_m", "t_s"))
    _go(page, time - start)
    page.select_option("#tag", label=page.locator("#tag option", has_text=NASTY).inner_text())
    shown = dict(line.inner_text().split("\t") for line in page.locator("#now tr").all())
    assert shown["x"].startswith(f"{x:.3f}\u202fm ± {rows['std_x_m'][int(own)]:.3f}")
    assert shown["horizontal error"] == f"{tracks.recordings[0].miss[own]:.3f}\u202fm"
    page.locator("#now li").first.click()
    assert page.inner_text("#clock") == "5.00 s"
    assert errors == []


def test_the_tracker_is_chosen_and_the_moment_and_the_tag_stay(browser, tmp_path):
    first, second = small_tracks(seed=1), small_tracks(rows=60, seed=2)
    page, errors = _opened(browser, _written(tmp_path, first, second))
    page.select_option("#tag", label=page.locator("#tag option", has_text="B ·").inner_text())
    _go(page, 3.02)
    page.select_option("#tracker", label=NASTY)
    assert page.inner_text("#summary") == f"{NASTY}: a tracker"
    assert page.inner_text("#clock") == "6.02 s"
    assert page.inner_text("#now h3") == "tag B"
    for kind, rows in ((".tag", second.rows), (".other", first.rows)):
        own = np.flatnonzero((rows["tag"] == "B").to_numpy())[30]
        x, y, pixel = page.evaluate(PLACE, [kind, "B"])
        assert np.hypot(*np.subtract((x, y), rows.select("x_m", "y_m").row(int(own)))) < pixel
    assert page.inner_text("#others") == "At the same moment: ○ uwb"
    assert page.locator("#metrics tbody tr").count() == 2 + 2 * len(TAGS)
    assert errors == []


@pytest.mark.parametrize("in_plane", [False, True])
def test_directions_are_drawn_around_the_station(browser, tmp_path, in_plane):
    tracks, estimate, true = small_bearings(in_plane)
    page, errors = _opened(browser, _written(tmp_path, tracks))
    for row in (3, 30, 55):
        _go(page, 0.1 * row + 0.02)
        for kind, angles in ((".tag", estimate), (".truth", true)):
            x, y, pixel = page.evaluate(PLACE, [kind, "A, station S"])
            # from the array's x axis to the right, or from the boresight up, to the left
            angle = np.arctan2(y, x) if in_plane else np.arctan2(-x, y)
            turn = np.exp(1j * (angle - np.radians(angles[row, 0])))
            assert abs(np.angle(turn)) * np.hypot(x, y) < 1.5 * pixel
    assert errors == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 390])
@pytest.mark.parametrize("kind", ["track", "comparison"])
def test_a_page_fits_its_window_in_both_themes_and_no_chart_can_be_uploaded(browser, tmp_path, kind, width, scheme):
    path = tmp_path / "comparison.html"
    charts = comparison_charts({"uwb": small_run({"a": 0.2}), "median": small_run({"a": 0.5})})
    path = _written(tmp_path, small_tracks()) if kind == "track" else write_comparison(path, ["a"], [], charts, ["b"])
    page, errors = _opened(browser, path, width, scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    brightness = "getComputedStyle(document.body).backgroundColor.match(/[0-9]+/g).reduce((a, b) => a + +b, 0)"
    assert (page.evaluate(brightness) > 600) == (scheme == "light")
    titles = page.evaluate("[...document.querySelectorAll('.modebar-btn')].map((one) => one.dataset.title)")
    assert {*titles} <= {"Zoom", "Pan", "Reset axes", "Download plot as a PNG", "Download plot as a png"}
    assert errors == []
