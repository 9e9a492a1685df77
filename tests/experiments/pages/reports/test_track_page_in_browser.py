"""The page of `track` in Chromium: what moves is where the table has it, and what is hovered shows its numbers."""

import numpy as np
import polars as pl
import pytest

from tests.browser import chromium, watched
from tests.experiments.pages.reports.small_tracks import NASTY, TAGS, small_bearings, small_tracks
from tests.experiments.pages.reports.test_track_page import NO_EVENTS
from trackwright.experiments.pages.plot import Playback
from trackwright.experiments.pages.reports.track import run_data, track_page, write_track_page
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

PIXEL = """([x, y]) => {
  const plan = document.getElementById("plan"), box = plan.getBoundingClientRect(), { xaxis, yaxis } = plan._fullLayout;
  const along = (v, axis) => axis._offset + (v - axis.range[0]) / (axis.range[1] - axis.range[0]) * axis._length;
  return [box.x + along(x, xaxis), box.y + 2 * yaxis._offset + yaxis._length - along(y, yaxis)];
}"""
"""The pixel of a place on the plan."""


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


def _written(folder, tracks):
    event = pl.DataFrame({"recording": ["hall"], "tag": ["B"], "t_s": [5.0], "event": ["lost"], "detail": ["for 2 s"]})
    evaluation = Evaluation.of(tracks.rows)
    run = run_data(tracks, event, evaluation, f"uwb: {NASTY}")
    write_track_page(folder / "report.html", [run], "trackwright track hall")
    return (folder / "report.html").as_uri()


def _opened(browser, address, width=1300, scheme="light"):
    """The page, and the list into which its errors go."""
    page = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme).new_page()
    errors = watched(page)
    page.goto(address)
    page.wait_for_selector("#charts .main-svg", state="attached")
    return page, errors


def _go(page, time):
    page.evaluate(
        "t => { const s = document.getElementById('time'); s.value = t; s.dispatchEvent(new Event('input')); }", time
    )


def test_slider_keys_and_hover_show_what_the_table_holds(browser, tmp_path):
    tracks = small_tracks()
    rows = tracks.rows
    page, errors = _opened(browser, _written(tmp_path, tracks))
    start = float(rows["t_s"].min())
    for tag, number in (("A", 7), ("B", 41), (NASTY, 79)):
        own = np.flatnonzero((rows["tag"] == tag).to_numpy())[number]
        _go(page, float(rows["t_s"][int(own)]) - start + 0.02)
        for kind, expected in (
            (".tag", rows.select("x_m", "y_m").row(int(own))),
            (".truth", rows.select("true_x_m", "true_y_m").row(int(own))),
        ):
            x, y, pixel = page.evaluate(PLACE, [kind, tag])
            assert np.hypot(x - expected[0], y - expected[1]) < pixel

    _go(page, 2.0)
    page.keyboard.press("ArrowRight")
    assert page.inner_text("#clock") == "5.10 s"
    page.keyboard.press("End")
    assert page.inner_text("#clock") == f"{float(rows['t_s'].max()):.2f} s"
    page.keyboard.press(" ")
    page.wait_for_function("parseFloat(document.getElementById('clock').textContent) > 3.2")
    page.keyboard.press(" ")
    stopped = page.inner_text("#clock")
    page.wait_for_timeout(150)
    assert page.inner_text("#clock") == stopped

    own = np.flatnonzero((rows["tag"] == NASTY).to_numpy())[30]
    x, y, time = (float_column(rows, name)[own] for name in ("x_m", "y_m", "t_s"))
    page.evaluate("document.getElementById('plan').scrollIntoView()")
    page.mouse.move(*page.evaluate(PIXEL, [x, y]))
    page.wait_for_selector("#tip:not([hidden])")
    shown = dict(line.split(": ", 1) for line in page.inner_text("#tip").splitlines())
    miss = float(np.hypot(*(tracks.recordings[0].errors[own, :2])))
    assert shown["tag"] == NASTY
    assert shown["time"] == f"{time:.2f}\u202fs"
    assert shown["x"].startswith(f"{x:.3f}\u202fm ± {rows['std_x_m'][int(own)]:.3f}")
    assert shown["horizontal error"] == f"{miss:.3f}\u202fm"

    assert page.locator("#ticks i").count() == 1
    assert page.title() == "hall · trackwright track"
    assert errors == []


def test_the_tracker_is_chosen_and_the_moment_and_the_tag_stay(browser, tmp_path):
    first, second = small_tracks(seed=1), small_tracks(rows=60, seed=2)
    runs = [
        run_data(t, NO_EVENTS, Evaluation.of(t.rows), f"{name}: a tracker", name, 2)
        for name, t in (("uwb", first), (NASTY, second))
    ]
    write_track_page(tmp_path / "report.html", runs, "trackwright track hall")
    page, errors = _opened(browser, (tmp_path / "report.html").as_uri())
    page.select_option("#tag", label=page.locator("#tag option", has_text="B ·").inner_text())
    _go(page, 3.02)
    page.select_option("#tracker", label=NASTY)
    assert page.inner_text("#summary") == f"{NASTY}: a tracker"
    assert page.inner_text("#clock") == "6.02 s"
    assert page.inner_text("#now h3") == "tag B"
    rows = second.rows
    own = np.flatnonzero((rows["tag"] == "B").to_numpy())[30]
    of_first = np.flatnonzero((first.rows["tag"] == "B").to_numpy())[30]
    x, y, pixel = page.evaluate(PLACE, [".tag", "B"])
    assert np.hypot(x - rows["x_m"][int(own)], y - rows["y_m"][int(own)]) < pixel
    x, y, _ = page.evaluate(PLACE, [".other", "B"])
    rows = first.rows
    assert np.hypot(x - rows["x_m"][int(of_first)], y - rows["y_m"][int(of_first)]) < pixel
    assert page.inner_text("#others") == "At the same moment: ○ uwb"
    page.evaluate("document.getElementById('plan').scrollIntoView()")
    page.locator("circle.other[data-tag=B]").hover()
    shown = dict(line.split(": ", 1) for line in page.inner_text("#tip").splitlines())
    assert (shown["tracker"], shown["tag"]) == ("uwb", "B")
    expected = first.rows.row(int(of_first), named=True)
    assert shown["x"].startswith(f"{expected['x_m']:.3f}\u202fm ± {expected['std_x_m']:.3f}")
    cells = [row.inner_text().split("\t") for row in page.locator("#metrics tbody tr").all()]
    assert [row[:3] for row in cells[:4]] == [
        ["hall", "", "uwb"],
        ["hall", "", NASTY],
        *[["hall", cells[2][1], n] for n in ("uwb", NASTY)],
    ]
    assert len(cells) == 2 + 2 * len(TAGS)
    page.locator("#metrics tbody tr").first.click()
    assert page.input_value("#tracker") == "0"
    assert errors == []


SPAN = """() => {
  const groups = [...document.querySelectorAll("circle.tag")].map((one) => one.parentNode);
  const rows = groups.filter((one) => one.style.display !== "none");
  return [rows.length, ...rows.map((one) => one.querySelector(".tail").getAttribute("points").split(" ").length)];
}"""
"""How many tags are drawn at the moment, and the points of the tail of each."""


def test_a_zoom_in_time_limits_playback_ellipses_and_tails(browser, tmp_path):
    tracks = small_tracks()
    page, errors = _opened(browser, _written(tmp_path, tracks))
    page.select_option("#tail", "Infinity")
    _go(page, 1.0)
    page.evaluate("Plotly.relayout('series', {'xaxis.range': [6.05, 8.05]})")
    page.wait_for_function("document.getElementById('clock').textContent === '6.10 s'")
    assert page.evaluate(SPAN) == [3, 1, 1, 1]
    _go(page, 4.0)
    assert page.evaluate(SPAN) == [3, 10, 10, 10]
    page.keyboard.press("End")
    assert page.inner_text("#clock") == "8.05 s"
    assert page.evaluate(SPAN) == [3, 20, 20, 20]
    page.keyboard.press("Home")
    assert page.inner_text("#clock") == "6.10 s"
    page.select_option("#tag", label=page.locator("#tag option", has_text="B ·").inner_text())
    page.locator("#now li").first.click()
    assert page.inner_text("#clock") == "5.00 s"
    assert page.evaluate(SPAN)[0] == 1
    assert errors == []


@pytest.mark.parametrize("in_plane", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_directions_are_drawn_around_the_station(browser, tmp_path, in_plane):
    tracks, estimate, true = small_bearings(in_plane)
    run = run_data(tracks, NO_EVENTS, Evaluation.of(tracks.rows), "beam")
    write_track_page(tmp_path / "report.html", [run], "trackwright track yard")
    page, errors = _opened(browser, (tmp_path / "report.html").as_uri())
    for row in (3, 30, 55):
        _go(page, 0.1 * row + 0.02)
        for kind, angles in ((".tag", estimate), (".truth", true)):
            x, y, pixel = page.evaluate(PLACE, [kind, "A, station S"])
            # from the array's x axis to the right, or from the boresight up, to the left
            angle = np.arctan2(y, x) if in_plane else np.arctan2(-x, y)
            turn = np.exp(1j * (angle - np.radians(angles[row, 0])))
            assert abs(np.angle(turn)) * np.hypot(x, y) < 1.5 * pixel
    names = ["in-plane angle"] if in_plane else ["azimuth", "elevation"]
    expected = [words for name in names for words in (name, f"error in {name}")]
    assert [title.replace(" (°)", "") for title in _words(page)][: len(expected)] == expected
    assert errors == []


def test_a_notebook_shows_the_page_in_a_frame(browser, tmp_path):
    tracks = small_tracks()
    run = run_data(tracks, NO_EVENTS, None, "uwb")
    page = browser.new_page()
    errors = watched(page)
    page.set_content(f"<h1>notebook</h1>{Playback('hall', track_page([run]))._repr_html_()}")
    frame = page.frame_locator("iframe")
    frame.locator("#charts .main-svg").first.wait_for(state="attached")
    assert frame.locator("circle.tag").count() == len(TAGS)
    assert frame.locator("#command").count() == 0
    assert errors == []


def _words(page):
    """The titles of the axes of the charts over time, from the top, their lines joined."""
    found = page.evaluate(
        "[...Array(9).keys()].map(k => document.getElementById('series').layout[`yaxis${k ? k + 1 : ''}`])"
    )
    return [axis["title"]["text"].replace("<br>", " ") for axis in found if axis]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1300, 400])
def test_the_page_fits_its_window_in_both_themes(browser, tmp_path, width, scheme):
    page, errors = _opened(browser, _written(tmp_path, small_tracks()), width, scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.locator("#charts figure").count() >= 5
    brightness = "getComputedStyle(document.body).backgroundColor.match(/[0-9]+/g).reduce((a, b) => a + +b, 0)"
    assert (page.evaluate(brightness) > 600) == (scheme == "light")
    page.click(".theme")
    assert (page.evaluate(brightness) > 600) != (scheme == "light")
    assert page.locator("#series .xtitle").count() == 1
    page.emulate_media(media="print")
    assert page.evaluate(brightness) > 600
    page.emulate_media(media="screen")
    assert len(page.pdf(format="A4")) > 20_000
    assert errors == []
