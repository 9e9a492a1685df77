"""Surveys of stations: derivatives and volumes against dense ones, recovered rooms, verdicts, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trackwright.experiments.lab.validation.bearing_surveys import LASTS, _markov, errors_of, simulated_stations
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.recordings.rig_file import mounted
from trackwright.tuning.survey import volume
from trackwright.tuning.survey.bearings import bearing_walks
from trackwright.tuning.survey.solving import Solution, linearised
from trackwright.tuning.survey.station_starts import any_rotations, placed, rotations_found
from trackwright.tuning.survey.surveying import survey


def _small(height=None, seconds=4.0):
    """The start of a simulated walk with its true stations, turned from their references, and path."""
    folder, truth, path = simulated_stations(3, height, 0.0)
    table = folder.tables["bearings"].filter(folder.tables["bearings"]["t_s"] < seconds)
    (walk,) = bearing_walks([replace(folder, tables={"bearings": table})], list(folder.rig.stations), None)
    turns = 0.3 * np.random.default_rng(0).standard_normal((len(truth), 3))
    references = walk.references @ Rotation.from_rotvec(turns).as_matrix().transpose(0, 2, 1)
    at = np.column_stack([np.interp(walk.times, np.arange(len(path)) / 4.0, column) for column in path.T])
    sensors = np.column_stack([truth[:, :3], turns, truth[:, 6:]])
    levels = np.full(2 * len(truth), 0.05), np.array([[0.3, 0.3, 0.05]])
    walk = replace(walk, references=references)
    return folder, walk, Solution(sensors, [walk.fitted(at)], *levels)


def _angles(walk, sensors, path):
    """The readings without errors, by the angles of the rig's stations."""
    rotation = Rotation.from_matrix(walk.references) * Rotation.from_rotvec(sensors[:, 3:6])
    places = walk.positions(path)
    found = np.zeros(len(places))
    for k, quaternion in enumerate(rotation.as_quat(scalar_first=True)):
        own = walk.station == k
        angles = sensors[k, 6:] * Station(sensors[k, :3], quaternion).angles(places[own])
        found[own] = np.take_along_axis(angles, walk.angle[own][:, None], axis=1)[:, 0]
    return found


@pytest.mark.parametrize("height", [None, 1.2])
def test_derivatives_of_bearings_are_those_of_finite_differences(height):
    _, walk, solution = _small(height)
    (path,), sensors, step = solution.paths, solution.sensors, 1e-6
    residuals, units, partial = walk.linearised(sensors, path)
    wrapped = np.exp(1j * (walk.values - residuals)) / np.exp(1j * _angles(walk, sensors, path))
    np.testing.assert_allclose(np.angle(wrapped), 0.0, atol=1e-9)
    for column in range(sensors.size):
        move = step * np.eye(sensors.size)[column].reshape(sensors.shape)
        by = (_angles(walk, sensors + move, path) - _angles(walk, sensors - move, path)) / (2 * step)
        np.testing.assert_allclose(partial[:, column], by, atol=1e-5)
    for axis in np.eye(3)[: walk.dimensions]:
        move = step * axis[: walk.dimensions]
        by = (_angles(walk, sensors, path + move) - _angles(walk, sensors, path - move)) / (2 * step)
        np.testing.assert_allclose(units @ axis, by, atol=1e-5)


def test_the_slope_of_the_volume_is_that_of_the_dense_determinant(monkeypatch):
    _, walk, solution = _small()
    monkeypatch.setattr(volume, "PROBES", 4000)
    (path,), step = solution.paths, 1e-5
    part = linearised(walk, solution, 0, 0.0)
    rough = walk.rough(solution.densities[0]).toarray() + 1e-6 * np.eye(path.size)
    # Axes have roughness of their own.
    bent = np.diff(np.eye(len(path)), 2, axis=0)
    np.testing.assert_allclose(rough[2::3, 2::3], bent.T @ bent / 0.25**3 / 0.05 + 1e-6 * np.eye(len(path)), rtol=1e-12)

    def along(sensors, at):
        return walk.along(walk.linearised(sensors, at)[1]).toarray()

    first = along(solution.sensors, path)
    information = first.T @ (part.weights[:, None] * first) + rough
    follows = -np.linalg.solve(information, first.T @ (part.weights[:, None] * part.partial))

    def half_log(k, sign):
        move = sign * step * np.eye(solution.sensors.size)[k]
        at = along(solution.sensors + move.reshape(solution.sensors.shape), path + (follows @ move).reshape(path.shape))
        return 0.5 * np.linalg.slogdet(at.T @ (part.weights[:, None] * at) + rough)[1]

    dense = np.array([(half_log(k, 1) - half_log(k, -1)) / (2 * step) for k in range(solution.sensors.size)])
    found = volume.volume_slope([walk], solution)
    assert np.abs(found - dense).max() < 0.1 * np.abs(dense).max()


def test_errors_that_last_have_the_precision_of_their_dense_covariance():
    random = np.random.default_rng(0)
    levels, times = random.integers(0, 4, 60), np.sort(random.uniform(0.0, 20.0, 60))
    apart = np.abs(np.subtract.outer(times, times))
    covariance = np.exp(-apart / LASTS) * (levels[:, None] == levels)
    np.testing.assert_allclose(_markov(levels, times).toarray() @ covariance, np.eye(60), atol=1e-9)


def test_exact_directions_give_rotations_and_places():
    random = np.random.default_rng(1)
    places = random.uniform([0.0, 0.0, 2.0], [8.0, 6.0, 2.6], (4, 3))
    points = np.column_stack([random.uniform([1.0, 1.0], [7.0, 5.0], (60, 2)), np.full(60, 1.1)])
    turns = Rotation.random(4, random).as_matrix()
    offset = points[:, None] - places
    local = np.einsum("sji,ksj->ksi", turns, offset / np.linalg.norm(offset, axis=2, keepdims=True))
    found, _ = rotations_found(places, local, points[:, 2], any_rotations(random), random)
    assert Rotation.from_matrix(turns.transpose(0, 2, 1) @ found[0]).magnitude().max() < 0.15
    place, turn = placed(points, local[:, 0], random)
    assert np.linalg.norm(place - places[0]) < 0.3
    assert Rotation.from_matrix(turns[0].T @ turn).magnitude() < 0.1


def test_rotations_of_stations_at_known_places_are_found_from_nothing():
    folder, *_ = simulated_stations(0, 1.2, 0.0)
    unknown = {name: replace(s, rotation=np.eye(4)[0]) for name, s in folder.rig.stations.items()}
    found = survey(replace(folder, rig=replace(folder.rig, stations=unknown)), given="all")
    turns = errors_of(found, folder.rig)[:, 3:]
    assert np.rad2deg(np.median(np.linalg.norm(turns, axis=1))) < 4.0
    assert np.mean(np.abs(turns) < found.half_widths[:, 3:6]) >= 0.75
    np.testing.assert_array_equal(found.positions, [s.position for s in folder.rig.stations.values()])
    # The angles are those from which rig.toml has rotations.
    for angles, quaternion in zip(found.angles(), found.rotations, strict=True):
        assert abs(mounted(*angles) @ quaternion) == pytest.approx(1.0)
    lines = str(found).splitlines()
    assert sum(line.split()[0].rstrip(":") in found.names for line in lines if line) == 2 * len(found.names)
    assert np.isfinite(found.rig.stations["S0"].rotation).all()


def test_rough_poses_are_refined():
    folder, *_ = simulated_stations(2, None, 0.0)
    random = np.random.default_rng(2)
    rough = {
        name: replace(
            s,
            position=s.position + 0.1 * random.standard_normal(3),
            rotation=(Rotation.from_quat(s.rotation, scalar_first=True) * Rotation.from_rotvec(
                np.deg2rad(5.0) * random.standard_normal(3))).as_quat(scalar_first=True),
        )
        for name, s in folder.rig.stations.items()
    }  # fmt: skip
    given = replace(folder, rig=replace(folder.rig, stations=rough))
    found = survey(given, given="all", sigma=0.1, sigma_deg=5.0)
    errors, before = errors_of(found, folder.rig), errors_of(replace(
        found, positions=np.array([s.position for s in rough.values()]),
        rotations=np.array([s.rotation for s in rough.values()])), folder.rig)  # fmt: skip
    assert np.sqrt(np.mean(errors[:, 3:] ** 2)) < np.sqrt(np.mean(before[:, 3:] ** 2))
    assert (found.rms < found.rms_before).mean() > 0.5


@pytest.mark.slow
def test_two_positions_determine_little():
    given, *_ = simulated_stations(2, None, 0.0)
    two = survey(given, given=("S0", "S1"))
    assert not any(all(two.determined(name)) for name in two.names)
    assert two.verdict("S2").startswith(("weak: x, y", "not determined: x, y"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"given": ("S0",)}, "neither the origin nor the scale"),
        ({}, "neither the origin nor the scale"),
        ({"given": "all", "sigma_deg": -1.0}, "expected degrees"),
        ({"frame": ("S0", "S1", "S2")}, "have that of given stations"),
        ({"given": ("B",)}, "station 'B' has no readings"),
    ],
)
def test_what_leaves_the_frame_open_is_refused(options, words):
    folder, *_ = simulated_stations(2, None, 0.0)
    with pytest.raises(UnusableInput, match=words):
        survey(folder, **options)


def test_stations_must_be_in_the_rig_and_rotations_are_of_stations():
    folder, *_ = simulated_stations(2, None, 0.0)
    with pytest.raises(UnusableInput, match="rig.toml has no station S0"):
        survey(replace(folder, rig=Rig("empty")), given="all")
