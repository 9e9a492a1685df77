"""The page of a plan in a real browser: the same bounds as in Python, anchors that move, names that are only text."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.plan.accuracy import Sigmas, floor_map
from experiments.plan.report import write_plan
from sim.stations import work_station
from tests.browser import chromium, watched
from trackers.core.rig import Rig

SIGMAS, HEIGHT = Sigmas(0.1, 0.05, 0.3), 1.2
ROOM = Rig(
    "room",
    anchors={"<b>A": np.array([0.0, 0, 0.5]), "B": np.array([8.0, 0, 2.5]), "C": np.array([8.0, 5, 0.6]),
             "D": np.array([0.0, 5, 2.4])},
)  # fmt: skip
ANGLES = replace(
    work_station(),
    stations={name: replace(s, antennas=None, wavelength=None) for name, s in work_station().stations.items()},
)
FIELDS = {"flat": "horizontal, height known", "horizontal": "horizontal", "vertical": "vertical"}


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


def _opened(browser, tmp_path, rig):
    page = browser.new_page(viewport={"width": 1300, "height": 1000})
    errors = watched(page)
    floor = floor_map(rig, SIGMAS, HEIGHT)
    page.goto(write_plan(tmp_path / "plan.html", rig, floor, np.zeros((0, 3)), ["trackwright"]).as_uri())
    return page, floor, errors


def _compare(page, floor):
    for field, name in FIELDS.items():
        found = page.evaluate(f"computed.map(row => row.map(c => c === null ? null : c.{field}))")
        values = np.array([[np.nan if v is None else v for v in row] for row in found], float)
        np.testing.assert_allclose(values, floor.bounds[name], rtol=1e-5)


@pytest.mark.parametrize("rig", [ROOM, work_station(), ANGLES], ids=["ranges", "phases", "angles"])
def test_the_page_computes_the_bounds_that_python_computes(browser, tmp_path, rig):
    page, floor, errors = _opened(browser, tmp_path, rig)
    _compare(page, floor)
    assert not errors


def test_the_bound_follows_a_dragged_anchor(browser, tmp_path):
    page, _, errors = _opened(browser, tmp_path, ROOM)
    box = page.locator('[data-id="B"] circle').bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 200, y - 100, steps=4)
    page.mouse.up()
    moved = np.array(page.evaluate("anchors[1].position"))
    assert np.linalg.norm(moved - ROOM.anchors["B"]) > 1.0
    assert moved[2] == 2.5
    _compare(page, floor_map(replace(ROOM, anchors={**ROOM.anchors, "B": moved}, outline=_corners()), SIGMAS, HEIGHT))
    assert f'"B" = [{round(moved[0], 3):g}, {round(moved[1], 3):g}, 2.5]' in page.inner_text("#toml")
    assert "<b>A" in page.text_content("#marks")
    before, after = (row.inner_text() for row in page.locator("#summary tbody tr").all())
    assert before.split("\t")[1:] != after.split("\t")[1:]
    page.click("#reset")
    assert page.evaluate("anchors[1].position") == ROOM.anchors["B"].tolist()
    assert not errors


def _corners():
    """The floor of the page, which stays where it was."""
    return np.array([[0.0, 0], [8, 0], [8, 5], [0, 5]])
