"""Track loss by the track score and by the room, against the same rules in NumPy."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import trackwright as tw
from trackwright.trackers.core.model.rig import MARGIN, room_rows
from trackwright.trackers.core.model.tunable import with_values
from trackwright.trackers.core.run.track_loss import BLUR, PRICE, READINGS, ROOM, SIGMAS, WILD
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.parts.start_nearby import NEARBY

ANCHORS = np.array([[0.0, 0.0, 2.0], [8.0, 0.0, 1.0], [8.0, 6.0, 2.5], [0.0, 6.0, 1.0]])
TIMES = np.arange(0.0, 30.0, 0.1)
AWAY_S, BACK_S = 10.0, 15.0


def _recording(eastward):
    """Ranges of a tag that circles for 10 s, then `eastward` (T,) m away from the circle for 5 s, then on it again."""
    angle = TIMES / 3
    path = np.stack([4 + 2 * np.cos(angle), 3 + 1.5 * np.sin(angle), np.full(len(TIMES), 1.1)], axis=1)
    away = (TIMES >= AWAY_S) & (TIMES < BACK_S)
    path[away, 0] += eastward[away]
    rng = np.random.default_rng(0)
    ranges = np.linalg.norm(path[:, None] - ANCHORS, axis=2) + 0.05 * rng.standard_t(3, (len(TIMES), 4))
    return tw.uwb_imu.range_recording(TIMES, ranges, ANCHORS, height=1.1), np.repeat(path, 4, axis=0)


def _never(tracker):
    return with_values(tracker, {"track_loss.score_limit": np.inf, "track_loss.max_gap": np.inf})


def _without_room(recording):
    return dataclasses.replace(recording, inputs={k: x for k, x in recording.inputs.items() if k != ROOM.name})


def _first(condition):
    return int(np.flatnonzero(condition)[0])


def _assert_same_before(one, other, row):
    for name in ("cov_upper", "log_likelihood", "nis", "status"):
        np.testing.assert_array_equal(getattr(one, name)[..., :row], getattr(other, name)[..., :row])


def test_the_room_is_the_outline_or_wider_than_the_anchors_by_its_longer_side_and_at_least_by_10_m():
    corners = np.array([[1.0, 2.0], [5.0, 2.0], [3.0, 9.0]])
    np.testing.assert_array_equal(room_rows(ANCHORS, corners, 2), [[1, 5, 2, 9]] * 2)
    np.testing.assert_array_equal(room_rows(ANCHORS, None, 1), [[-MARGIN, 8 + MARGIN, -MARGIN, 6 + MARGIN]])
    np.testing.assert_array_equal(room_rows(5 * ANCHORS, None, 1), [[-40, 80, -40, 70]])


@pytest.mark.slow
@pytest.mark.parametrize("together", [1, pytest.param(9, marks=pytest.mark.slow)])
def test_a_track_three_standard_deviations_outside_the_room_is_lost_and_starts_again_where_ranges_agree(together):
    recording, path = _recording(5.0 * (TIMES - AWAY_S))
    tracker = _never(tw.uwb_imu.range_tracker(4, planar=True))
    free = tracker.run([_without_room(recording)] * together)[together - 1]
    kept = tracker.run([recording] * together)[together - 1]
    x, sigma = np.asarray(free.mean.position[0]), free.sigmas["position.0"]
    leaves = _first(x - (8 + MARGIN) > SIGMAS * sigma)
    assert leaves == _first(np.isin(kept.status, (tw.Status.LOST, tw.Status.RESTARTED)))
    _assert_same_before(free, kept, leaves)
    determined = recording.inputs[NEARBY.name][leaves:, 3] == 1
    assert leaves + _first(determined) == _first(kept.status == tw.Status.RESTARTED)
    # The tag returns at once: a track in the room needs no search for it.
    error = np.hypot(*(np.asarray(p) - q for p, q in zip(kept.mean.position, path.T, strict=False)))
    assert error[recording.times > BACK_S + 2].max() < 0.5


def _log_densities(recording, places):
    """Of each range at a place of its own (T, 3), by the defaults of `range_tracker`, blurred: a two-piece Student's t."""
    sigma, skew, dof, bias = BLUR * 0.09, 4.0, 1.8, 0.07
    errors = recording.readings[RANGES].values[:, 0] - bias
    errors -= np.linalg.norm(places - recording.inputs["anchors"], axis=1)
    scales = np.where(errors > 0, sigma * skew, sigma)
    return stats.t.logpdf(errors / scales, dof) - np.log(sigma * (1 + skew) / 2)


def test_a_track_is_lost_where_the_evidence_for_another_place_passes_the_limit_and_starts_again_there():
    recording, path = _recording(np.full(len(TIMES), 5.0))
    tracker = tw.uwb_imu.range_tracker(4, planar=True)
    free, kept = _never(tracker).run(recording), tracker.run(recording)
    policy, nearby = tracker.track_loss, recording.inputs[NEARBY.name]
    log_width = np.log(policy.width.value)
    first = _first(free.status == tw.Status.OK)
    there = _log_densities(recording, np.vstack([nearby[:1, :3], nearby[:-1, :3]])) + log_width
    here = free.log_likelihood + log_width
    evidence, wild = 0.0, WILD[1]
    for row in range(first + 1, len(nearby)):
        odds = np.log(wild / (1 - wild))
        gain = np.logaddexp(odds, there[row]) - np.logaddexp(odds, here[row])
        away = np.hypot(*(p[row - 1] - q for p, q in zip(free.mean.position, nearby[row - 1], strict=False))) > 0.5
        evidence = max(evidence + (gain if away else min(gain, 0.0)) - PRICE, 0.0)
        if evidence > policy.score_limit.value:
            break
        of_reading = 1 / (1 + np.exp(max(here[row], there[row]) - odds))
        wild = np.clip(wild + (of_reading - wild) / READINGS, *WILD)
    assert row == _first(kept.status == tw.Status.RESTARTED)
    assert AWAY_S < recording.times[row] < AWAY_S + 1
    _assert_same_before(free, kept, row)
    np.testing.assert_allclose([p[row] for p in kept.mean.position], nearby[row, :2], rtol=1e-6)
    error = np.hypot(*(np.asarray(p) - q for p, q in zip(kept.mean.position, path.T, strict=False)))
    assert error[(recording.times > AWAY_S + 2) & (recording.times < BACK_S)].max() < 0.5
