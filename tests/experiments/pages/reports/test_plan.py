"""The bound over a floor against dense NumPy with finite differences, and places of anchors against an exhaustive search."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

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
