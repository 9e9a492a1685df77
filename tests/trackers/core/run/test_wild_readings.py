"""Wild readings lose no good track, and a lost one is found among them, against a gated EKF in NumPy.

A hall of 10 by 8 m, six anchors ten times a second, a tag on an ellipse. Errors count from `SETTLED_S` on: the first
ranges are as wild as the others, so that a track may start far away. Halfway, at `JUMP_S`, the tag may be carried away.
"""

import numpy as np
import pytest

import trackwright as tw

ANCHORS = np.array([[0, 0, 2.5], [10, 0, 0.4], [10, 8, 2.5], [0, 8, 0.4], [5, 0, 2.8], [5, 8, 0.3]])
HEIGHT, SIGMA, DT, EPOCHS = 1.2, 0.06, 0.1, 230
TIMES = DT * np.arange(EPOCHS)
SETTLED_S, JUMP_S, JUMP_M, FOUND_S, FOUND_M = 2.0, 18.0, 4.0, 2.0, 0.5
KINDS = ("both signs", "too long", "bursts of an anchor", "one anchor")


def _paths(rng, worlds, jump):
    """Positions (worlds, EPOCHS, 2), m; with a `jump` by 4 m halfway, to a place in the hall."""
    turn = rng.uniform(0.15, 0.3, (worlds, 1)) * TIMES + rng.uniform(0, 2 * np.pi, (worlds, 1))
    a, b = rng.uniform([2.0, 1.5], [3.5, 3.0], (worlds, 2)).T[..., None]
    path = np.stack([5 + a * np.cos(turn), 4 + b * np.sin(turn)], axis=-1)
    if jump:
        after = TIMES >= JUMP_S
        for one in path:
            angles = rng.uniform(0, 2 * np.pi, 64)
            moves = JUMP_M * np.stack([np.cos(angles), np.sin(angles)], axis=1)
            moved = one[after][:, None] + moves
            inside = np.all((moved > 0.3) & (moved < [9.7, 7.7]), axis=2).mean(axis=0)
            one[after] += moves[np.argmax(inside)]
    return path


def _wild(rng, kind, share, shape):
    """Which ranges are wild; bursts last 1 s on average."""
    if kind == "one anchor":
        return (rng.random(shape) < share) & (np.arange(shape[2]) == rng.integers(0, shape[2], (shape[0], 1, 1)))
    if kind != "bursts of an anchor":
        return rng.random(shape) < share
    wild, on = np.empty(shape, bool), rng.random((shape[0], shape[2])) < share
    for epoch in range(shape[1]):
        wild[:, epoch] = on
        draw = rng.random(on.shape)
        on = np.where(on, draw > DT, draw < DT * share / (1 - share))
    return wild


def _worlds_of(kind, share, worlds, jump=False, batch=0):
    """True positions (worlds, EPOCHS, 2), m, and ranges (worlds, EPOCHS, anchors), m, of which a share is wild."""
    rng = np.random.default_rng([KINDS.index(kind), int(100 * share), jump, batch])
    path = _paths(rng, worlds, jump)
    exact = np.hypot(np.linalg.norm(path[:, :, None] - ANCHORS[:, :2], axis=3), HEIGHT - ANCHORS[:, 2])
    ranges = exact + SIGMA * rng.normal(size=exact.shape)
    wild = ranges + rng.uniform(1, 30, exact.shape) if kind == "too long" else rng.uniform(-100, 100, exact.shape)
    return path, np.where(_wild(rng, kind, share, exact.shape), wild, ranges)


def _gated_errors(path, ranges):
    """Errors (worlds, EPOCHS), m, of an EKF from the truth that leaves ranges beyond three sigmas out."""
    state = np.concatenate([path[:, 0], np.zeros((len(path), 2))], axis=1)
    cov = np.tile(np.eye(4), (len(path), 1, 1))
    step = np.eye(4) + DT * np.eye(4, k=2)
    noise = 0.3**2 * np.kron([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]], np.eye(2))
    errors = np.empty(path.shape[:2])
    for epoch in range(EPOCHS):
        if epoch:
            state, cov = state @ step.T, step @ cov @ step.T + noise
        for anchor, z in zip(ANCHORS, ranges[:, epoch].T, strict=True):
            offset = state[:, :2] - anchor[:2]
            predicted = np.hypot(np.linalg.norm(offset, axis=1), HEIGHT - anchor[2])
            H = np.pad(offset / predicted[:, None], ((0, 0), (0, 2)))
            PH = np.einsum("wij,wj->wi", cov, H)
            variance = np.sum(H * PH, axis=1) + SIGMA**2
            used = (z > 0) & ((z - predicted) ** 2 < 9 * variance)
            gain = np.where(used[:, None], PH / variance[:, None], 0.0)
            state = state + gain * (z - predicted)[:, None]
            cov = cov - gain[:, :, None] * PH[:, None]
        errors[:, epoch] = np.linalg.norm(state[:, :2] - path[:, epoch], axis=1)
    return errors


def _tracked(path, ranges):
    """Errors (worlds, EPOCHS), m, of `range_tracker`, and whether its track starts again in an epoch."""
    recordings = [tw.uwb_imu.range_recording(TIMES, z, ANCHORS, height=HEIGHT) for z in ranges]
    estimates = tw.uwb_imu.range_tracker(len(ANCHORS), planar=True).run(recordings)
    by_epoch = (len(path), EPOCHS, len(ANCHORS))
    position = np.stack([np.asarray(p).reshape(by_epoch)[..., -1] for p in estimates.mean.position], axis=-1)
    restarted = (np.asarray(estimates.status) == tw.Status.RESTARTED).reshape(by_epoch).any(axis=2)
    return np.linalg.norm(position - path, axis=2), restarted


def _rates(kind, share, worlds, batch):
    """Median over worlds of RMSE over the gated EKF's, the share of good tracks lost, and of lost ones not found."""
    path, ranges = _worlds_of(kind, share, worlds, jump=True, batch=batch)
    errors, restarted = _tracked(path, ranges)
    good = slice(round(SETTLED_S / DT), round(JUMP_S / DT))
    gated = _gated_errors(path, ranges)[:, good]
    ratio = np.median(np.sqrt(np.mean(errors[:, good] ** 2, axis=1))) / np.median(np.sqrt(np.mean(gated**2, axis=1)))
    found = errors[:, round((JUMP_S + FOUND_S) / DT)] < FOUND_M
    return float(ratio), float(restarted[:, good].any(axis=1).mean()), float(1 - found.mean())


@pytest.mark.parametrize(("kind", "share"), [("both signs", 0.4), ("too long", 0.3)])
def test_wild_ranges_lose_no_track_and_it_is_as_good_as_that_of_a_gated_filter(kind, share):
    path, ranges = _worlds_of(kind, share, 8)
    errors, restarted = (x[:, TIMES >= SETTLED_S] for x in _tracked(path, ranges))
    gated = _gated_errors(path, ranges)[:, TIMES >= SETTLED_S]
    assert not restarted.any()
    assert np.sqrt(np.mean(errors**2)) <= 1.3 * np.median(np.sqrt(np.mean(gated**2, axis=1)))


def test_a_track_that_jumps_by_4_m_among_wild_ranges_is_found_within_2_s():
    errors, _ = _tracked(*_worlds_of("both signs", 0.4, 8, jump=True))
    assert np.all(errors[:, round(JUMP_S / DT)] > 1.0)
    assert np.all(errors[:, round((JUMP_S + FOUND_S) / DT)] < FOUND_M)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_few_of_200_good_tracks_are_lost_and_few_lost_ones_not_found(kind):
    for share in (0.1, 0.3, 0.5):
        rates = np.mean([_rates(kind, share, 50, batch) for batch in range(4)], axis=0)
        ratio, lost, unfound = rates
        print(f"{kind:20s} {share:.1f} RMSE over the gated EKF's {ratio:.2f}, lost {lost:.1%}, not found {unfound:.1%}")
        # Half the anchors wild for a second each leave too few readings to a tracker of any kind.
        assert ratio <= (2.0 if kind == "bursts of an anchor" and share == 0.5 else 1.3)
        assert lost <= 0.03
        assert unfound <= (0.03 if share < 0.5 else 0.15)
