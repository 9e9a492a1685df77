"""Surveys of anchors: information against dense matrices, invariance to the frame, recovered rooms, refused heights."""

from dataclasses import replace

import numpy as np
import pytest

from tests.survey_sites import simulated_site
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.tuning import survey as surveying
from trackwright.tuning.anchor_paths import FISHER, Equations, Prior, Solution, cost_of, solved, walks_of
from trackwright.tuning.survey import aligned, survey, triangle


def _small(height=None, seconds=6.0):
    """The start of a simulated walk with its true anchors and path."""
    (folder,), anchors, (path,) = simulated_site(4, (height,), 0.0)
    table = folder.tables["ranges"].filter(folder.tables["ranges"]["t_s"] < seconds)
    names = sorted(table["anchor"].unique())
    walk = walks_of([replace(folder, tables={"ranges": table})], names, height)
    at = np.column_stack([np.interp(walk.times, np.arange(len(path)) / 4.0, column) for column in path.T])
    unknown = np.column_stack([anchors, np.full(len(anchors), 0.1)])
    levels = np.full(len(anchors), 0.1), np.full(1, 0.5)
    known = np.zeros(unknown.size), np.diag(np.tile([0.0, 0.0, 0.0, 10.0], len(unknown))), np.ones(unknown.size, bool)
    return walk, Solution(unknown, walk.fitted(at), *levels), Prior(*known)


def _ranges(walk, unknown, path):
    """The ranges at these anchors and path, by plain sums of cubic B-splines."""
    u = (walk.times - walk.times[0]) / 0.25
    x = np.zeros((len(u), path.shape[1]))
    for knot, value in enumerate(path):
        t = np.abs(u - (knot - 1))
        x += np.where(t < 1, 2 / 3 - t**2 + t**3 / 2, np.where(t < 2, (2 - t) ** 3 / 6, 0.0))[:, None] * value
    x = x if x.shape[1] == 3 else np.column_stack([x, walk.heights[walk.walk]])
    one = unknown[walk.anchor]
    return np.linalg.norm(x - one[:, :3], axis=1) + one[:, 3]


@pytest.mark.parametrize("height", [None, 1.2])
def test_the_information_is_the_schur_complement_of_the_dense_one(height):
    walk, solution, _ = _small(height)
    path = solution.path.reshape(-1, 3 if height is None else 2)
    point = np.concatenate([solution.anchors.ravel(), path.ravel()])
    size = solution.anchors.size

    def predicted(x):
        return _ranges(walk, x[:size].reshape(-1, 4), x[size:].reshape(path.shape))

    step = 1e-5
    jacobian = np.stack([(predicted(point + e) - predicted(point - e)) / (2 * step) for e in step * np.eye(len(point))])
    dense = FISHER / 0.1**2 * jacobian @ jacobian.T
    second = np.diff(np.eye(len(path)), 2, axis=0) / 0.25**2
    dense[size:, size:] += np.kron(second.T @ second * 0.25, np.eye(path.shape[1])) / 0.5
    dense[size:, size:] += 1e-6 * np.eye(path.size)
    a, b, c = dense[:size, :size], dense[:size, size:], dense[size:, size:]
    found = Equations(walk, solution, expected=True).system
    np.testing.assert_allclose(found, a - b @ np.linalg.solve(c, b.T), rtol=1e-4, atol=1e-2)


def test_the_solution_is_a_minimum_of_the_cost():
    (walk, start, prior), random, h = _small(), np.random.default_rng(1), 1e-3
    found = solved(walk, start, prior, levels=False)
    for _ in range(20):
        anchors, path = (random.standard_normal(x.shape) for x in (found.anchors, found.path))
        below, at, above = (
            cost_of(walk, replace(found, anchors=found.anchors + k * anchors, path=found.path + k * path), prior)
            for k in (-h, 0.0, h)
        )
        # The lowest point of the parabola through the three.
        assert abs(0.5 * h * (below - above) / (below + above - 2.0 * at)) < 1e-5


def test_a_turned_room_has_the_same_cost():
    walk, start, prior = _small()
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    turned = np.column_stack([start.anchors[:, :3] @ turn.T + [1.0, 2.0, 3.0], start.anchors[:, 3]])
    moved = replace(start, anchors=turned, path=(start.path.reshape(-1, 3) @ turn.T + [1.0, 2.0, 3.0]).ravel())
    assert cost_of(walk, moved, prior) == pytest.approx(cost_of(walk, start, prior), rel=1e-9)


@pytest.mark.slow
def test_a_walk_at_two_heights_finds_the_anchors_and_a_flat_one_refuses_their_heights():
    folders, anchors, _ = simulated_site(2, (0.5, 1.9), 0.0)
    ((turn, shift),) = aligned(anchors[:3], triangle(range(3), (), anchors, 2)[1], 2)
    found = survey(folders)
    error = found.positions - (anchors @ turn.T + shift)
    assert np.median(np.abs(error)) < 0.15
    assert not found.mirrored.any()
    assert (np.abs(error) <= 4.0 * found.half_widths[:, :3] / 1.96 + 1e-9).all()

    unknown = survey([folders[0], replace(folders[1], rig=Rig("high"))])
    assert unknown.notes[0] == "heights of tags known: 0.5 m"

    flat = survey(folders[:1])
    assert flat.mirrored.all()
    assert all("not determined: above or below the walk" in flat.verdict(name) for name in flat.names)
    assert "two heights" in flat.notes[-1]
    # Those of the frame define it, and stay on it.
    assert (flat.positions[:2, 1] == 0.0).all()
    assert (flat.positions[0, :2] == 0.0).all()


def test_the_third_anchor_of_the_frame_is_the_first_that_stands_aside():
    anchors = np.array([[0.0, 0.0, 2.0], [10.0, 0.0, 2.0], [5.0, 0.01, 2.0], [5.0, 4.0, 2.0]])
    chosen, places = triangle("ABCD", (), anchors, 3)
    assert chosen == [0, 1, 3]
    np.testing.assert_allclose(places, [[0, 0, 0], [10, 0, 0], [5, 4, 0]])
    with pytest.raises(UnusableInput, match="A, B, C: stand in a line"):
        triangle("ABCD", "ABC", anchors, 3)


@pytest.mark.slow
def test_given_anchors_stay_and_too_few_are_refused(monkeypatch):
    folders, anchors, _ = simulated_site(2, (0.5, 1.9), 0.0)
    names = [f"A{k:02d}" for k in range(len(anchors))]
    known = dict(zip(names[:3], anchors, strict=False))
    placed = [replace(folder, rig=Rig(folder.name, anchors=known, tags=folder.rig.tags)) for folder in folders]
    found = survey(placed, given=names[:3])
    np.testing.assert_array_equal(found.positions[:3], anchors[:3])
    assert np.median(np.abs(found.positions - anchors)) < 0.15
    # Other minima a metre away widen what is searched for alone.
    monkeypatch.setattr(surveying, "between", lambda minima, *_: np.ones(minima[0].anchors.size))
    taped = survey(placed, given=names[:3], sigma=0.05)
    assert (taped.half_widths[:3, :3] <= 1.96 * 0.05 + 1e-9).all()
    assert (taped.half_widths[3:, :3] >= 1.96).all()
    elsewhere = Rig("high", anchors={**known, names[2]: known[names[2]] + 1.0}, tags=folders[1].rig.tags)
    with pytest.raises(UnusableInput, match="anchor 'A02' stands elsewhere than in"):
        survey([placed[0], replace(placed[1], rig=elsewhere)], given=names[:3])
    assert survey(placed[:1], given=",".join(names[:3])).verdict("A00") == "determined"
    with pytest.raises(UnusableInput, match="'B': no anchor of the survey"):
        found.verdict("B")
    with pytest.raises(UnusableInput, match="leave a rotation about their line"):
        survey(placed, given=names[:2])
    with pytest.raises(UnusableInput, match="has no readings"):
        survey(placed, frame=("A00", "A01", "B"))
