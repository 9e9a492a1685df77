"""From phases and angles to positions: the direct tracker, the cascade, and the intersection of rays."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.sim import corruptions
from trackwright.sim.stations import PhaseDraw, facing, work_station
from trackwright.trackers.aoa.cascade import cascade_tracker
from trackwright.trackers.aoa.direct import direct_tracker
from trackwright.trackers.aoa.fusion import bearing_inputs
from trackwright.trackers.aoa.rays import MIN_RAYS, PATIENCE_S, nearest_to_rays, recent_points
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.rig import Station

RIG = work_station()
TAGS, ROWS, SIGMA_P = 6, 40, 0.2
TRACKERS = {"direct": direct_tracker, "cascade": cascade_tracker}
WORLDS = {
    "whole": {},
    "a station is lost": {"lost": corruptions.lose_station(1)},
    "a station falls silent": {"lost": corruptions.lose_station(1, 1.0, 3.0)},
    "an antenna is dead": {"dead": corruptions.mask_antenna(0, 2)},
    "rows drop out": {"rows": corruptions.drop_outs(0.3)},
    "phases with outliers": {"wild": corruptions.outliers(0.02, np.pi)},
}


def _recordings(pieces):
    world = PhaseDraw(RIG, "hand", pieces, n_points=ROWS, sigma_p=SIGMA_P).drawn(TAGS, 5)
    made = []
    for phases, seen, position in zip(world.phases, world.seen, world.positions, strict=True):
        readings = {name: Readings(phases[:, k], seen[:, k]) for k, name in enumerate(RIG.stations)}
        inputs = {"height": np.zeros(ROWS)}
        made.append(Recording(world.times, readings, inputs, {"position": (position, np.ones(ROWS, bool))}))
    return made


@pytest.fixture(scope="module")
def runs():
    """What the trackers make of each world, run when first asked for: estimates, and errors (tags, rows, 3) in m."""

    class Runs(dict):
        def __missing__(self, key):
            tracker, world = key
            recordings = _recordings(WORLDS[world])
            estimates = TRACKERS[tracker](RIG.stations).run(stack(recordings))
            positions = np.stack([np.asarray(x) for x in estimates.mean.position], axis=-1)
            errors = positions - np.stack([r.truth["position"][0] for r in recordings])
            errors[~estimates.usable] = np.nan
            self[key] = estimates, errors
            return self[key]

    return Runs()


@pytest.mark.slow
@pytest.mark.parametrize("tracker", ["direct", "cascade"])
@pytest.mark.parametrize(
    ("world", "bound"),
    [
        # a quarter above the larger of both trackers' errors over three seeds
        ("whole", 0.035),
        ("a station is lost", 0.063),
        ("a station falls silent", 0.05),
        ("an antenna is dead", 0.034),
        ("rows drop out", 0.042),
        ("phases with outliers", 0.046),
    ],
)
def test_positions_are_found_to_centimetres_whatever_is_missing(runs, tracker, world, bound):
    estimates, errors = runs[tracker, world]
    assert np.isfinite(errors[:, 3:]).all()
    assert np.sqrt(np.nanmean((errors[:, 3:] ** 2).sum(axis=-1))) < bound
    started_again = {Status.RESTARTED} if world == "phases with outliers" else set()
    assert set(np.unique(estimates.status)) <= {Status.OK, Status.WAITING} | started_again


@pytest.mark.slow
@pytest.mark.parametrize("world", ["whole", "a station is lost"])
def test_the_direct_tracker_is_consistent(runs, world):
    estimates, errors = runs["direct", world]
    sigmas = np.sqrt(np.einsum("...ii->...i", estimates.covariance[..., :3, :3]))
    inside = np.abs(errors[:, 5:]) < 3 * sigmas[:, 5:]
    assert inside.mean() > 0.98


# where rays meet

MIDDLE = np.array([3.0, 2.5, 1.2])
CORNERS = np.array([[0.0, 0.0, 2.4], [6.0, 0.0, 2.3], [6.0, 5.0, 2.5], [0.0, 5.0, 2.2]])
STATIONS = [Station(corner, facing(corner, MIDDLE, (0.0, 0.0, 1.0))) for corner in CORNERS]


def _rays(rng, rows, noise, position=MIDDLE):
    """Rows of bearings to one position from random stations at random times, as `recent_points` takes them."""
    turn = rng.integers(0, len(STATIONS), rows)
    where = np.array([bearing_inputs(STATIONS[k]) for k in turn])
    angles = np.array([STATIONS[k].angles(position) for k in turn]) + noise * rng.normal(size=(rows, 2))
    return np.sort(rng.uniform(0, 5, rows)), where[:, :3], where[:, 3:], angles, turn


def _points(times, origins, axes, angles, seen, height):
    """`recent_points` of one tag whose bearings have both angles or none."""
    of_both, heights = np.stack([seen, seen], axis=1), np.array([height], float)
    return recent_points(np.array([0, len(times)]), times, origins, axes, angles, of_both, heights)


def _square_distances(points, origins, directions):
    """Of points (…, 3) from rays, by the cross product: Σ |(p − o) × u|²."""
    return (np.cross(points[..., None, :] - origins, directions) ** 2).sum(axis=(-1, -2))


def _directions(angles, turn):
    azimuth, elevation = angles.T
    local = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)], 1)
    return np.array([STATIONS[k].world_from_array() @ u for k, u in zip(turn, local, strict=True)])


@pytest.mark.parametrize("height", [None, 1.2])
def test_points_are_the_least_squares_of_the_rays_of_the_last_second(height):
    rng = np.random.default_rng(3)
    times, origins, axes, angles, turn = _rays(rng, 120, 0.05)
    seen = rng.random(120) < 0.8
    points = _points(times, origins, axes, angles, seen, height)
    directions = _directions(angles, turn)
    several = np.array([len(set(turn[(times >= t - 1) & (times <= t) & seen])) > 1 for t in times])
    several &= (np.cumsum(seen) >= MIN_RAYS) | (times >= times[seen][0] + PATIENCE_S)
    assert (points[several, 3] == 1).all()
    free = np.eye(3)[: 3 if height is None else 2]
    for k in np.flatnonzero(several)[::7]:
        mine = (times >= times[k] - 1) & (np.arange(120) <= k) & seen
        best = _square_distances(points[k, :3], origins[mine], directions[mine])
        for scale in (1e-3, 0.1, 1.0):
            nearby = points[k, :3] + scale * rng.normal(size=(200, len(free))) @ free
            assert (_square_distances(nearby, origins[mine], directions[mine]) > best).all()
    if height is not None:
        assert (points[several, 2] == height).all()


def test_exact_rays_intersect_at_the_position():
    times, origins, axes, angles, _ = _rays(np.random.default_rng(4), 60, 0.0)
    for height in (None, MIDDLE[2]):
        points = _points(times, origins, axes, angles, np.ones(60, bool), height)
        determined = points[:, 3] == 1
        assert determined[10:].all()
        np.testing.assert_allclose(points[determined, :3], np.broadcast_to(MIDDLE, (determined.sum(), 3)), atol=1e-9)


def _two_rays(first, second, height=None, seen=(True, True), gap=0.5):
    """The last row of two bearings, each heard twice, from the first station; angles of each in rad."""
    where = np.array([bearing_inputs(STATIONS[0])] * 4)
    times, angles, seen = (np.repeat(x, 2, axis=0) for x in ([0.0, gap], [first, second], seen))
    return _points(times, where[:, :3], where[:, 3:], angles, seen, height)[-1]


@pytest.mark.parametrize(
    "case",
    [
        {"first": (0.1, 0.0), "second": (0.1, 0.0)},
        {"first": (0.1, 0.0), "second": (0.15, 0.02)},
        {"first": (0.1, 0.0), "second": (0.9, 0.0), "seen": (False, True)},
        {"first": (0.1, 0.0), "second": (0.9, 0.0), "gap": 1.5},
        {"first": (0.1, 0.0), "second": (0.9, 0.0), "seen": (False, False), "height": 1.0},
    ],
)
def test_rays_that_are_parallel_too_old_or_not_seen_determine_nothing(case):
    np.testing.assert_array_equal(_two_rays(**case), 0.0)


def test_one_steep_ray_is_enough_at_a_known_height():
    steep = _two_rays((0.0, -0.8), (0.0, -0.8), height=0.5)
    assert steep[3] == 1
    assert steep[2] == 0.5
    direction = _directions(np.array([[0.0, -0.8]]), [0])[0]
    # nearest to the ray among the points of that height is where the ray goes through it
    reach = (0.5 - CORNERS[0, 2]) / direction[2]
    np.testing.assert_allclose(steep[:2], (CORNERS[0] + reach * direction)[:2], rtol=1e-9)


@pytest.mark.parametrize("height", [None, 1.2])
def test_the_point_nearest_to_beams_is_the_stacked_least_squares(height):
    _, origins, _, angles, turn = _rays(np.random.default_rng(6), 4, 0.03)
    directions, counts = _directions(angles, turn), np.array([True, True, False, True])
    centre = np.array([2.5, 2.0, 1.0])
    rays = [(jnp.asarray(o), jnp.asarray(u), c) for o, u, c in zip(origins, directions, counts, strict=True)]
    point = nearest_to_rays(rays, jnp.asarray(centre), height)
    # each ray measures the component of p − o across it as zero; the centre has a weight of a tenth, a height of 100
    across = [np.eye(3) - np.outer(u, u) for u in directions[counts]]
    weights, target = np.full(3, 0.1), centre.copy()
    if height is not None:
        weights[2], target[2] = 100.0, height
    rows = np.concatenate([*across, np.diag(weights)])
    values = np.concatenate([*(a @ o for a, o in zip(across, origins[counts], strict=True)), weights * target])
    np.testing.assert_allclose(point, np.linalg.lstsq(rows, values, rcond=None)[0], rtol=1e-9)
