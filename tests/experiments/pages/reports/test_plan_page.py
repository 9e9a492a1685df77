"""The page of a plan in a real browser: the same bounds as in Python, anchors that move, names that are only text."""

from dataclasses import replace

import numpy as np
import pytest

from tests.browser import chromium, watched
from trackwright.experiments.cli.plan import plan
from trackwright.experiments.pages.reports.plan import write_plan
from trackwright.experiments.pages.reports.plan_accuracy import Sigmas, floor_map
from trackwright.sim.stations import work_station
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.rig_file import rig_text

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
FIELDS = {"flat": "horizontal, height known", "horizontal": "horizontal", "vertical": "vertical", "spatial": "3-D"}


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


def _opened(browser, tmp_path, rig, sigmas=SIGMAS):
    page = browser.new_page(viewport={"width": 1300, "height": 1000})
    errors = watched(page)
    floor = floor_map(rig, sigmas, HEIGHT)
    page.goto(write_plan(tmp_path / "plan.html", rig, floor, {}, ["trackwright"]).as_uri())
    return page, floor, errors


def _compare(page, floor):
    for field, name in FIELDS.items():
        found = page.evaluate(f"computed.map(row => row.map(c => c === null ? null : c.{field}))")
        values = np.array([[np.nan if v is None else v for v in row] for row in found], float)
        np.testing.assert_allclose(values, floor.bounds[name], rtol=1e-5)


@pytest.mark.parametrize(
    ("rig", "sigmas"),
    [(ROOM, SIGMAS), (ROOM, SIGMAS._replace(difference=0.15)), (work_station(), SIGMAS), (ANGLES, SIGMAS)],
    ids=["ranges", "range differences", "phases", "angles"],
)
def test_the_page_computes_the_bounds_that_python_computes(browser, tmp_path, rig, sigmas):
    page, floor, errors = _opened(browser, tmp_path, rig, sigmas)
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


@pytest.mark.slow
def test_the_page_opens_with_the_proposal_and_the_printed_figures_and_has_axes_in_metres(browser, tmp_path, capsys):
    rig = replace(ROOM, anchors={"P1": np.array([8.0, 5, 2.6]), **ROOM.anchors})
    (tmp_path / "rig.toml").write_text(rig_text(rig), "utf-8")
    assert plan(tmp_path, out=tmp_path / "out", place=1) == 0
    printed = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith(" 3-D")]
    page = browser.new_page(viewport={"width": 1300, "height": 1000})
    errors = watched(page)
    page.goto((tmp_path / "out" / "plan.html").as_uri())
    rows = [row.inner_text().split("\t") for row in page.locator("#summary tbody tr").all()]
    assert [row[0] for row in rows] == ["as in rig.toml", "as drawn, with P2"]
    assert [[cell.removesuffix(" cm") for cell in row[1:4]] for row in rows] == [line[1:4] for line in printed]
    assert printed[0] != printed[1]
    assert '"P2" = [' in page.inner_text("#toml")
    numbers = [one.text_content() for one in page.locator("#marks text.grid").all()]
    assert numbers == [*(str(x) for x in range(9)), *(str(y) for y in range(6)), "x (m)", "y (m)"]
    least, most = (float(page.inner_text(f"#{end}").split()[0]) for end in ("least", "most"))
    assert most >= 1.99 * least
    page.click("#reset")
    rows = [row.inner_text().split("\t") for row in page.locator("#summary tbody tr").all()]
    assert rows[1] == ["as drawn", *rows[0][1:]]
    assert not errors
