"""The bound over a floor against dense NumPy, places of anchors against an exhaustive search, and the page in a browser."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.browser import chromium, watched
from trackwright.experiments.cli.plan import plan
from trackwright.experiments.pages.reports import plan_accuracy
from trackwright.experiments.pages.reports.plan import plan_data, summary_text, write_plan
from trackwright.experiments.pages.reports.plan_accuracy import (
    HIGHEST,
    LOWEST,
    SPACING,
    FloorMap,
    Sigmas,
    floor_map,
    floor_of,
    place_anchors,
)
from trackwright.sim.stations import work_station
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.rig_file import rig_text
from trackwright.tuning.design import WallAnchors

SIGMAS = Sigmas(0.1, 0.05, 0.3)
ROOM = Rig(
    "room",
    anchors={"A": np.array([0.0, 0, 0.5]), "B": np.array([8.0, 0, 2.5]), "C": np.array([8.0, 5, 0.6]),
             "D": np.array([0.0, 5, 2.4])},
)  # fmt: skip
HEIGHT = 1.2
NAMED = replace(ROOM, anchors={"<b>A" if name == "A" else name: place for name, place in ROOM.anchors.items()})
FIELDS = {"flat": "horizontal, height known", "horizontal": "horizontal", "vertical": "vertical", "spatial": "3-D"}


def _epoch(rig, sigmas):
    """All measurements of one epoch at a point, each over its standard deviation.

    A phase is known up to an offset, as is a time of arrival, which has half the variance of a difference.
    """

    def measured(point):
        values = np.array([np.linalg.norm(point - anchor) / sigmas.range for anchor in rig.anchors.values()])
        if sigmas.difference is not None:
            values = (values - values.mean()) * sigmas.range / (sigmas.difference / np.sqrt(2))
        values = list(values)
        for station in rig.stations.values():
            if station.antennas is None:
                values += list(station.angles(point) / SIGMAS.angle)
            else:
                distances = np.linalg.norm(point - station.antenna_positions(), axis=1)
                phases = 2 * np.pi / station.wavelength * distances / SIGMAS.phase
                values += list(phases - phases.mean())
        return np.array(values)

    return measured


def _covariance(rig, point, axes, sigmas=SIGMAS):
    measured, step = _epoch(rig, sigmas), 1e-5
    columns = [(measured(point + e) - measured(point - e)) / (2 * step) for e in step * np.eye(3)[:axes]]
    H = np.stack(columns, axis=1)
    return np.linalg.inv(H.T @ H)


def test_bounds_of_range_differences_are_those_of_a_dense_covariance():
    rig = replace(ROOM, anchors=ROOM.anchors | {"E": np.array([4.0, 0, 2.6]), "F": np.array([4.0, 5, 0.3])})
    floor, anchors = floor_map(rig, SIGMAS._replace(difference=0.2), HEIGHT), np.array([*rig.anchors.values()])
    # Of all pairs, from six times of arrival with half the variance each.
    pairs = np.array([(i, j) for i in range(6) for j in range(i)])
    incidence = np.eye(6)[pairs[:, 0]] - np.eye(6)[pairs[:, 1]]
    precision = np.linalg.pinv(incidence @ incidence.T * 0.2**2 / 2)
    for i, k in [(3, 4), (len(floor.x) // 2, len(floor.y) // 2), (-2, 1)]:
        away = np.array([floor.x[i], floor.y[k], HEIGHT]) - anchors
        H = incidence @ (away / np.linalg.norm(away, axis=1)[:, None])
        for n, covariance in ((2, floor.flat[i, k]), (3, floor.covariance[i, k])):
            np.testing.assert_allclose(covariance, np.linalg.inv(H[:, :n].T @ precision @ H[:, :n]), rtol=1e-4)


def _work_station(angles):
    rig = work_station()
    if angles:
        stations = {name: replace(s, antennas=None, wavelength=None) for name, s in rig.stations.items()}
        rig = replace(rig, stations=stations)
    return rig


@pytest.mark.parametrize("rig", [ROOM, _work_station(False), _work_station(True)], ids=["ranges", "phases", "angles"])
def test_bounds_over_the_floor_are_those_of_dense_matrices(rig):
    floor = floor_map(rig, SIGMAS, HEIGHT)
    for i, k in [(3, 4), (len(floor.x) // 2, len(floor.y) // 2), (-2, 1)]:
        point = np.array([floor.x[i], floor.y[k], HEIGHT])
        np.testing.assert_allclose(floor.flat[i, k], _covariance(rig, point, 2), rtol=2e-4)
        np.testing.assert_allclose(floor.covariance[i, k], _covariance(rig, point, 3), rtol=2e-4, atol=1e-9)


def test_a_position_in_line_with_two_anchors_is_not_determined():
    two = replace(ROOM, anchors={"A": np.array([0.0, 2, 1.2]), "B": np.array([4.0, 2, 1.2])},
                  outline=np.array([[0.0, 1.9], [4, 1.9], [4, 2.1], [0, 2.1]]))  # fmt: skip
    floor = floor_map(two, SIGMAS, HEIGHT)
    assert np.isnan(floor.covariance).all()
    assert "100 %" in summary_text(floor, None)


@pytest.mark.slow
@pytest.mark.parametrize("sigmas", [SIGMAS, SIGMAS._replace(difference=0.2)], ids=["ranges", "range differences"])
def test_the_place_of_one_more_anchor_is_as_good_as_an_exhaustive_search(sigmas):
    # The difference has one unknown more.
    three = replace(
        ROOM, anchors={name: ROOM.anchors[name] for name in ("ABC" if sigmas.difference is None else "ABCD")}
    )
    floor = floor_map(three, sigmas, HEIGHT)
    found = place_anchors(three, 1, floor, height_known=False)

    def rms(floor_map_):
        return np.sqrt(np.nanmean(floor_map_.bounds["3-D"] ** 2))

    def mean_bound(anchor):
        rig = replace(three, anchors={**three.anchors, "P": anchor})
        points = np.stack(np.meshgrid(floor.x, floor.y, indexing="ij"), axis=-1)[floor.inside][::19]
        return np.sqrt(np.mean([np.trace(_covariance(rig, np.append(p, HEIGHT), 3, sigmas)) for p in points]))

    corners = floor_of(three)
    walls = [
        a + s * (b - a)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        for s in np.linspace(0, 1, 9)[:-1]
    ]
    tried = [mean_bound(np.append(wall, z)) for wall in walls for z in np.linspace(LOWEST, HIGHEST, 4)]
    proposed = found.anchors["P1"]
    assert mean_bound(proposed) < 1.02 * min(tried)
    assert rms(found.floor) == pytest.approx(mean_bound(proposed), rel=0.05)
    assert rms(found.floor) < rms(floor)
    assert min(np.linalg.norm(proposed - a) for a in three.anchors.values()) > 0.99 * SPACING


@pytest.mark.parametrize(
    ("most", "expected"), [(3, [[1, 1], [2, 1], [3, 2]]), (9, [[1, 1], [1, 2], [2, 1], [3, 1], [3, 2]])]
)
def test_the_bound_is_averaged_over_few_points_of_a_large_floor_and_all_of_a_small_one(monkeypatch, most, expected):
    averaged = []

    def objective(layout, points):
        averaged.extend(points)
        # Nothing is searched.
        raise StopIteration

    monkeypatch.setattr(plan_accuracy, "POINTS", most)
    monkeypatch.setattr(WallAnchors, "objective", objective)
    # Six cells, of which that at (2, 2) is outside.
    inside = np.array([[True, True], [True, False], [True, True]])
    unused = np.zeros((3, 2, 2, 2)), np.zeros((3, 2, 3, 3))
    floor = FloorMap(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0]), inside, HEIGHT, SIGMAS, *unused)
    with pytest.raises(StopIteration):
        place_anchors(ROOM, 1, floor, height_known=True)
    np.testing.assert_array_equal(averaged, expected)


def test_a_rig_that_measures_nothing_or_has_stations_is_refused():
    with pytest.raises(UnusableInput, match="neither anchors nor stations"):
        floor_map(Rig("empty"), SIGMAS, HEIGHT)
    with pytest.raises(UnusableInput, match="all anchors and stations are at one place"):
        floor_map(Rig("heap", anchors={"A": np.zeros(3), "B": np.zeros(3)}), SIGMAS, HEIGHT)
    stations = _work_station(True)
    with pytest.raises(UnusableInput, match="--place 1: .* has stations"):
        place_anchors(stations, 1, floor_map(stations, SIGMAS, HEIGHT), True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigma_range": 0.0}, "--sigma-range 0: expected a number above zero"),
        ({"sigma_phase": math.inf}, "--sigma-phase inf"),
        ({"place": 9}, "--place 9: expected a number of anchors from 0 to 8"),
        ({"height": math.nan}, "--height nan"),
    ],
)
def test_wrong_options_are_refused_before_the_rig_is_read(tmp_path, options, message):
    with pytest.raises(UnusableInput, match=message):
        plan(tmp_path / "missing.toml", out=tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_the_command_writes_a_page_and_a_picture(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(plan_accuracy, "POINTS", 20)
    monkeypatch.setattr(plan_accuracy, "STARTS", 2)
    (tmp_path / "rig.toml").write_text(rig_text(ROOM), "utf-8")
    assert plan(tmp_path, out=tmp_path / "out", place=1) == 0
    shown = capsys.readouterr().out
    assert "tags at 1.2 m" in shown
    assert "P1 = [" in shown
    assert "Bound of one epoch, tags at 1.2 m, as in rig.toml" in shown
    assert "Bound of one epoch, tags at 1.2 m, with P1" in shown
    assert "least bound (3-D, RMS over the floor)" in shown
    assert (tmp_path / "out" / "plan.png").read_bytes().startswith(b"\x89PNG")
    assert '"proposed":[{"id":"P1",' in (tmp_path / "out" / "plan.html").read_text("utf-8")
    assert plan(tmp_path, out=tmp_path / "out", format="pdf") == 0
    assert (tmp_path / "out" / "plan.pdf").read_bytes().startswith(b"%PDF")


def test_names_on_the_page_do_not_end_its_script(tmp_path):
    rig = replace(ROOM, anchors={"</script><b>": np.array([1.0, 1, 1]), **ROOM.anchors})
    floor = floor_map(rig, SIGMAS, HEIGHT)
    text = write_plan(tmp_path / "plan.html", rig, floor, {}, ["trackwright"]).read_text("utf-8")
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, flags=re.DOTALL)
    assert json.loads(data) == json.loads(json.dumps(plan_data(rig, floor, {})))


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
    [
        (NAMED, SIGMAS),
        (NAMED, SIGMAS._replace(difference=0.15)),
        (work_station(), SIGMAS),
        (_work_station(True), SIGMAS),
    ],
    ids=["ranges", "range differences", "phases", "angles"],
)
def test_the_page_computes_the_bounds_that_python_computes(browser, tmp_path, rig, sigmas):
    page, floor, errors = _opened(browser, tmp_path, rig, sigmas)
    _compare(page, floor)
    assert not errors


def test_the_bound_follows_a_dragged_anchor(browser, tmp_path):
    page, _, errors = _opened(browser, tmp_path, NAMED)
    box = page.locator('[data-id="B"] circle').bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 200, y - 100, steps=4)
    page.mouse.up()
    moved = np.array(page.evaluate("anchors[1].position"))
    assert np.linalg.norm(moved - NAMED.anchors["B"]) > 1.0
    assert moved[2] == 2.5
    _compare(page, floor_map(replace(NAMED, anchors={**NAMED.anchors, "B": moved}, outline=_corners()), SIGMAS, HEIGHT))
    assert f'"B" = [{round(moved[0], 3):g}, {round(moved[1], 3):g}, 2.5]' in page.inner_text("#toml")
    assert "<b>A" in page.text_content("#marks")
    before, after = (row.inner_text() for row in page.locator("#summary tbody tr").all())
    assert before.split("\t")[1:] != after.split("\t")[1:]
    page.click("#reset")
    assert page.evaluate("anchors[1].position") == NAMED.anchors["B"].tolist()
    assert not errors


def _corners():
    """The floor of the page, which stays where it was."""
    return np.array([[0.0, 0], [8, 0], [8, 5], [0, 5]])


@pytest.mark.slow
def test_the_page_opens_with_the_proposal_and_the_printed_figures_and_has_axes_in_metres(browser, tmp_path, capsys):
    rig = replace(NAMED, anchors={"P1": np.array([8.0, 5, 2.6]), **NAMED.anchors})
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
